# `make test` and `make demo` need Python 3.10 or later, make and a C library; everything else goes into .venv.
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help test test-fast slow-tests demo lint docs bench fuzz lock bill clean

VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
# Tests run in so many processes, files as a whole; WORKERS=0 runs them in one, for a debugger.
WORKERS ?= 2
# With bytecode kept: pytest rewrites the assertions of every test file, which takes 20 s where it cannot keep them.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile
SOURCES := $(wildcard sgwarp kernels tests notebooks benchmarks tools)

# A name on PATH may be an empty shim, so each candidate has to run.
PYTHON ?= $(shell for name in python3 python python3.14 python3.13 python3.12 python3.11 python3.10; do \
	$$name -c 'import sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1 && { echo $$name; break; }; done)

help:
	@echo "make test       install into $(VENV), run the tests       (ARGS='tests/io -x' for some of them)"
	@echo "make test-fast  the same without the slow ones, for the inner loop"
	@echo "make slow-tests measure them, and add what is slow to tests/slow_tests.txt"
	@echo "make demo       install into $(VENV), run the demonstration; pictures and a table go to demo_out/"
	@echo "make lint       ruff and mypy"
	@echo "make docs       build the documentation into site/; warnings are errors"
	@echo "make bench      the benchmarks, as ratios within one run"
	@echo "make fuzz       a million damaged files against every reader (ARGS='--inputs 10000' for fewer)"
	@echo "make lock       requirements.lock anew: every package of constraints.txt with its hashes"
	@echo "make bill       licenses of everything installed      (ARGS='--out FILE' for a bill of materials)"
	@echo "make clean      remove what the other targets built"

test: $(VENV)/installed-test
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || \
		echo "no chromium here: the tests in a browser are skipped (apt-get install chromium)"
	$(PYTEST) $(ARGS)

test-fast: $(VENV)/installed-test
	$(PYTEST) -m "not slow" $(ARGS)

slow-tests: $(VENV)/installed-test
	$(PYTEST) -m "not slow" --record-slow $(ARGS)

demo: $(VENV)/installed-demo
	$(BIN)/sgwarp demo --out demo_out $(ARGS)

lint: $(VENV)/installed-dev
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy

docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "open site/index.html"

bench: $(VENV)/installed-test
	$(BIN)/python -m benchmarks $(ARGS)

fuzz: $(VENV)/installed-test
	$(BIN)/python tests/fuzz/fuzzer.py --keep fuzz_findings $(ARGS)

lock: $(BIN)/python
	$(BIN)/python -m pip install --disable-pip-version-check --quiet uv==0.13.9
	$(BIN)/python -m tools.lock

bill: $(VENV)/installed-test
	$(BIN)/python -m tools.bill $(ARGS)

clean:
	rm -rf $(VENV) demo_out site build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/installed-test: EXTRAS = test,ptx
$(VENV)/installed-demo: EXTRAS = demo
$(VENV)/installed-dev: EXTRAS = dev
$(VENV)/installed-docs: EXTRAS = docs

# One stamp per set of extras: installed again only when what is asked for changes. With HASHED=1, only files whose
# hashes are in requirements.lock.
$(VENV)/installed-%: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing sgwarp[$(EXTRAS)] into $(VENV); the first time takes some minutes"
ifdef HASHED
	$(BIN)/python -m tools.install '$(EXTRAS)'
else
	$(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt -e '.[$(EXTRAS)]'
endif
	@touch $@

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "make: no Python 3.10 or later found; install one or say make PYTHON=/path/to/python3" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
