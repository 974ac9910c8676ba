# SPDX-License-Identifier: Apache-2.0
# Needs Python 3.10 or newer with pip and venv. All other packages are installed into .venv.
PYTHON ?= python3
VENV := .venv
PIP := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

SOURCES := setup.py setup.cfg pyproject.toml package.xml \
	$(shell find paul_ros msg_adapters training lib launch config rviz foxglove sros2 resource bags -type f -not -path '*/__pycache__/*')

.PHONY: setup demo test test-fast lint docs clean

setup: $(VENV)/.package

# Not an editable install: that would put nothing where `ros2 run` looks. Changed sources are installed again.
$(VENV)/.package: $(VENV)/.dependencies $(SOURCES)
	rm -rf build
	$(PIP) --no-deps --no-build-isolation .
	touch $@

$(VENV)/.dependencies: constraints.txt setup.cfg
	$(PYTHON) -m venv $(VENV)
	$(PIP) setuptools wheel
	$(PIP) --no-build-isolation ".[ros,train,bags,docs,test]"
	touch $@

# The versions of apt on Ubuntu 24.04. NumPy 1.26 has no wheels for Python 3.13, so its test is skipped there.
$(VENV)/.robot: $(VENV)/.dependencies
	$(PYTHON) -m venv $(VENV)/robot
	$(VENV)/robot/bin/python -m pip install --quiet --disable-pip-version-check \
		"numpy==1.26.4; python_version < '3.13'" "PyYAML==6.0.1; python_version < '3.13'"
	touch $@

# Tests that start nodes share one worker (see test/conftest.py); the others run beside it.
PYTEST := $(VENV)/bin/python -m pytest -n 2 --dist loadgroup

# Linting comes last, so that a fault of style does not hide the tests; mypy takes 15 s, with its cache 1 s.
test: setup $(VENV)/.robot
	$(PYTEST)
	@$(MAKE) --no-print-directory lint

# Without nodes, installs, training, pages and long searches: 1 minute on two idle cores.
test-fast: setup
	$(PYTEST) -m "not (dds or install or training or docs or slow)"

lint: setup
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

demo: setup
	$(VENV)/bin/paul demo

# The pages, as HTML in out/docs.
docs: setup
	$(VENV)/bin/python -m sphinx -W --keep-going -q -b html docs out/docs

clean:
	rm -rf $(VENV) build install log out *.egg-info
