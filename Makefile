# make demo: environment, install, and two sample scans registered. make test: lint, types and tests, and what was skipped.
# Both make .venv from nothing but Python 3.11 or later (on Debian: apt install python3-venv); again, they are quick.
PYTHON ?= python3
BIN := .venv/bin
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e
WORKERS ?= auto # of pytest; a test process takes about 0.7 GB

.PHONY: demo test coverage clean

demo: .venv/installed
	mkdir -p demo
	$(BIN)/fmr align samples/scan_a.ply samples/scan_b.ply -o demo/T.txt --merged demo/merged.ply --metrics demo/metrics.json
	cat demo/T.txt

test: .venv/installed-for-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	OMP_NUM_THREADS=1 $(BIN)/pytest -n $(WORKERS)

coverage: .venv/installed-for-tests
	OMP_NUM_THREADS=1 $(BIN)/pytest -n $(WORKERS) --cov --cov-report=term-missing:skip-covered

.venv/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(INSTALL) .
	touch $@

# Every extra: no test is skipped for want of a package.
.venv/installed-for-tests: .venv/installed
	$(INSTALL) '.[eval,report,e57,ros,crs,baselines,dask,dev]'
	touch $@

clean:
	rm -rf .venv demo build dist *.egg-info
