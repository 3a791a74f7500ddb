# brmgeo: the doors. `make` lists them.
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
SHELL := bash

REGION ?= demo
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
BRMGEO := $(BIN)/brmgeo
export SCHEDULER

.PHONY: help setup maps tiles train status localize evaluate demo test test-slow stress qgis-test docs bench bench-odometry lint check clean

help:  ## List these commands
	@awk 'BEGIN {FS = ":.*## "} /^[a-z-]+:.*## / {printf "  \033[1m%-14s\033[0m %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP)  ## Create .venv and install brmgeo with its tools

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "brmgeo needs Python 3.11 or newer; set PYTHON=/path/to/python3.11"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "Python lacks venv: install the package python3-venv"; exit 2; }
	@echo "setting up $(VENV) (a few minutes once)"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

maps: setup  ## Build all maps of REGION (default demo): footprints, imagery, buildings, ratio maps, QGIS project
	@$(BRMGEO) maps $(REGION) $(ARGS)

tiles: setup  ## Cut training tiles of REGION (or of REGIONS="a b c"); ARGS=--align moves labels onto the imagery
	@$(BRMGEO) tiles $(if $(REGIONS),$(REGIONS),$(REGION)) $(ARGS)

train: setup  ## Train a U-Net on generated regions (minutes, CPU) and test it on REGION; RECIPE=shipped: how the shipped ones began
	@$(BRMGEO) train $(REGION) $(if $(RECIPE),--recipe $(RECIPE)) $(ARGS)

status: setup  ## Show which stages of REGION are fresh, and why the others are not
	@$(BRMGEO) status $(REGION)

localize: setup  ## Localize FLIGHT=folder (default: a simulated one) over REGION by METHOD=mask|ratio|paper
	@$(BRMGEO) localize $(REGION) $(if $(FLIGHT),--flight $(FLIGHT)) $(if $(METHOD),--method $(METHOD)) $(ARGS)

evaluate: setup  ## Fly many simulated flights over REGION through all three matchers and print the table
	@$(BRMGEO) evaluate $(REGION) $(ARGS)

demo: maps localize  ## Maps, a simulated flight and its report, over the embedded demo region

test: setup  ## Run the tests (needs nothing but Python; real data and QGIS only where they are present)
	$(BIN)/pytest -n 2 --dist loadfile -m "not slow" $(ARGS)

test-slow: setup  ## Run the long tests too
	$(BIN)/pytest -n 2 --dist loadfile $(ARGS)

stress: setup  ## Break it by force: kills, damaged files, bombs, full disks, dying workers; laws explored (docs/reliability.md)
	@status=0; \
	$(BIN)/pytest -n 2 --dist load -W default $(addprefix tests/stress/,mutations.py losses.py bombs.py disks.py deaths.py kills.py) $(ARGS) || status=1; \
	$(BIN)/pytest -n 2 --dist loadfile --hypothesis-profile=explore -m "not slow" $$(grep -rl "^from hypothesis" tests --include="test_*.py") || status=1; \
	exit $$status

qgis-test: maps localize  ## Open the demo's QGIS projects in a real QGIS, check and render them (needs qgis, python3-qgis)
	@/usr/bin/python3 -c 'import qgis.core' 2>/dev/null || { echo "QGIS is not installed: apt-get install qgis python3-qgis"; exit 2; }
	QT_QPA_PLATFORM=offscreen /usr/bin/python3 tests/qgis/check_qgis.py data/out/$(REGION) --out data/out/$(REGION)/qgis-test

docs: setup  ## Build the documentation site into docs/_build/html; a warning is an error
	$(BIN)/python -m sphinx -q -W --keep-going -j auto -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

bench: setup  ## Measure the kernels against their alternatives and rewrite the tables in docs/
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,bench]'
	$(BIN)/python benchmarks/ratio_maps.py --full
	$(BIN)/python benchmarks/dxf_readers.py --write docs/benchmarks-dxf.md
	$(BIN)/python benchmarks/matchers.py

bench-odometry: maps  ## Measure embedded odometry over seeds and conditions (hours) and rewrite docs/odometry.md
	$(BIN)/python benchmarks/odometry.py --seeds 5 --write

lint: setup  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

check: lint test  ## Everything a change must pass

clean:  ## Remove built maps and the store (data/source stays)
	rm -rf data/work data/out
