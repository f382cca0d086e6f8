# Everything from a bare clone: Python 3.11+, pip and a C++17 compiler are all that is needed.
SHELL := /bin/bash
PYTHON ?= python3
VENV ?= .venv
RUN := $(VENV)/bin/python
# Torch's threads would otherwise spin for one another beside a busy process.
export OMP_WAIT_POLICY ?= passive
# A process per core, each with one thread; whoever is done takes tests from the others.
PYTEST = OMP_NUM_THREADS=1 $(RUN) -m pytest -n auto --dist worksteal --instafail --durations=10
SOURCES := $(wildcard ops/csrc/*.* CMakeLists.txt)
# An editable installation knows its modules by a list: one that came or went needs another.
MODULES := $(VENV)/.modules-$(shell find gsparc ops callbacks conf -name '*.py' | LC_ALL=C sort | cksum | cut -d' ' -f1)

.DEFAULT_GOAL := help
RFID ?= ../shared/data/rfid-s23-160
DIST ?= dist
# Its own objects, made anew: those of another compiler would be taken as they are.
WHEEL ?= -Cbuild-dir=build/wheel/objects
GRID ?=
.PHONY: browser grid oracle rare results help setup sionna cuda docs wheel demo test test-slow hard-cases bench lint typecheck format clean

help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup: $(VENV)/.installed ## make the environment and build the kernels

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else f"gsparc needs Python 3.11 or newer; {sys.executable} is {sys.version.split()[0]}. Say: make PYTHON=python3.11")'
	@command -v c++ >/dev/null || command -v g++ >/dev/null || command -v clang++ >/dev/null || { echo "gsparc needs a C++17 compiler (for example: apt-get install g++)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(MODULES): $(VENV)/.python
	@rm -f $(VENV)/.modules-*
	@touch $@

$(VENV)/.installed: $(VENV)/.python pyproject.toml constraints.txt $(SOURCES) $(MODULES)
	@echo "Installing what gsparc needs into $(VENV) (a few minutes the first time)"
	$(VENV)/bin/pip install --quiet -c constraints.txt torch
	$(VENV)/bin/pip install --quiet -c constraints.txt -e '.[cluster,dev,hub,itm,maps,ray,serve,sweep,tables,viewer,wifi]'
	@touch $@

sionna: $(VENV)/.sionna ## what `gsparc simulate` needs: Sionna, an LLVM that works with it, without root, readers of maps

$(VENV)/.docs: $(VENV)/.installed
	@$(RUN) -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['optional-dependencies']['docs'], sep='\n')" > $(VENV)/docs.txt
	$(VENV)/bin/pip install --quiet -c constraints.txt -r $(VENV)/docs.txt
	@touch $@

docs: setup $(VENV)/.docs named ## run the tutorials and build the documentation site, strictly: build/site/index.html
	$(RUN) docs/site/notebooks.py
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --quiet --strict

# The older the C library it is built against, the more systems it runs on: releases are built in an image of manylinux_2_28.
wheel: setup ## a wheel that needs no compiler, into dist/, marked for the oldest Linux it runs on
	rm -rf build/wheel $(DIST)/gsparc-*.whl && $(RUN) -m pip wheel --quiet --no-deps --no-build-isolation $(WHEEL) -w build/wheel .
	PATH="$(abspath $(VENV)/bin):$$PATH" $(RUN) -m auditwheel repair --wheel-dir $(DIST) build/wheel/*.whl

$(VENV)/.sionna: $(VENV)/.installed
	$(VENV)/bin/pip install --quiet -c constraints.txt sionna-rt sionna osmnx shapely trimesh mapbox_earcut
	$(RUN) -m gsparc.simulate.llvm
	@touch $@

demo: setup ## train on a small simulated site, print the table, draw the spectra (half a minute)
	$(RUN) train.py experiment=demo hydra.run.dir=demo

test: setup ## fast tests (five minutes on two idle cores)
	$(PYTEST) -m "not slow"

browser: ## Debian's chromium for the test of the report, where packages can be reached
	@command -v chromium >/dev/null && command -v chromedriver >/dev/null || (apt-get update -qq && apt-get install -y -qq chromium chromium-driver) >/dev/null 2>&1 || echo "no chromium here: the test of the report in a browser is skipped"

results: setup ## tables of docs/results.md in outputs/results/report, measured anew (of gsparc data rfid-200, or of RFID=DIR; about five minutes)
	$(RUN) train.py -m experiment=results $(if $(RFID),dataset.root=$(RFID),dataset.listed=160) hydra.sweep.dir=outputs/results
	$(RUN) -m gsparc report outputs/results hydra.run.dir=outputs/results/report

test-slow: setup sionna browser $(VENV)/.docs ## slow tests: whole training runs, kills, sanitizers, ray tracing
	$(PYTEST) -m "slow and not rare"

rare: setup sionna browser $(VENV)/.docs ## what takes minutes each: furnished rooms, all commands of all pages
	$(PYTEST) -m rare

hard-cases: setup ## every hard case on every backend, and the tables of docs/hard-cases.md
	$(RUN) -m pytest tests/hard_cases --table docs/hard-cases.md

grid: setup ## every kind of data with defaults beside the plain methods (two hours, resumable; GRID=--seed 7: others)
	$(RUN) tests/grid/sweep.py build/grid/results$(subst $() ,,$(GRID)).jsonl $(GRID)

oracle: setup ## what fits and answers of fixed problems moved since BASE=COMMIT, both trees on this machine (five minutes)
	OMP_NUM_THREADS=1 $(RUN) tests/oracle/two_trees.py $(or $(BASE),HEAD)

bench: setup ## seconds of the kernels beside plain PyTorch
	$(RUN) -m gsparc bench

cuda: setup ## build the CUDA kernels for this machine's GPU (otherwise done when first used)
	$(RUN) -P -m gsparc.ops.cuda_library

lint: setup style typecheck ## ruff and mypy

.PHONY: style
style: setup
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

.PHONY: named
named: # the packages under their installed names
	@rm -rf build/typed && mkdir -p build/typed/gsparc
	@cp -rs $(CURDIR)/gsparc/. build/typed/gsparc/ && for room in ops callbacks conf; do cp -rs $(CURDIR)/$$room build/typed/gsparc/; done

typecheck: setup named ## mypy over the packages under their installed names
	cd build/typed && $(CURDIR)/$(RUN) -m mypy --config-file $(CURDIR)/pyproject.toml gsparc

format: setup ## let ruff rewrite the code
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

clean: ## remove what was built (keeps runs)
	rm -rf $(VENV) build .pytest_cache .mypy_cache .ruff_cache
