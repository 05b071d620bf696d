# Two commands do everything on a fresh machine: `make demo` and `make test`.
SHELL := /bin/bash
VENV ?= .venv
BIN := $(VENV)/bin
UV := $(shell command -v uv 2>/dev/null || echo .uv/bin/uv)
PYTHON ?= python3
STAMP := $(VENV)/.installed
RIVALS := $(VENV)/.rivals
WORKERS ?= 2
WORDS ?= experiment=pendulum
SETS ?= 600
KILLS ?= 60
MUTATIONS ?= 500
SEED ?= 1
OUT ?= runs/$@/$$(date +%Y%m%d-%H%M%S)
size ?= small
# worlds whose effects no YAML of conf/ names
EXAM := --config-dir tests/exam

.DEFAULT_GOAL := help
.PHONY: help install docs demo test test-long test-recordings test-slow check lint format bench benchmarks bench-discover torture sbc exam lock data real clean reproduce-metrics_vs_n_train reproduce-sinusoids reproduce-bimodal reproduce-panel-a reproduce-panel-b reproduce-offline reproduce-online bench-simulators differences

help: ## Show this list
	@grep -hE '^[a-z_-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  \033[1m%-30s\033[0m %s\n", $$1, $$2}'

install: $(STAMP) ## Set up .venv from the lock (brings uv along if it is not there)

# bytecode: where Python may not write it, every start of `simpel` compiled what it imports (4.5 s instead of 1.6 s)
$(STAMP): pyproject.toml uv.lock
	@command -v $(UV) >/dev/null || { $(PYTHON) -m venv .uv && .uv/bin/python -m pip install --quiet uv; }
	UV_PROJECT_ENVIRONMENT=$(VENV) UV_PYTHON_DOWNLOADS=never $(UV) sync --frozen --quiet --compile-bytecode --python $(PYTHON)
	@touch $@

demo: install ## Run the main job (simpel fit experiment=pendulum) and say where the report lies
	$(BIN)/simpel fit experiment=pendulum

# most of the time of the tests is XLA's, for programs that run for a moment: 124 s became 92 in two files (cold cache, one core);
# `make test-slow`, and pytest by itself, compile as users do
# jaxlib 0.11 no longer knows the second switch, and would not start with it
NO_EMITTERS = $$($(BIN)/python -c "from importlib.metadata import version as v; print('--xla_cpu_use_fusion_emitters=false' * ([int(n) for n in v('jaxlib').split('.')[:2]] < [0, 11]))")
QUICK = --xla_backend_optimization_level=0 $(NO_EMITTERS)

test: install ## Run the tests (under 12 minutes on two cores)
	XLA_FLAGS="$(QUICK) $$XLA_FLAGS" $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m "not slow and not long"

test-long: install ## Run the tests of 4 s or more (tests/long.txt), which `make test` leaves out and CI runs; 25 minutes
	XLA_FLAGS="$(QUICK) $$XLA_FLAGS" $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder -m "long and not slow"

test-recordings: install ## Run the tests that need the recordings (SIMPEL_SHARED=FOLDER, or ../shared)
	XLA_FLAGS="$(QUICK) $$XLA_FLAGS" $(BIN)/python -m pytest -n $(WORKERS) -m "needs_recordings and not slow"

test-slow: install ## Run the studies that take minutes each
	$(BIN)/python -m pytest -m slow

check: install ## Before a commit: format, lint, layers, types, quick tests of what changed (under a minute)
	$(BIN)/ruff format --quiet .
	$(BIN)/ruff check --quiet .
	$(BIN)/lint-imports --no-logo >.lint-imports.log || { cat .lint-imports.log; exit 1; }
	$(BIN)/mypy --no-error-summary
	XLA_FLAGS="$(QUICK) $$XLA_FLAGS" $(BIN)/python -m tests.changed

lint: install ## Check format, lint, layers, types, lock
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	$(UV) lock --check --no-config

docs: $(STAMP) ## Build the documentation site from docs/ into site/
	UV_PROJECT_ENVIRONMENT=$(VENV) UV_PYTHON_DOWNLOADS=never $(UV) sync --group docs --inexact --frozen --quiet --python $(PYTHON)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "site/index.html"

format: install ## Format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: install ## Measure scores of every method, and speed of every estimator, on the reference's arrays (needs SIMPEL_SHARED)
	$(BIN)/python -m tests.benchmarks.reference
	$(BIN)/python -m tests.benchmarks.speed estimators

benchmarks: install ## Compare free runs with published figures and models by hand, by the benchmarks' protocol (needs SIMPEL_SHARED; OUT=DIR to go on)
	$(BIN)/python -m tests.benchmarks.published --out $(OUT)

