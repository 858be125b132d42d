# make train  the whole way from nothing to a results table; make check, make test  the tests. All set up .venv first.
PYTHON ?= python3
BIN := .venv/bin
EXPERIMENT ?= outage
PROFILE ?= quick
REAL ?=
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help install train paper plus check test mutants lint types bench docs ui clean

help:
	@echo "make install   what training, evaluating and navigating need, into .venv"
	@echo "make train     train on simulated drives and score against the baselines, some minutes"
	@echo "make paper     the paper's experiments and their page, days on a CPU; goes on where it stopped, takes REAL=data/kitti"
	@echo "make plus      the tables of docs/results/plus.md, an hour; takes REAL=data/real, ARGS=--train for fresh weights and constants"
	@echo "make check     tests of a developer, two to three minutes on two cores: without trainings, MLflow, compilers"
	@echo "make test      all tests but the longest (pytest -m exports, -m commands), eight minutes on two cores"
	@echo "make mutants   whether the tests notice small faults of the core (tests/mutants.yaml)"
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

# Trainings that are finished are kept, so the same command goes on. ARGS go to each training. REAL: a dataset of real
# drives with a good IMU, whose motion section 5.3 takes.
paper: .venv/installed
	$(BIN)/python pipelines/paper_imu_error.py --as-published --seeds 0 $(ARGS)
	$(BIN)/python pipelines/paper_imu_error.py $(ARGS)
	$(BIN)/python pipelines/paper_kalman_gain.py --seeds 0,1,2 $(ARGS)
	$(BIN)/python pipelines/paper_outage.py --seeds 0,1,2 --models dlkf,dlkf_literal $(ARGS)
	$(BIN)/python pipelines/paper_figures.py $(if $(REAL),--real $(REAL)) $(ARGS)
	$(if $(REAL),$(BIN)/python pipelines/paper_real_motion.py --real $(REAL))
	$(BIN)/python pipelines/paper_ablations.py $(ARGS)
	$(BIN)/python pipelines/paper_report.py

# Without --sets a study makes and scores every simulated set. REAL: a folder with kitti, rtkx, wid, wid_mru, linkoping.
PLUS := $(BIN)/python -m pipelines.studies.plus
PARTS := tones patches askew steady puck good others fleet gears cvt soft_mount rough phone
MOTION := kitti_consumer kitti_adis rtkx wid wid_mru linkoping
plus: .venv/installed
	$(PLUS) --oracle --no-auto --out outputs/plus $(ARGS)
	$(if $(REAL),$(PLUS) --real $(REAL) --sets $(MOTION) --out outputs/plus_real)
	$(PLUS) --parts $(if $(REAL),--real $(REAL)) --sets $(if $(REAL),$(MOTION)) $(PARTS) --out outputs/plus_parts
	$(if $(REAL),$(BIN)/python -m pipelines.studies.wrong_sensors --real $(REAL))

# worksteal: a worker keeps the tests of a file together, and takes from the other's end when its own are done
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

check: .venv/installed-dev
	$(PYTEST) -m "not whole and not served and not exports and not commands and not mutations" $(ARGS)

test: .venv/installed-dev
	$(PYTEST) $(ARGS)

mutants: .venv/installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.mutants $(ARGS)

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
