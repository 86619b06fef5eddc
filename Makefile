# Everything that a fresh clone needs: each target sets up what it uses, in .venv, the first time
# and again whenever the native code or the dependencies change.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Beside it, holdfast as pip installs it: not editable, with the state machines compiled. What it needs
# of others it finds in the first.
COMPILED := .venv-compiled

# They stand inside the environment, so that they go when it goes.
INSTALLED_TOOLS := $(VENV)/.installed-tools
INSTALLED_KERNEL := $(VENV)/.installed-kernel
INSTALLED_FIGURES := $(VENV)/.installed-figures
INSTALLED_DEV := $(VENV)/.installed-dev
INSTALLED_DOCS := $(VENV)/.installed-docs
INSTALLED_COMPILED := $(COMPILED)/.installed

# The wheels of a real ROS 2, for tests alone.
ROS2 ?= $(CURDIR)/.ros2
# holdfast in the system's Python, which ROS 1 needs; its packages are Debian's.
ROS1 ?= $(CURDIR)/.ros1

DIST ?= dist
# Seconds since 1970 that archives bear, so that they come out the same whenever they are made.
RELEASED = $(shell git log -1 --format=%ct 2>/dev/null || date +%s)

BUILD_TOOLS := 'scikit-build-core>=0.11' 'nanobind>=2.4' cmake ninja
LAB_BUILD_TOOLS := 'hatchling>=1.27'
# What makes C of the machines is in the environment of developers; it takes its own tools from this.
MACHINE_BUILD_TOOLS := setuptools
NATIVE_SOURCES := $(wildcard CMakeLists.txt) $(shell find cpp -type f)
PACKAGE_SOURCES := $(shell find cmake src lab/src -type f -not -name '*.pyc') lab/pyproject.toml
CPP_FILES := $(shell find cpp -name '*.hpp' -o -name '*.cpp')

.DEFAULT_GOAL := help
.PHONY: help demo install test test-gate test-real test-defects test-slow test-deploy test-deploy-engine test-deploy-others test-deploy-slow test-ros test-ros1 test-compiled lint lint-forge format simulate chaos fuzz soak mutants bench results docs docs-links wheel sbom release-rehearsal requirements clean

help: ## what there is to make
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-16s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(INSTALLED_FIGURES) ## a cloud and a robot are killed, and no decision changes; see demo-run
	rm -rf demo-run
	$(BIN)/holdfast demo --out demo-run

install: $(INSTALLED_DEV) $(INSTALLED_COMPILED) ## the environments, which the others make when they need them

# Each of the processes imports what it finds, which takes as long as many of the tests.
WORKERS := 2
# Real processes wait for each other most of the time.
test test-real: WORKERS := 4
PYTEST = $(BIN)/pytest -q -n $(WORKERS) --dist worksteal --ignore=tests/deploy --ignore=tests/ros
# For one test that takes minutes: what takes longer hangs.
LONG := -o faulthandler_timeout=2400

test: $(INSTALLED_DEV) ## the quick tests
	$(PYTEST) -m "not slow"

test-gate: $(INSTALLED_DEV) ## those of them that no clock and no network decides
	$(PYTEST) -m "not real and not slow"

test-real: $(INSTALLED_DEV) ## those with real processes and sockets
	$(PYTEST) -m "real and not slow"

test-defects: $(INSTALLED_DEV) ## the simulator finds every defect that is planted: a minute
	$(PYTEST) $(LONG) -m slow tests/simulation/test_defects.py

test-slow: $(INSTALLED_DEV) ## what repeats them with more seeds, problems and moments: half an hour
	$(PYTEST) $(LONG) -m slow

test-compiled: $(INSTALLED_COMPILED) ## the simulator's tests and 10,000 seeds through compiled machines
	$(COMPILED)/bin/python -m pytest -q $(LONG) -m "slow or not slow" tests/scenarios tests/simulation/test_world.py \
	    tests/processes/test_compiled.py

test-deploy: $(INSTALLED_DEV) ## images, tunnels and machines; root, and packages that .ci/run installs
	$(MAKE) --no-print-directory -j2 -Otarget test-deploy-engine test-deploy-others

# What needs the engine, so that there is one; and what waits beside it.
ENGINE_TESTS := $(patsubst %,tests/deploy/test_%.py,compose deploy_page images machine wheel)
DEPLOY = $(BIN)/pytest -q $(LONG) --durations=8

test-deploy-engine: $(INSTALLED_DEV)
	$(DEPLOY) -m "deploy and not slow" $(ENGINE_TESTS)

test-deploy-others: $(INSTALLED_DEV)
	$(DEPLOY) -m "deploy and not slow" $(ENGINE_TESTS:%=--ignore=%) tests/deploy

test-deploy-slow: $(INSTALLED_DEV) ## those of them that take minutes
	$(DEPLOY) -m "deploy and slow" tests/deploy

