"""The reconstruction node: keyframes with depth in; the surface, rendered views and the map out.

Lossless, the worker does everything in the order of the input, like the line in one process. Live, the worker
places keyframes, a second thread learns and a third one draws (Sec. III-D); a fair lock passes the map between them.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
import threading
import time
from pathlib import Path
from typing import Any, ClassVar

from sf_interfaces import topics
from sf_interfaces.corrections import Correction
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.io.atomic import replace_file
from sf_interfaces.io.paths import inside
from sf_interfaces.ros import messages
from sf_interfaces.ros.calls import forwarded
from sf_interfaces.ros.inbox import Inbox
from sf_interfaces.ros.keyframes import KeyframeSource
from sf_interfaces.ros.node import BlockNode
from sf_interfaces.ros.process import run
from sf_interfaces.types import Camera, Keyframe, PointCloud
from sf_recon.config import ReconConfig
from sf_recon.core.learner import FairLock, Learner
from sf_recon.core.reconstruction import Reconstruction

_SNAPSHOT_KEYFRAMES = 15  # upstream keeps twice as many for a restarted node
_SNAPSHOT_S = 30.0  # after so long also fewer are saved


class ReconNode(BlockNode):
    """Surface, colour and renderer (Sec. III-D)."""

    short: ClassVar[str] = "recon"
    config_class: ClassVar[type] = ReconConfig
    defaults: ClassVar[dict[str, Any]] = {"source": "tracking"}

    def __init__(self) -> None:
        from sf_interfaces.srv import RenderView, SaveMap

        super().__init__()
        self.service(RenderView, "render_view", forwarded(self, "render"))
        self.service(SaveMap, "save_map", forwarded(self, "save"))

    def setup(self) -> None:
        """The reconstruction and its keyframes."""
        self.leader = ""
        saved = self.snapshot("recon.sfmap")
        self._reconstruction = (
            Reconstruction(self.config()) if saved is None else Reconstruction.load(saved, self.config().device)
        )
        self._source = KeyframeSource(self, landmarks=False)
        self._source.announces({"image", "camera_info", "pose", "state", "depth"})
        self._unsaved, self._resumed, self._saved_s = 0, saved is not None, time.monotonic()
        self._camera: Camera | None = None
        self._last_ns = 0
        self._lock = FairLock()
        self._learner: Learner | None = None
        self._drawer: threading.Thread | None = None
        if not self.options.lossless:
            self._learner = Learner(self._reconstruction, self._lock)
            self._jobs = Inbox(lambda kind, job, reason: self.health.drop(reason))
            self._drawer = threading.Thread(target=self._draw, name="drawer", daemon=True)
            self._drawer.start()
        if self.config().view_port:
            page = self._reconstruction.serve("127.0.0.1", self.config().view_port, self._lock)
            self.get_logger().info(f"the map is shown at {page.url}")
        self.listen(topics.VIEW_POSE, "view", 1)
        for topic in (topics.SURFACE, topics.VIEW_IMAGE, topics.VIEW_DEPTH):
            self.output(topic)
        if self._resumed:
            self._publish_surface(self._reconstruction.surface())

    def take(self, kind: str, msg: Any) -> None:
        """Add keyframes; render and save between them."""
        match kind:
            case "view" | "render" if self._drawer is not None:
                self._jobs.put(kind, msg, 1 if kind == "view" else None)
            case "view" | "render":
                self._draw_one(kind, msg)
            case "save":
                msg.answer(self._save_service)
            case "snapshot":
                self._snapshot()
            case _:
                for keyframe in self._source.push(kind, msg):
                    self.guarded(lambda keyframe=keyframe: self._add(keyframe))  # type: ignore[misc]

    def finish(self) -> None:
        """Final training, the whole surface, and the files."""
        for keyframe in self._source.end():
            self.guarded(lambda keyframe=keyframe: self._add(keyframe))  # type: ignore[misc]
        self._correct(self._source.correction())
        if self._drawer is not None:
            self._jobs.end()
            self._drawer.join()
            self._drawer = None
        if self._learner is not None:
            self._learner.stop()
            if self.out is not None:
                self._learner.write_timing(self.out / "timing.json")
        if self._camera is None and not self._resumed:
            self.health.error("nothing was reconstructed: no keyframe with depth arrived")
            return
        if self.out is not None and not self.options.lossless:
            self._save(self.out)  # whoever stops a live line may not wait for the last training
        with self._lock:
            self._reconstruction.finish()
            surface = self._reconstruction.surface()
        self._publish_surface(surface)
        if self.out is not None:
            self._save(self.out)

    def refresh(self) -> None:
        """Why input was dropped; where keyframes are rare, their snapshot is due by the clock."""
        if not self.leader:
            return
        self.health.set_drops(self._source.reasons)
        self.health.waiting(self._source.waiting_for)
        if self._unsaved and not self.options.lossless and time.monotonic() - self._saved_s > _SNAPSHOT_S:
            self._saved_s = time.monotonic()
            self.enqueue("snapshot", None)

    def _add(self, keyframe: Keyframe) -> None:
        self._source.announce(keyframe)
        if keyframe.depth is None:
            self.health.drop("keyframe without any depth")
            return
        self._correct(self._source.correction(keyframe.stamp_ns))
        if self._learner is None:
            with self._lock:
                added = self._reconstruction.add(keyframe)
        else:
            came = time.monotonic()
            with self._lock:
                placed = self._reconstruction.place(keyframe)
                added = self._reconstruction.colored(placed, keyframe.stamp_ns)
            self._learner.arrived(keyframe.stamp_ns, came)
        self._camera, self._last_ns = keyframe.camera, keyframe.stamp_ns
        self.health.count("keyframes")
        self.health.count("points", len(added))
        self._publish_surface(added)
        self.sent(keyframe.stamp_ns)
        self._unsaved += 1
        if self._unsaved >= _SNAPSHOT_KEYFRAMES:
            self._snapshot()

    def _snapshot(self) -> None:
        """Save what a successor goes on from."""
        path = self.state("recon.sfmap")
        if path is None or not self._unsaved:
            return
        with self._lock, replace_file(path) as draft:
            self._reconstruction.save(draft)
        self._source.done(self._last_ns)
        self._unsaved, self._saved_s = 0, time.monotonic()

    def _correct(self, correction: Correction | None) -> None:
        """Let the map follow corrected keyframes; a live map is then published as a whole."""
        if correction is None:
            return
        with self._lock:
            self._reconstruction.correct(correction)
            surface = None if self._learner is None else self._reconstruction.surface()
        self.health.count("corrections")
        if surface is not None:
            self._publish_surface(surface)

    def _publish_surface(self, cloud: PointCloud) -> None:
        placed = PointCloud(cloud.points, cloud.colors, stamp_ns=self._last_ns, frame_id="map")
        self.output(topics.SURFACE).publish(messages.encode_cloud(messages.rclpy_factory, placed))

    def _save(self, folder: Path) -> list[Path]:
        with self._lock:
            return self._reconstruction.save_products(folder)

    # ---- drawing: in a thread of its own when live

    def _draw(self) -> None:
        while True:
            job = self._jobs.get()
            if job is None:
                continue
            if job[0] == Inbox.END:
                return
            self.guarded(lambda job=job: self._draw_one(*job))  # type: ignore[misc]

    def _draw_one(self, kind: str, msg: Any) -> None:
        if kind == "view":
            self._view(msg)
        else:
            msg.answer(self._render_service)

    def _view(self, msg: Any) -> None:
        wanted = [topic for topic in (topics.VIEW_IMAGE, topics.VIEW_DEPTH) if self.wanted(topic)]
        if self._camera is None or not wanted:
            return
        image, depth = self._render(self._camera, msg)
        for topic, sent in ((topics.VIEW_IMAGE, image), (topics.VIEW_DEPTH, depth)):
            if topic in wanted:
                self.output(topic).publish(sent)

    def _render(self, camera: Camera, pose: Any) -> tuple[Any, Any]:
        stamp_ns, _, T_map_camera = messages.decode_pose(pose)
        with self._lock:
            view = self._reconstruction.render(camera, T_map_camera)
        image = messages.encode_image(messages.rclpy_factory, view.image, stamp_ns, camera.frame_id)
        return image, messages.encode_depth(messages.rclpy_factory, view.depth, stamp_ns, camera.frame_id)

    # ---- services, answered by the worker

    def _render_service(self, request: Any, response: Any) -> None:
        if self._camera is not None:
            camera, _ = messages.decode_camera_info(request.camera_info)
            response.image, response.depth = self._render(camera, request.pose)

    def _save_service(self, request: Any, response: Any) -> None:
        if self._camera is None and not self._resumed:
            response.message = "nothing is reconstructed yet; call again after the first keyframe"
            return
        try:
            folder = inside(self.out, request.directory)
            folder.mkdir(parents=True, exist_ok=True)
            response.paths = [str(path) for path in self._save(folder)]
            response.success = True
        except (OSError, SceneFactoryError) as error:
            response.message = f"cannot save to '{request.directory}': {error}"


def main() -> int:
    """Run the node."""
    return run(ReconNode)


if __name__ == "__main__":
    sys.exit(main())
