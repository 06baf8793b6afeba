# Everything a contributor runs. VENV may point to an environment of your own.
VENV ?= .venv
BIN = $(VENV)/bin

.PHONY: install test test-all lint flat types site package bench clean

install:
	python3 -m venv $(VENV)
	$(BIN)/pip install -e ".[dev]" -c constraints.txt

test:
	$(BIN)/pytest

test-all:
	$(BIN)/pytest -m "slow or not slow"

lint:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Type checkers and the reference cannot follow setuptools' package-dir map: they read a flat copy. setuptools never
# removes modules from build/lib.
flat:
	rm -rf build/flat build/lib
	$(BIN)/pip install --quiet --no-deps --target build/flat .

types: flat
	$(BIN)/mypy build/flat/ufmstar_torch

# The documentation, in build/site; a warning is an error.
site: flat
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

# The wheel and the sdist, each installed over the editable package, imported from elsewhere, and taken back.
package:
	rm -rf dist build/lib
	$(BIN)/python -m build --outdir dist .
	for archive in dist/*.whl dist/*.tar.gz; do \
		$(BIN)/pip install --quiet --no-deps --force-reinstall $$archive && $(BIN)/python -P tests/installed.py || exit 1; \
	done
	$(BIN)/pip install --quiet --no-deps -e .

bench:
	$(BIN)/ufmstar bench

clean:
	rm -rf build dist *.egg-info
