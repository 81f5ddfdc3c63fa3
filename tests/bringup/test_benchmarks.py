"""The benchmarks' shared parts: peers behind their protocols, bags with less in them, and the commands of all."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import pickle
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sf_bringup.evaluation import psnr
from sf_bringup.simulate import SimulationSpec
from sf_interfaces.geometry import se3
from sf_interfaces.io.bag import BagReader
from sf_interfaces.types import Frame

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import common
import map_memory
import paper
import peers

SPEC = SimulationSpec("room", frames=3, width=320, height=240, focal=240.0, supersampling=1, depth="exact")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bench")
    made, mesh = common.simulated(SPEC, out)
    assert mesh.is_file() and common.simulated(SPEC, out)[0] == made
    return made


@pytest.fixture(scope="module")
def frames(bag: Path) -> list[Frame]:
    return common.load_frames(bag)


def test_odometry_peers_follow_a_small_motion(frames: list[Frame]) -> None:
    found, missing = peers.load(peers.ODOMETRY, frames[0].camera)
    assert all("skipped" in why for why in missing.values()) and "Open3D odometry, hybrid" in found
    step = se3.inverse(frames[0].T_map_camera) @ frames[-1].T_map_camera
    for name, make in found.items():
        try:
            peer = make()
        except peers.PeerMissing as reason:
            assert "skipped" in str(reason)
            continue
        poses = [peer.track(frame) for frame in frames]
        assert poses[0] is not None and poses[-1] is not None, name
        error = se3.log(se3.inverse(step) @ se3.inverse(poses[0]) @ poses[-1])
        limit = 0.08 if name == "KISS-ICP" else 0.03  # m; its points are 5 cm apart
        assert np.linalg.norm(error[:3]) < limit and np.linalg.norm(error[3:]) < 0.03, name


def test_the_tsdf_peer_draws_what_it_fused(frames: list[Frame]) -> None:
    found, _ = peers.load(peers.MAPPING, frames[0].camera)
    mapper = found["Open3D TSDF"]()
    for frame in frames:
        mapper.add(frame)
    image, hit = mapper.render(frames[1].camera, frames[1].T_map_camera)
    assert hit.mean() > 0.5 and psnr(image, frames[1].image, hit) > 18
    assert len(mapper.surface().triangles) > 1000


def test_absent_peers_are_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    monkeypatch.delitem(sys.modules, "peers.small_gicp_map", raising=False)
    found, missing = peers.load(("small_gicp_map",))
    assert not found and "pip install" in missing["small_gicp_map"]


def test_bags_lose_topics_and_frames(bag: Path) -> None:
    with BagReader(common.without(bag, [common.DEPTH], "mono")) as reader:
        assert common.DEPTH not in reader.topics and reader.topics[common.COLOUR].count == 3
    with BagReader(common.thinned(bag, [0, 2], "two")) as reader:
        assert {reader.topics[t].count for t in (common.COLOUR, common.INFO, common.TRUE_POSE)} == {2}
        assert reader.topics["/tf_static"].count == 2


def test_results_say_how_they_came_about(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["rooms.py", "--out", str(tmp_path)])
    bench = common.Benchmark("rooms", "words")
    bench.parse()
    bench.note("a note")
    bench.write("Title", {"rows": [{"ATE cm": 1.0}]})
    result = json.loads((tmp_path / "rooms.json").read_text())
    assert result["rows"] == [{"ATE cm": 1.0}] and result["notes"] == ["a note"]
    assert result["machine"]["cpus"] and result["versions"]["numpy"] and result["command"].startswith("rooms.py")
    assert common.mean_row([{"a": 1.0, "b": "x"}, {"a": 3.0}], system="s") == {"system": "s", "a": 2.0}


def test_the_paper_s_rows_average_to_the_printed_means() -> None:
    printed = {
        "rgbd": {"ATE": 0.17, "ACCURACY": 1.30, "COMPLETION": 3.24, "RATIO": 88.07, "PSNR": 28.87, "SSIM": 0.877},
        "mono": {"ATE": 0.20, "ACCURACY": 3.76, "COMPLETION": 8.29, "RATIO": 70.89, "PSNR": 23.82, "SSIM": 0.766},
    }
    for kind, row in printed.items():
        for name, mean in row.items():
            assert np.mean(getattr(paper, name)[kind]) == pytest.approx(mean, rel=0.03), (kind, name)


def test_our_means_stand_beside_the_paper_s_and_a_missing_one_is_said() -> None:
    ours = {"input": "rgbd", "ATE cm": 0.3, "acc cm": 0.5, "comp cm": 1.0, "ratio %": 95.0, "PSNR": 30.0, "SSIM": 0.9}
    rows = {row["column"]: row for row in paper.columns(ours, paper.room_row("room0", "rgbd"))}
    assert rows["ATE cm"]["better"] == "paper" and rows["PSNR"]["better"] == "this run"
    assert rows["LPIPS"]["this run"] == "not measured" and "better" not in rows["LPIPS"]
    assert [rows["acc cm"][system] for system in ("this run", "paper")] == [0.5, 1.49]


def test_keyframes_of_a_large_map_halve_the_gaps_between_earlier_ones() -> None:
    assert map_memory.spread(800, 8) == [0, 400, 200, 600, 100, 500, 300, 700]


def test_every_benchmark_has_a_command(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    import all as everything

    data = shared_data("trajectories_evo").parent
    quick, full = (everything.commands(f, data, tmp_path) for f in (False, True))
    assert {"speed", "rooms", "depth", "scales", "real", "rasterize", "completion"} <= set(quick) == set(full)
    assert all(Path(command[1]).is_file() for command in quick.values())
    assert "--data" not in quick["rooms"] and "real" not in everything.commands(False, None, tmp_path)


def test_a_peer_that_lost_the_camera_is_not_the_best() -> None:
    import noise

    rows = [
        {"system": noise.OURS, "ATE cm": 0.2, "tracked": "30/30"},
        {"system": "lost early", "ATE cm": 0.01, "tracked": "12/30"},
        {"system": "good", "ATE cm": 0.4, "tracked": "29/30"},
        {"system": "poor", "ATE cm": 4.0, "tracked": "30/30"},
        {"system": "missing", "remark": "skipped"},
    ]
    found = noise.against_best("room0", rows, 30)
    assert found["best peer"] == "good" and found["ratio"] == pytest.approx(0.5)
    assert noise.against_best("room0", rows[:2], 30)["best peer"] == "none ran"


def test_sweeps_of_a_walk_are_brought_to_the_image_by_the_motion_tracked_so_far() -> None:
    import loops

    walk = loops.Walk("garden-sweeps", 0.25)
    assert np.linalg.norm(np.diff(walk.poses()[:, :3, 3], axis=0), axis=1).sum() > 251  # m

    T, before = (walk.simulator.path.pose(k / walk.fps) for k in (20, 19))
    twist = se3.twist_between(0, before, round(1e9 / walk.fps), T)

    def off(factor: float) -> float:
        """Mean distance, m, of the sweep's points from the surfaces."""
        sparse = walk.frame(20, factor * twist)[0].sparse_depth
        points = se3.transform(T, walk.spec.camera.unproject(sparse.uv, sparse.z))
        return float(walk.simulator.renderer.clearance(points).mean())

    right = off(1.0)
    assert right < 0.01 and right < 0.95 * min(off(0.0), off(2.0))


