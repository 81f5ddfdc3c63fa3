"""For colcon only, where this folder is a package of its own; pip uses the pyproject.toml above it."""

# SPDX-License-Identifier: Apache-2.0
from setuptools import find_packages, setup

NAME = "sf_depth"

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
    ],
    entry_points={
        "scenefactory.blocks": ["depth = sf_depth.block:SPECS"],
        "scenefactory.parts": [
            "depth:calibrate = sf_depth.block:make_calibrate",
            "depth:complete = sf_depth.block:make",
            "depth:mvd = sf_depth.block:make_mvd",
            "depth:posed = sf_depth.block:make_posed",
            "depth:slam = sf_depth.block:make_slam",
        ],
        "console_scripts": ["node = sf_depth.node:main"],
    },
)
