"""What the user points at becomes one bag: calibration with a lens, poses, broken files, cheap plans."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from sf_bringup.cli import main
from sf_bringup.inputs import readout_of
from sf_bringup.lenses import image_decoder
from sf_bringup.planner import plan
from sf_bringup.run_folder import RunFolder
from sf_bringup.runner import RunRequest, prepare, with_shutter
from sf_interfaces.blocks import Quantity, load_blocks
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.calibration import read_camera
from sf_interfaces.io.datasets import ReadOptions, SevenScenes
from sf_interfaces.io.sequence_writer import SHUTTER, SequenceWriter
from sf_interfaces.ros.messages import decode_image
from sf_interfaces.ros.sensors import SensorInputs
from sf_interfaces.sync import SyncConfig
from sf_interfaces.types import Frame
from tests.interfaces import layouts

SIZE, K = (160, 120), np.array([[120.0, 0, 79.5], [0, 120.0, 59.5], [0, 0, 1]])
LENSES = {
    "plumb_bob": [-0.3, 0.1, 0.001, -0.002, 0.0],
    "rational_polynomial": [-0.2, 0.05, 0.001, 0.0, 0.0, 0.1, 0.0, 0.0],
    "equidistant": [0.05, -0.02, 0.0, 0.0],
}
POINTS = np.array([[x, y, 1.0] for x in (-0.45, -0.15, 0.2, 0.5) for y in (-0.3, 0.05, 0.35)])


def distorted_pixels(model: str, points: np.ndarray) -> np.ndarray:
    """Where OpenCV projects points; pixel centres at integers."""
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    points = points.reshape(-1, 1, 3)
    return project(points, np.zeros(3), np.zeros(3), K, np.array(LENSES[model]))[0].reshape(-1, 2)


def photo(pixels: np.ndarray) -> np.ndarray:
    """White dots with a Gaussian profile on black."""
    v, u = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    squared = ((u[..., None] - pixels[:, 0]) ** 2 + (v[..., None] - pixels[:, 1]) ** 2).min(-1)
    return np.repeat((255 * np.exp(-squared / 8)).astype(np.uint8)[..., None], 3, axis=2)


def calibration(path: Path, model: str, size: tuple[int, int] = SIZE) -> Path:
    document = {
        "image_width": size[0],
        "image_height": size[1],
        "camera_name": "narrow",
        "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(LENSES[model]), "data": LENSES[model]},
    }
    path.write_text(yaml.safe_dump(document))
    return path


KINDS = {
    "/camera/color/image_raw": "image",
    "/camera/color/camera_info": "camera_info",
    "/camera/depth/image_raw": "depth",
    "/lidar/points": "lidar",
    "/sf/pose": "pose",
    "/tf_static": "tf_static",
}


def frames(bag: Path) -> list[Frame]:
    """What a line would get; nothing may be dropped."""
    with BagReader(bag) as reader:
        kinds = {topic: kind for topic, kind in KINDS.items() if topic in reader.topics}
        streams = {kind: kind in kinds.values() for kind in ("depth", "lidar", "pose")}
        inputs = SensorInputs(SyncConfig(**streams), lossless=True)
        for raw in reader.messages(list(kinds)):
            inputs.push(kinds[raw.topic], reader.decode(raw))
    inputs.assembler.end()
    found = list(inputs.assembler.ready())
    assert inputs.assembler.reasons == {}
    return found


@pytest.mark.parametrize("model", LENSES)
def test_a_given_calibration_takes_the_lens_out_once(model: str, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for i in range(2):
        cv2.imwrite(str(folder / f"{i}.png"), photo(distorted_pixels(model, POINTS)))
    given, _ = prepare(RunRequest((folder,), out=tmp_path / "out", calibration=calibration(tmp_path / "c.yaml", model)))
    assert {Quantity.IMAGE, Quantity.INTRINSICS} == given.mapping.available
    straight = POINTS[:, :2] * 120.0 + [79.5, 59.5]
    one, _ = frames(given.bag)
    assert one.camera is not None and one.camera.frame_id == "camera_optical_frame"
    inside = ((straight > 6) & (straight < np.array(SIZE) - 6)).all(axis=1)
    assert inside.sum() >= 8
    for u, v in straight[inside]:
        x, y = round(u), round(v)
        patch = one.image[y - 5 : y + 6, x - 5 : x + 6, 0].astype(float)
        rows, columns = np.mgrid[y - 5 : y + 6, x - 5 : x + 6]
        found = (patch * columns).sum() / patch.sum(), (patch * rows).sum() / patch.sum()
        np.testing.assert_allclose(found, (u, v), atol=0.35)  # the lens moved it by up to 7 px
    assert np.abs(distorted_pixels(model, POINTS)[inside] - straight[inside]).max() > 2


def test_references_in_the_input_are_freed_from_the_lens_as_its_images_are(tmp_path: Path) -> None:
    folder, run = tmp_path / "photos", RunFolder(tmp_path / "run")
    for path in (folder, run.path):
        path.mkdir()
    cv2.imwrite(str(folder / "0.png"), photo(distorted_pixels("plumb_bob", POINTS)))
    lens = calibration(tmp_path / "c.yaml", "plumb_bob")
    given, _ = prepare(RunRequest((folder,), out=tmp_path / "out", calibration=lens))
    (run.path / "run.json").write_text(json.dumps({"topics": dict(given.mapping.roles)}))
    with BagReader(given.bag) as reader:
        raw = reader.decode(next(iter(reader.messages(["/camera/color/image_raw"]))))
    freed = image_decoder(run, given.bag)(raw)
    np.testing.assert_array_equal(freed, frames(given.bag)[0].image)
    assert (freed != decode_image(raw)).any()


def test_a_calibration_of_another_size_or_model_is_refused(tmp_path: Path) -> None:
    folder = layouts.photos(tmp_path / "photos", 2)
    path = calibration(tmp_path / "c.yaml", "plumb_bob")
    with pytest.raises(CalibrationError, match="160x120, but the images"):
        prepare(RunRequest((folder,), out=tmp_path / "out", calibration=path))
    path.write_text(path.read_text().replace("plumb_bob", "thin_prism"))
    with pytest.raises(CalibrationError, match=r"c\.yaml.*thin_prism"):
        read_camera(path)
    path.write_text("image_width: 3\n")
    with pytest.raises(CalibrationError, match=r"camera_matrix\.data"):
        read_camera(path)


def test_poses_of_a_data_set_and_of_a_bag_become_input_on_request(tmp_path: Path) -> None:
    folder = layouts.strecha(tmp_path / "set", 3)
    for path in (folder, tmp_path / "out" / "input.mcap"):
        request = RunRequest((path,), out=tmp_path / "out")
        assert Quantity.GIVEN_POSE not in prepare(request)[0].mapping.available
        posed = RunRequest((path,), out=tmp_path / "posed", reading=ReadOptions(use_poses=True))
        assert Quantity.GIVEN_POSE in prepare(posed)[0].mapping.available


@pytest.mark.parametrize(
    ("folder", "count", "posed"),
    [
        ("lidarcompletion_kitti2015_a", 4, False),
        ("mvd_robustmvd_sample", 7, True),
        ("mvs_strecha_fountain_P11", 11, True),
        ("rgbd_7scenes_redkitchen_000_199", 5, True),
        ("rgbl_kitti_odometry04_000_017", 18, True),
    ],
)
def test_every_frame_of_a_real_recording_reaches_a_line(
    folder: str, count: int, posed: bool, shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    reading = ReadOptions(use_poses=posed, limit=count)
    given, _ = prepare(RunRequest((shared_data(folder),), out=tmp_path, reading=reading))
    found = frames(given.bag)
    assert len(found) == count and all((frame.T_map_camera is not None) == posed for frame in found)
    depths = [frame.sparse_depth for frame in found] if "lidar" in given.mapping.roles else []
    assert all(sparse is not None and len(sparse) > 10_000 for sparse in depths)
    if "depth" in given.mapping.roles:
        assert all(frame.depth is not None and frame.depth.density > 0.6 for frame in found)


def test_plan_reads_only_the_first_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = layouts.scannet(tmp_path / "set", 6)
    for name in ("color/40.jpg", "depth/40.png", "pose/40.txt"):
        (folder / name).write_text("broken")
    assert main(["plan", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["line"] == ["tracking", "recon"]
    assert main(["convert", str(folder), str(tmp_path / "o.mcap")]) == 2
    assert "40." in capsys.readouterr().err and not list(tmp_path.glob("*.mcap"))
    assert main(["convert", str(folder), str(tmp_path / "o.mcap"), "--skip-bad", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert main(["convert", str(folder), str(tmp_path / "o.bag")]) == 2
    assert main(["convert", str(tmp_path / "o.mcap"), str(tmp_path / "p.mcap")]) == 2
    assert "must end in .mcap" in (err := capsys.readouterr().err) and "a bag already" in err
    assert (said["frames"], said["skipped"]) == (5, 1) and "40." in said["reasons"][0]
    assert main(["convert", str(folder), str(tmp_path / "q.mcap"), "--limit", "3", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 3
    assert main(["convert", str(folder), str(tmp_path / "r.mcap"), "--limit", "0"]) == 2


def test_frames_without_order_get_the_goal_that_suits_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for make, options, line in (
        (layouts.kitti_stereo, [], ["depth:complete"]),
        (layouts.photos, [], ["depth:mvd"]),
        (layouts.strecha, ["--use-poses"], ["depth:posed", "recon"]),
        (layouts.kitti_stereo, ["--goal", "tracking"], ["tracking"]),
    ):
        folder = make(tmp_path / make.__name__ / str(len(options)), 3)
        assert main(["plan", str(folder), "--json", *options]) == 0
        assert json.loads(capsys.readouterr().out)["line"] == line


def test_bags_without_images_get_one_sentence(
    shared_data: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shared_data("trajectories_evo")
    for name in ("nav2_turtlebot.mcap", "tf_example"):
        assert main(["plan", str(folder / name)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and "no image, depth, point cloud or pose" in said
    for name in ("", "KITTI_00_gt.txt", "fr2_desk_ORB.txt"):
        assert main(["plan", str(folder / name)]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_an_input_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="does not exist"):
        prepare(RunRequest((tmp_path / "none",), out=tmp_path))
    with pytest.raises(FormatError, match="exactly one"):
        prepare(RunRequest((tmp_path, tmp_path), out=tmp_path))


def one_image(path: Path, **metadata: str) -> Path:
    with SequenceWriter(path) as writer:
        writer.image("/camera/color/image_raw", 1_000_000_000, np.zeros((12, 16), np.uint8), "camera")
        if metadata:
            writer.bag.metadata(SHUTTER, metadata)
    return path


def test_what_a_bag_says_about_its_shutter_reaches_tracking_alone(tmp_path: Path) -> None:
    layouts.seven_scenes(tmp_path / "set", 2)
    given, _ = prepare(RunRequest((tmp_path / "set",), out=tmp_path / "out"))
    assert readout_of(given.bag) == SevenScenes.readout_s > 0
    colour, depth = frozenset({Quantity.IMAGE, Quantity.INTRINSICS}), frozenset({Quantity.DEPTH, Quantity.INTRINSICS})
    line, of_depth, posed = (
        plan(quantities, goal, load_blocks())
        for quantities, goal in ((colour, "slam"), (depth, "slam"), (colour | {Quantity.GIVEN_POSE}, "recon"))
    )
    empty = ConfigFile({})
    assert with_shutter(empty, line, given.bag).sections["tracking"] == {"readout_s": SevenScenes.readout_s}
    for other in (of_depth, posed):  # images made of depth, and no tracking at all
        assert not with_shutter(empty, other, given.bag).sections
    own = ConfigFile({"tracking": {"readout_s": 0.0, "patches": 100}})
    assert with_shutter(own, line, given.bag).sections == own.sections
    assert not with_shutter(empty, line, one_image(tmp_path / "plain.mcap")).sections
    with pytest.raises(FormatError, match="'soon', which is no number"):
        with_shutter(empty, line, one_image(tmp_path / "bad.mcap", readout_s="soon"))
