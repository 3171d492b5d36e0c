# Two commands on a fresh clone (Debian or Ubuntu, Python 3.10 or newer):
#
#   make demo    set up, render the demo place into out/demo
#   make test    set up with the test extras, run the tests; ARGS="-k panorama" chooses among them
#   make mutants judge the tests by 400 small mistakes in the source, resuming where it stopped (about an hour at first)
#
# Set-up is done once: the second run of either only does its own work.

PYTHON ?= python3
ARGS ?=

.PHONY: demo test mutants setup

demo: setup
	.venv/bin/nerg demo --out out/demo

test: EXTRAS = test
test: setup
	.venv/bin/python -m pytest $(ARGS)

mutants: EXTRAS = test
mutants: setup
	.venv/bin/python tools/mutants.py $(ARGS)

setup:
	@$(PYTHON) tools/setup.py $(EXTRAS)
