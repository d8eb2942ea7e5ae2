# All the set-up on a machine that has only Python, make and git: `make bench` and `make test`;
# `make bounds` runs some of the tests once more with every array access in the kernels checked.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip --disable-pip-version-check --quiet

.PHONY: bench test bounds clean

bench: .stamps/core
	$(BIN)/polyexplore bench --out results/bench

test: .stamps/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2

# Compiled apart: kernels with checks must not take the place of those without.
bounds: .stamps/dev
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(CURDIR)/.bounds-cache $(BIN)/pytest -n 2 --dist loadfile -m 'bounds and not slow'

.stamps/venv:
	$(PYTHON) -m venv $(VENV)
	mkdir -p .stamps && touch $@

.stamps/core: .stamps/venv pyproject.toml constraints.txt
	$(PIP) install -c constraints.txt -e '.[plots]'
	touch $@

# torch first and by its exact version: a resolver left alone takes a CUDA build of gigabytes.
.stamps/dev: .stamps/venv pyproject.toml constraints.txt
	$(PIP) install -c constraints.txt torch==2.13.0
	$(PIP) install -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) .stamps .bounds-cache results
