# Two commands a newcomer needs: `make demo` and `make test`. Both set everything up first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
FITS := $(VENV)/.fits
READY := $(VENV)/.ready
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

export OPENBLAS_NUM_THREADS ?= 1
# a new environment holds no bytecode: unwritten, every process would compile its libraries anew
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all test-fast lint docs bench clean

$(FITS): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) -e .
	touch $(FITS)

$(READY): $(FITS)
	$(INSTALL) -e '.[test,dev,docs,cluster,service]'
	touch $(READY)

demo: $(FITS)  ## fit the five recordings that ship with the project
	$(BIN)/tune --flights reference_flights/*.bag --out runs/demo

test: $(READY)  ## every test but what is marked long: that repeats others at length
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not long"

test-all: $(READY)  ## every test, all code optimised; more than an hour on two cores
	TUNE_TESTS_OPTIMISED=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test-fast: $(READY)  ## what a change is checked against while it is being made
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow and not long"

lint: $(READY)  ## style, types, and who may import whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

docs: $(READY)  ## reference pages from the code, then the site into build/site
	$(BIN)/python -m docs.generate
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

bench: $(READY)  ## measure everything and write benchmarks/RESULTS.md; needs a quiet machine
	$(INSTALL) -e '.[bench]' || true
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) runs
