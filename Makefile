# Two commands, each with nothing before it:
#
#   make demo     installs sim2gp into .venv and learns to swing up a pendulum
#   make test     adds the test tools; lint, types, site, tests (at most 20 minutes, 2 cores)
#
# And `make docs` builds the site into build/docs/site, where a warning is an error.
# uv is used when it is on the PATH, else the standard library's venv and pip. Another
# interpreter: make test PYTHON=python3.13. More arguments: make demo ARGS="--seed 1".

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
UV := $(shell command -v uv 2>/dev/null)
ARGS ?=

ifeq ($(UV),)
  MAKE_VENV := $(PYTHON) -m venv $(VENV)
  INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check
else
  MAKE_VENV := $(UV) venv --quiet --allow-existing --python $(PYTHON) $(VENV)
  INSTALL := $(UV) pip install --quiet --python $(BIN)/python
endif

.PHONY: demo test lint types docs unit nightly figures format constraints clean help
.DEFAULT_GOAL := help

help:
	@sed -n '1,9s/^# \{0,1\}//p' Makefile

demo: $(VENV)/.core
	$(BIN)/sim2gp demo $(ARGS)

# The three checks run side by side, the tests alone.
test: $(VENV)/.test
	$(MAKE) -j3 lint types docs
	$(MAKE) unit

lint: $(VENV)/.test
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: $(VENV)/.test
	$(BIN)/mypy

# Plain pages and the docstrings become a folder that is read without a network.
docs: $(VENV)/.docs
	$(BIN)/python docs/site/stage.py build/docs/pages
	$(BIN)/zensical build --clean --strict

# Two processes, whole files each, and one cache of what they compile, empty at the start.
# Compilation is most of the time: by day XLA optimises nothing, by night as for users.
unit: export XLA_FLAGS = --xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1
unit: $(VENV)/.test
	@cache=$$(mktemp -d) && trap 'rm -rf "$$cache"' EXIT && \
	  export JAX_COMPILATION_CACHE_DIR="$$cache" && \
	  export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0 && \
	  $(BIN)/python -m pytest -m "not nightly" -n 2 --dist loadfile \
	    --no-loadscope-reorder $(ARGS)

nightly: $(VENV)/.test
	$(BIN)/python -m pytest -m nightly $(ARGS)

# Redraws figure 1 of the paper.
figures: $(VENV)/.core
	$(BIN)/sim2gp reproduce fig1 --out results/fig1 $(ARGS)

format: $(VENV)/.test
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# Needs uv. One universal file: pinned versions, no hosts, no hashes.
constraints:
	uv pip compile --quiet --universal --upgrade --python-version 3.11 --no-header \
	  --no-annotate --all-extras pyproject.toml --output-file constraints.txt
	grep -v '^sim2gp\b' constraints.txt > constraints.tmp && mv constraints.tmp constraints.txt

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "sim2gp needs Python 3.11 or newer; try: make $(MAKECMDGOALS) PYTHON=python3.11"; exit 1; }
	$(MAKE_VENV)

$(VENV)/.core: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -c constraints.txt -e .
	@touch $@

$(VENV)/.docs: $(VENV)/.core
	$(INSTALL) -c constraints.txt -e ".[docs]"
	@touch $@

$(VENV)/.test: $(VENV)/.core
	$(INSTALL) -c constraints.txt -e ".[docs,test]"
	@touch $@ $(VENV)/.docs
