# make demo: environment, install, and two sample scans registered. make test: lint, types and tests.
# Both make .venv from nothing but Python 3.11 or later (on Debian: apt install python3-venv); again, they are quick.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test clean

demo: .venv/installed
	mkdir -p demo
	$(BIN)/fmr align samples/scan_a.ply samples/scan_b.ply -o demo/T.txt --merged demo/merged.ply --metrics demo/metrics.json
	cat demo/T.txt

test: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/pytest

.venv/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf .venv demo build dist *.egg-info
