# make train  the whole way from nothing to a results table; make test  the tests. Both set up .venv first.
PYTHON ?= python3
BIN := .venv/bin
EXPERIMENT ?= outage
PROFILE ?= quick
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help install train test lint types bench docs ui clean

help:
	@echo "make install   what training, evaluating and navigating need, into .venv"
	@echo "make train     train on simulated drives and score against the baselines, some minutes"
	@echo "make test      all tests"
	@echo "make lint      ruff, then make types"
	@echo "make types     pyright over src and pipelines, under a minute"
	@echo "make bench     speed of the filters and of training"
	@echo "make docs      the pages of docs/ with search, equations and the API, in outputs/docs"
	@echo "make ui        MLflow's pages over the runs of this folder"
	@echo "make clean     remove what can be made again; data and runs stay"

# A stamp is younger than what it was made from, so nothing is installed twice.
# Without compiling everything ahead, installing takes half the time; Python compiles what it imports, once where it may
# keep it: a process that compiles torch and its like anew takes twice as long to start.
unexport PYTHONDONTWRITEBYTECODE

.venv/pyvenv.cfg:
	$(PYTHON) -m venv .venv

.venv/installed: pyproject.toml constraints.txt | .venv/pyvenv.cfg
	$(BIN)/pip install --quiet --no-compile --constraint constraints.txt --editable '.[joblib]'
	@touch $@

.venv/installed-dev: .venv/installed
	$(BIN)/pip install --quiet --no-compile --constraint constraints.txt --editable '.[dev,docs]'
	@touch $@

install: .venv/installed

train: .venv/installed
	$(BIN)/python -m dlkf.train +experiment=$(EXPERIMENT) +profile=$(PROFILE) $(ARGS)

test: .venv/installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 $(ARGS)

lint: .venv/installed-dev types
	$(BIN)/ruff check src tests pipelines docs

types: .venv/installed-dev
	$(BIN)/pyright

bench: .venv/installed
	$(BIN)/python -m pipelines.studies.benchmark $(ARGS)

docs: .venv/installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo "outputs/docs/index.html"

ui: .venv/installed
	$(BIN)/python -m dlkf.ui $(ARGS)

clean:
	rm -rf .venv build dist .pytest_cache .ruff_cache
	find src tests pipelines -name __pycache__ -type d -prune -exec rm -rf {} +
