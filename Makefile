# make run    a virtual environment, the package in it, and the hexacopter trained
# make test   the same plus the tools of development: style, types, documentation, tests
# make slow   the tests that `make test` leaves out for their time
# make docs   the documentation as a site, into build/docs
# make blocks runs the commands whose output the documentation shows, and writes what they print today into its pages
# make golden writes the files anew that tests/golden holds behaviour against
# make clean  removes the environment and the caches; runs stay
#
# PYTHON chooses the interpreter, PIP_FLAGS goes to every `pip install` (an index of CPU builds of torch, say), JOBS is
# the number of test files that run at a time, one core each.

PYTHON ?= python3
PIP_FLAGS ?=
JOBS ?= 2
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) --constraint constraints.txt
# Tests run one torch thread: more make small rollouts slower, up to a thousand times on a busy machine.
TEST_ENV := OMP_NUM_THREADS=1 MPLBACKEND=Agg
PYTEST = $(TEST_ENV) $(BIN)/python -m pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder

.PHONY: run test lint types docs pytest slow blocks golden clean
.DEFAULT_GOAL := run

run: $(VENV)/.installed
	$(BIN)/nsde train system=hexacopter

# What needs no test runs side by side, then the tests, which take all cores.
test: $(VENV)/.installed-dev
	$(MAKE) --jobs=$(JOBS) --output-sync lint types docs
	$(MAKE) pytest

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev
	$(BIN)/mypy

# Strict: a warning (a link that leads nowhere, a name that the code lost) ends it.
docs: $(VENV)/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(TEST_ENV) $(BIN)/mkdocs build --strict --quiet --config-file docs/mkdocs.yml

# Files in the order of their names: by their numbers of tests, the last would be those of one long test.
pytest: $(VENV)/.installed-dev
	$(PYTEST) -m 'not slow'

slow: $(VENV)/.installed-dev
	$(PYTEST) -m slow

blocks: $(VENV)/.installed-dev
	$(TEST_ENV) $(BIN)/python docs/blocks.py

golden: $(VENV)/.installed-dev
	$(TEST_ENV) $(BIN)/python -m pytest tests/golden --regenerate

# The stamps make a second `make` quick; a changed requirement installs anew.
$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) --editable '.[dev,docs]'
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
