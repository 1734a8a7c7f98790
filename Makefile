# make demo: environment, install, and two sample scans registered. make test: lint, types and tests, and what was skipped.
# make test-all: the slow tests too, as CI runs them. make docs: the documentation, into site/; a broken link fails it.
# All make .venv from nothing but Python 3.11 or later (on Debian: apt install python3-venv); again, they are quick.
PYTHON ?= python3
BIN := .venv/bin
# Python compiles what it imports, the first time: a small part of what pip would take a minute for.
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e
# Processes of pytest, about 0.7 GB each; one more than there are cores, since tests that kill and stop processes wait.
WORKERS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1)

PYTEST = OMP_NUM_THREADS=1 $(BIN)/pytest -n $(WORKERS) --dist worksteal # runs of tests: what a file's tests share is made once

# Tests start many processes: what the first one compiles, the others read, even where the environment says otherwise.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo lint test test-all quick-tests all-tests coverage docs clean

demo: .venv/installed
	mkdir -p demo
	$(BIN)/fmr align samples/scan_a.ply samples/scan_b.ply -o demo/T.txt --merged demo/merged.ply --metrics demo/metrics.json
	cat demo/T.txt

lint: .venv/installed-for-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Lint runs beside the tests: alone it would leave all cores but one idle.
test: .venv/installed-for-tests
	$(MAKE) --no-print-directory --jobs=2 lint quick-tests

test-all: .venv/installed-for-tests
	$(MAKE) --no-print-directory --jobs=2 lint all-tests

quick-tests: .venv/installed-for-tests
	$(PYTEST) -m "not slow"

all-tests: .venv/installed-for-tests
	$(PYTEST)

coverage: .venv/installed-for-tests
	$(PYTEST) --cov --cov-report=term-missing:skip-covered

docs: .venv/installed-for-docs
	$(BIN)/mkdocs build --strict

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/installed: pyproject.toml constraints.txt | .venv/bin/python
	$(INSTALL) .
	touch $@

# Every extra: no test is skipped for want of a package.
.venv/installed-for-tests: pyproject.toml constraints.txt | .venv/bin/python
	$(INSTALL) '.[eval,report,e57,ros,crs,baselines,dask,docs,dev]'
	touch .venv/installed $@

.venv/installed-for-docs: .venv/installed
	$(INSTALL) '.[docs]'
	touch $@

clean:
	rm -rf .venv demo site build dist *.egg-info
