# tactomo: everything a fresh machine needs is Python 3.11+ (with venv), git and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TRAIN_READY := $(VENV)/.ready-train

LOCKED := pyproject.toml --universal --python-version 3.11 --generate-hashes \
  --no-emit-package tactomo-client --no-emit-package tactomo

.PHONY: help setup run test test-slow test-train faults soak firmware fuzz lint format bench deb lock clean

help:            ## list these targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

setup: $(READY) ## the environment in .venv, which the others make by themselves

run: $(READY)    ## twin, daemon and viewer: a skin to press in the browser
	$(BIN)/tactomo demo $(ARGS)

test: $(READY)   ## the default test suite
	$(BIN)/pytest -n auto --dist loadfile $(ARGS)

test-slow: $(READY)  ## the tests too long for every run
	$(BIN)/pytest -m 'slow and not train' $(ARGS)

test-train: $(TRAIN_READY)  ## the tests of training; installs PyTorch
	$(BIN)/pytest -m train $(ARGS)

faults: $(READY) ## every fault and measure (an hour), then docs/reliability.md from them
	$(BIN)/pytest tests/faults -m '' --reliability docs/reliability.md $(ARGS)

soak: $(READY)   ## a million dual scans as fast as they are taken
	$(BIN)/pytest tests/faults -m '' -k soak $(ARGS)

firmware:        ## the C firmware library's emulator of a skin: firmware_protocol/c/build
	$(MAKE) -C firmware_protocol/c

FUZZ_SECONDS ?= 60
fuzz: $(READY)   ## a minute of each parser, in Python (x86_64), C and C++ (clang): FUZZ_SECONDS=3600
	$(BIN)/python -m pip install --quiet 'atheris==3.0.0'
	set -e; for target in $$($(BIN)/python tests/fuzz/run.py list); do \
	  $(BIN)/python tests/fuzz/run.py $$target -max_total_time=$(FUZZ_SECONDS); done
	$(BIN)/python tests/fuzz/run_cpp.py -max_total_time=$(FUZZ_SECONDS)
	$(MAKE) -C firmware_protocol/c fuzz FUZZ_SECONDS=$(FUZZ_SECONDS)

lint: $(READY)   ## ruff and mypy --strict
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY) ## let ruff rewrite what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(READY)  ## latency and time per frame on this machine
	$(BIN)/tactomo bench $(ARGS)

deb: $(READY)    ## the Debian package, for this distribution and processor, in dist/
	deploy/debian/build.sh $(BIN)/python

lock:            ## refresh the lock files (needs uv on the PATH)
	uv pip compile $(LOCKED) --extra dev -o requirements.lock
	uv pip compile $(LOCKED) --extra train -c requirements.lock -c requirements-torch.txt \
	  --no-emit-package torch -o requirements-train.lock

clean:           ## remove the environment and caches
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis

# Built in place under a temporary marker so that an interrupted install is simply redone.
$(READY): requirements.lock pyproject.toml clients/python/pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "tactomo needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-build-isolation --no-deps -e clients/python -e .
	touch $@

# On top of that: torch last, when all it needs has come with its hash. Where its own index cannot
# be reached, pip says so and takes what the others have.
$(TRAIN_READY): $(READY) requirements-train.lock requirements-torch.txt
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements-train.lock
	$(BIN)/python -m pip install --quiet -r requirements-torch.txt
	touch $@
