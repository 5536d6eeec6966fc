# Every target makes the virtual environment it needs; `make PYTHON=python3.12 test` chooses its Python.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

# One core where it can be chosen: timings that share a core with others say little.
PINNED := $(shell taskset -c 0 true 2>/dev/null && echo taskset -c 0)

export OMP_NUM_THREADS := 1

.PHONY: run test soak lint bench clean

run: $(READY)
	@n=1; while [ -e runs/whisker_maze-$$n ]; do n=$$((n + 1)); done; \
	set -x; $(BIN)/python -m ratslam run configs/whisker_maze.yaml -o runs/whisker_maze-$$n

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile

soak: $(READY)
	$(BIN)/python -m pytest --soak -m soak -n 4 -v --timeout 3600

lint: $(READY)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports --no-logo

bench: $(READY)
	$(PINNED) $(BIN)/python -m pytest tests/benchmarks --benchmark-only

clean:
	rm -rf $(VENV) build dist *.egg-info .hypothesis .benchmarks .ruff_cache .mypy_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# gtsam, which only one test compares with, has no wheel for some platforms.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "ratslam needs Python 3.11 or newer, and $(PYTHON) is" \
	    "$$($(PYTHON) --version 2>&1); choose another: make PYTHON=python3.11 ..." >&2; exit 1; }
	@echo "Making the virtual environment $(VENV) ..."
	@$(PYTHON) -m venv $(VENV)
	@echo "Installing ratslam and what it needs (a minute or two) ..."
	@$(INSTALL) --only-binary gtsam -e '.[dev,sweep,live,anchor]' || { \
	  echo "That did not work; trying without gtsam (its test will be skipped) ..."; \
	  $(INSTALL) -e '.[dev,sweep,live]'; }
	@touch $@
	@echo "$(VENV) is ready."
