# SPDX-License-Identifier: Apache-2.0
# Everything runs in .venv, which the first call creates; a ROS installation is not needed.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
PY := $(VENV)/bin/python
OPEN3D_NEEDS := libusb-1.0-0 libgl1 libgomp1
READY := $(VENV)/.scenefactory
# Python edits take effect at once (scenefactory_dev.pth); only what is compiled or declared needs a new install.
DECLARED := pyproject.toml CMakeLists.txt $(wildcard sf_*/CMakeLists.txt sf_*/*/CMakeLists.txt sf_*/cmake/*.cmake \
	sf_*/package.xml sf_interfaces/msg/*.msg sf_interfaces/srv/*.srv sf_interfaces/tf2_msgs/msg/*.msg \
	sf_recon/csrc/* sf_tracking/csrc/* sf_depth/csrc/*)

.PHONY: demo test lint bench bench-full clean setup

demo: $(READY)
	$(PY) -m sf_bringup.cli demo

test: lint
	$(PY) -m pytest -m "not graph and not slow"
	$(PY) -m pytest -m "graph or slow"

lint: $(READY)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

# BENCH is the folder of results, DATA one of real recordings (without it, what needs them is left out).
BENCH ?= bench
DATA ?= $(wildcard ../shared/data)

bench: $(READY)
	$(PY) benchmarks/all.py --out $(BENCH) $(if $(DATA),--data $(DATA))

bench-full: $(READY)
	$(PY) benchmarks/all.py --full --out $(BENCH)-full $(if $(DATA),--data $(DATA))

clean:
	rm -rf $(VENV) build dist out demo install log .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

setup: $(READY)

$(READY): $(DECLARED)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11")'
	@test -x $(PY) && $(PY) -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV) || \
		{ rm -rf $(VENV); $(PYTHON) -m pip install -q virtualenv && $(PYTHON) -m virtualenv -q $(VENV); } || \
		{ echo "no way to create $(VENV): install python3-venv" >&2; exit 1; }
	$(PY) -m pip install '.[test]'
	@$(PY) .ci/link_checkout.py
	@# Open3D's wheel links libraries that a bare system lacks.
	@$(PY) -c 'import open3d' 2>/dev/null || { apt-get update -qq && apt-get install -y -qq $(OPEN3D_NEEDS); } || \
		{ echo "Open3D cannot be imported: sudo apt-get install $(OPEN3D_NEEDS)" >&2; exit 1; }
	@touch $@
