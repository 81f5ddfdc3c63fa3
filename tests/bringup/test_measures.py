"""``sf eval`` and ``sf report`` on a run with known contents, and on plain files."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from run_sample import SIGMA, make_run

from sf_bringup import cli
from sf_bringup.bench_report import tables
from sf_bringup.run_folder import RunFolder
from sf_bringup.simulate import SimulationSpec, simulate
from sf_bringup.simulate.simulator import Simulator
from sf_interfaces.io.bag import BagReader
from sf_interfaces.types import Scale


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return make_run(tmp_path_factory.mktemp("sample"))


def evaluate(capsys: pytest.CaptureFixture[str], *args: object) -> dict:
    capsys.readouterr()
    assert cli.main(["eval", *map(str, args), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_an_exact_run_has_no_error(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(capsys, "traj", run.path)["rmse"] < 1e-8
    depth = evaluate(capsys, "depth", run.path)
    assert depth["absrel"] == 0 and depth["density"] == 100 and depth["within_1_sigma"] == 100
    assert depth["nll"] == pytest.approx(0.5 * np.log(2 * np.pi * SIGMA**2), abs=1e-4)
    assert depth["robust_mvd_all_views"]["inlier"] == 100
    mesh = evaluate(capsys, "mesh", run.path, "--reference", run.path / "mesh.ply")
    assert mesh["nicer_unculled"]["f_score"] == mesh["nice_culled"]["f_score"] == 100
    assert mesh["seen"]["f_score"] == 100 and mesh["seen"]["accuracy"] < 1e-3
    assert mesh["nice_culled"]["samples"] < 0.95 * mesh["nicer_unculled"]["samples"]


def test_the_table_names_units(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", "traj", str(run.path)]) == 0
    said = capsys.readouterr().out
    assert "rmse" in said and said.splitlines()[0].endswith(" m") and "deg" in said


def test_plain_files_are_measured(run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["export", str(run.path), "--out", str(tmp_path), "--tum", "--depth", "--nerfstudio"]) == 0
    tum, depth, images = tmp_path / "trajectory.tum", tmp_path / "depth", tmp_path / "nerfstudio" / "images"
    assert evaluate(capsys, "traj", tum, "--reference", tum, "--align", "sim3")["scale"] == pytest.approx(1)
    assert evaluate(capsys, "depth", depth, "--reference", depth)["images"] == 3
    one = next(depth.glob("*.png"))
    assert evaluate(capsys, "depth", one, "--reference", one.with_suffix(".npz"))["absrel"] < 0.02
    assert evaluate(capsys, "depth", run.path, "--reference", depth)["absrel"] == 0
    assert evaluate(capsys, "render", images, "--reference", images)["ssim"] == 1
    for args, words in (
        (["traj", str(tum)], "--reference"),
        (["depth", str(depth), "--reference", str(one)], "both be files or both be folders"),
        (["mesh", str(tum), "--reference", str(tum)], "surface file"),
        (["mesh", str(run.path / "mesh.ply"), "--reference", str(run.path / "mesh.ply"), "--poses", str(tum)], "both"),
    ):
        assert cli.main(["eval", *args]) == 2
        assert words in capsys.readouterr().err


def test_mono_runs_are_measured_up_to_scale(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path)
    info = json.loads((run.path / "run.json").read_text())
    info["topics"].pop("depth")
    (run.path / "run.json").write_text(json.dumps(info))
    rows = [line.split() for line in (run.path / "trajectory.tum").read_text().splitlines()]
    lines = [" ".join([r[0], *(f"{2 * float(v):.9f}" for v in r[1:4]), *r[4:]]) for r in rows]
    (run.path / "trajectory.tum").write_text("\n".join(lines))
    for path in (run.path / "depth").glob("*.npz"):
        with np.load(path) as data:
            np.savez(path, z=2 * data["z"], variance=4 * data["variance"])
    assert run.scale is Scale.ARBITRARY
    traj = evaluate(capsys, "traj", run.path)
    assert traj["scale"] == pytest.approx(0.5) and traj["rmse"] < 1e-8
    assert evaluate(capsys, "depth", run.path)["absrel"] < 1e-4
    assert evaluate(capsys, "traj", run.path, "--align", "none")["rmse"] > 0.05


def test_reports_of_runs_and_of_benchmarks(run: RunFolder, tmp_path: Path) -> None:
    assert cli.main(["report", str(run.path)]) == 0
    page = (run.path / "report.html").read_text()
    for figure in ("overview", "trajectory", "depth error", "calibration of the depth variance"):
        assert f"<h3>{figure}</h3>" in page
    bench = tmp_path / "bench"
    bench.mkdir()
    (bench / "speed.json").write_text(json.dumps({"title": "Speed <1>", "rows": [{"ms": 1.5}, {"ms": 2, "n": 3}]}))
    (bench / "runs").symlink_to(run.path.parent)
    assert cli.main(["report", str(bench)]) == 0
    page = (bench / "report.html").read_text()
    assert "Speed &lt;1&gt;" in page and "<td>1.5</td>" in page
    empty = tmp_path / "empty"
    empty.mkdir()
    assert cli.main(["report", str(empty)]) == 2
    (bench / "broken.json").write_text("{")
    assert cli.main(["report", str(bench)]) == 2


def test_tables_are_found_in_any_json() -> None:
    value = {"a": {"x": {"ms": 1}, "y": {"ms": 2}}, "rows": [{"p": 1, "q": {"r": 2}}], "n": 5}
    assert list(tables(value)) == [
        ("a", [{"": "x", "ms": 1}, {"": "y", "ms": 2}]),
        ("rows", [{"p": 1, "q r": 2}]),
        ("", [{"n": 5}]),
    ]


def test_a_simulation_leaves_its_surface_and_views_off_the_path(tmp_path: Path) -> None:
    spec = SimulationSpec("room", frames=3, width=32, height=24, focal=24.0, supersampling=1, novel_views=1)
    simulate(spec, tmp_path / "s.mcap", mesh=tmp_path / "s.ply")
    simulator = Simulator(spec)
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "s.ply"))
    assert len(mesh.triangles) == len(simulator.renderer.scene.corners)
    _, z, T = simulator.frame(1)
    world = spec.camera.unproject(spec.camera.pixel_grid(), z).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    distance = scene.compute_distance(o3d.core.Tensor(world.astype(np.float32))).numpy()
    assert distance.max() < 1e-3  # the bag's depth lies on the written surface
    with BagReader(tmp_path / "s.mcap") as bag:
        assert bag.topics["/ground_truth/novel/image"].count == bag.topics["/ground_truth/novel/pose"].count == 1
    offset = np.linalg.norm(simulator.novel_pose(1)[:3, 3] - T[:3, 3])
    assert 0.05 < offset < simulator.renderer.clearance(T[None, :3, 3])[0] / 2 + 1e-6