torture: install ## Kill, starve and mislead every verb (KILLS=60 MUTATIONS=500 SEED=1 OUT=DIR); about two hours
	$(BIN)/python -m tests.torture --kills $(KILLS) --mutations $(MUTATIONS) --seed $(SEED) --out $(OUT)

sbc: install ## Calibrate the inference of an experiment on functions of its own prior (WORDS="experiment=pendulum method=fsvgd")
	$(BIN)/python -m tests.benchmarks.sbc $(WORDS)

bench-discover: install ## Measure time and memory of verdicts, compiled anew and cached (needs SIMPEL_SHARED)
	$(BIN)/python -m tests.benchmarks.verdicts

bench-simulators: install ## Measure what every simulator costs: conversion, compilation, a million transitions, memory
	$(BIN)/python -m tests.benchmarks.simulators

differences: install ## Let `simpel discover` find what the paper's low-fidelity simulators lack (OUT=DIR)
	$(BIN)/python -m tests.benchmarks.differences --out $(OUT)

exam: $(RIVALS) ## Give `simpel discover` and PySINDy the blind exam (SETS=600 SEED=1, OUT=DIR to go on, ONLY="cart car", SECOND=1: nuisances)
	$(BIN)/python -m tests.exam --sets $(SETS) --seed $(SEED) --out $(OUT) $(if $(ONLY),--only $(ONLY)) $(if $(SECOND),--second)

$(RIVALS): $(STAMP)
	UV_PROJECT_ENVIRONMENT=$(VENV) UV_PYTHON_DOWNLOADS=never $(UV) sync --group exam --frozen --quiet --python $(PYTHON)
	@touch $@

real: install ## Search the recordings for what their simulators lack (needs SIMPEL_SHARED)
	$(BIN)/python -m tests.benchmarks.real --out runs/real/$$(date +%Y%m%d-%H%M%S)

reproduce-metrics_vs_n_train: install ## Make the README's figure anew (36 fits)
	$(BIN)/simpel sweep experiment=pendulum method=simpel,simpel_only_sim,fsvgd data.n_train=10,20,40,80 'run.seed=range(3)' \
		hydra.sweep.dir=runs/reproduce/metrics_vs_n_train-$(shell date +%Y%m%d-%H%M%S)
	@echo "the figure lies in runs/reproduce; the README shows docs/figures/metrics_vs_n_train.png"

reproduce-sinusoids: install ## Make the paper's figure of sinusoids: six fits of two points
	$(BIN)/python -m tests.reproduce.sinusoids

reproduce-bimodal: install ## Make the paper's figure of two modes: four score estimators, two also as published
	$(BIN)/python -m tests.reproduce.bimodal

reproduce-panel-a: install ## Make the paper's panel of four simulated systems (size=small or full; out=DIR to go on)
	$(BIN)/python -m tests.reproduce.panel_a --size $(size) $(if $(out),--out $(out))

reproduce-offline: install ## Make the paper's parking from recorded drives (size=small or full; out=DIR to go on)
	$(BIN)/python -m tests.reproduce.control offline --size $(size) $(if $(out),--out $(out))

reproduce-online: install ## Make the paper's parking from episodes of its own (size=small or full; out=DIR to go on)
	$(BIN)/python -m tests.reproduce.control online --size $(size) $(if $(out),--out $(out))

reproduce-panel-b: install ## Make the paper's panel of the recorded RC car (size=small or full; needs SIMPEL_SHARED)
	$(BIN)/python -m tests.reproduce.panel_b --size $(size) $(if $(out),--out $(out))

lock: ## Write uv.lock against the public index only
	env -u UV_DEFAULT_INDEX -u UV_INDEX_URL -u UV_INDEX -u UV_EXTRA_INDEX_URL -u UV_FIND_LINKS -u PIP_INDEX_URL $(UV) lock --no-config

data: install ## Make the measurements in data/ anew
	rm -rf data/pendulum data/racecar data/greenhouse data/sergio data/hidden_pendulum data/hidden_cart data/parking data/pendulum_swing_up
	$(BIN)/simpel simulate simulation=pendulum out=data/pendulum
	$(BIN)/simpel simulate sim=pendulum_high_fidelity simulation=pendulum_swing_up out=data/pendulum_swing_up
	$(BIN)/simpel simulate sim=parking_car simulation=parking out=data/parking
	for system in racecar greenhouse sergio; do \
		$(BIN)/simpel simulate sim=$${system}_high_fidelity simulation=$$system out=data/$$system || exit; done
	$(BIN)/simpel simulate $(EXAM) sim=mujoco_pendulum simulation=hidden_pendulum out=data/hidden_pendulum
	$(BIN)/simpel simulate $(EXAM) sim=mujoco_cart simulation=hidden_cart out=data/hidden_cart

clean: ## Remove what make made
	rm -rf $(VENV) .uv .pytest_cache .ruff_cache .mypy_cache .import_linter_cache dist build
