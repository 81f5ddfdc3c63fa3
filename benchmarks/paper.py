"""Published rows to print beside ours: the tables of the SceneFactory paper on Replica and on the MVD benchmark.

Replica's rooms are scans of real ones, our simulated rooms are not, and the paper's numbers come from a GPU: the
rows say how far the method can get, and are no baseline of the same run.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

ROOMS = ("room0", "room1", "room2", "office0", "office1", "office2", "office3", "office4")

# ATE RMSE in cm, per room (Table "Camera Tracking Results on the Replica Dataset").
ATE = {
    "rgbd": (0.20, 0.12, 0.14, 0.17, 0.07, 0.13, 0.29, 0.22),
    "mono": (0.20, 0.20, 0.15, 0.20, 0.12, 0.25, 0.29, 0.22),
}
# Accuracy cm, completion cm, completion ratio % (Table "Reconstruction Results", rows "Ours").
ACCURACY = {
    "rgbd": (1.49, 1.16, 1.24, 1.11, 0.91, 1.37, 1.62, 1.52),
    "mono": (3.61, 4.02, 5.53, 2.71, 2.17, 4.09, 4.23, 3.69),
}
COMPLETION = {
    "rgbd": (3.65, 2.88, 4.31, 1.68, 2.23, 3.59, 3.59, 4.02),
    "mono": (6.98, 6.76, 12.24, 6.46, 5.59, 10.31, 7.53, 10.46),
}
RATIO = {
    "rgbd": (87.61, 90.02, 86.83, 93.43, 90.39, 86.24, 84.98, 85.07),
    "mono": (74.06, 72.59, 63.85, 77.80, 75.26, 65.56, 68.89, 69.10),
}
# PSNR dB, SSIM, LPIPS-Alex (Table "Novel View Synthesis Evaluation", rows "Ours").
PSNR = {
    "rgbd": (27.72, 28.86, 30.17, 32.59, 31.39, 24.44, 25.34, 30.47),
    "mono": (23.12, 24.10, 24.11, 26.15, 24.68, 21.55, 22.44, 24.42),
}
SSIM = {
    "rgbd": (0.850, 0.872, 0.899, 0.915, 0.892, 0.837, 0.867, 0.887),
    "mono": (0.686, 0.749, 0.765, 0.816, 0.852, 0.731, 0.739, 0.789),
}
LPIPS = {
    "rgbd": (0.124, 0.166, 0.143, 0.165, 0.262, 0.208, 0.132, 0.184),
    "mono": (0.353, 0.307, 0.366, 0.338, 0.291, 0.381, 0.346, 0.375),
}
# Averages of others in the same tables: system, input, ATE, acc, comp, ratio, PSNR, SSIM, LPIPS.
OTHERS = (
    ("NICE-SLAM", "rgbd", 1.95, 3.87, 3.87, 82.41, 24.42, 0.809, 0.233),
    ("Vox-Fusion", "rgbd", 0.65, 2.67, 4.55, 86.59, 24.41, 0.801, 0.236),
    ("DROID-SLAM", "mono", 0.33, 5.50, 12.29, 63.60, 21.69, 0.812, 0.246),
    ("NICER-SLAM", "mono", 1.88, 3.65, 4.16, 79.37, 25.41, 0.827, 0.191),
)
# Multi-view depth: (absrel %, tau %) on KITTI, ScanNet, ETH3D, DTU, T&T for U2-MVD and the best other of each setting.
MVD_SETS = ("KITTI", "ScanNet", "ETH3D", "DTU", "T&T")
MVD = {
    ("c", "U2-MVD"): ((23.6, 31.8), (27.6, 21.8), (2.6, 43.7), (2.82, 81.1), (2.26, 89.2)),
    ("c", "Robust MVD"): ((7.1, 41.9), (7.4, 38.4), (9.0, 42.6), (2.7, 82.0), (5.0, 75.1)),
    ("d", "U2-MVD"): ((2.07, 81.9), (3.40, 41.4), (1.89, 44.8), (2.77, 72.0), (2.30, 81.4)),
    ("d", "DeepV2D ScanNet"): ((10.0, 36.2), (4.4, 54.8), (11.8, 29.3), (7.7, 33.0), (8.9, 46.4)),
    ("e", "U2-MVD"): ((2.08, 82.01), (7.19, 22.17), (1.87, 50.14), (15.61, 33.74), (2.46, 81.00)),
    ("e", "DUSt3R 512"): ((9.11, 39.49), (4.93, 60.20), (2.91, 76.91), (3.52, 69.33), (3.17, 76.68)),
}


PAPER = "paper, Replica"
# Column -> whether more is better.
COLUMNS = {
    "ATE cm": False,
    "acc cm": False,
    "comp cm": False,
    "ratio %": True,
    "PSNR": True,
    "SSIM": True,
    "LPIPS": False,
}


def columns(ours: Mapping[str, Any], paper: Mapping[str, Any]) -> list[dict[str, object]]:
    """One row for each column of the paper's tables: our mean, the paper's over the same rooms, which is better."""
    rows: list[dict[str, object]] = []
    for name, more in COLUMNS.items():
        row = {"input": ours["input"], "column": name, "this run": ours.get(name, "not measured"), "paper": paper[name]}
        if name in ours:
            row["better"] = "this run" if (ours[name] > paper[name]) == more else "paper"
        rows.append(row)
    return rows


def room_row(room: str, kind: str) -> dict[str, object]:
    """The paper's numbers of one Replica room."""
    k = ROOMS.index(room)
    tables = {"ATE cm": ATE, "acc cm": ACCURACY, "comp cm": COMPLETION, "ratio %": RATIO, "PSNR": PSNR, "SSIM": SSIM}
    numbers = {name: table[kind][k] for name, table in tables.items()}
    return {"room": room, "input": kind, "system": PAPER, **numbers, "LPIPS": LPIPS[kind][k]}


def other_rows() -> list[dict[str, object]]:
    """Averages of other systems over Replica."""
    names = ("system", "input", "ATE cm", "acc cm", "comp cm", "ratio %", "PSNR", "SSIM", "LPIPS")
    return [dict(zip(names, row, strict=True)) for row in OTHERS]


def mvd_rows() -> list[dict[str, object]]:
    """absrel and tau of the MVD benchmark, one row for each setting and system."""
    rows = []
    for (setting, system), pairs in MVD.items():
        cells = {f"{name} rel/tau %": f"{rel} / {tau}" for name, (rel, tau) in zip(MVD_SETS, pairs, strict=True)}
        rows.append({"setting": setting, "system": system, **cells})
    return rows
