# The project's one entry point; `make help` lists what it does. Everything is installed into VENV, nothing elsewhere.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV ?= .venv
# The interpreter the environment is made with, once; empty: the first on PATH that is new enough.
PYTHON ?=
# The releases that are installed, one a line; empty: the newest that pyproject.toml allows.
CONSTRAINTS ?= constraints.txt
export CONSTRAINTS
# The folder of motions of people that `make people`, `make ablations` and `make continuous` measure.
PEOPLE ?= ../shared/data
# Options of scripts/bench.py: --short, --pykoopman=PYTHON.
BENCH ?=
# How long `make fuzz` and `make soak` try to break koopdqn, from which seed, and what `make physics` plays.
TRY_MINUTES ?= 10
SEED ?= 0
RUNS ?=
PATHS ?= 1000
# After how many minutes `make study`, `make ablations` and `make continuous` begin no new run.
MINUTES ?= 90

BIN := $(VENV)/bin
AUDIT_TOOLS = $(BIN)/python -m pip install --quiet $(if $(CONSTRAINTS),-c $(CONSTRAINTS)) -e '.[audit]'
STAMP := $(VENV)/.koopdqn-installed

.PHONY: help setup demo test coverage learn lint format types sizes bench ablations continuous study people people-continuous docs arms site figures \
	pictures fuzz soak physics audit licences sbom package constraints clean

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/^([a-z-]+):.*## (.*)$$/  \1\t\2/' | expand -t 20

setup: $(STAMP) ## Make the virtual environment and install koopdqn there, editable, with pinned dependencies

$(STAMP): pyproject.toml $(CONSTRAINTS) scripts/setup.sh
	@bash scripts/setup.sh "$(VENV)" "$(PYTHON)" "$(CONSTRAINTS)"
	@touch "$@"

demo: $(STAMP) ## Learn the shelf task from nothing, then measure what was learned; results go to runs/
	$(BIN)/koopdqn train task=shelf seed=0
	$(BIN)/koopdqn eval

# Two workers with one thread each: on few cores, threads that compete cost more than they give. What the tests start would
# compile the package anew each time where Python is told to keep no bytecode.
FAST_TESTS := env -u PYTHONDONTWRITEBYTECODE OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" -n 2 --dist loadfile --no-loadscope-reorder

test: $(STAMP) ## Run the fast tests
	$(FAST_TESTS)

coverage: $(STAMP) ## Run the fast tests; fails if they run too small a share of the package (pyproject.toml says how much)
	$(FAST_TESTS) --cov --cov-report=term

learn: $(STAMP) ## Run the slow tests, which learn whole tasks
	$(BIN)/python -m pytest -m slow

lint: $(STAMP) ## Check style, formatting, and that imports run one way without circles
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

format: $(STAMP) ## Mend formatting, and what style rules can mend by themselves
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(STAMP) ## Check types
	$(BIN)/mypy

sizes: $(STAMP) ## Print lines and modules of the package; fails where it grows, or imports run in circles or upwards
	$(BIN)/python scripts/sizes.py --check

bench: $(STAMP) ## Measure speed beside peers, into docs/performance.md; minutes
	$(BIN)/python -m pip install --quiet $(if $(CONSTRAINTS),-c $(CONSTRAINTS)) -e '.[bench]'
	$(BIN)/python scripts/bench.py $(BENCH)

ablations: $(STAMP) ## Measure each deviation from the paper, for at most MINUTES; hours, goes on where it stopped
	$(BIN)/python scripts/study.py ablations --data $(PEOPLE) --minutes $(MINUTES)

continuous: $(STAMP) ## Learn tasks and motions of people with continuous actions; goes on where it stopped
	$(BIN)/python scripts/study.py continuous --data $(PEOPLE) --minutes $(MINUTES)

study: $(STAMP) ## Measure the default beside simpler and older methods, for at most MINUTES; goes on where it stopped
	$(BIN)/python scripts/study.py study --minutes $(MINUTES)

people-continuous: $(STAMP) ## Measure people's motions with continuous actions; hours, goes on where it stopped
	$(BIN)/python scripts/study.py people-continuous --data $(PEOPLE)

people: $(STAMP) ## Measure every set of people's motions below PEOPLE; hours, goes on where it stopped
	$(BIN)/python scripts/study.py people --data $(PEOPLE)

fuzz: $(STAMP) ## Damage input for TRY_MINUTES, count what comes of it, into docs/reliability.md
	OMP_NUM_THREADS=1 $(BIN)/python scripts/prove.py fuzz --minutes $(TRY_MINUTES) --seed $(SEED)

# A training that was begun goes on after the minutes are over; 15 of them end within 20.
soak: $(STAMP) ## Kill trainings for TRY_MINUTES, at most 15, and compare what comes of them, into docs/reliability.md
	OMP_NUM_THREADS=1 timeout 1200 $(BIN)/python scripts/prove.py soak --minutes $(TRY_MINUTES) --seed $(SEED)

physics: $(STAMP) ## Play PATHS paths of each of RUNS in perturbed dynamics, into docs/reliability.md
	OMP_NUM_THREADS=1 $(BIN)/python scripts/prove.py physics --paths $(PATHS) --runs $(RUNS)

audit: $(STAMP) ## Look up known flaws of the dependencies; needs the network
	@$(AUDIT_TOOLS)
	@$(BIN)/python scripts/audit.py

licences: $(STAMP) ## List the licence of every dependency
	@$(AUDIT_TOOLS)
	@$(BIN)/pip-licenses --python $(BIN)/python --from mixed --order license

sbom: $(STAMP) ## Write dist/sbom.json, a bill of materials in CycloneDX
	@$(AUDIT_TOOLS)
	@mkdir -p dist
	$(BIN)/cyclonedx-py environment --output-reproducible --pyproject pyproject.toml -o dist/sbom.json $(BIN)/python

docs: $(STAMP) ## Write the generated tables of docs/files.md
	$(BIN)/python scripts/docs.py

arms: $(STAMP) ## Write the models of the UR family's other arms below assets/ur/
	$(BIN)/python scripts/arms.py

site: $(STAMP) ## Build the documentation's site into site/; any warning fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

figures: $(STAMP) ## Measure the README's figures and draw its pictures anew; takes minutes
	$(BIN)/python scripts/study.py figures

pictures: $(STAMP) ## Draw the pictures of the documentation anew, but those of figures; takes minutes
	$(BIN)/python scripts/pictures.py

package: $(STAMP) ## Build dist/, install it in a clean environment and use it there
	$(BIN)/python scripts/check_package.py

constraints: $(STAMP) ## Write constraints.txt from what VENV holds now
	bash scripts/freeze.sh "$(BIN)/python" > "$(VENV)/constraints.new"
	mv "$(VENV)/constraints.new" constraints.txt
	touch "$(STAMP)"

clean: ## Remove build products and caches; the environment and runs/ stay
	rm -rf dist site .coverage* .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find assets conf docs examples koopdqn scripts tests -name __pycache__ -type d -prune -exec rm -rf {} +
