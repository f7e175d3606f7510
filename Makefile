# make demo: train and score the embedded scene. make test: the tests. Both need python3 with venv alone.
PYTHON ?= python3
BIN := .venv/bin
DEMO := runs/demo

.PHONY: demo test lint clean

$(BIN)/.installed: setup.cfg pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --editable .
	touch $@

$(BIN)/.dev: $(BIN)/.installed
	$(BIN)/pip install --quiet --editable '.[dev,tensorboard]'
	touch $@

demo: $(BIN)/.installed
	$(BIN)/python -m jaxnerf.train --config=configs/quickstart.py --workdir=$(DEMO)
	$(BIN)/python -m jaxnerf.eval --workdir=$(DEMO) --overwrite
	$(BIN)/python -m jaxnerf.render --workdir=$(DEMO) --overwrite
	$(BIN)/python experiments/table.py $(DEMO)

test: $(BIN)/.dev
	$(BIN)/python -m pytest -q --numprocesses=auto --maxprocesses=4 --dist=loadfile

lint: $(BIN)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

clean:
	rm -rf .venv runs build *.egg-info
