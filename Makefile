# make demo: environment, install, and two sample scans registered. make test: lint, types and tests, and what was skipped.
# make test-all: the slow tests too, as CI runs them. make docs: the documentation, into site/; a broken link fails it.
# All make .venv from nothing but Python 3.11 or later (on Debian: apt install python3-venv); again, they are quick.
PYTHON ?= python3
BIN := .venv/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e
WORKERS ?= auto # of pytest; a test process takes about 0.7 GB

PYTEST = OMP_NUM_THREADS=1 $(BIN)/pytest -n $(WORKERS) --dist worksteal # runs of tests: what a file's tests share is made once

# Tests start many processes: what the first one compiles, the others read, even where the environment says otherwise.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo lint test test-all coverage docs clean

demo: .venv/installed
	mkdir -p demo
	$(BIN)/fmr align samples/scan_a.ply samples/scan_b.ply -o demo/T.txt --merged demo/merged.ply --metrics demo/metrics.json
	cat demo/T.txt

lint: .venv/installed-for-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint
	$(PYTEST) -m "not slow"

test-all: lint
	$(PYTEST)

coverage: .venv/installed-for-tests
	$(PYTEST) --cov --cov-report=term-missing:skip-covered

docs: .venv/installed-for-docs
	$(BIN)/mkdocs build --strict

.venv/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(INSTALL) .
	touch $@

# Every extra: no test is skipped for want of a package.
.venv/installed-for-tests: .venv/installed
	$(INSTALL) '.[eval,report,e57,ros,crs,baselines,dask,docs,dev]'
	touch $@

.venv/installed-for-docs: .venv/installed
	$(INSTALL) '.[docs]'
	touch $@

clean:
	rm -rf .venv demo site build dist *.egg-info
