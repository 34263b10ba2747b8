# Everything here needs Python 3.11 and make; the rest is installed into .venv on first use.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed

# Small networks and several threads do not mix, least of all under parallel tests.
one_thread := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
announce = @printf '\n==> %s\n'

.DEFAULT_GOAL := help
.PHONY: help table test lint format pytest docs clean

help: ## list the targets
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "make %-8s %s\n", $$1, $$2 }'

table: $(INSTALLED) ## print the cartpole reward table, quick mode (about 3 minutes)
	@$(BIN)/trajlearn reproduce reward-table --task cartpole --quick

test: $(INSTALLED) ## everything a change must pass: lint, types, layers, tests, docs
	@$(MAKE) --no-print-directory lint
	@$(MAKE) --no-print-directory pytest
	@$(MAKE) --no-print-directory docs
	$(announce) 'all checks passed'

lint: $(INSTALLED) ## style, format, types and layers
	$(announce) 'ruff check'
	@$(BIN)/ruff check
	$(announce) 'ruff format --check'
	@$(BIN)/ruff format --check
	$(announce) 'mypy'
	@$(BIN)/mypy
	$(announce) 'lint-imports'
	@$(BIN)/lint-imports

format: $(INSTALLED) ## mend what ruff can mend
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format

pytest: $(INSTALLED) ## tests/ and the examples in the package's docstrings
	$(announce) 'pytest'
	@$(one_thread) MPLBACKEND=Agg $(BIN)/python -m pytest -n 2 --dist worksteal --durations=10

# -E: a notebook is run again although only the library has changed.
docs: $(INSTALLED) ## build the documentation into docs/_build/html and run its notebooks
	$(announce) 'sphinx-build'
	@$(one_thread) $(BIN)/sphinx-build -E -W --keep-going -q docs docs/_build/html
	@echo 'documentation: docs/_build/html/index.html'

clean: ## remove what was built, .venv included
	rm -rf .venv build dist *.egg-info docs/_build docs/api/generated docs/notebooks
	rm -rf .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find trajlearn tests benchmarks docs -type d -name __pycache__ -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml constraints.txt trajlearn/_version.py
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed; set PYTHON=..." if sys.version_info < (3, 11) else 0)'
	$(announce) 'installing into .venv (once, some minutes)'
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --no-input --prefer-binary --no-compile \
		-c constraints.txt -e '.[all]'
	@touch $@
