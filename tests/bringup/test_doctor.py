"""Every finding of the doctor has its mend; shared memory of the dead is told from that of the living."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import fcntl
import json
import os
from pathlib import Path

import numpy as np
import pytest

from sf_bringup import cli, doctor
from sf_bringup.discovery import Probe
from sf_bringup.doctor_topics import Heard, _share_lost, _together, _topic
from sf_bringup.shared_memory import orphaned_segments, sweep_shared_memory

IMAGE, INFO, CLOUD = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"


def segment(folder: Path, name: str, age_s: float = 60.0) -> Path:
    for suffix in ("", "_el"):
        path = folder / f"{name}{suffix}"
        path.write_bytes(b"x")
        os.utime(path, (path.stat().st_atime - age_s, path.stat().st_mtime - age_s))
    return folder / name


def test_only_segments_without_an_owner_are_removed(tmp_path: Path) -> None:
    dead, alive, young = (
        segment(tmp_path, "fastrtps_dead"),
        segment(tmp_path, "fastrtps_alive"),
        segment(tmp_path, "fastrtps_young", age_s=0.0),
    )
    port, foreign = segment(tmp_path, "fastrtps_port7400"), segment(tmp_path, "somebody_elses")
    with (tmp_path / "fastrtps_alive_el").open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert orphaned_segments(tmp_path) == [dead]
        assert sweep_shared_memory(tmp_path) == 1
    assert not dead.exists() and all(p.exists() for p in (alive, young, port, foreign))


def test_every_check_that_fails_says_how_to_mend_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "_WANTED_SHM_MB", 1 << 40)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(tmp_path / "missing.xml"))
    pytest.importorskip("rclpy")
    found = [doctor._shared_memory(), doctor._import("no_such_module")(), doctor._middleware()]
    assert not any(check.ok for check in found) and all(check.mend for check in found)


def test_the_verb_prints_findings_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("rclpy")
    cli.main(["doctor", "--json", "--seconds", "0"])
    found = json.loads(capsys.readouterr().out)
    assert {"check", "ok", "detail", "mend"} == set(found[0])
    names = {row["check"] for row in found}
    assert names >= {
        "versions",
        "blocks",
        "torch",
        "shared memory",
        "orphaned segments",
        "middleware",
        "optional models",
    }


def heard(lidar: bool = False, info_frame: str = "cam") -> Heard:
    pytest.importorskip("rclpy")
    from sensor_msgs.msg import CameraInfo

    info = CameraInfo(width=64, height=48, k=[60.0, 0, 32, 0, 60, 24, 0, 0, 1])
    info.header.frame_id = info_frame
    out = Heard(types={"/cam/image_raw": IMAGE, "/cam/camera_info": INFO})
    out.probes["/cam/image_raw"] = Probe("rgb8", "cam")
    out.infos["/cam/camera_info"] = info
    if lidar:
        out.types["/points"] = CLOUD
        out.probes["/points"] = Probe("", "lidar")
    return out


def test_silence_a_wrong_frame_and_a_missing_extrinsic_are_found() -> None:
    silent = heard()
    silent.quality["/cam/image_raw"] = "reliable volatile"
    assert "no message within" in _topic(silent, "/cam/image_raw", 3.0).detail
    by_name = {c.name: c for c in _together(heard(info_frame="other"))}
    assert not by_name["calibration"].ok and "frame_id" in by_name["calibration"].mend
    by_name = {c.name: c for c in _together(heard(lidar=True))}
    assert not by_name["extrinsic"].ok and "static_transform_publisher" in by_name["extrinsic"].mend
    assert by_name["calibration"].ok and "tracking" in by_name["line"].detail


def test_images_that_transports_lose_are_told_by_their_stamps() -> None:
    rng = np.random.default_rng(3)
    stamps = 1_000_000_000 + np.arange(200) * 66_666_667 + rng.integers(-4_000_000, 4_000_000, 200)
    assert _share_lost(stamps.tolist()) == 0.0
    for share in (0.2, 0.5, 0.7):
        kept = stamps[rng.random(200) >= share]
        assert abs(_share_lost(kept.tolist()) - (1 - len(kept) / 200)) < 0.03
    lossy = heard()
    lossy.quality["/cam/image_raw"] = "best_effort volatile"
    lossy.counts["/cam/image_raw"], lossy.bytes["/cam/image_raw"] = len(kept), 921_600 * len(kept)
    lossy.stamps["/cam/image_raw"] = kept.tolist()
    found = _topic(lossy, "/cam/image_raw", 3.0)
    assert not found.ok and "lost on the way" in found.detail and "FASTRTPS_DEFAULT_PROFILES_FILE" in found.mend