def test_weights_of_lpips_are_read_without_unpickling() -> None:
    import lpips_weights

    rng = np.random.default_rng(0)
    layers: dict[str, object] = {}
    for j, (side, inputs, outputs) in enumerate(lpips_weights.KERNELS):
        kernel = rng.normal(size=(side, side, inputs, outputs)).astype(np.float32)
        layers[f"Conv_{j}"] = {"kernel": kernel, "bias": rng.normal(size=outputs).astype(np.float32)}
    kernel, bias = layers["Conv_1"]["kernel"], layers["Conv_1"]["bias"]  # type: ignore[index]
    linear = [rng.normal(size=(1, 1, outputs, 1)).astype(np.float32) for *_, outputs in lpips_weights.KERNELS]
    pickled = pickle.dumps((layers, linear), protocol=3)
    alexnet, found = lpips_weights.convert(pickled)
    np.testing.assert_array_equal(alexnet["features.3.weight"], kernel.transpose(3, 2, 0, 1))
    np.testing.assert_array_equal(alexnet["features.3.bias"], bias)
    np.testing.assert_array_equal(found["lin4.model.1.weight"], linear[4].transpose(3, 2, 0, 1))
    with pytest.raises(ValueError, match="known order"):
        lpips_weights.convert(pickle.dumps(layers, protocol=3))
