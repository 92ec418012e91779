# Everything runs in a virtual environment in .venv, made when first needed from `python3` (3.11 or
# newer; another one: `make demo PYTHON=python3.12`). `make help` lists the targets.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
NEWEST := .venv-newest
# Tests compile a lot: two processes are nearly twice as fast as one, more need more memory.
WORKERS ?= 2
# What `make test-newest` runs: the parts that depend most on the version of JAX, in about ten minutes on two
# cores. Others by `make test-newest CORE="costs io"`.
CORE ?= _base mesh energies adjoints solvers fitting relax/test_relaxation.py project/test_compilations.py

# Python compiles a module when it imports it first. (To compile all of them takes 20 s and more.)
PIP_INSTALL := -m pip install --quiet --no-compile --editable

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-thorough test-docs test-experiments test-slow test-newest check notebooks notebooks-write lint format types docs benchmark build clean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1 \t\2/p' $(MAKEFILE_LIST) | expand -t 22

demo: $(VENV)/.base ## infer hidden shape factors of a synthetic tissue and show how well it went
	$(BIN)/vertax run configs/demo.toml $(DEMO_OPTIONS)

test: $(VENV)/.dev ## the tests that run on every change
	$(BIN)/python tests/run.py --workers $(WORKERS) --without experiments $(PYTEST_OPTIONS)

test-thorough: $(VENV)/.dev ## tests that compile for longer; other solvers, adjoints and boundaries
	$(BIN)/python tests/run.py --workers $(WORKERS) -m "thorough and not slow" $(PYTEST_OPTIONS)

test-docs: $(VENV)/.dev ## the code in the README and in the documentation
	$(BIN)/python tests/run.py --only project/test_code_blocks.py -m docs $(PYTEST_OPTIONS)

test-experiments: $(VENV)/.dev ## short runs of each experiment
	$(BIN)/python tests/run.py --workers $(WORKERS) --only experiments -m "experiments and not slow" $(PYTEST_OPTIONS)

test-slow: $(VENV)/.dev ## the longer scientific checks
	$(BIN)/python tests/run.py --workers $(WORKERS) -m slow $(PYTEST_OPTIONS)

test-newest: $(NEWEST)/.dev ## the core tests with the newest Python of this machine and the newest JAX
	@if [ -e $(NEWEST)/.dev ]; then \
	    $(NEWEST)/bin/python -c "import jax, platform; print('Python', platform.python_version(), 'and JAX', jax.__version__)"; \
	    $(NEWEST)/bin/python tests/run.py --workers $(WORKERS) $(addprefix --only ,$(CORE)) $(PYTEST_OPTIONS); \
	else \
	    echo "Not tested: this machine has no Python 3.12 to 3.14."; \
	fi

# Each part runs even if one before it fails; the last lines name the parts that failed.
CHECKS := lint types docs test test-thorough test-docs test-experiments notebooks test-newest test-slow
check: ## all tests, with those that take hours: before a larger change is called done
	@failed=; for part in $(CHECKS); do \
	    echo "=== $$part"; $(MAKE) --no-print-directory $$part || failed="$$failed $$part"; \
	done; \
	if [ -n "$$failed" ]; then echo "Failed:$$failed"; exit 1; fi; echo "All parts passed: $(CHECKS)"

notebooks: $(VENV)/.dev ## execute the notebooks, shortened; their outputs stay as they are
	$(BIN)/python notebooks/execute.py --light --jobs $(WORKERS)

notebooks-write: $(VENV)/.dev ## execute the notebooks in full and keep the outputs
	$(BIN)/python notebooks/execute.py --write

lint: $(VENV)/.dev ## style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python .ci/prose.py

format: $(VENV)/.dev ## mend style and format where a program can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(VENV)/.dev ## static types; those of a project that builds on vertax strictly
	$(BIN)/pyright
	$(BIN)/pyright --project tests/project/downstream

# Material announces a change of MkDocs that pyproject.toml rules out.
docs: export NO_MKDOCS_2_WARNING := 1
docs: $(VENV)/.docs ## the documentation in site; what it cannot resolve is an error
	$(BIN)/python -m mkdocs build --strict

benchmark: $(VENV)/.dev ## measure speed; nothing else should run meanwhile
	@for script in benchmarks/[a-z]*.py; do \
	    echo "== $$script"; $(BIN)/python "$$script" || exit 1; \
	done

build: $(VENV)/.dev ## wheel and source archive in dist
	rm -rf dist
	$(BIN)/python -m build

clean: ## remove the environment, caches and builds, but no results
	rm -rf $(VENV) $(NEWEST) build dist site *.egg-info .cache .pytest_cache .ruff_cache .hypothesis
	find . -name .git -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp is newer than pyproject.toml when the environment holds what that asks for. The package itself
# is installed in place, so changes of its code need no new set-up.
$(VENV)/.base: pyproject.toml | $(BIN)/python
	@echo "Setting up $(VENV); this takes a minute or two and happens once."
	$(BIN)/python $(PIP_INSTALL) '.[run]'
	@touch $@

$(VENV)/.dev: pyproject.toml | $(BIN)/python
	@echo "Setting up $(VENV) for development; this takes a few minutes and happens once."
	$(BIN)/python $(PIP_INSTALL) '.[dev]'
	@touch $@ $(VENV)/.base

$(VENV)/.docs: pyproject.toml | $(BIN)/python
	@echo "Setting up $(VENV) for the documentation; this takes a minute or two and happens once."
	$(BIN)/python $(PIP_INSTALL) '.[docs]'
	@touch $@

# Made anew each time, so that it has the newest versions; without Python 3.12 there is none, and no stamp. (pyenv
# finds a version only if it is active.)
$(NEWEST)/.dev: pyproject.toml | $(BIN)/python
	@rm -rf $(NEWEST)
	@python=$$(for version in 3.14 3.13 3.12; do \
	    PYENV_VERSION=$$(pyenv whence python$$version 2>/dev/null | tail -n 1) \
	        python$$version -c 'import ensurepip, sys; print(sys.executable)' 2>/dev/null && break; \
	done); \
	if [ -n "$$python" ]; then \
	    echo "Setting up $(NEWEST) with $$python; this takes a few minutes and happens once."; \
	    "$$python" -m venv $(NEWEST) && \
	    $(NEWEST)/bin/python $(PIP_INSTALL) '.[dev]' && \
	    touch $@; \
	fi

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { \
	    echo "There is no program $(PYTHON). Install Python 3.11 or newer, or name one: make PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "vertax needs Python 3.11 or newer, but $(PYTHON) is $$($(PYTHON) -V 2>&1). Name a newer one: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
