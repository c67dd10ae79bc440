# Everything runs in .venv, with the versions of constraints.txt.
#   make demo    simulate the paper's experiments, identify them, print the tables: demo/index.html
#   make test    the ordinary tests
#   make test-portable  the tests that compare with stored numbers, with the instructions of an old processor
#   make outputs the texts that tests/outputs holds, anew: read what has changed
#   make slow    the other tests: statistics, and what compiles long
#   make ranking the benchmarks in short: which estimator is better, and is any wrong silently
#   make notebooks  executes the notebooks: notebooks/executed/*.ipynb, with their figures
#   make docs    the site: site/index.html; the notebooks are its gallery
#   make wheel-test  the wheel in empty environments: PYTHONS="python3.11 python3.13" DEPENDENCIES=oldest
#   make lint    style;  make types    static types;  make clean    remove what was made

PYTHON ?= python3
BIN := .venv/bin
INSTALL := $(BIN)/python -m pip install --quiet --constraint constraints.txt

PYTHONS ?= $(PYTHON)
DEPENDENCIES ?= newest
# What notebooks compile is kept where the tests keep it.
COMPILED := JAX_COMPILATION_CACHE_DIR=$(CURDIR)/.pytest_cache/d/xla JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0

# Tests with their assertions and etid with its checks of types are kept as bytecode: a third of the
# time of a collection.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-portable outputs slow ranking notebooks docs wheel-test lint types clean

demo: .venv/package
	$(BIN)/python -m benchmarks.paper.demo demo/

test: .venv/tools
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile

# Each test writes its text, and fails because there was none.
outputs: .venv/tools
	rm -f tests/outputs/*.txt
	-$(BIN)/python -m pytest --quiet --tb=no --numprocesses auto --dist loadfile -m "" \
		tests/test_outputs_of_*.py tests/test_report.py
	git diff --stat -- tests/outputs

# Another order of sums must stay within the tolerances.
test-portable: .venv/tools
	XLA_FLAGS=--xla_cpu_max_isa=SSE4_2 OPENBLAS_CORETYPE=Nehalem $(BIN)/python -m pytest \
		--numprocesses auto --dist loadfile -m "stored and not slow" \
		$$(grep -rlE "kept_numbers|import printed|, printed" tests --include "test_*.py")

slow: .venv/tools
	$(BIN)/python -m pytest -m slow --numprocesses auto --dist loadfile

ranking: .venv/tools
	$(COMPILED) $(BIN)/python -m benchmarks speed_accuracy --quick --folder results/quick
	$(COMPILED) $(BIN)/python -m benchmarks failure_map --quick --folder results/quick

notebooks: .venv/tools
	$(BIN)/python -m pytest tests/test_notebooks.py -m notebook --numprocesses auto

docs: .venv/docs
	$(COMPILED) $(BIN)/python -m properdocs build -f mkdocs.yml

wheel-test: .venv/tools
	$(BIN)/python .ci/wheel.py --python $(PYTHONS) --dependencies $(DEPENDENCIES)

lint: .venv/tools
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-logo

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

.venv/docs: .venv/tools
	$(INSTALL) --group docs
	touch $@

clean:
	rm -rf .venv .rivals demo results site dist build .pytest_cache .ruff_cache .hypothesis .coverage*
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
