# SPDX-License-Identifier: Apache-2.0
# `make demo` and `make test` need Python 3.10 or newer with pip and venv; all else goes into .venv.
PYTHON ?= python3
VENV := .venv
PIP := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

SOURCES := setup.py setup.cfg pyproject.toml package.xml \
	$(shell find paul_ros msg_adapters training lib launch config rviz foxglove sros2 resource bags -type f -not -path '*/__pycache__/*')

.PHONY: setup demo test test-fast lint clean

setup: $(VENV)/.package

# Not an editable install: that would put nothing where `ros2 run` looks. Sources that changed are installed anew.
$(VENV)/.package: $(VENV)/.dependencies $(SOURCES)
	rm -rf build
	$(PIP) --no-deps --no-build-isolation .
	touch $@

$(VENV)/.dependencies: constraints.txt setup.cfg
	$(PYTHON) -m venv $(VENV)
	$(PIP) setuptools wheel
	$(PIP) --no-build-isolation ".[ros,train,bags,docs,test]"
	touch $@

# What apt gives a robot on Ubuntu 24.04. NumPy 1.26 has no wheels for Python 3.13; its test is left out there.
$(VENV)/.robot: $(VENV)/.dependencies
	$(PYTHON) -m venv $(VENV)/robot
	$(VENV)/robot/bin/python -m pip install --quiet --disable-pip-version-check \
		"numpy==1.26.4; python_version < '3.13'" "PyYAML==6.0.1; python_version < '3.13'"
	touch $@

# Tests that start nodes share one worker (see test/conftest.py); the others run beside it.
PYTEST := $(VENV)/bin/python -m pytest -n 2 --dist loadgroup

test: setup $(VENV)/.robot
	$(PYTEST)

# Without nodes, installs, training and long searches: for every save.
test-fast: setup
	$(PYTEST) -m "not (dds or install or training or slow)"

lint: setup
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

demo: setup
	$(VENV)/bin/paul demo

clean:
	rm -rf $(VENV) build install log out *.egg-info
