# make demo: train on the scene that ships with gsopt and write a report.
# make test: lint, type-check and test.   make lint: only the first two.
# Each makes .venv when it is missing and installs again when pyproject.toml, constraints.txt or the C++ sources change.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
RUN ?=
TEST_EXTRAS := dev,viewer,video,spz,blender,sfm,sds

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check install -qq --constraint constraints.txt
# The build tools are pinned too, which an isolated build would not heed.
INSTALL := $(PIP) --no-build-isolation --editable
SOURCES := pyproject.toml constraints.txt \
  $(shell find gsopt/raster -name '*.cpp' -o -name '*.cu' -o -name '*.h' -o -name CMakeLists.txt)

.DEFAULT_GOAL := demo
.NOTPARALLEL:
.PHONY: demo test lint

demo: $(VENV)/.for-demo
	$(PY) -m gsopt demo $(if $(RUN),-m "$(RUN)")

test: lint
	OMP_NUM_THREADS=1 $(PY) -m pytest -n 2

lint: $(VENV)/.for-test
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(VENV)/bin/lint-imports --no-logo

$(VENV)/.build-tools: constraints.txt
	@echo "Installing into $(VENV); the first time takes a few minutes."
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PIP) scikit-build-core nanobind cmake ninja
	touch $@

$(VENV)/.for-demo: $(VENV)/.build-tools $(SOURCES)
	$(INSTALL) .
	touch $@

$(VENV)/.for-test: $(VENV)/.build-tools $(SOURCES)
	$(INSTALL) '.[$(TEST_EXTRAS)]'
	touch $@ $(VENV)/.for-demo
