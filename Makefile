# Everything a fresh machine needs: Python 3.11-3.13 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: help setup demo test test-slow lint bench clean

help:
	@echo "make demo       set up, train TF-Lane with and without traffic flow on the built-in world, print the table"
	@echo "make test       set up, lint, run the tests (what CI runs)"
	@echo "make test-slow  the checks that take minutes"
	@echo "make lint       ruff and pyright"
	@echo "make bench      the benchmarks, as JSON under runs/bench"

# Constraints pin every version; the index is whatever pip is configured with.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] <= (3, 13) else "tflane_jax needs Python 3.11 to 3.13; set PYTHON=python3.12, say")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

setup: $(STAMP)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/pyright

test: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/python -m pytest -q --numprocesses 2 --dist loadfile --durations=15

test-slow: $(STAMP)
	$(BIN)/python -m pytest -q -m slow --durations=15

demo: $(STAMP)
	$(BIN)/tflane demo

bench: $(STAMP)
	$(BIN)/tflane bench --out runs/bench

clean:
	rm -rf $(VENV) runs .pytest_cache .ruff_cache .hypothesis
