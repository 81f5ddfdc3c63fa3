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
        # sf_recon and sf_tracking are ament_cmake packages, which declare no entry points of their own.
        "scenefactory.blocks": ["recon = sf_recon.block:SPEC", "tracking = sf_tracking.block:SPEC"],
        "scenefactory.parts": ["recon = sf_recon.block:make", "tracking = sf_tracking.block:make"],
        "console_scripts": ["sf = sf_bringup.cli:main"],
    },
)
