# make run    a virtual environment, the package in it, and the hexacopter trained
# make test   the same plus the tools of development: style, types, tests
# make golden writes the files anew that tests/golden holds behaviour against
# make clean  removes the environment and the caches; runs stay
#
# PYTHON chooses the interpreter, PIP_FLAGS goes to every `pip install` (an index of CPU builds of torch, say).

PYTHON ?= python3
PIP_FLAGS ?=
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) --constraint constraints.txt
# Tests run one torch thread: more make small rollouts slower, up to a thousand times on a busy machine.
TEST_ENV := OMP_NUM_THREADS=1 MPLBACKEND=Agg

.PHONY: run test lint types pytest golden clean
.DEFAULT_GOAL := run

run: $(VENV)/.installed
	$(BIN)/nsde train system=hexacopter

test: lint types pytest

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed-dev
	$(BIN)/mypy

pytest: $(VENV)/.installed-dev lint types
	$(TEST_ENV) $(BIN)/python -m pytest

golden: $(VENV)/.installed-dev
	$(TEST_ENV) $(BIN)/python -m pytest tests/golden --regenerate

# The stamps make a second `make` quick; a changed requirement installs anew.
$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(PIP) --editable '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
