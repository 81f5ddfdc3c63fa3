"""Ray casting and shading: colour and exact depth of a scene from a pinhole camera.

One ray goes through every pixel centre; textures are filtered by their footprint, and only pixels on an
edge of geometry or shadow are supersampled: a fraction of the work of supersampling everything.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from sf_bringup.simulate.builder import Light, Scene
from sf_interfaces.types import Camera, Float32, Float64, UInt8

_SHADOW_BIAS = 2e-3  # relative to the distance of the hit; keeps a surface from shadowing itself


@dataclass(frozen=True)
class Hits:
    """What rays met: distance [N] (inf = nothing), triangle [N], barycentric uv [N, 2]."""

    distance: Float32
    triangle: NDArray[np.int64]
    barycentric: Float32


class Renderer:
    """Casts rays into one scene."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._caster = o3d.t.geometry.RaycastingScene(nthreads=2)
        vertices = np.ascontiguousarray(scene.corners.reshape(-1, 3))
        triangles = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
        self._caster.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
        self._face_normal, self._density = _triangle_properties(scene)

    def cast(self, origins: Float64, directions: Float64) -> Hits:
        """First hits of rays: origins [N, 3] or [3] m, unit directions [N, 3], world frame."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origins, directions
        out = self._caster.cast_rays(o3d.core.Tensor(rays))
        triangle = out["primitive_ids"].numpy().astype(np.int64)
        triangle[triangle == o3d.t.geometry.RaycastingScene.INVALID_ID] = -1
        return Hits(out["t_hit"].numpy(), triangle, out["primitive_uvs"].numpy())

    def face_normals(self, triangle: NDArray[np.int64]) -> Float32:
        """Geometric unit normals [N, 3] of triangles."""
        return self._face_normal[triangle]

    def clearance(self, points: Float64) -> Float32:
        """Distance [N] m from points [N, 3] of the world to the nearest surface."""
        return self._caster.compute_distance(o3d.core.Tensor(np.asarray(points, np.float32))).numpy()

    def render(self, camera: Camera, T_map_camera: Float64, supersampling: int = 2) -> tuple[UInt8, Float32]:
        """Image [H, W, 3] and exact depth z [H, W] m (NaN = sky), with n x n rays on edges."""
        pixels = camera.pixel_grid().reshape(-1, 2)
        shape = (camera.height, camera.width)
        hits, directions, slant = self._trace(camera, T_map_camera, pixels)
        colour, shadow = self._shade(hits, T_map_camera[:3, 3], directions, slant / camera.fx)
        z = np.where(np.isfinite(hits.distance), hits.distance / slant, np.nan).astype(np.float32)
        if supersampling > 1:
            edge = self._edges(hits, z.reshape(shape), shadow.reshape(shape)).ravel()
            offsets = (np.arange(supersampling) + 0.5) / supersampling - 0.5
            dv, du = (g.ravel() for g in np.meshgrid(offsets, offsets, indexing="ij"))
            fine = (pixels[edge][:, None] + np.stack([du, dv], -1)).reshape(-1, 2)
            fine_hits, fine_directions, fine_slant = self._trace(camera, T_map_camera, fine)
            samples, _ = self._shade(
                fine_hits, T_map_camera[:3, 3], fine_directions, fine_slant / camera.fx / supersampling
            )
            colour[edge] = samples.reshape(-1, supersampling**2, 3).mean(1)
        image = np.clip(colour * 255 + 0.5, 0, 255).astype(np.uint8)
        return image.reshape(*shape, 3), z.reshape(shape)

    def _trace(self, camera: Camera, T: Float64, pixels: Float64) -> tuple[Hits, Float32, Float32]:
        rays = camera.unproject(pixels, np.ones(len(pixels)))
        slant = np.linalg.norm(rays, axis=1)
        directions = (rays / slant[:, None]) @ T[:3, :3].T
        hits = self.cast(T[:3, 3], directions)
        return hits, directions.astype(np.float32), slant.astype(np.float32)

    def _edges(self, hits: Hits, z: Float32, shadow: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Pixels whose neighbour shows another surface: normal, texture or shadow change, or depth jumps."""
        shape = z.shape
        normal = self._face_normal[hits.triangle].reshape(*shape, 3)
        texture = np.where(hits.triangle < 0, -1, self.scene.texture[hits.triangle]).reshape(shape)
        tint = self.scene.tint[hits.triangle].sum(-1).reshape(shape)
        near = np.nan_to_num(1 / z)
        edge = np.zeros(shape, bool)
        for a, b in (
            ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
            ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
        ):
            jump = np.abs(near[a] - near[b]) > 0.04 * np.maximum(near[a], near[b])
            change = (texture[a] != texture[b]) | (shadow[a] != shadow[b]) | (tint[a] != tint[b])
            change |= jump | (np.einsum("hwc,hwc->hw", normal[a], normal[b]) < 0.9)
            edge[a] |= change
            edge[b] |= change
        return edge

    def _shade(
        self, hits: Hits, eye: Float64, directions: Float32, pixel_angle: Float32
    ) -> tuple[Float32, NDArray[np.bool_]]:
        """Colours [N, 3] in 0..1 and which samples lie in the shadow of the shadow-casting light."""
        s = self.scene
        colour = _sky(directions) if s.outdoor else np.zeros_like(directions)
        shadow = np.zeros(len(directions), bool)
        found = np.flatnonzero(hits.triangle >= 0)
        tri, t, view = hits.triangle[found], hits.distance[found], directions[found]
        b = hits.barycentric[found]
        w = np.stack([1 - b[:, 0] - b[:, 1], b[:, 0], b[:, 1]], -1)[:, :, None]
        facing = np.einsum("nc,nc->n", self._face_normal[tri], view)
        normal = (s.normals[tri] * w).sum(1)
        normal *= (np.sign(-facing) / np.maximum(np.linalg.norm(normal, axis=1), 1e-6))[:, None]
        # geometric mean of the footprint's axes, leaning towards the long one: sharp, yet no shimmer
        footprint = t * pixel_angle[found] * np.maximum(np.abs(facing), 0.04) ** -0.65
        texture = s.texture[tri]
        texels = footprint * self._density[tri]
        uv = (s.uv[tri] * w).sum(1)
        albedo = s.textures.sample(texture, uv, np.log2(np.maximum(texels, 1e-6)).astype(np.float32))
        albedo *= s.tint[tri]
        point = eye.astype(np.float32) + view * t[:, None]
        light, shine, dark = self._lighting(point, normal, view, s.gloss[tri], t)
        colour[found] = _tone(albedo * light + shine)
        shadow[found] = dark
        return colour, shadow

    def _lighting(
        self, point: Float32, normal: Float32, view: Float32, gloss: Float32, t: Float32
    ) -> tuple[Float32, Float32, NDArray[np.bool_]]:
        s = self.scene
        light = np.repeat((s.ambient * (0.8 + 0.2 * normal[:, 2]))[:, None], 3, axis=1)
        shine = np.zeros_like(light)
        dark = np.zeros(len(point), bool)
        for lamp in s.lights:
            towards, distance, strength = _reach(lamp, point)
            lambert = np.maximum(np.einsum("nc,nc->n", normal, towards), 0)
            half = towards - view
            half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-6)
            phong = gloss * np.maximum(np.einsum("nc,nc->n", normal, half), 0) ** 32 * (lambert > 0)
            if lamp.shadows:
                start = point + normal * (_SHADOW_BIAS * (1 + t))[:, None]
                hit = self.cast(start, towards).distance
                dark = (hit < distance * 0.97) & (lambert > 0)
                strength = strength * np.where(dark, np.float32(0.15), np.float32(1))
            colour = np.asarray(lamp.colour, np.float32)
            light += (lambert * strength)[:, None] * colour
            shine += (phong * strength)[:, None] * colour
        return light, shine, dark


