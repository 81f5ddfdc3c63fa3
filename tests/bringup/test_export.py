"""Every exported format opens with a library that is not ours, and says what the run holds."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
import trimesh
from evo.tools import file_interface
from run_sample import CAMERA, SIGMA, STAMPS, T_BASE_CAMERA, WALL, depth_of, image_of, make_run, poses

from sf_bringup import cli
from sf_bringup.export import FORMATS, export
from sf_bringup.run_folder import RunFolder
from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return make_run(tmp_path_factory.mktemp("sample"))


@pytest.fixture(scope="module")
def out(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    written, left_out = export(run.path, folder, ())
    assert written and not left_out
    return folder


def test_evo_reads_the_three_trajectory_formats(out: Path) -> None:
    tum = file_interface.read_tum_trajectory_file(out / "trajectory.tum")
    euroc = file_interface.read_euroc_csv_trajectory(out / "trajectory.csv")
    kitti = file_interface.read_kitti_poses_file(out / "trajectory.kitti")
    for read in (tum, euroc, kitti):
        np.testing.assert_allclose(np.array(read.poses_se3), poses(), atol=1e-8)
    np.testing.assert_allclose(tum.timestamps, np.array(STAMPS) * 1e-9)
    np.testing.assert_allclose(euroc.timestamps, np.array(STAMPS) * 1e-9)


def test_trajectories_of_other_frames_need_their_mounting(
    run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(run.path, tmp_path, ["tum"], "base_link")
    read = file_interface.read_tum_trajectory_file(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(np.array(read.poses_se3), poses() @ se3.inverse(T_BASE_CAMERA), atol=1e-8)
    with pytest.raises(CalibrationError, match="no transform from 'lidar' to 'camera_optical_frame'"):
        export(run.path, tmp_path, ["tum"], "lidar")
    assert cli.main(["export", str(run.path), "--out", str(tmp_path), "--tum", "--frame", "lidar"]) == 2
    assert "/tf_static" in capsys.readouterr().err


def test_open3d_and_trimesh_read_surface_and_mesh(run: RunFolder, out: Path) -> None:
    cloud = o3d.io.read_point_cloud(str(out / "surface.ply"))
    assert len(cloud.points) == 3000 and cloud.has_colors()
    mesh, glb = trimesh.load(out / "mesh.ply"), trimesh.load(out / "mesh.glb", force="mesh")
    assert len(mesh.faces) == len(glb.faces) == 2
    np.testing.assert_allclose(glb.vertices @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]], mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(glb.visual.vertex_colors, mesh.visual.vertex_colors)
    np.testing.assert_allclose(mesh.area, 4 * 1.6)


def test_depth_images_hold_millimetres_and_variance(out: Path) -> None:
    image = cv2.imread(str(out / "depth" / f"{STAMPS[2]:020d}.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    np.testing.assert_allclose(image, 1000 * depth_of(poses()[2]), atol=0.51)
    with np.load(out / "depth" / f"{STAMPS[2]:020d}.npz") as data:
        np.testing.assert_allclose(data["z"], depth_of(poses()[2]), rtol=1e-6)
        np.testing.assert_allclose(data["variance"], SIGMA**2, rtol=1e-6)


def test_pycolmap_reads_the_model(out: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(str(out / "colmap" / "sparse" / "0"))
    (camera,) = model.cameras.values()
    np.testing.assert_allclose(camera.params, [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy])
    assert model.num_reg_images() == 3 and model.num_points3D() > 500
    for k, image in enumerate(sorted(model.images.values(), key=lambda i: i.name)):
        assert (out / "colmap" / "images" / image.name).is_file()
        np.testing.assert_allclose(image.cam_from_world().matrix(), se3.inverse(poses()[2 * k])[:3], atol=1e-9)
        seen = image.get_observation_points2D()
        assert len(seen) > 500
        for point in seen[::50]:
            world = model.points3D[point.point3D_id]
            assert world.xyz[2] == pytest.approx(WALL)
            np.testing.assert_allclose(image.project_point(world.xyz), point.xy, atol=0.01)


def test_the_mvsnet_layout_projects_the_wall_where_the_image_shows_it(out: Path) -> None:
    folder = out / "mvsnet"
    lines = (folder / "cams" / f"{STAMPS[4]:020d}_cam.txt").read_text().split()
    assert lines[0] == "extrinsic" and lines[17] == "intrinsic"
    T, K = np.array(lines[1:17], float).reshape(4, 4), np.array(lines[18:27], float).reshape(3, 3)
    pixel = K @ se3.transform(T, np.array([0.1, 0.05, WALL]))
    uv, _ = CAMERA.project(se3.transform(se3.inverse(poses()[4]), np.array([0.1, 0.05, WALL])))
    np.testing.assert_allclose(pixel[:2] / pixel[2], uv - 0.5, atol=1e-4)
    low, step, count, high = map(float, lines[27:31])
    assert low < 1.9 and high > WALL and low + step * (count - 1) == pytest.approx(high, rel=1e-4)
    pairs = (folder / "pair.txt").read_text().splitlines()
    assert pairs[0] == "3" and pairs[2].split()[0] == "2" and {p.split()[1] for p in pairs[2::2]} == {"1", "0"}


def test_transforms_json_has_opengl_axes(out: Path) -> None:
    document = json.loads((out / "nerfstudio" / "transforms.json").read_text())
    assert (document["fl_x"], document["cx"], document["w"]) == (CAMERA.fx, CAMERA.cx, CAMERA.width)
    for k, frame in enumerate(document["frames"]):
        T = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(T[:3, 3], poses()[2 * k][:3, 3], atol=1e-8)
        np.testing.assert_allclose(-T[:3, 2], poses()[2 * k][:3, 2], atol=1e-8)  # it looks along -z
        image = cv2.imread(str(out / "nerfstudio" / frame["file_path"]))
        np.testing.assert_array_equal(image[..., ::-1], image_of(poses()[2 * k]))
        assert (out / "nerfstudio" / frame["depth_file_path"]).is_file()


def test_what_a_run_lacks_is_said(run: RunFolder, tmp_path: Path) -> None:
    bare = RunFolder(tmp_path / "bare")
    bare.path.mkdir()
    for name in ("run.json", "trajectory.tum"):
        (bare.path / name).write_bytes((run.path / name).read_bytes())
    written, left_out = export(bare.path, tmp_path / "some", ())
    assert {p.name for p in written} == {"trajectory.tum", "trajectory.kitti", "trajectory.csv"}
    assert set(left_out) == set(FORMATS) - {"tum", "kitti", "euroc"} and "mesh" in left_out["glb"]
    with pytest.raises(FormatError, match="--goal recon"):
        export(bare.path, tmp_path / "some", ["ply"])
