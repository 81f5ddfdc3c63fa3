"""For colcon only, where this folder is a package of its own; pip uses the pyproject.toml above it."""

# SPDX-License-Identifier: Apache-2.0
from glob import glob

from setuptools import find_packages, setup

NAME = "sf_bringup"

LAYOUTS = ("launch", "config", "rviz", "foxglove")

setup(
    name=NAME,
    version="0.1.0",
    license="Apache-2.0",
    package_dir={NAME: "."},
    packages=[NAME, *(f"{NAME}.{sub}" for sub in find_packages())],
    package_data={NAME: ["py.typed", "*/*.yaml", "*/*.json", "*/*.rviz", "*/*.xml", "*/*.html"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *(
            (f"share/{NAME}/{folder}", sorted(glob(f"{folder}/*")))
            for folder in ("launch", "config", "rviz", "foxglove")
        ),
    ],
    entry_points={
        # sf_depth, sf_recon and sf_tracking are ament_cmake packages, which declare no entry points of their own.
        "scenefactory.blocks": [
            "depth = sf_depth.block:SPECS",
            "recon = sf_recon.block:SPEC",
            "tracking = sf_tracking.block:SPEC",
        ],
        "scenefactory.parts": [
            "depth:calibrate = sf_depth.block:make_calibrate",
            "depth:complete = sf_depth.block:make",
            "depth:mvd = sf_depth.block:make_mvd",
            "depth:posed = sf_depth.block:make_posed",
            "depth:slam = sf_depth.block:make_slam",
            "recon = sf_recon.block:make",
            "tracking = sf_tracking.block:make",
        ],
        "scenefactory.covariance": [
            "depthcov = sf_depth.core.depthcov:make",
            "structure = sf_depth.core.covariance:make_structure",
        ],
        "console_scripts": ["sf = sf_bringup.cli:main"],
    },
)
