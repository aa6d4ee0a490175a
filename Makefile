# Each target sets up what it needs in .venv: Python 3.11 or later is all that must be there.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.installed
MINUTES ?= 2

.PHONY: card demo test test-long lint setup clean

setup: $(SETUP)

$(SETUP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "expected Python 3.11 or later; say which: make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	  --constraint constraints.txt --editable '.[all,browser,dev]'
	touch $(SETUP)

# Make semantic2d-mini, train S3-Net for two minutes, predict, score, and show it all.
demo: $(SETUP)
	rm -rf demo
	mkdir demo
	$(BIN)/semantic2d info semantic2d-mini
	$(BIN)/semantic2d baseline train s3net --preset quick --minutes $(MINUTES) --out demo/s3net
	$(BIN)/semantic2d baseline predict demo/s3net --out demo/predictions.h5
	$(BIN)/semantic2d score demo/predictions.h5 --out demo/result.json
	$(BIN)/semantic2d report demo/predictions.h5 --out demo/report.html

# Make DATASET_CARD.md again: it is counted from semantic2d-mini, not typed.
card: $(SETUP)
	$(BIN)/semantic2d card semantic2d-mini --out DATASET_CARD.md

test: $(SETUP)
	$(BIN)/pytest -n 2 -m 'not long'

# Thousands of kills, cuts and flips, sixteen workers, a Dask cluster, a wheel by itself.
test-long: $(SETUP)
	$(BIN)/pytest -n 2 -m long

lint: $(SETUP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) demo build dist *.egg-info
