# Every target makes the virtual environment it needs; `make PYTHON=python3.12 test` chooses its Python.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
BASE := $(VENV)/.base
DEV := $(VENV)/.dev
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

# Benchmarks run on core 0 alone, because timings spread more when the scheduler moves a process between cores.
PINNED := $(shell taskset -c 0 true 2>/dev/null && echo taskset -c 0)

# The soak runs in SOAK_PARTS parts of at most 60 minutes with two workers; `make soak PART=2` runs one of them.
SOAK_PARTS := 4

export OMP_NUM_THREADS := 1

.PHONY: run test soak lint bench docs clean

run: $(BASE)
	@n=1; while [ -e runs/whisker_maze-$$n ]; do n=$$((n + 1)); done; \
	set -x; $(BIN)/python -m ratslam run configs/whisker_maze.yaml -o runs/whisker_maze-$$n

# Three workers on two cores, because live sessions wait most of their time. The longest modules begin first.
test: $(DEV)
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

soak: $(DEV)
	$(BIN)/python -m pytest --soak -n 2 --dist loadfile -v --timeout 3600 $(if $(PART),--part $(PART)/$(SOAK_PARTS))

lint: $(DEV)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports --no-logo

bench: $(DEV)
	$(PINNED) $(BIN)/python -m pytest tests/benchmarks --benchmark-only

docs: $(DEV)
	$(BIN)/python docs/reference.py build/docs

clean:
	rm -rf $(VENV) build dist *.egg-info .hypothesis .benchmarks .ruff_cache .mypy_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Installs the program without the dependencies of its tests.
$(BASE): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "ratslam needs Python 3.11 or newer, and $(PYTHON) is" \
	    "$$($(PYTHON) --version 2>&1); choose another: make PYTHON=python3.11 ..." >&2; exit 1; }
	@echo "Making the virtual environment $(VENV) ..."
	@$(PYTHON) -m venv $(VENV)
	@echo "Installing ratslam and its dependencies (a minute or two) ..."
	@$(INSTALL) -e .
	@touch $@

# Installs the dependencies of the tests. Only one test needs gtsam, which has no wheel for some platforms.
# opexebo asks for an OpenCV with windows; it works with the one without, which is installed.
$(DEV): $(BASE)
	@echo "Installing the dependencies of the tests ..."
	@$(INSTALL) -e '.[dev]'
	@$(INSTALL) --no-deps 'opexebo>=0.7'
	@$(INSTALL) --only-binary gtsam -e '.[anchor]' || echo "gtsam has no wheel here; its test is skipped."
	@touch $@
