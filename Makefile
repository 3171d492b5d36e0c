# Commands on a fresh clone (Debian or Ubuntu, Python 3.10 or newer):
#
#   make demo      set up, render the demo place into out/demo
#   make test      set up with the test extras, run the tests; ARGS="-k panorama" chooses among them, JOBS=0 runs them in one process
#   make test-all  the same, and the tests marked "nightly": long trainings, whole demos, kills, leaks, recorded data
#
# While working, and before a release:
#
#   make check     the quick tests of every part (a minute on two cores); ARGS as above
#   make lint      format, style and import rules, all of which have to be right; nothing is changed
#   make types     what a type checker finds
#   make format    put right what of it can be put right by itself
#   make docs      write what the pages say about the code: tables
#   make manual    build the manual into out/manual/html (Python 3.11 or newer); any warning is an error
#   make onecore   the tests that render, write pictures and train, on one core, where Dr.Jit has one thread
#   make coverage  all tests, and which lines and branches of the package they reach (into out/coverage/index.html too)
#   make fuzz      damage what every reader reads, 20,000 times, and count what comes of it (some ten minutes)
#   make faults    kill commands at moments spread over their run: nothing may be lost
#   make soak      thousands of frames and steps: memory may not grow
#   make bench     frames, stages, growth, memory and start beside peers (under ten minutes); ARGS=--long for more
#   make bench-gpu the same on a CUDA device, where there is one
#   make packages  build the packages, install and try them with every Python that is here (nox)
#
# Set-up is done once: the second run of any of these only does its own work. `make fuzz`, `make faults` and `make bench` print
# tables; ARGS="--update docs/explanation/robustness.md" puts those of the first two there, ARGS="--page docs/explanation/performance.md" those of the third.

# Tests start many processes: byte code that is kept spares each of them compiling the package, and pytest its rewriting.
export PYTHONDONTWRITEBYTECODE =
PYTHON ?= python3
ARGS ?=
RUN = .venv/bin/python
# One process a core, four at most since each takes a gigabyte; a file's tests share what they have made. Files come in the
# order of tests/conftest.py.
JOBS ?= auto
PYTEST = $(RUN) -m pytest -n $(JOBS) --maxprocesses 4 --dist loadfile --no-loadscope-reorder
ONE_CORE = tests/cli/test_scenes.py tests/cli/test_ending.py tests/files/test_images.py tests/files/test_images.py \
	tests/test_runtime.py tests/renders

.PHONY: demo test test-all check lint types format docs manual onecore coverage fuzz faults soak packages bench bench-gpu setup

demo: setup
	.venv/bin/nerg demo --out out/demo

test test-all check onecore coverage fuzz faults soak: EXTRAS = test

packages: EXTRAS = dev

test: setup
	$(PYTEST) -m "not nightly" $(ARGS)

test-all: setup
	$(PYTEST) $(ARGS)

bench bench-gpu: EXTRAS = torch

lint types format docs: EXTRAS = lint

manual: EXTRAS = manual

lint: setup
	$(RUN) -m ruff check
	$(RUN) -m ruff format --check
	$(RUN) -m tools.import_rules

types: setup
	$(RUN) -m basedpyright --project pyproject.toml

format: setup
	$(RUN) -m ruff check --fix
	$(RUN) -m ruff format

docs: setup
	$(RUN) -m tools.generated

manual: setup
	$(RUN) -m sphinx -b html -W --keep-going -q -E -c docs -d out/manual/doctrees . out/manual/html $(ARGS)
	@echo wrote out/manual/html/docs/index.html

check: setup
	$(PYTEST) -q -m "not slow and not nightly" $(ARGS)

onecore: setup
	@if command -v taskset > /dev/null; then taskset -c 0 $(RUN) -m pytest -q $(ONE_CORE) $(ARGS); \
	else echo "One core is not tried: taskset (of util-linux) is not installed."; fi

coverage: setup
	$(RUN) -m coverage erase
	$(RUN) -m coverage run -m pytest -q $(ARGS)
	$(RUN) -m coverage combine -q
	$(RUN) -m coverage html -q
	$(RUN) -m coverage report

fuzz faults: setup
	$(RUN) -m tools.$@ $(ARGS)

soak: setup
	NERG_SOAK=1 $(RUN) -m pytest -q -s tests/test_soak.py $(ARGS)

packages: setup
	$(RUN) -m nox $(ARGS)

bench: setup
	$(RUN) benchmarks/bench.py $(ARGS)

bench-gpu: setup
	$(RUN) benchmarks/bench.py --mode cuda_ad_rgb $(ARGS)

setup:
	@$(PYTHON) tools/setup.py $(EXTRAS)
