# Everything a contributor runs. VENV may point to an environment of your own.
VENV ?= .venv
BIN = $(VENV)/bin

.PHONY: install test test-all lint flat types site package clean

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

# The documentation, in build/site; a warning is an error, and the reference must have content.
site: flat
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict
	grep -q 'id="ufmstar_torch.ufmstar.UfMStar"' build/site/reference/core.html
	grep -qF "[B, H, W]" build/site/reference/core.html

# The wheel and the sdist, each installed into a folder of its own and imported from there.
package:
	rm -rf dist build/lib
	$(BIN)/python -m build --outdir dist .
	for archive in dist/*.whl dist/*.tar.gz; do \
		rm -rf build/archive && $(BIN)/pip install --quiet --no-deps --target build/archive $$archive && \
		PYTHONPATH=$(CURDIR)/build/archive $(BIN)/python -P tests/installed.py || exit 1; \
	done

clean:
	rm -rf build dist *.egg-info
