# Two commands do all the set-up: `make run` (the main job) and `make test` (everything that must hold).
# PYTHON: 3.11 or newer. TORCH_ARGS: extra pip arguments for torch, such as the index of PyTorch's CPU builds.
# HASHES: the packages with the hashes of their files. Empty (make HASHES= ...) installs by version only, for an index
# whose files are not those of hashes.txt. JOBS: processes that test side by side.
PYTHON ?= python3
VENV ?= .venv
TORCH_ARGS ?=
HASHES ?= hashes.txt
JOBS ?= 2
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check

.PHONY: run test test-pythons coverage ros2 format picture docs wheel image clean

run: $(VENV)/warm
	@echo "with a live page for browsers: $(BIN)/neurove demo --page"
	@$(BIN)/neurove demo

test: $(VENV)/warm $(VENV)/packages
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	MYPYPATH=$(VENV)/packages $(BIN)/mypy
	$(BIN)/python tests/wheel.py
	$(BIN)/pytest --numprocesses $(JOBS) --dist loadgroup --no-loadscope-reorder

coverage: $(VENV)/warm  # the tests with the share of lines and branches that they run; it takes half as long again
	$(BIN)/pytest --numprocesses $(JOBS) --dist loadgroup --no-loadscope-reorder --cov --cov-report=term

test-pythons: $(VENV)/installed  # some tests with each Python from 3.11 to 3.14 that is at hand; PYTHONS_ARGS: see the module
	$(BIN)/python -m tests.long.pythons $(PYTHONS_ARGS)

ros2: .venv-ros2/ready  # for the tests with real nodes of ROS 2; without it they are skipped

.venv-ros2/ready: tests/ros2/install.sh tests/ros2/make_messages.py tests/ros2/requirements.txt
	@sh tests/ros2/install.sh $(PYTHON) .venv-ros2

picture: $(VENV)/installed  # the pictures in README and in the guides, of simulated streets; the page needs Chromium
	@$(BIN)/neurove demo "sim://street?seed=7&seconds=8" --force --screenshot service/pictures/demo.svg
	@$(BIN)/python -m tests.long.page_picture
	@$(BIN)/python -m tests.long.docs_pictures

docs: $(VENV)/installed  # the documentation site in build/docs/site; a broken link is an error
	@$(BIN)/python deploy/docs/build.py build/docs

wheel: $(VENV)/installed  # in dist, with compiled code for x86-64-v3; CPUS: for these processors instead
	@$(BIN)/python deploy/wheel.py dist $(CPUS)

image:  # the container image `neurove`, with buildah; IMAGE_ARGS: further arguments of `buildah build`
	@deploy/image.sh neurove $(IMAGE_ARGS)

format: $(VENV)/installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf $(VENV) .venv-ros2* build dist *.egg-info .coverage* .mypy_cache .pytest_cache .ruff_cache .hypothesis

$(VENV)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "make: $(PYTHON) is $$($(PYTHON) --version 2>&1): Python 3.11 or newer is needed, set PYTHON=..."; exit 1; }
	@echo "setting up $(VENV): some minutes the first time"
	@$(PYTHON) -m venv $(VENV)
	@touch $@

# Type checkers do not follow the mapping of folders to packages in pyproject.toml; these links show it to them.
$(VENV)/packages: $(VENV)/python
	@mkdir -p $@
	@ln -sfn $(CURDIR)/protocol $@/neurove_protocol
	@ln -sfn $(CURDIR)/neurove_core $@/neurove_core
	@ln -sfn $(CURDIR)/service $@/neurove_service

# Three steps, because one hash makes pip ask for a hash of every package of the same call: the pinned packages with
# hashes, torch by version (its builds for CPU and GPU differ under one version), and NeuroVE.
$(VENV)/installed: $(VENV)/python pyproject.toml constraints.txt hashes.txt
ifneq ($(HASHES),)
	@$(PIP) install --require-hashes --no-deps -r $(HASHES)
	@$(PIP) install -c constraints.txt $(TORCH_ARGS) torch
	@$(PIP) install --no-deps --no-build-isolation -e .
else
	@$(PIP) install -c constraints.txt $(TORCH_ARGS) torch
	@$(PIP) install -c constraints.txt -e '.[dev]'
endif
	@$(PIP) check
	@touch $@

# Compiled ahead, so that a run or a test does not wait for it. Without changes this takes some seconds.
$(VENV)/warm: $(VENV)/installed $(shell find neurove_core -name '*.py')
	@$(BIN)/neurove warm-up
	@touch $@
