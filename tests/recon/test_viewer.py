"""The viewer's page in a real browser, and its pictures without one."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sf_recon.core.reconstruction import Reconstruction
from sf_recon.core.viewer import LAYERS, Viewer, picture
from tests.recon.scene import CAMERA, view

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytest.importorskip("viser")


def test_every_layer_is_a_picture(room: Reconstruction) -> None:
    drawn = room.render(CAMERA, view(3).T_map_camera, full=True)
    pictures = [picture(drawn, layer) for layer in LAYERS]
    assert all(p.shape == (120, 160, 3) and p.dtype == np.uint8 and p.std() > 5 for p in pictures)
    assert len({p.tobytes() for p in pictures}) == len(LAYERS)


class Browser:
    """A headless Chromium driven over its debugging socket."""

    def __init__(self, profile: Path) -> None:
        from websockets.sync.client import connect

        assert BROWSER is not None
        flags = ["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--remote-debugging-port=0"]
        flags += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=640,480"]
        self._process = subprocess.Popen(
            [BROWSER, *flags, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        told = profile / "DevToolsActivePort"
        deadline = time.monotonic() + 60
        while not (told.is_file() and len(told.read_text().splitlines()) == 2):
            assert time.monotonic() < deadline and self._process.poll() is None, "the browser did not start"
            time.sleep(0.1)
        port = told.read_text().splitlines()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(t for t in json.load(answer) if t["type"] == "page")
        self._socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self._count, self.errors = 0, []
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("id") == self._count:
                return message["result"]
            self._listen(message)

    def _listen(self, event: dict[str, Any]) -> None:
        params = event.get("params", {})
        match event.get("method"):
            case "Runtime.exceptionThrown":
                self.errors.append(str(params["exceptionDetails"]))
            case "Log.entryAdded" if params["entry"]["level"] == "error":
                self.errors.append(str(params["entry"]))
            case "Runtime.consoleAPICalled" if params["type"] == "error":
                self.errors.append(str(params["args"]))

    def screenshot(self) -> np.ndarray:
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(int)

    def drag(self, x: int, y: int, dx: int, dy: int) -> None:
        common = {"button": "left", "clickCount": 1}
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **common)
        for step in range(1, 11):
            at = {"x": x + dx * step // 10, "y": y + dy * step // 10}
            self.call("Input.dispatchMouseEvent", type="mouseMoved", **at, **common, buttons=1)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x + dx, y=y + dy, **common)

    def close(self) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(20)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    if BROWSER is None:
        pytest.skip("no Chromium on this machine (Debian package chromium)")
    made = Browser(tmp_path / "profile")
    yield made
    made.close()


def wait_for(condition: Any, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "the page did not come that far in time"
        time.sleep(0.2)


@pytest.mark.slow
def test_page_loads_and_follows_the_mouse(room: Reconstruction, browser: Browser) -> None:
    viewer = Viewer(room, port=0)
    try:
        assert viewer.url.startswith("http://127.0.0.1:")
        browser.call("Page.navigate", url=viewer.url)
        wait_for(lambda: viewer.pictures > 0)

        def settled() -> np.ndarray:
            before = viewer.pictures
            wait_for(lambda: all(not p.due() and p.drawn for p in viewer._pages.values()))
            time.sleep(2)
            assert viewer.pictures >= before
            return browser.screenshot()

        first = settled()
        assert first[:, :400].std() > 20  # a picture, not a blank page
        browser.drag(200, 300, 120, 20)
        second = settled()
        assert (np.abs(second - first)[:, :400].max(axis=2) > 25).mean() > 0.2
        assert browser.errors == []
    finally:
        viewer.stop()
