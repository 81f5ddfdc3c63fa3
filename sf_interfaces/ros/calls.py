"""Service calls that a node's worker answers: it alone touches the core, the executor only waits."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.task import Future

from sf_interfaces.ros.node import BlockNode


@dataclass(frozen=True, slots=True)
class Call:
    """A service call on its way to the worker."""

    request: Any
    response: Any
    done: Future

    def answer(self, serve: Callable[[Any, Any], None]) -> None:
        """Let ``serve(request, response)`` fill in the response, and send it whatever happens."""
        try:
            serve(self.request, self.response)
        finally:
            self.done.set_result(self.response)


def forwarded(node: BlockNode, kind: str) -> Any:
    """The callback of a service whose calls reach ``node.take`` as jobs of a kind."""

    async def call(request: Any, response: Any) -> Any:
        worker = node._worker
        if worker is None or not worker.is_alive():
            # Before activation and after the end of the stream there is no worker, and the core is free.
            job = Call(request, response, Future())
            node.take(kind, job)
            return response
        job = Call(request, response, Future(executor=node.executor))
        node.enqueue(kind, job)
        return await job.done

    return call
