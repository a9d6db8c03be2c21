# Each target sets up .venv (test-core: .venv-core) by itself the first time, and again when pyproject.toml or
# constraints.txt changes.
# PYTHON picks the interpreter that makes it: make test PYTHON=python3.12

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := -m pip --disable-pip-version-check --no-input
CORE := .venv-core

.DEFAULT_GOAL := help
.PHONY: help demo test test-core lint fuzz setup clean

help: ## print this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1|\2/p' $(firstword $(MAKEFILE_LIST)) | \
	  while IFS='|' read -r target text; do printf '  make %-9s %s\n' "$$target" "$$text"; done

demo: $(VENV)/.installed ## align two shipped scans and write the page to look at
	$(BIN)/idam demo

test: $(VENV)/.installed-dev ## run the tests
	$(BIN)/python -m pytest -n auto --dist loadfile

test-core: $(CORE)/.installed ## run the tests of the core in an environment of the core alone
	$(CORE)/bin/python -m pytest -n auto --dist loadfile --ignore tests/network --ignore tests/lab --ignore tests/rivals

lint: $(VENV)/.installed-dev ## check style and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

fuzz: $(VENV)/.installed-dev ## try fresh damaged input for MINUTES (10), keep what fails
	$(BIN)/python benchmarks/fuzz.py --minutes $(or $(MINUTES),10)

setup: $(VENV)/.installed-dev ## only set up .venv for development

clean: ## remove caches and build outputs, but not .venv
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests examples benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/pip
	$(BIN)/python $(PIP) install -c constraints.txt -e .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(BIN)/pip
	$(BIN)/python $(PIP) install -c constraints.txt -e '.[dev]'
	@touch $@ $(VENV)/.installed

# without trimesh: all but the meshes has to do without it
$(CORE)/.installed: pyproject.toml constraints.txt | $(CORE)/bin/pip
	$(CORE)/bin/python $(PIP) install -c constraints.txt -e . pytest pytest-timeout pytest-xdist hypothesis
	$(CORE)/bin/python $(PIP) uninstall --yes trimesh
	@touch $@

# pip rather than python is the sign of a whole environment: without ensurepip, venv stops between the two.
$(BIN)/pip $(CORE)/bin/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	  { echo 'idam needs Python 3.10 or newer: install it, or name it with make PYTHON=python3.12' >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  package=$$($(PYTHON) -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'); \
	  root=; [ "$$(id -u)" = 0 ] || root='sudo -n'; \
	  command -v apt-get >/dev/null && $$root true 2>/dev/null && $$root apt-get update -q && \
	  $$root env DEBIAN_FRONTEND=noninteractive apt-get install -q -y "$$package" || \
	  { echo "$(PYTHON) cannot make virtual environments: install $$package (apt-get install $$package)" >&2; exit 1; }; }
	$(PYTHON) -m venv $(@:/bin/pip=)
