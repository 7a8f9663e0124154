# Every command of the project. `make` lists them; none needs more than git, make and Python 3.11 or newer.

PYTHON ?= python3
JOBS ?= 2
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# Small tensors: threads that wait for each other cost more than they give, so parallel work comes from processes.
RUN := OMP_NUM_THREADS=1 $(BIN)/python -m
PYTEST := $(RUN) pytest -n $(JOBS) --dist worksteal -q

.DEFAULT_GOAL := help
.PHONY: help env lint format test test-slow demo clean

help: ## list the commands
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' Makefile

env: $(STAMP) ## make .venv and install the project (again only when what it needs has changed)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "error: $(PYTHON) is missing or older than 3.11; name another one: make env PYTHON=python3.12" >&2; \
	    exit 1; }
	@$(PYTHON) -m venv $(VENV) || { \
	    rm -rf $(VENV); \
	    echo "error: $(PYTHON) cannot make a virtual environment; install its venv module (Debian: python3-venv)" >&2; \
	    exit 1; }

$(STAMP): pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing into $(VENV); the first time takes minutes"
	@$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[sumo,argoverse,video,ray,dev]'
	@touch $@

lint: env ## style, spelling and who may import whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/lint-imports

format: env ## put the code into the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

test: lint ## all checks: lint, tests and the examples in docstrings
	$(PYTEST)

test-slow: env ## the tests of more than ten seconds
	$(PYTEST) -m slow

demo: env ## the whole method on synthetic scenes, on a CPU
	$(RUN) recipes.compare --config-name demo

clean: ## remove the environment and what tools cached
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
