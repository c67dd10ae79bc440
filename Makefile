# Everything runs in .venv, with the versions of constraints.txt.
#   make demo    simulate the paper's experiments, identify them, print the tables: demo/index.html
#   make test    the ordinary tests
#   make ranking the benchmarks in short: which estimator is better, and is any wrong silently
#   make lint    style;  make types    static types;  make clean    remove what was made

PYTHON ?= python3
BIN := .venv/bin
INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt

.PHONY: demo test ranking lint types clean

demo: .venv/package
	$(BIN)/python -m etid.demo demo/

test: .venv/tools
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile

ranking: .venv/tools
	$(BIN)/python -m benchmarks speed_accuracy --quick --folder results/quick

lint: .venv/tools
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: .venv/tools
	$(BIN)/pyright

.venv/package: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade pip  # older ones do not know --group
	$(INSTALL) --editable .
	touch $@

.venv/tools: .venv/package
	$(INSTALL) --group dev
	touch $@

clean:
	rm -rf .venv .rivals demo results dist build .pytest_cache .ruff_cache .hypothesis .coverage*
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
