"""Nothing read from a file or the wire runs code or leaves the folder it was given."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import ConfigError
from sf_interfaces.io.paths import inside

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("sf_tracking", "sf_flexion", "sf_depth", "sf_recon", "sf_interfaces", "sf_bringup", "benchmarks")
UNPICKLERS = {"pickle", "cPickle", "dill", "shelve", "marshal", "joblib", "cloudpickle"}
RUNNERS = {"eval", "exec", "__import__"}


def calls() -> Iterator[tuple[str, str, ast.Call]]:
    """Place, dotted name and node of every call."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", ast.unparse(node.func), node


def keyword(node: ast.Call, name: str) -> str:
    return next((ast.unparse(k.value) for k in node.keywords if k.arg == name), "")


def test_no_module_unpickles() -> None:
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                found += [f"{path}: {n}" for n in names if n.split(".")[0] in UNPICKLERS]
    assert not found


def test_loading_runs_no_code() -> None:
    found = []
    for place, name, node in calls():
        if name in ("np.load", "numpy.load") and keyword(node, "allow_pickle") == "True":
            found.append(f"{place}: {name} unpickles")
        if name == "torch.load" and keyword(node, "weights_only") != "True":
            found.append(f"{place}: torch.load unpickles; pass weights_only=True")
        if name in ("yaml.load", "yaml.unsafe_load", "yaml.full_load"):
            found.append(f"{place}: {name}; use yaml.safe_load")
        if name in RUNNERS:
            found.append(f"{place}: {name}")
        if keyword(node, "shell") == "True" or name == "os.system":
            found.append(f"{place}: a shell")
    assert not found, "\n".join(found)


def test_a_config_that_asks_for_code_is_refused(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    (tmp_path / "c.yaml").write_text(f"tracking: !!python/object/apply:os.mkdir ['{marker}']\n")
    with pytest.raises(ConfigError, match="cannot read config"):
        ConfigFile.load(tmp_path / "c.yaml")
    with pytest.raises(ConfigError, match="write it as YAML"):
        ConfigFile.load(None, {"tracking.patches": f"!!python/object/apply:os.mkdir ['{marker}']"})
    assert not marker.exists()


@pytest.mark.parametrize("given", ["", "map", "a/b", "a/../b"])
def test_paths_below_the_folder_are_taken(tmp_path: Path, given: str) -> None:
    assert inside(tmp_path, given).is_relative_to(tmp_path.resolve())
    assert inside(tmp_path, str(tmp_path / given)).is_relative_to(tmp_path.resolve())


@pytest.mark.parametrize("given", ["..", "../x", "/etc", "a/../../x", "link/x", "x\0y"])
def test_paths_that_lead_out_are_refused_with_a_sentence(tmp_path: Path, given: str) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / "link").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="give a"):
        inside(home, given)


def test_without_a_folder_no_path_is_taken() -> None:
    with pytest.raises(ConfigError, match="no output folder"):
        inside(None, "map")
