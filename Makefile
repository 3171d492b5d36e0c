# Commands on a fresh clone (Debian or Ubuntu, Python 3.10 or newer):
#
#   make demo      install, then render the demo scene into out/demo
#   make test      install the test extras, then run the tests; ARGS="-k panorama" selects tests, JOBS=0 uses one process
#   make test-all  also run the tests marked "nightly": long trainings, whole demos, kills, leaks, recorded data
#
# During development and before a release:
#
#   make check     run the quick tests of every package (one minute on two cores); ARGS as above
#   make lint      check format, style, import rules, spelling, words and the names in sentences; change nothing
#   make types     run the type checker
#   make format    fix format and style where that can be automated
#   make docs      regenerate the parts of the manual that are derived from the code
#   make manual    build the manual into out/manual/html (Python 3.11 or newer); any warning is an error
#   make onecore   run the tests that render, write images and train on one core, where Dr.Jit has one thread
#   make portable  run all tests in random order, as a processor with narrower vectors computes; ARGS=--randomly-seed=N
#                  repeats an order
#   make coverage  measure line and branch coverage of all tests (also as out/coverage/index.html)
#   make fuzz      pass 20,000 damaged files to the readers and count the outcomes (about ten minutes)
#   make faults    kill commands at moments spread over their run and check that nothing is lost
#   make soak      render and train for thousands of frames and steps and check that memory does not grow
#   make bench     time frames and stages next to peers (under ten minutes);
#                  ARGS=--long adds more
#   make bench-gpu the same on a CUDA device, if there is one
#   make packages  build the packages, then install and test them with every Python found (nox)
#
# The set-up runs once; later calls only do their own work. `python -m tools.results NAME` publishes a result again.

# Tests start many processes: byte code that is kept spares each of them compiling the package, and pytest its rewriting.
export PYTHONDONTWRITEBYTECODE =
PYTHON ?= python3
ARGS ?=
RUN = .venv/bin/python
# One process a core, four at most since each takes a gigabyte; a file's tests share what they have made. Files come in the
# order of tests/conftest.py. A process that ends during a test is not replaced: pytest-xdist would wait forever at the end.
JOBS ?= auto
PYTEST = $(RUN) -m pytest -n $(JOBS) --maxprocesses 4 --max-worker-restart 0 --dist loadfile --no-loadscope-reorder
ONE_CORE = tests/cli/test_scenes.py tests/cli/test_ending.py tests/files/test_images.py \
	tests/test_runtime.py tests/renders

.PHONY: demo test test-all portable check lint types format docs manual onecore coverage fuzz faults soak packages bench bench-gpu setup

demo: setup
	.venv/bin/nerg demo --output out/demo

test test-all portable check onecore coverage fuzz faults soak: EXTRAS = test

packages: EXTRAS = dev

test: setup
	$(PYTEST) -m "not nightly" $(ARGS)

test-all: setup
	$(PYTEST) $(ARGS)

bench bench-gpu: EXTRAS = torch

portable: setup
	$(RUN) -m tools.other_processor $(PYTEST) -p randomly $(ARGS)

lint types format docs: EXTRAS = lint

manual: EXTRAS = manual

lint: setup
	$(RUN) -m ruff check
	$(RUN) -m ruff format --check
	$(RUN) -m tools.import_rules
	git ls-files -z | xargs -0 $(RUN) -m codespell_lib
	$(RUN) -m tools.words
	$(RUN) -m tools.backticks

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
