# A fresh machine needs Python 3.11 to 3.13 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: help setup demo test test-slow lint types same-losses bench clean

help:
	@echo "make demo         set up, train with and without traffic flow on the built-in world, table and picture"
	@echo "make test         set up, lint, run the tests (what CI runs)"
	@echo "make test-slow    check types, run the longer tests"
	@echo "make lint         ruff (rules and format) and pyright"
	@echo "make same-losses  train every configuration in this checkout and in BEFORE=../before, compare bit by bit"
	@echo "make bench        the benchmarks, as JSON under runs/bench"
	@echo "make clean        delete the environment and the caches of these tools; trained runs stay"

# Constraints pin every version; the index is whatever pip is configured with. Two processes install half of the pinned
# packages each, which takes two thirds of the time of one; the last command adds what they could not install.
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check
$(STAMP): pyproject.toml setup.py constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] <= (3, 13) else "tflane_jax needs Python 3.11 to 3.13; set PYTHON=python3.12, say")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	-xargs -n 50 -P 2 $(PIP) --no-deps --only-binary=:all: < constraints.txt
	$(PIP) --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

setup: $(STAMP)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@$(MAKE) --no-print-directory types

# pyright needs Node.js; its Python package fetches one where none is installed.
types: $(STAMP)
	@if $(BIN)/pyright --version >/dev/null 2>&1; then $(BIN)/pyright; else echo "pyright skipped: it needs Node.js"; fi

PYTEST := $(BIN)/python -m pytest -q --numprocesses 2 --dist loadfile --no-loadscope-reorder --durations=15

test: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(PYTEST)

# Before a release. With types, `make test` would take a minute longer.
test-slow: types
	$(PYTEST) -m slow

# For a change that must not change a number: git worktree add ../before COMMIT, then for example
# make same-losses BEFORE=../before NAMES="tf_lane camera.toponet" STEPS=20
BEFORE ?= ../before
STEPS ?= 50
same-losses: $(STAMP)
	$(BIN)/python -m tests.same_losses $(BEFORE) $(NAMES) --steps $(STEPS)

demo: $(STAMP)
	$(BIN)/tflane demo

bench: $(STAMP)
	$(BIN)/tflane bench --out runs/bench

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis
