# On a machine with Python 3.11 or newer, `make run` and `make test` install everything that they need.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SCENARIO ?= scenarios/step.yaml
PARTS ?=
AGAINST ?=
WORKERS ?= 4
FLIGHT := python
CONSTRAINTS ?= constraints.txt
KERNELS := $(shell grep -rlF --include=*.py zsim.math.compiled zsim world agents)
# Constraints are set in the environment, so that they apply to the build of zsim too; empty: the newest versions.
HELD = PIP_CONSTRAINT=$(CONSTRAINTS) PIP_BUILD_CONSTRAINT=$(CONSTRAINTS)
PIP = $(HELD) $(BIN)/pip install --disable-pip-version-check --no-compile
COMPILED = @$(MAKE) --silent --no-print-directory $(VENV)/.compiled
export PYTHONDONTWRITEBYTECODE = # bytecode is written: pip has not compiled the files that many processes import

.PHONY: run test setup lint soak bench docs constraints clean help

help:            ## list the commands
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

run: $(VENV)/.run ## install what a flight needs, fly Test 1 of the paper as separate processes, and make its report
	$(COMPILED)
	$(BIN)/zsim run $(SCENARIO)

test: $(VENV)/.dev ## run the tests
	@$(MAKE) --silent --no-print-directory -j2 $(VENV)/.compiled $(VENV)/.bytecode
	$(BIN)/pytest -n $(WORKERS) --dist loadgroup -m "not soak"

setup: $(VENV)/.all ## install every extra into .venv: console, cameras, exports, sweeps, hosts, ROS
	$(COMPILED)

lint: $(VENV)/.dev ## check style, types, and which package may import which
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

soak: $(VENV)/.dev ## run the long tests and those with many repetitions
	$(COMPILED)
	$(BIN)/pytest -n 0 -m soak

bench: $(VENV)/.dev ## measure everything, or PARTS='a b'; PARTS=c AGAINST=REV compares with a commit; see docs/performance.md
	$(COMPILED)
	$(BIN)/python -m benchmarks $(PARTS) $(if $(AGAINST),--against $(AGAINST))

docs: $(VENV)/.dev ## build the Python reference from the docstrings, in build/api
	$(BIN)/sphinx-build -W --keep-going -q docs/api build/api
	@echo "build/api/index.html"

constraints: $(VENV)/bin/python ## rewrite constraints.txt with the newest versions of all packages, for Python 3.11 to 3.14
	@$(BIN)/pip install --disable-pip-version-check -q uv
	@{ sed -n '/^#/p' constraints.txt; echo hatchling | \
		$(BIN)/uv pip compile pyproject.toml - --extra dev --extra notebook --universal --python-version 3.11 --upgrade \
		--no-emit-index-url --no-header --no-annotate -q; } >constraints.new && mv constraints.new constraints.txt

clean:           ## remove the environment and the caches of tools
	rm -rf $(VENV) .venv-bench .pytest_cache .ruff_cache .hypothesis .import_linter_cache

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "zsim needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1). Give PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || \
		{ echo "Python's venv module is missing; on Debian: apt-get install python3-venv"; exit 1; }
	@echo "creating the environment $(VENV) with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv $(VENV)

# The output of pip is shown, because over a slow network or disk this takes minutes.
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

# A separate target, so that it runs in parallel with those that need no kernels. Two processes compile; each uses the
# functions that the other has compiled. Changed kernels are compiled here, since otherwise every process of a flight
# would compile them.
$(VENV)/.compiled: pyproject.toml $(KERNELS)
	@echo "compiling the kernels, which takes about a minute; once on this machine, and after changes of their files"
	@$(BIN)/python -P -m zsim_deploy.roles.warm_up agents & agents=$$!; \
		$(BIN)/python -P -m zsim_deploy.roles.warm_up world; world=$$?; wait $$agents && exit $$world
	@touch $@

# Compiles the imports of the tests to bytecode once; otherwise all WORKERS do so at the same time, which takes 15 s.
$(VENV)/.bytecode: pyproject.toml
	@$(BIN)/pytest -n 0 --collect-only -q >/dev/null 2>&1 || true # the tests themselves report errors
	@touch $@
