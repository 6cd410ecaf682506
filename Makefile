# `make demo` and `make test` do their whole set-up on a machine with Python and make only.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# a bare `torch` is a CUDA build of several gigabytes on Linux; the pinned one is small where a CPU wheel is at hand
TORCH := $(shell sed -n 's/^torch==/torch==/p' constraints.txt)
export PYTHONUNBUFFERED := 1

.PHONY: help install test lint docs demo clean
help:
	@echo "make demo     train, evaluate and predict on a simulated town; writes runs/demo/report.html"
	@echo "make test     the test suite"
	@echo "make lint     ruff and mypy"
	@echo "make docs     the documentation as HTML, in docs/_build/html"
	@echo "make install  only build .venv"

install: $(VENV)/installed
$(VENV)/installed: pyproject.toml constraints.txt plugins/all.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt $(TORCH)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -r plugins/all.txt -e ".[dev,docs,slurm]"
	touch $@

demo: install
	$(BIN)/python tools/demo.py

# one process a core, one thread each: many small networks
test: install
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: install
	$(BIN)/python -m sphinx -W -q docs docs/_build/html

clean:
	rm -rf $(VENV) build dist *.egg-info docs/_build
