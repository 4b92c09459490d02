# Everything a person or the CI does with this repository. `make` alone lists the targets.

PYTHON :=
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
PYTEST_ARGS ?=
BENCH ?=

# Without byte code every start of the command compiles its imports again: 3 to 6 times slower.
unexport PYTHONDONTWRITEBYTECODE
# Small matrices: threads of the linear algebra library wait for each other, most of all on a busy machine.
export OPENBLAS_NUM_THREADS ?= 1
# Neither may decide what a fresh environment imports or where it is installed.
unexport PYTHONPATH
unexport PYTHONHOME
unexport PIP_TARGET
unexport PIP_USER

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all tests lint types firmware peers bench docs format changelog transcripts lock clean distclean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' Makefile | sed -E 's/:[^#]*## */|/' | awk -F'|' '{ printf "  make %-11s %s\n", $$1, $$2 }'

setup: $(VENV)/.setup  ## make .venv with ambid and its tools, from hash-pinned versions (PYTHON=... chooses the Python)

# A Python named on the command line counts also where the environment is already there.
ifneq ($(strip $(PYTHON)),)
.PHONY: $(VENV)/.setup
endif
$(VENV)/.setup: pyproject.toml requirements/build.txt requirements/dev.txt tools/venv.sh
	@sh tools/venv.sh $(VENV) "$(PYTHON)"
	@echo "Installing the pinned packages into $(VENV) (some minutes, once) ..." >&2
	@$(PIP) install -qq --require-hashes -r requirements/build.txt
	@$(PIP) install -qq --require-hashes -r requirements/dev.txt
	@$(PIP) install -qq --no-build-isolation --no-deps --no-index --editable .
	@$(BIN)/python -m compileall -q src
	@touch $@

demo: setup  ## identify the embedded record and print the estimate beside the truth
	@$(BIN)/ambid demo

test: setup  ## what must hold at each change: lint, types, firmware, short tests; ends with pytest's verdict (PYTEST_ARGS="-k words" chooses)
	@$(MAKE) --no-print-directory lint
	@sh tools/firmware_tools.sh && $(MAKE) --no-print-directory -C firmware all || [ $$? -eq 3 ]
	@$(MAKE) --no-print-directory -j2 types tests

test-all: export AMBID_TESTS := all
test-all: test  ## the same with the long half of the tests: full Monte Carlo, every page of the docs, whole commissionings

tests: setup
	$(BIN)/python -m pytest -n 2 --dist loadfile $(PYTEST_ARGS)

lint: setup  ## formatting and lint
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: setup  ## strict type check
	$(BIN)/mypy

firmware:  ## build the controller's firmware and the emulated bench into firmware/build (installs gcc-avr avr-libc libsimavr-dev where it may)
	@sh tools/firmware_tools.sh
	@$(MAKE) --no-print-directory -C firmware all

peers: bench/.venv/linear/.setup bench/.venv/tracking/.setup bench/.venv/rotor/.setup  ## make the environments of the packages that the benchmarks compare with

bench/.venv/%/.setup: requirements/peers-%.txt tools/venv.sh
	@mkdir -p bench/.venv
	@sh tools/venv.sh bench/.venv/$* "$(PYTHON)"
	@echo "Installing the peers into bench/.venv/$* (a minute or two, once) ..." >&2
	@bench/.venv/$*/bin/python -m pip --disable-pip-version-check --no-input install -qq --require-hashes -r $<
	@touch $@

bench: setup peers  ## measure speed and accuracy beside SciPy and peers; writes docs/benchmarks.md (BENCH="speed records" chooses)
	@$(BIN)/python bench/run.py $(BENCH)

docs: $(VENV)/.docs  ## build the documentation into docs/_site
	@$(BIN)/python -m sphinx --quiet -W -b html docs docs/_site
	@echo "docs/_site/index.html"

$(VENV)/.docs: $(VENV)/.setup requirements/docs.txt
	@$(PIP) install -qq --require-hashes -r requirements/docs.txt
	@touch $@

format: setup  ## rewrite the files in the project's format
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

changelog: setup  ## make CHANGELOG.md from changes/
	@$(BIN)/python tools/changelog.py

transcripts: setup  ## run the commands of README and docs, and put what they print into their transcripts
	@$(BIN)/python tools/transcripts.py

lock: setup  ## pin the newest allowed versions again (needs the package index)
	@sh tools/lock.sh $(BIN)/python

clean:  ## remove caches and builds
	@rm -rf build dist firmware/build docs/_site docs/made .pytest_cache .mypy_cache .ruff_cache
	@find src tests bench tools docs -type d -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true

distclean: clean  ## clean, and remove .venv
	@rm -rf $(VENV) bench/.venv src/*.egg-info
