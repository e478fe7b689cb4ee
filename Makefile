# Every target installs what it needs into .venv first, when that is missing or older than pyproject.toml.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CONSTRAINTS := constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: demo test test-fast bench docs lint format type commit-checks

demo: $(VENV)/.demo
	@echo "make demo: training; it shows its progress"
	$(BIN)/python examples/quickstart.py

test: $(VENV)/.dev
	$(BIN)/python -m pytest -n 2 --dist worksteal tests

# What a change is tried with; CI runs all of them.
test-fast: $(VENV)/.dev
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow" tests

bench: $(VENV)/.dev
	$(BIN)/python benchmarks/run.py

docs: $(VENV)/.dev
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "make docs: open docs/_build/html/index.html"

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Types are checked in the package as it is installed, where wrappers/ is sb3_ctco.wrappers.
type: $(VENV)/.dev
	rm -rf build .typecheck
	$(BIN)/pip install --quiet --no-deps --no-build-isolation --target .typecheck .
	cd .typecheck && ../$(BIN)/mypy --config-file ../pyproject.toml --python-executable ../$(BIN)/python -p sb3_ctco

commit-checks: format type lint

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 14))' \
		|| { echo "sb3-ctco needs Python 3.10 to 3.13; name one: make PYTHON=python3.12 ..."; exit 1; }
	@echo "make: making a virtual environment in $(VENV)"
	@$(PYTHON) -m venv $(VENV) \
		|| { rm -rf $(VENV); echo "On Debian the venv module is a package of its own: apt install python3-venv"; exit 1; }

$(VENV)/.demo: $(VENV)/bin/python pyproject.toml $(CONSTRAINTS)
	@echo "make: installing the package with PyTorch and MuJoCo into $(VENV): several hundred megabytes, a few minutes, once"
	$(BIN)/pip install --quiet --constraint $(CONSTRAINTS) --editable '.[demo]'
	touch $@

$(VENV)/.dev: $(VENV)/bin/python pyproject.toml $(CONSTRAINTS)
	@echo "make: installing the package and the tools of development into $(VENV): a gigabyte or more, some minutes, once"
	$(BIN)/pip install --quiet --constraint $(CONSTRAINTS) setuptools wheel
	$(BIN)/pip install --quiet --constraint $(CONSTRAINTS) --editable '.[dev]'
	touch $@ $(VENV)/.demo
