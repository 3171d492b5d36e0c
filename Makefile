# Two commands on a fresh clone (Debian or Ubuntu, Python 3.10 or newer):
#
#   make demo    set up, render the demo place into out/demo
#   make test    set up with the test extras, run the tests; ARGS="-k panorama" chooses among them
#
# Set-up is done once: the second run of either only does its own work.

PYTHON ?= python3
ARGS ?=

.PHONY: demo test setup

demo: setup
	.venv/bin/nerg demo --out out/demo

test: EXTRAS = test
test: setup
	.venv/bin/python -m pytest $(ARGS)

setup:
	@$(PYTHON) tools/setup.py $(EXTRAS)