def _reach(lamp: Light, point: Float32) -> tuple[Float32, Float32, Float32]:
    """Unit direction to the lamp [N, 3], distance [N] m and fall-off [N]."""
    if np.isinf(lamp.reach):
        d = np.asarray(lamp.position, np.float32)
        far = np.full(len(point), np.inf, np.float32)
        return np.broadcast_to(d / np.linalg.norm(d), point.shape), far, np.ones(len(point), np.float32)
    to = np.asarray(lamp.position, np.float32) - point
    distance = np.linalg.norm(to, axis=1)
    strength = 1 / (1 + (distance / np.float32(lamp.reach)) ** 2)
    return to / np.maximum(distance, 1e-6)[:, None], distance, strength


def _tone(colour: Float32) -> Float32:
    """Soft shoulder above 0.8, so that highlights keep their texture."""
    over = np.maximum(colour - 0.8, 0)
    return np.where(colour > 0.8, 0.8 + over / (1 + over / 0.2), colour)


def _sky(directions: Float32) -> Float32:
    """Blue gradient with soft clouds that depend on direction alone (they are infinitely far)."""
    up = np.maximum(directions[:, 2], 0)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    cloud = np.zeros_like(up)
    for k, (a, e) in enumerate(((3, 9), (7, 16), (13, 31), (29, 60))):
        cloud += np.sin(a * azimuth + 1.7 * k + 3 * np.sin(e * up + k)) * np.sin(e * up + 2.1 * k) / (k + 1.5)
    base = np.array([0.78, 0.86, 0.95], np.float32) - up[:, None] * np.array([0.45, 0.35, 0.12], np.float32)
    return np.clip(base + 0.12 * cloud[:, None], 0, 0.98).astype(np.float32)


def _triangle_properties(scene: Scene) -> tuple[Float32, Float32]:
    """Face normals [T, 3] and texel density [T] (texels per metre)."""
    c = scene.corners.astype(np.float64)
    n = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
    area = np.linalg.norm(n, axis=1)
    a, b = (scene.uv[:, 1] - scene.uv[:, 0]).astype(float), (scene.uv[:, 2] - scene.uv[:, 0]).astype(float)
    uv_area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    density = np.sqrt(uv_area / np.maximum(area, 1e-12)) * scene.textures.sizes(scene.texture)
    return (n / np.maximum(area, 1e-12)[:, None]).astype(np.float32), density.astype(np.float32)
