# make demo | make test | make lint; a fresh machine needs Python >= 3.12, pip, gcc and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
OUT ?= demo-output

# Of studies: what is called and imported exists, and takes these arguments.
LENIENT := --no-warn-unused-ignores $(addprefix --disable-error-code ,import-untyped import-not-found index misc operator union-attr arg-type type-var)

# With the oldest libraries: what each of them is used for.
OLDEST := .venv-oldest
OLDEST_TESTS := tests/test_package.py $(addprefix tests/emulator/,mechanics scenes fem/test_simulator.py surrogates \
	training core/test_schema.py core/test_store.py) $(addprefix tests/calibrate/,samplers certificate cli/test_cli.py \
	analysis/test_sensitivity.py report posterior/test_tree.py measurements/test_data.py project/test_demo.py)

.PHONY: demo test nightly test-slow test-studies test-oldest package release notebooks pictures \
	docs lint format study clean

demo: $(STAMP)
	@$(BIN)/calibrate demo --out $(OUT)

# Programs run once or twice here, so the compiler's expensive passes cost more than they save. Some
# tests of the solver run with what users compile.
test: $(STAMP)
	JAX_DISABLE_MOST_OPTIMIZATIONS=1 $(BIN)/python -m pytest -m "not slow and not optimised" -n 2 \
		--dist loadfile --durations=20
	$(BIN)/python -m pytest -m "optimised and not slow" -n 2 --dist loadfile tests/emulator/fem

# Every tier, one after the other; docs/testing.md gets a table of how each ended.
nightly: $(STAMP)
	$(BIN)/python tests/nightly.py

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m slow -n 2 --dist loadfile --durations=20 \
		--ignore=tests/test_studies.py --ignore=tests/test_notebooks.py

test-studies: $(STAMP)
	$(BIN)/python -m pytest -m slow --durations=40 tests/test_studies.py

# Warnings are shown, not errors: old libraries announce what new ones did.
test-oldest: $(OLDEST)/.installed
	JAX_COMPILATION_CACHE_DIR=$(OLDEST)/jax $(OLDEST)/bin/python -m pytest -m "not slow" -W default $(OLDEST_TESTS)

package: $(STAMP)
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/python tests/package_check.py dist

# Versions agree, and what is built works elsewhere: make release, of a tag make release TAG=v0.1.0.
release: $(STAMP)
	$(BIN)/python tests/release_check.py "$$TAG"
	$(MAKE) package
	@ls -sh1 dist

notebooks: $(STAMP)
	$(BIN)/python -m pytest tests/test_notebooks.py

# README's and the docs'; photographs of pages need a Chromium, see docs/pictures.py.
pictures: $(STAMP)
	$(BIN)/python docs/pictures.py

# Fails where a formula does not convert or a link leads nowhere; marks figures older than their code.
docs: $(STAMP)
	$(BIN)/sphinx-build -E -a -W --keep-going -q -b html docs docs/_build
	@echo docs/_build/index.html

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	MYPYPATH=src:. $(BIN)/mypy --explicit-package-bases $(LENIENT) studies/*/*.py
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

study: $(STAMP)
	$(BIN)/python -m studies.accuracy_vs_time

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null || { \
	found=$$($(PYTHON) -V 2>/dev/null || echo missing); \
	echo "Python 3.12 or newer is needed, '$(PYTHON)' is $$found; name one: make $(or $(MAKECMDGOALS),demo) PYTHON=python3.12"; \
	exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

$(OLDEST)/.installed: pyproject.toml constraints-oldest.txt
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python -m pip install --quiet --constraint constraints-oldest.txt \
		--editable '.[plot]' pytest pytest-xdist jsonschema
	@touch $@

clean:
	rm -rf $(VENV) $(OLDEST) dist $(OUT)
