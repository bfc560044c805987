# Everything happens in .venv; nothing is installed elsewhere but the system libraries that Debian and
# Ubuntu have packages for.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test lint bench system chromium clean

demo: system .venv/installed
	$(BIN)/pipeline run data_samples/three_photos -w runs/demo

test: system chromium .venv/installed-dev
	$(BIN)/python -m pytest

lint: .venv/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: .venv/installed-dev
	for script in benchmarks/*.py; do $(BIN)/python $$script || exit 1; done

# Shared libraries that Python wheels expect from the system, and the module that makes environments.
system:
	@tools/system-packages required

# Only the test of the viewer page needs a browser.
chromium:
	@tools/system-packages browser

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/installed: .venv/bin/python setup.cfg constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/installed-dev: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv build dist runs *.egg-info
