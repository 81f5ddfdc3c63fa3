"""Gazebo worlds as textured scenes: every included model's COLLADA visual, placed by the world file."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from sf_bringup.simulate.builder import Light, Scene, SceneBuilder
from sf_bringup.simulate.furniture import material
from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float64

_MAX_SIDE = 1024


def load_world(path: Path) -> Scene:
    """Scene of a ``.world`` file whose models lie in ``../models``; surfaces without a texture get plaster.

    Raises:
        FormatError: the world, a model or its mesh is missing or not readable.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as e:
        raise FormatError(f"{path} is not a readable Gazebo world ({e}); give the path of a .world file") from e
    builder = SceneBuilder(0)
    models: dict[str, list] = {}
    for instance in root.iter("model"):
        uri = instance.findtext("include/uri")
        if uri is None or not uri.startswith("model://"):
            continue
        name = uri.removeprefix("model://").strip("/")
        pose = instance.findtext("pose") or instance.findtext("include/pose")
        builder._pose = _pose(pose)
        if name not in models:
            models[name] = _load_model(builder, path.parent.parent / "models" / name)
        for part in models[name]:
            builder.triangles(*part)
    for x in (-6.0, 0.0, 6.0):
        builder.lights.append(Light((x, 0.0, 2.4), (0.6, 0.58, 0.54), reach=4.0, shadows=x == 0.0))
    return builder.build(ambient=0.6)


def _pose(text: str | None) -> Float64:
    values = [float(v) for v in (text or "0 0 0 0 0 0").split()]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", values[3:6]).as_matrix()
    T[:3, 3] = values[:3]
    return T


def _load_model(builder: SceneBuilder, folder: Path) -> list:
    """Arguments of ``SceneBuilder.triangles`` for every geometry of a model, in metres."""
    import trimesh

    meshes = sorted(p for p in folder.glob("meshes/*") if p.name.lower().endswith("_visual.dae"))
    if not meshes:
        raise FormatError(f"model {folder.name} has no *_visual.dae mesh in {folder}; add it to the models folder")
    parts = []
    for file in meshes:
        unit = re.search(r'<unit[^>]*meter="([^"]+)"', file.read_text(errors="ignore"))
        scale = float(unit.group(1)) if unit else 1.0
        scene = trimesh.load(file, force="scene")
        for node in scene.graph.nodes_geometry:
            T, geometry = scene.graph[node]
            mesh = scene.geometry[geometry]
            corners = (np.asarray(mesh.vertices) @ T[:3, :3].T + T[:3, 3])[mesh.faces] * scale
            n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            length = np.linalg.norm(n, axis=1)
            keep = length > 1e-12
            normals = np.repeat((n[keep] / length[keep, None])[:, None], 3, axis=1)
            texture, tint, uv = _appearance(builder, mesh, corners)
            parts.append((corners[keep], uv[keep], normals, texture, tint, 0.15))
    return parts


def _appearance(builder: SceneBuilder, mesh, corners: Float64) -> tuple[int, tuple, Float64]:  # type: ignore[no-untyped-def]
    """Texture index, tint and uv [T, 3, 2] of a mesh; box-projected plaster where it has no image."""
    look = getattr(mesh.visual, "material", None)
    image = getattr(look, "baseColorTexture", None) or getattr(look, "image", None)
    uv = getattr(mesh.visual, "uv", None)
    if image is not None and uv is not None and len(uv) == len(mesh.vertices):
        pixels = np.asarray(image.convert("RGB"))
        side = min(_MAX_SIDE, 1 << int(np.ceil(np.log2(max(pixels.shape[:2])))))
        square = cv2.resize(pixels, (side, side), interpolation=cv2.INTER_AREA)
        flipped = np.asarray(uv, float) * (1, -1) + (0, 1)
        return builder.textures.add(square), (1.0, 1.0, 1.0), flipped[mesh.faces]
    n = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axes = np.array([[1, 2], [0, 2], [0, 1]])[n.argmax(1)]
    uv = np.take_along_axis(corners, axes[:, None, :].repeat(3, 1), axis=2) / 1.5
    return material(builder, "plaster"), (1.0, 1.0, 1.0), uv
