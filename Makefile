# `make test` on a machine that has Python and nothing else sets everything up and runs the tests.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TRAINERS ?= all
MINUTES ?= 20

.PHONY: help setup test check bounds browser three film fuzz mutations trainers play configs train benchmark results docs pages clean

help:  ## list the targets
	@grep -E '^[a-z]+:.*##' Makefile | sed 's/:.*##/ -/'

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "marl_pack needs Python 3.11 or newer"'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

setup: $(STAMP)  ## make the virtual environment and install everything

test: $(STAMP)  ## style, types and tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2

check: test

bounds: $(STAMP)  ## the tests of compiled code, with every array access checked
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=build/bounds $(BIN)/python -m pytest -n 2 tests/test_bins.py \
	  tests/test_exact_game.py tests/test_exact_rules.py tests/test_exact_search.py tests/test_items.py tests/test_packing.py \
	  tests/test_stability_rules.py tests/test_stability_properties.py

browser: $(STAMP)  ## the replay page in a headless browser, which has to be installed
	$(BIN)/python -m pytest -v tests/browser

three:  ## bundle three.js into the replay page again; needs Node.js
	cd marl_pack/replay/web && npm ci --ignore-scripts && node node_modules/esbuild/install.js && npm run bundle

film: $(STAMP)  ## the film in the README and the pictures of docs/replay.md
	$(BIN)/python -m docs.replay_pictures

fuzz: $(STAMP)  ## bad and hard input at random, for MINUTES=20
	$(BIN)/python -m tests.fuzz --minutes $(MINUTES)

mutations: $(STAMP)  ## wrong lines in copies of the package, and the tests that notice them
	$(BIN)/python -m tests.mutations --jobs 2

trainers: $(STAMP)  ## every trainer of examples/ in its own environment, briefly (TRAINERS=ci: four)
	$(BIN)/nox --tags $(TRAINERS)

play: $(STAMP)  ## one game by a heuristic, shown and drawn
	$(BIN)/python -m marl_pack.play --policy dblf --seed 0 --picture play.png

configs: $(STAMP)  ## write configs/default.yaml again from the settings' defaults
	$(BIN)/python -m marl_pack.config > configs/default.yaml

train: $(STAMP)  ## train for a few minutes, then compare with heuristics
	@if [ -f runs/quick/latest.pt ]; then \
	  $(BIN)/python -m marl_pack.train --resume runs/quick; \
	else \
	  $(BIN)/python -m marl_pack.train --config quick --output.name quick; \
	fi
	$(BIN)/python -m marl_pack.evaluate --policy runs/quick dblf random --items rs --seed 1

benchmark: $(STAMP)  ## measure every figure on speed in the pages of results
	$(BIN)/python -m benchmarks.masks
	$(BIN)/python -m benchmarks.rules
	$(BIN)/python -m benchmarks.room
	$(BIN)/python -m benchmarks.game
	$(BIN)/python -m benchmarks.training
	$(BIN)/python -m benchmarks.play
	$(BIN)/python -m benchmarks.exact
	$(BIN)/python -m benchmarks.service

results: $(STAMP)  ## make the pages of results of the figures in results/
	$(BIN)/python -m experiments.page
	$(BIN)/python -m experiments.selection_plots

docs: $(STAMP)  ## the pages and the API reference as HTML
	$(BIN)/sphinx-build -W -q -c docs . build/docs
	@echo build/docs/docs/index.html

pages: $(STAMP)  ## write the parts of docs/ that the code determines
	$(BIN)/python -m docs.pages

clean:  ## forget compiled code and caches
	find . -name __pycache__ -prune -exec rm -rf {} +
	rm -rf .mypy_cache .ruff_cache .pytest_cache build *.egg-info
