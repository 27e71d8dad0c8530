# Two commands do it all on a machine with Python 3.11 or newer: `make run` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SCENARIO ?= scenarios/step.yaml
PARTS ?=
AGAINST ?=
WORKERS ?= 4
FLIGHT := python
CONSTRAINTS ?= constraints.txt
# by the environment, so that what builds zsim is held to the same versions; empty: the newest of everything
HELD = PIP_CONSTRAINT=$(CONSTRAINTS) PIP_BUILD_CONSTRAINT=$(CONSTRAINTS)
PIP = $(HELD) $(BIN)/pip install --disable-pip-version-check --no-compile
COMPILED = @$(MAKE) --silent --no-print-directory $(VENV)/.compiled
export PYTHONDONTWRITEBYTECODE = # many processes import the same files, and pip has not compiled them

.PHONY: run test setup lint soak bench docs constraints clean help

help:            ## list the commands
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

run: $(VENV)/.run ## fly Test 1 of the paper as real processes and report it; installs what a flight needs
	$(COMPILED)
	$(BIN)/zsim run $(SCENARIO)

test: $(VENV)/.dev ## run the tests
	@$(MAKE) --silent --no-print-directory -j2 $(VENV)/.compiled $(VENV)/.bytecode
	$(BIN)/pytest -n $(WORKERS) --dist loadgroup -m "not soak"

setup: $(VENV)/.all ## install every extra into .venv: console, cameras, exports, sweeps, hosts, ROS
	$(COMPILED)

lint: $(VENV)/.dev ## style, types, and who may import whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

soak: $(VENV)/.dev ## repetitions and long runs
	$(COMPILED)
	$(BIN)/pytest -n 0 -m soak

bench: $(VENV)/.dev ## measure, all or PARTS='a b'; PARTS=c AGAINST=REV: beside a commit; see docs/performance.md
	$(COMPILED)
	$(BIN)/python -m benchmarks $(PARTS) $(if $(AGAINST),--against $(AGAINST))

docs: $(VENV)/.dev ## the reference of zsim in Python, from its docstrings, into build/api
	$(BIN)/sphinx-build -W --keep-going -q docs/api build/api
	@echo "build/api/index.html"

constraints: $(VENV)/bin/python ## write constraints.txt anew: the newest versions of all packages, for Python 3.11 to 3.14
	@$(BIN)/pip install --disable-pip-version-check -q uv
	@{ sed -n '/^#/p' constraints.txt; echo hatchling | \
		$(BIN)/uv pip compile pyproject.toml - --extra dev --extra notebook --universal --python-version 3.11 --upgrade \
		--no-emit-index-url --no-header --no-annotate -q; } >constraints.new && mv constraints.new constraints.txt

clean:           ## remove the environment and what tools leave behind
	rm -rf $(VENV) .venv-bench .pytest_cache .ruff_cache .hypothesis .import_linter_cache

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "zsim needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1). Say PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || \
		{ echo "Python's venv module is missing; on Debian: apt-get install python3-venv"; exit 1; }
	@echo "making the environment $(VENV) with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv $(VENV)

# pip's own output is shown: on a slow line or disk this takes minutes
$(VENV)/.run: pyproject.toml $(CONSTRAINTS) | $(VENV)/bin/python
	@echo "installing what a flight needs (extras $(FLIGHT); about 600 MB; \`make setup\` installs all extras)"
	@$(PIP) -e '.[$(FLIGHT)]'
	@touch $@

$(VENV)/.all: pyproject.toml $(CONSTRAINTS) | $(VENV)/bin/python
	@echo "installing all extras (about 1.2 GB)"
	@$(PIP) -e '.[all]'
	@touch $@ $(VENV)/.run

$(VENV)/.dev: pyproject.toml $(CONSTRAINTS) | $(VENV)/bin/python
	@echo "installing all extras and what the tests need (about 3 GB)"
	@$(PIP) -e '.[dev]'
	@touch $@ $(VENV)/.all $(VENV)/.run

# of its own, so that it can go on beside what needs no kernel; in two processes, of which the second one to come to a
# function finds it compiled
$(VENV)/.compiled: pyproject.toml
	@echo "compiling what flies, once on this machine: about a minute"
	@$(BIN)/python -P -m zsim_deploy.roles.warm_up agents & agents=$$!; \
		$(BIN)/python -P -m zsim_deploy.roles.warm_up world; world=$$?; wait $$agents && exit $$world
	@touch $@

# compiles what the tests import to bytecode, once; without it, each of the WORKERS does so at the same time, which takes
# each a quarter of a minute
$(VENV)/.bytecode: pyproject.toml
	@$(BIN)/pytest -n 0 --collect-only -q >/dev/null 2>&1 || true # the tests themselves report what fails
	@touch $@