test-ros: $(INSTALLED_DEV) ## a real ROS 1, and ROS 2 Kilted and Jazzy, which tests/ros/set_up_ros2 installs the first time
	tests/ros/set_up_ros2 $(ROS2) $(PYTHON)
	tests/ros/set_up_ros2 $(ROS2)-jazzy $(PYTHON) jazzy
	if [ -e /usr/bin/rosmaster ]; then tests/ros/set_up_ros1 $(ROS1); fi
	ROS1=$(ROS1) ROS2=$(ROS2) $(BIN)/pytest -q $(LONG) -m ros -n 2 --dist loadfile tests/ros
	ROS2=$(ROS2)-jazzy $(BIN)/pytest -q $(LONG) -m ros -n 2 --dist loadfile tests/ros/test_*ros2*.py \
	    tests/ros/test_topic_robot.py tests/ros/test_nav2_example.py

test-ros1: $(INSTALLED_DEV) ## those of them that need Debian's ROS 1 alone, but for the slow ones
	tests/ros/set_up_ros1 $(ROS1)
	ROS1=$(ROS1) $(BIN)/pytest -q $(LONG) -m "ros and not slow" -n 2 --dist worksteal \
	    tests/ros/test_ros1_*.py tests/ros/test_master_guard.py

fuzz: $(INSTALLED_DEV) ## a live service is attacked in all ways, 5 minutes over each wire
	for wire in tcp tls udp; do $(BIN)/python -m tests.fuzz.attacker --minutes 5 --transport $$wire || exit; done

soak: $(INSTALLED_DEV) ## sessions come and go for 10 minutes, and nothing may grow
	$(BIN)/python -m tests.fuzz.soak --minutes 10 --seed 1

mutants: $(INSTALLED_DEV) ## small mistakes in the product: how many do its tests notice? An hour at most, and again to go on
	nice -n 19 $(BIN)/python -m tests.mutants

