# make demo: trains and scores the embedded scene; make view: shows it in a browser; make test: runs the fast tests.
# All need only python3 with venv.
PYTHON ?= python3
BIN := .venv/bin
DEMO := runs/demo
# Compiled programs are kept in build/, so that tests compile each only once, but the smallest, which are stored no faster
# than compiled; if JAX warns of one that it cannot read, after a test was killed, call make clean. A worker that crashes
# is not replaced: pytest-xdist can wait for the new one for ever.
PYTEST := JAX_COMPILATION_CACHE_DIR=$(CURDIR)/build/compiled JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0.05 $(BIN)/python -m pytest -q --numprocesses=auto --maxprocesses=4 --dist=loadfile --no-loadscope-reorder --max-worker-restart=0

.PHONY: demo view test test-slow test-extra docs lint clean

$(BIN)/.installed: setup.cfg pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet $(PIP_OPTIONS) --editable .
	touch $@

$(BIN)/.dev: $(BIN)/.installed
	$(BIN)/pip install --quiet --editable '.[dev,check,docs,export,tensorboard,viewer]'
	touch $@

# pip spends half of its time on compiling all modules. Python compiles those that it imports, when it first does.
demo: PIP_OPTIONS := --no-compile
demo: $(BIN)/.installed
	$(BIN)/jaxnerf-train --config=quickstart --config.eval.at_end --workdir=$(DEMO)
	$(BIN)/jaxnerf-render --workdir=$(DEMO) --frames=24 --overwrite
	$(BIN)/jaxnerf-report $(DEMO)
	@echo "make view shows the scene in a browser; its image is in $(DEMO)/eval, a video in $(DEMO)/renders"

view: $(BIN)/.installed
	$(BIN)/pip install --quiet --editable '.[viewer]'
	$(BIN)/jaxnerf-view --workdir=$(DEMO)

# What the fast tests check needs few optimizations, and without them they compile in half the time.
test: $(BIN)/.dev
	JAX_DISABLE_MOST_OPTIMIZATIONS=1 $(PYTEST) -m "not slow and not extra"

test-slow: $(BIN)/.dev
	$(PYTEST) -m slow

# The fast tests again, optimized, as rounding differs. The others take longer, need root to mount small disks, or need Chromium and npm; .ci/run does not call them.
test-extra: $(BIN)/.dev
	$(BIN)/pip install --quiet --editable '.[notebooks]'
	$(PYTEST) -m "not slow"
	rm -rf runs/extra/oldest_versions
	$(BIN)/python tests/slow/oldest_versions.py runs/extra/oldest_versions
	$(BIN)/python tests/slow/notebooks.py
	$(BIN)/python tests/slow/minimal_nerf.py
	PYTHONPATH=.:tests $(BIN)/python tests/slow/commands.py
	PYTHONPATH=.:tests $(BIN)/python tests/slow/device_matrix.py runs/extra/device_matrix
	PYTHONPATH=.:tests $(BIN)/python tests/slow/faults/kill_many.py --kills=20 --seed=1 --out=runs/extra/kill_many
	PYTHONPATH=.:tests $(BIN)/python tests/slow/faults/each.py --out=runs/extra/faults
	PYTHONPATH=.:tests $(BIN)/python tests/slow/cameras_from_images.py runs/extra/cameras
	$(BIN)/python experiments/gpu/run.py --tiny --minutes=60 --out=runs/extra/gpu
	$(BIN)/pip install --quiet playwright
	PYTHONPATH=.:tests $(BIN)/python tests/slow/viewer_in_browser.py runs/extra/viewer
	PYTHONPATH=.:tests $(BIN)/python tests/slow/mesh_in_browser.py runs/extra/mesh

# zensical prints what griffe finds in docstrings, but does not fail.
docs: $(BIN)/.dev
	@$(BIN)/python examples/notebooks/pages.py
	@mkdir -p build
	@$(BIN)/zensical build --clean --strict >build/site.log 2>&1 && ! grep -q griffe: build/site.log || (cat build/site.log; exit 1)
	@tail -1 build/site.log

lint: $(BIN)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

clean:
	rm -rf .venv build site *.egg-info
