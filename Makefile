# make demo | test | test-all | lint | docs | clean | distclean
# Needs Python 3.11 or later with venv, make and git; everything else goes into $(VENV).

PYTHON ?= python3
VENV ?= .venv
# Optional pip constraints, e.g. CONSTRAINTS=requirements/ubuntu-24.04.txt
CONSTRAINTS ?=
# More options for pytest, e.g. PYTEST_ARGS='test/test_geometry.py -x'
PYTEST_ARGS ?=

bin := $(VENV)/bin
# Absolute without resolving the link that venv makes: the environment is where the link lies.
prefix := $(abspath $(VENV))
stamp := $(VENV)/.installed
test_stamp := $(VENV)/.installed-for-tests
docs_stamp := $(VENV)/.installed-for-docs
pip := $(bin)/python -m pip --quiet --quiet --disable-pip-version-check

# What a run imports is byte-compiled by the set-up, or else the first run would do it, and every run
# where PYTHONDONTWRITEBYTECODE is set. pip would do it for all 6,000 modules of the environment.
first_run := rs_relpose_ros.nodes.relpose_node, rs_relpose_ros.nodes.global_shutter_node, rs_relpose_ros.cli.poses, \
    rs_relpose_ros.odometry.offline, rs_relpose_lab.live.player, \
    rs_relpose_lab.live.live_run, rs_relpose_lab.experiments.comparison

# The environment brings its own ROS; one that a sourced setup.bash offers must not mix with it.
unexport PYTHONPATH LD_LIBRARY_PATH
export AMENT_PREFIX_PATH := $(prefix)
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST

.DELETE_ON_ERROR:
.PHONY: demo test test-all lint docs clean distclean same-python

demo: $(stamp)
	@$(bin)/python demo/run_demo.py

# One thread of OpenBLAS, as nodes and commands have: with more, results differ in the last bits
# (NumPy 1.26). Message types are checked in tests; in Jazzy that is off unless asked for. Three
# processes for two cores: one runs the live tests, which wait half of the time, the others with
# lower priority (test/conftest.py); PYTEST_ARGS='-n 0 ...' for one.
pytest := OPENBLAS_NUM_THREADS=1 ROS_PYTHON_CHECK_FIELDS=1 $(bin)/python -m pytest -n 3 \
    --no-loadscope-reorder

test: $(test_stamp)
	$(pytest) $(PYTEST_ARGS)

test-all: $(test_stamp)
	$(pytest) -m 'long or not long' $(PYTEST_ARGS)

lint: $(test_stamp)
	$(bin)/ruff format --check --quiet . || { echo 'layout: run $(bin)/ruff format .' >&2; exit 1; }
	$(bin)/ruff check .
	$(bin)/mypy

# Warnings are errors, and nothing is fetched. The pages are in build/docs/html.
docs: $(docs_stamp)
	$(bin)/python -m sphinx --fail-on-warning --keep-going --quiet -b html \
	    -d build/docs/doctrees docs build/docs/html

# The kernels, which need nothing of ROS, are compiled meanwhile. A failure there is reported by the
# last step, which does what is left.
# Removed, a quarter of the environment: the libraries' own tests, GTSAM's data sets, headers, sources
# in C and files for CMake, two of three copies of Fast DDS, which are links outside a wheel, pytest,
# which GTSAM asks for and does not import, and symbol tables of modules that have no libraries of
# their own (in the others auditwheel has moved sections, which strip may not expect). Copies of one
# library in several wheels become links. Files are replaced and not changed: the compilation uses them.
packages := $(VENV)/lib/python3*/site-packages
stripped = $(packages)/llvmlite $(packages)/numba $(packages)/fontTools $(packages)/kiwisolver \
    $(packages)/lz4 $(packages)/yaml
$(stamp): export PYTHONDONTWRITEBYTECODE :=
$(stamp): requirements/base.txt requirements/demo.txt $(CONSTRAINTS) setup.py setup.cfg \
    package.xml rs_relpose_lab/pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo '$(PYTHON) is no Python 3.11 or later; choose one: make PYTHON=python3.12 ...' >&2; exit 1; }
	@echo 'Setting up $(VENV): a minute or two and 0.7 GB.'
	@$(bin)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	@echo '[1/3] NumPy, SciPy, OpenCV, Numba ...'
	@grep -v -e '^#' -e '^ros-' requirements/base.txt | \
	    xargs $(pip) install --no-compile $(CONSTRAINTS:%=-c %)
	@echo '[2/3] ROS 2 and GTSAM; meanwhile the kernels are compiled ...'
	@$(bin)/python -m rs_relpose_ros.pipeline.warm_up & kernels=$$!; \
	$(pip) install --no-compile -r requirements/demo.txt $(CONSTRAINTS:%=-c %) && \
	find $(VENV)/lib -type d '(' -name tests -o -name gtsam_unstable -o -path '*/gtsam/Data' ')' \
	    -prune -exec rm -rf {} + && \
	find $(VENV)/lib -type f '(' -name '*.[ach]' -o -name '*.pyx' ')' -delete && \
	rm -rf $(VENV)/include $(VENV)/lib/cmake $(VENV)/share/*/cmake && \
	find $(VENV)/lib -maxdepth 1 '(' -name libfastrtps.so -o -name 'libfastrtps.so.*.*.*' ')' -delete && \
	$(pip) uninstall --yes iniconfig pluggy pygments pytest && \
	find $(VENV)/lib -path '*.libs/*' -type f -exec md5sum {} + | sort | while read -r sum file; do \
	    test "$$sum" = "$$last" && ln -f "$$kept" "$$file" || { last=$$sum; kept=$$file; }; \
	done && \
	find $(stripped) -name '*.so' | while read -r file; do \
	    ! strip -o $(VENV)/stripped "$$file" 2>/dev/null || mv $(VENV)/stripped "$$file"; \
	done && \
	$(bin)/python -c 'import $(first_run)'; \
	installed=$$?; wait $$kernels; exit $$installed
	@echo '[3/3] this package and the kernels that are left ...'
	@$(pip) install --no-deps --no-build-isolation --editable . --editable ./rs_relpose_lab
	@find $(packages)/pip -name __pycache__ -prune -exec rm -rf {} +
	@touch $@

$(test_stamp): $(stamp) requirements/test.txt
	@echo 'Adding what tests and linters need: half a minute and 0.2 GB.'
	@$(pip) install --no-compile -r requirements/test.txt $(CONSTRAINTS:%=-c %)
	@touch $@

$(docs_stamp): $(stamp) requirements/docs.txt
	@$(pip) install --no-compile -r requirements/docs.txt $(CONSTRAINTS:%=-c %)
	@touch $@

# A PYTHON that was asked for must be the one that an existing environment was made with.
version := -c 'import sys; print(*sys.version_info[:2], sep=".")'
ifneq ($(filter command environment,$(origin PYTHON)),)
$(stamp): | same-python
endif
same-python:
	@test ! -e $(stamp) || test "$$($(PYTHON) $(version))" = "$$($(bin)/python $(version))" || \
	    { echo '$(VENV) was made with another Python: make distclean, or choose VENV=...' >&2; exit 1; }

clean:
	rm -rf build install log dist demo_out *.egg-info rs_relpose_lab/*.egg-info rs_relpose_lab/build \
	    .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name '.venv*' -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean
	rm -rf .venv .venv-*
