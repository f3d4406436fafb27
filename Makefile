# Every habit is one word. The set-up comes by itself: a .venv with what constraints.txt pins.
#
#   make train                     train CartPole-v1 through rl-zoo3 (more arguments: ARGS="--seed 1")
#   make test                      run the tests (fewer of them: ARGS="tests/test_zoo_hook.py -k spawn")
#   make check                     formatting, lint, types
#   make format                    put formatting right
#   make docs                      build the book into docs/_build/html; a warning is an error
#   make bench                     the gate: has anything become slower, or does it learn less? Five minutes
#   make bench-full                also speed of whole iterations and of each part; and what is not in benchmarks/results yet of
#                                  what the shipped settings reach and of the runs beside peers (days, if nothing is)
#   make clean                     remove .venv and what builds and tools left
#   make PYTHON=python3.12 train   choose an interpreter

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TIANSHOU := .venv-tianshou
# Written last, so that a .venv without it is half-made
STAMP := $(VENV)/.installed
SETUP_FILES := setup.cfg setup.py pyproject.toml constraints.txt sb3_gae_zoo_hook.pth sb3_gae_zoo_hook.start
WHICH_PYTHON := -c 'import sys; print(sys.version)'

# Make the .venv anew if its Python does not run, or another one was asked for
IN_PLACE := $(shell $(BIN)/python $(WHICH_PYTHON) 2>/dev/null)
ifeq ($(IN_PLACE),)
ANEW := FORCE
else ifneq ($(origin PYTHON),file)
ifneq ($(shell $(PYTHON) $(WHICH_PYTHON) 2>/dev/null),$(IN_PLACE))
ANEW := FORCE
endif
endif

# Commands are run by name, as one would type them
IN_VENV := PATH="$(CURDIR)/$(BIN):$$PATH"

.PHONY: FORCE setup train test check format docs bench bench-full clean

setup: $(STAMP)

$(STAMP): $(SETUP_FILES) $(ANEW)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo "sb3-gae needs Python 3.11 or newer, but $(PYTHON) is $$($(PYTHON) --version 2>/dev/null || echo missing)." \
			"Choose one: make PYTHON=python3.12 $(or $(MAKECMDGOALS),setup)" >&2; exit 1; }
	@$(if $(ANEW),rm -f $@)
	test -f $@ || $(PYTHON) -m venv --clear $(VENV)
	@rm -f $@
	$(BIN)/python -m pip install -c constraints.txt -e ".[tests,docs]"
	@touch $@

train: $(STAMP)
	$(IN_VENV) python -m rl_zoo3.train --algo trpo_gae --env CartPole-v1 --progress $(ARGS)

test: $(STAMP)
	$(IN_VENV) python -m pytest $(ARGS)

check: $(STAMP)
	$(IN_VENV) ruff format --check .
	$(IN_VENV) ruff check .
	$(IN_VENV) mypy

format: $(STAMP)
	$(IN_VENV) ruff format .
	$(IN_VENV) ruff check --fix .

docs: $(STAMP)
	$(IN_VENV) sphinx-build --fail-on-warning --keep-going --fresh-env -b html docs docs/_build/html
	$(IN_VENV) sphinx-build --fail-on-warning --keep-going -b doctest docs docs/_build/doctest

bench: $(STAMP)
	$(IN_VENV) python -m benchmarks.gate $(ARGS)

bench-full: bench $(TIANSHOU)/.installed
	$(IN_VENV) python benchmarks/update_speed.py
	$(IN_VENV) python benchmarks/rollout_speed.py
	$(IN_VENV) python -m benchmarks.speed run
	$(IN_VENV) python -m benchmarks.speed targets
	$(IN_VENV) python -m benchmarks.speed profile
	$(IN_VENV) python -m benchmarks.speed threads
	$(IN_VENV) python -m benchmarks.speed report
	$(IN_VENV) python -m benchmarks.first_results
	$(IN_VENV) python -m benchmarks.paper_tasks
	$(IN_VENV) python -m benchmarks.peers run --jobs 2
	$(IN_VENV) python -m benchmarks.peers export
	$(IN_VENV) python -m benchmarks.peers report

# The peer that asks for packages that the others' set does not have
$(TIANSHOU)/.installed: $(SETUP_FILES) benchmarks/peers/tianshou.txt
	$(PYTHON) -m venv --clear $(TIANSHOU)
	grep -v '^filelock==' constraints.txt > $(TIANSHOU)/constraints.txt
	$(TIANSHOU)/bin/python -m pip install -c $(TIANSHOU)/constraints.txt -e . -r benchmarks/peers/tianshou.txt
	@touch $@

clean:
	rm -rf $(VENV) $(TIANSHOU) build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis .benchmarks docs/_build
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
