# Two commands do all the set-up: `make run` (the main job) and `make test` (everything that must hold).
# PYTHON: 3.11 or newer. TORCH_ARGS: extra pip arguments for torch, such as the index of PyTorch's CPU builds.
# JOBS: processes that test side by side.
PYTHON ?= python3
VENV ?= .venv
TORCH_ARGS ?=
JOBS ?= 2
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: run test format picture clean

run: $(VENV)/installed
	@$(BIN)/neurove demo

test: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	MYPYPATH=$(VENV)/packages $(BIN)/mypy
	$(BIN)/python tests/wheel.py
	$(BIN)/pytest --numprocesses $(JOBS) --dist loadgroup --no-loadscope-reorder --cov --cov-report=term

picture: $(VENV)/installed  # the picture in README, of a simulated street with its truth
	@$(BIN)/neurove demo "sim://street?seed=7&seconds=8" --screenshot service/pictures/demo.svg

format: $(VENV)/installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) build dist *.egg-info .coverage* .mypy_cache .pytest_cache .ruff_cache .hypothesis

$(VENV)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "make: $(PYTHON) is $$($(PYTHON) --version 2>&1): Python 3.11 or newer is needed, set PYTHON=..."; exit 1; }
	@echo "setting up $(VENV): some minutes the first time"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) $(TORCH_ARGS) torch
	@touch $@

# Type checkers do not follow the mapping of folders to packages in pyproject.toml; these links show it to them.
$(VENV)/packages: $(VENV)/python
	@mkdir -p $@
	@ln -sfn $(CURDIR)/protocol $@/neurove_protocol
	@ln -sfn $(CURDIR)/neurove_core $@/neurove_core
	@ln -sfn $(CURDIR)/service $@/neurove_service

$(VENV)/installed: $(VENV)/python pyproject.toml constraints.txt
	@$(PIP) -e '.[serve,recordings,experiments]'
	@touch $@

$(VENV)/installed-dev: $(VENV)/installed $(VENV)/packages
	@$(PIP) -e '.[dev]'
	@touch $@