# On the forge actionlint looks at them, too (.github/workflows/test.yml).
lint-forge: $(INSTALLED_DEV)
	$(BIN)/check-jsonschema -q --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema -q --builtin-schema vendor.github-issue-config .github/ISSUE_TEMPLATE/config.yml
	$(BIN)/check-jsonschema -q --builtin-schema vendor.github-issue-forms $(filter-out %/config.yml,$(wildcard .github/ISSUE_TEMPLATE/*.yml))
	$(BIN)/check-jsonschema -q --builtin-schema vendor.dependabot .github/dependabot.yml
	$(BIN)/zizmor -q --offline --min-severity medium .github

lint: $(INSTALLED_DEV) lint-forge ## style, types, layers, and the forge's workflows
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.line_budgets
	$(BIN)/clang-format --dry-run -Werror $(CPP_FILES)

format: $(INSTALLED_DEV) ## rewrite the code in the common style
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CPP_FILES)

simulate: $(INSTALLED_COMPILED) ## 100,000 simulated runs with faults: minutes
	$(COMPILED)/bin/holdfast simulate --seeds 0:100000

bench: $(INSTALLED_DEV) $(INSTALLED_COMPILED) ## the benchmarks
	$(BIN)/python benchmarks/run.py

chaos: $(INSTALLED_FIGURES) ## 500 runs with real faults, about 25 minutes; see chaos-run
	rm -rf chaos-run
	$(BIN)/holdfast chaos --trials 500 --jobs 2 --out chaos-run

results: $(INSTALLED_DEV) ## the experiments behind docs/results.md: hours, the last half hour with the machine to itself
	$(BIN)/python -m studies all --out runs/experiments
	for study in runs/experiments/*/origin.json; do \
	    name=$$(basename $$(dirname $$study)); mkdir -p docs/results/$$name; \
	    find runs/experiments/$$name -maxdepth 1 -type f -not -name '*_trials.csv' -exec cp {} docs/results/$$name/ \; ; \
	done

docs: $(INSTALLED_DOCS) ## the site, in build/site; its tutorials are run, and a warning is an error
	$(BIN)/python -m sphinx -E -W --keep-going -q -b html -d build/site-doctrees docs build/site

docs-links: $(INSTALLED_DOCS) ## every link of the site, those to other sites too: needs the internet
	$(BIN)/python -m sphinx -E -q -b linkcheck -D nb_execution_mode=off -D suppress_warnings=myst-nb.lexer -d build/links-doctrees docs build/links

wheel: $(INSTALLED_DEV) ## dist/: the sources, and a wheel for machines of this kind, the same bytes each time; dist/lab/
	rm -rf $(DIST)
	SOURCE_DATE_EPOCH=$(RELEASED) $(BIN)/python -m build --outdir $(DIST)/unrepaired
	mv $(DIST)/unrepaired/*.tar.gz $(DIST)
	PATH="$(CURDIR)/$(BIN):$$PATH" SOURCE_DATE_EPOCH=$(RELEASED) \
	    $(BIN)/auditwheel repair -w $(DIST) $(DIST)/unrepaired/*.whl
	rm -rf $(DIST)/unrepaired
	SOURCE_DATE_EPOCH=$(RELEASED) $(BIN)/python -m build --outdir $(DIST)/lab lab
	for package in ros1_master_guard holdfast_ros; do \
	    SOURCE_DATE_EPOCH=$(RELEASED) $(BIN)/python -m build --outdir $(DIST)/ros ros/$$package || exit; done

release-rehearsal: wheel sbom ## a release up to its upload, to an index of this machine's own; then README's first steps from there
	deploy/rehearse_release $(DIST) $(WHEELS)

sbom: $(INSTALLED_DEV) ## dist/holdfast-sensing-VERSION.cdx.json: what the images' environment is made of, with licences
	$(BIN)/python deploy/sbom.py $(DIST)

requirements: $(INSTALLED_DEV) ## deploy/*requirements.txt anew: the versions and digests that images are made of
	$(BIN)/uv pip compile -q --upgrade --python-version 3.11 --generate-hashes --no-annotate --extra service --extra udp \
	    --custom-compile-command "make requirements" pyproject.toml -o deploy/requirements.txt
	printf '%s\n' $(BUILD_TOOLS) | \
	    $(BIN)/uv pip compile -q --upgrade --python-version 3.11 --generate-hashes --no-annotate \
	    --custom-compile-command "make requirements" - -o deploy/build-requirements.txt

clean: ## remove what was built or run here, but keep .venv
	rm -rf ros/*/build ros/*/*.egg-info
	rm -rf build dist demo-run chaos-run .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
	rm -f $(INSTALLED_KERNEL) $(INSTALLED_FIGURES) $(INSTALLED_DEV) $(INSTALLED_DOCS)
	rm -rf $(COMPILED)

# The interpreter is looked at first: without this, what is missing shows only as an error deep in
# pip or CMake.
$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { \
	    echo "make: no $(PYTHON) here; install Python 3.11 or newer, or say make PYTHON=..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "make: $(PYTHON) is older than 3.11; say make PYTHON=python3.11, for example" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "make: $(PYTHON) has no venv module; on Debian: apt-get install python3-venv" >&2; exit 1; }
	@$(PYTHON) -c 'import pathlib, sys, sysconfig; \
	    sys.exit(not (pathlib.Path(sysconfig.get_path("include")) / "Python.h").exists())' || { \
	    echo "make: $(PYTHON) has no headers; on Debian: apt-get install python3-dev" >&2; exit 1; }
	@command -v "$${CXX:-c++}" >/dev/null || { \
	    echo "make: no C++ compiler; install gcc or clang, or set CXX" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(INSTALLED_TOOLS): pyproject.toml | $(BIN)/python
	@cmake/pip_install $(BIN)/python $(VENV)/pip.log $(BUILD_TOOLS) $(LAB_BUILD_TOOLS) $(MACHINE_BUILD_TOOLS)
	@touch $@

# With tools that stay where they are, only what has changed is compiled: pip's own are elsewhere
# each time, and then so is all that CMake remembers.
# An environment from before the distribution was called holdfast-sensing still has it as holdfast.
$(INSTALLED_KERNEL): pyproject.toml $(NATIVE_SOURCES) | $(INSTALLED_TOOLS)
	@$(BIN)/python -m pip uninstall -q -y holdfast 2>/dev/null
	@cmake/pip_install $(BIN)/python $(VENV)/pip.log --no-build-isolation --no-deps -e .
	@touch $@

# The laboratory, beside what it needs of others.
INSTALL_LAB = @cmake/pip_install $(BIN)/python $(VENV)/pip.log --no-build-isolation --no-deps -e lab

$(INSTALLED_FIGURES): $(INSTALLED_KERNEL) lab/pyproject.toml
	@cmake/pip_install $(BIN)/python $(VENV)/pip.log "holdfast-sensing[figures,service]"
	$(INSTALL_LAB)
	@touch $@

$(INSTALLED_DEV): $(INSTALLED_KERNEL) lab/pyproject.toml $(wildcard ros/*/setup.py)
	@cmake/pip_install $(BIN)/python $(VENV)/pip.log "holdfast-sensing[dev]" -e ros/ros1_master_guard -e ros/holdfast_ros
	$(INSTALL_LAB)
	@touch $(INSTALLED_FIGURES) $@

$(INSTALLED_DOCS): $(INSTALLED_FIGURES)
	@cmake/pip_install $(BIN)/python $(VENV)/pip.log "holdfast-sensing[docs]"
	@touch $@

# The sources are copied into it, so whatever of them changes is installed again. The kernel is the one
# of the first, whose build goes on: only the machines are compiled.
$(INSTALLED_COMPILED): pyproject.toml $(NATIVE_SOURCES) $(PACKAGE_SOURCES) | $(INSTALLED_DEV)
	rm -rf $(COMPILED)
	$(BIN)/python -m venv --without-pip $(COMPILED)
	@HOLDFAST_COMPILED=1 PIP_COMMAND=wheel cmake/pip_install $(BIN)/python $(COMPILED)/pip.log \
	    --no-build-isolation --no-deps -w $(COMPILED)/wheels . ./lab
	@$(BIN)/python -m pip --python $(COMPILED)/bin/python install -q --no-deps $(COMPILED)/wheels/*.whl
	@cd $(COMPILED)/lib/python*/site-packages && $(CURDIR)/$(BIN)/python -c \
	    'import sysconfig; print(sysconfig.get_path("purelib"))' >others.pth
	@touch $@
