"""A page that shows the map: first-person navigation, drawn live by IPR and the colour field (Sec. IV-D).

The picture is the page's background; the trajectory, the keyframes and the points are drawn over it by the browser.
One thread draws for all pages, the page that waited longest first, small while its camera moves and full when it
rests.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import tempfile
import threading
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sf_interfaces.errors import ConfigError
from sf_interfaces.geometry import se3
from sf_interfaces.io.cloud import write_surface
from sf_interfaces.types import Camera, Float32, Float64, UInt8
from sf_recon.core.reconstruction import Reconstruction
from sf_recon.core.renderer import RenderedView

LAYERS = ("colour", "depth", "uncertainty", "normals")
_MOVING, _RESTING = 240, 480  # px, height of a picture while its camera moves and after
_REST_S = 0.2  # a camera that has not moved for so long rests
_MAX_FRUSTA = 100
_MAX_POINTS = 100_000  # sent to a page
_REFRESH_S = 2.0  # between updates of the overlays while the map grows


def picture(view: RenderedView, layer: str) -> UInt8:
    """A drawn view as the image [H, W, 3] of one layer; normals and uncertainty need a full view."""
    if layer == "colour":
        return view.image
    if layer == "normals":
        assert view.normal is not None
        return np.rint(np.nan_to_num(127.5 * (1 - view.normal))).astype(np.uint8)
    if layer == "depth":
        return _heat(view.depth.z)
    assert view.depth.variance is not None
    heat = _heat(np.sqrt(view.depth.variance))
    return cv2.addWeighted(view.image, 0.4, heat, 0.6, 0)


def _heat(values: Float32) -> UInt8:
    """Values [H, W] from blue (5th percentile) to red (95th); black where NaN."""
    known = np.isfinite(values)
    if not known.any():
        return np.zeros((*values.shape, 3), np.uint8)
    low, high = np.percentile(values[known], [5, 95])
    scaled = np.nan_to_num(np.clip((values - low) / max(high - low, 1e-12), 0, 1))
    out = cv2.cvtColor(cv2.applyColorMap((255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    out[~known] = 0
    return out


class Viewer:
    """Serves the page of one map until :meth:`stop`.

    Args:
        reconstruction: the map; it may grow meanwhile, under ``lock``.
        host: address to listen on; the default is this machine only.
        port: of the page; another free one is taken where it is in use.
        lock: held while the map is read.

    Raises:
        ConfigError: viser is not installed.
    """

    def __init__(
        self,
        reconstruction: Reconstruction,
        host: str = "127.0.0.1",
        port: int = 8080,
        lock: AbstractContextManager[Any] | None = None,
    ) -> None:
        try:
            import viser
        except ImportError as error:
            raise ConfigError(f"the viewer needs viser ({error}); install it with scenefactory[view]") from error
        self._map, self._lock = reconstruction, threading.RLock() if lock is None else lock
        self._pages: dict[int, _Page] = {}
        self._changed = threading.Condition()
        self._stopped = False
        self.pictures = 0
        self._server = viser.ViserServer(host=host, port=port, label="SceneFactory", verbose=False)
        self.url = f"http://{host}:{self._server.get_port()}"
        self._shown = -1
        self._controls()
        self.refresh()
        self._server.on_client_connect(self._open)
        self._server.on_client_disconnect(self._close)
        self._thread = threading.Thread(target=self._draw, name="viewer", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Close the page."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join()
        self._server.stop()

    def refresh(self) -> None:
        """Bring trajectory, keyframes and points up to the state of the map."""
        with self._lock:
            poses = list(self._map.poses.values())
            views = self._map.views
            camera = views[0].camera if views else None
            points = self._map.surface() if self._layers["points"].value or self._shown < 0 else None
        self._shown = len(poses)
        if not poses:
            return
        scene = self._server.scene
        up = -np.mean([T[:3, 1] for T in poses], axis=0)
        scene.set_up_direction(tuple(up / max(float(np.linalg.norm(up)), 1e-9)))
        centres = np.array([T[:3, 3] for T in poses])
        size = max(10 * self._map.resolution, 0.02 * float(np.ptp(centres, axis=0).max(initial=0)))
        if len(centres) > 1:
            segments = np.stack([centres[:-1], centres[1:]], axis=1)
            scene.add_line_segments("/trajectory", points=segments, colors=(250, 120, 30), thickness=size / 20)
        if camera is not None:
            aspect, fov = camera.width / camera.height, 2 * float(np.arctan(camera.height / 2 / camera.fy))
            for index in range(0, len(poses), max(1, len(poses) // _MAX_FRUSTA)):
                self._frustum(index, poses[index], fov, aspect, size)
        if points is not None and len(points):
            step = max(1, len(points) // _MAX_POINTS)
            scene.add_point_cloud(
                "/points", points.points[::step], points.colors[::step], point_size=self._map.resolution
            )
        self._show_layers()
        self._layers["time"].max = max(1, len(poses) - 1)

    def _frustum(self, index: int, T: Float64, fov: float, aspect: float, size: float) -> None:
        self._server.scene.add_camera_frustum(
            f"/keyframes/{index}",
            fov=fov,
            aspect=aspect,
            scale=size,
            color=(60, 140, 250),
            wxyz=_wxyz(T),
            position=T[:3, 3],
        )

    # ---- controls, one set for all pages

    def _controls(self) -> None:
        gui = self._server.gui
        self._layers = {
            "layer": gui.add_dropdown("picture", LAYERS),
            "trajectory": gui.add_checkbox("trajectory", True),
            "keyframes": gui.add_checkbox("keyframes", True),
            "points": gui.add_checkbox("points", False),
            "time": gui.add_slider("keyframe", min=0, max=1, step=1, initial_value=0),
        }
        self._export = gui.add_button("export surface (.ply)")
        self._layers["layer"].on_update(lambda _: self._redraw())
        for name in ("trajectory", "keyframes", "points"):
            self._layers[name].on_update(lambda _: self._show_layers())
        self._layers["time"].on_update(self._travel)
        self._export.on_click(self._send_surface)

    def _show_layers(self) -> None:
        scene = self._server.scene
        for name in ("trajectory", "keyframes", "points"):
            handle = scene.get_handle_by_name(f"/{name}")
            if handle is not None:
                handle.visible = self._layers[name].value

    def _travel(self, event: Any) -> None:
        """The timeline: look from the chosen keyframe."""
        poses = list(self._map.poses.values())
        if event.client is not None and poses:
            _look(event.client, poses[min(int(self._layers["time"].value), len(poses) - 1)])

    def _send_surface(self, event: Any) -> None:
        with self._lock:
            cloud = self._map.surface()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "surface.ply"
            write_surface(path, cloud)
            content = path.read_bytes()
        event.client.send_file_download("surface.ply", content)

    # ---- pages

    def _open(self, client: Any) -> None:
        page = _Page(client)
        poses = list(self._map.poses.values())
        if poses:
            _look(client, poses[-1])

        def moved(_: Any) -> None:
            with self._changed:
                page.moved_at, page.drawn = time.monotonic(), 0
                self._changed.notify()

        client.camera.on_update(moved)
        with self._changed:
            self._pages[client.client_id] = page
            self._changed.notify()

    def _close(self, client: Any) -> None:
        with self._changed:
            self._pages.pop(client.client_id, None)

    def _redraw(self) -> None:
        with self._changed:
            for page in self._pages.values():
                page.drawn = 0
            self._changed.notify()

    # ---- render thread

    def _draw(self) -> None:
        refreshed = time.monotonic()
        while not self._stopped:
            page = self._next()
            if page is not None:
                self._picture(page)
            if time.monotonic() - refreshed > _REFRESH_S and len(self._map.poses) != self._shown:
                self.refresh()
                self._redraw()
                refreshed = time.monotonic()

    def _next(self) -> _Page | None:
        """The page that waits longest for a picture; None after a while without any."""
        with self._changed:
            waiting = [p for p in self._pages.values() if p.due()]
            if not waiting:
                self._changed.wait(_REST_S / 4)
                return None
            return min(waiting, key=lambda p: p.served_at)

    def _picture(self, page: _Page) -> None:
        layer = str(self._layers["layer"].value)
        height = page.height()
        page.drawn, page.served_at = height, time.monotonic()
        camera, T_map_camera = page.camera(height)
        with self._lock:
            view = self._map.render(camera, T_map_camera, full=layer in ("uncertainty", "normals"))
        page.client.scene.set_background_image(picture(view, layer), format="jpeg", jpeg_quality=85)
        self.pictures += 1


class _Page:
    """One browser: what it looks at, and when it was last served."""

    def __init__(self, client: Any) -> None:
        self.client = client
        self.moved_at = time.monotonic()
        self.served_at = 0.0
        self.drawn = 0  # height of the last picture since the camera moved

    def height(self) -> int:
        return _RESTING if time.monotonic() - self.moved_at > _REST_S else _MOVING

    def due(self) -> bool:
        return self.drawn < self.height()

    def camera(self, height: int) -> tuple[Camera, Float64]:
        """Intrinsics for a picture of this height, and T_map_camera."""
        seen = self.client.camera
        focal = height / 2 / np.tan(seen.fov / 2)
        width = int(np.clip(round(height * seen.aspect), 1, 4 * height))
        T = se3.from_quaternion(np.asarray(seen.position), np.roll(np.asarray(seen.wxyz), -1))
        return Camera(width, height, focal, focal, width / 2, height / 2), se3.orthonormalise(T)


def _look(client: Any, T_map_camera: Float64) -> None:
    """Move a page's camera to a pose."""
    with client.atomic():
        client.camera.wxyz = _wxyz(T_map_camera)
        client.camera.position = T_map_camera[:3, 3]


def _wxyz(T: Float64) -> Float64:
    return np.roll(se3.to_quaternion(T)[1], 1)
