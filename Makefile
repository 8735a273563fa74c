# tactomo: everything a fresh machine needs is Python 3.11+ (with venv), git and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN_READY := $(VENV)/.ready-run
READY := $(VENV)/.ready
TRAIN_READY := $(VENV)/.ready-train
DOCS_READY := $(VENV)/.ready-docs
PEERS_PYTHON ?= python3.12
PEERS := .venv-peers
PEERS_READY := $(PEERS)/.ready
SHELL := bash
.SHELLFLAGS := -eo pipefail -c

# A line for each package, of all that pip says. Compiled at install, modules that nothing imports
# would take longer than all else.
INSTALL := $(BIN)/python -m pip install --no-compile
SHOW := sed -un 's/^Collecting \([^=; ]*\).*/  \1/p; s/^Installing.*/  unpacking/p'
BUILD := --quiet --no-build-isolation --no-deps
LAB := models/tactomo_lab
DIST := dist
VERSION = $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
SITE = $(DIST)/docs/$(VERSION)
COMMIT := daemon/tactomo/commit.txt

LOCKED := pyproject.toml --universal --python-version 3.11 --generate-hashes \
  --no-emit-package tactomo-client --no-emit-package tactomo --no-emit-package tactomo-lab

# What a robot of 64-bit Arm installs, from wheels alone: `make lock` fails where one has none.
ON_ARM := --python-version 3.11 --python-platform aarch64-manylinux_2_28 --only-binary :all: \
  --no-emit-package tactomo-client --no-emit-package tactomo --no-annotate

.PHONY: help setup run test test-lab test-all test-random test-long test-train test-peers faults soak fleet firmware fuzz lint format schema pictures bench docs wheels release-check deb lock clean

help:            ## list these targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

setup: $(READY) ## the environment in .venv, which the others make by themselves

run: $(RUN_READY)  ## twin, daemon and viewer: a skin to press in the browser
	$(BIN)/tactomo demo $(ARGS)

# The tests start many a Python, each of which compiles all that it imports where none keeps it.
test test-lab test-all test-random test-long test-train faults: export PYTHONDONTWRITEBYTECODE :=

test: $(READY)   ## the default test suite
	$(BIN)/pytest -n auto --dist loadfile $(ARGS)

test-lab: $(READY)  ## the tests of the laboratory
	$(BIN)/pytest tests/lab -n auto --dist loadfile \
	  -m 'not slow and not long and not train and not peers and not faults' $(ARGS)

test-all: $(READY)  ## every test but the long ones, training and faults; more examples in each
	$(BIN)/pytest -n auto --dist loadfile -m 'not long and not train and not peers and not faults' \
	  --hypothesis-profile many $(ARGS)

RANDOM_SECONDS ?= 600
test-random: $(READY)  ## Hypothesis with a new seed, modules in any order, for RANDOM_SECONDS
	$(BIN)/pytest -n 0 -m 'hypothesis and not long and not train and not peers and not faults' \
	  --hypothesis-profile new --seconds $(RANDOM_SECONDS) $(ARGS)

test-long: test-random fuzz  ## statistics, measured sets and days of drift: minutes each; random seeds
	$(BIN)/pytest -m long $(ARGS)

test-train: $(TRAIN_READY)  ## the tests of training; installs PyTorch
	$(BIN)/pytest -m train $(ARGS)

test-peers: $(PEERS_READY)  ## LeRobot and ROS 2 themselves read ours; installs them (4 GB), needs Python 3.12
	HF_HOME=$(PEERS)/huggingface HF_HUB_OFFLINE=1 $(PEERS)/bin/python -m pytest -m peers \
	  tests/learning tests/ros2/test_node.py $(ARGS)

faults: $(READY) ## every fault and measure (hours; a tenth: ARGS='--scale 0.1'), then docs/reliability.md from them
	$(BIN)/pytest tests/faults -m '' --reliability docs/reliability.md $(ARGS)

soak: $(READY)   ## a million dual scans as fast as they are taken, and their row of that page
	$(BIN)/pytest tests/faults -m '' -k soak --reliability docs/reliability.md $(ARGS)

fleet: $(READY)  ## a thousand simulated skins through two Zenoh routers: docs/fleet.md
	$(BIN)/python tests/support/fleet_measure.py $(ARGS)

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

schema: $(READY) ## tables of the documentation and the C++ fields, from tactomo_client/schema.py
	$(BIN)/python tests/support/write_schema.py

pictures: $(READY)  ## the page's pictures in docs/, of a demo in Chromium
	$(BIN)/python tests/support/page_pictures.py

bench: $(READY)  ## latency and time per frame on this machine
	$(BIN)/tactomo bench $(ARGS)

# A warning fails it: a link that leads nowhere, a page that docs/README.md does not name.
docs: $(DOCS_READY)  ## the documentation as a site: dist/docs/VERSION/index.html
	$(BIN)/python -m sphinx -W --keep-going -q -E -d $(VENV)/doctrees -c docs . $(SITE)

# The wheels are made of the source archives, so that these are known to be whole.
wheels: $(RUN_READY)  ## wheels and source archives of every distribution, and an SBOM, in dist/
	rm -f $(DIST)/*.whl $(DIST)/*.tar.gz
	mkdir -p $(DIST)
	$(BIN)/python deploy/sbom.py requirements-run.lock $(VERSION) > $(DIST)/sbom.json
	git describe --always --dirty --abbrev=12 > $(COMMIT) || rm -f $(COMMIT)
	for each in $(dir $(wildcard pyproject.toml */*/pyproject.toml)); do \
	  (cd $$each && $(abspath $(BIN))/python -m hatchling build -t sdist -d $(abspath $(DIST))); done
	$(BIN)/python -m pip wheel $(BUILD) --wheel-dir $(DIST) $(DIST)/*.tar.gz
	rm -f $(COMMIT)
	ls -lh $(DIST)

# The checklist of a release, in order; the first thing that is amiss ends it.
release-check: $(READY)  ## all that a release must pass: clean, told, linted, built, installed, tested
	test -z "$$(git status --porcelain)" || { git status --short; echo "commit these first, or move them: archives would hold them"; exit 1; }
	grep -q '^## $(VERSION)' CHANGELOG.md || { echo "CHANGELOG.md lacks $(VERSION)"; exit 1; }
	$(MAKE) lint schema
	git diff --quiet HEAD || { echo "commit what make schema has written"; exit 1; }
	$(BIN)/python -m pip install --quiet --dry-run --ignore-installed --no-deps --only-binary :all: \
	  $(foreach each,2_28 2_17,--platform manylinux_$(each)_aarch64) --python-version 3.11 \
	  --target $(DIST)/aarch64 -r requirements-aarch64.lock
	$(MAKE) docs wheels
	$(BIN)/pytest tests/deploy -n 0 -m 'not long'
	$(MAKE) test-all

deb: $(READY)    ## the Debian package, for this distribution and processor, in dist/
	deploy/debian/build.sh $(BIN)/python

lock:            ## refresh the lock files (needs uv on the PATH)
	uv pip compile $(LOCKED) --extra dev --group build -o requirements.lock
	uv pip compile $(LOCKED) --group build -c requirements.lock -o requirements-run.lock
	uv pip compile pyproject.toml --extra drawings --extra foxglove --extra matlab --extra metrics --extra plot --extra ros2 --extra zenoh --group build \
	  $(ON_ARM) -c requirements.lock -o requirements-aarch64.lock
	uv pip compile --group docs --universal --python-version 3.11 --generate-hashes \
	  -c requirements.lock -o requirements-docs.lock
	uv pip compile $(LAB)/$(LOCKED) --extra train -c requirements.lock -c requirements-torch.txt \
	  --no-emit-package torch -o requirements-train.lock

clean:           ## remove the environment and caches
	rm -rf $(VENV) $(PEERS) .mypy_cache .ruff_cache .pytest_cache .hypothesis

# The inner loop is compiled (hatch_build.py): for those without a compiler a package brings one.
# Built in place under a temporary marker so that an interrupted install is simply redone. First what
# runs, then on top of that what tests, then what trains.
$(RUN_READY): requirements-run.lock pyproject.toml hatch_build.py models/tactomo_models/inner_loop.c clients/python/pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "tactomo needs Python 3.11 or newer")'
	@echo "setting up $(VENV): what runs"
	@$(PYTHON) -m venv $(VENV)
	@$(INSTALL) --require-hashes -r requirements-run.lock | $(SHOW)
	@command -v $${CC:-cc} >/dev/null || $(INSTALL) ziglang | $(SHOW) || true
	@$(INSTALL) $(BUILD) -e clients/python -e .
	@command -v $${CC:-cc} >/dev/null || $(BIN)/python -m pip uninstall --quiet --yes ziglang
	@touch $@

$(READY): $(RUN_READY) requirements.lock $(LAB)/pyproject.toml
	@echo "setting up $(VENV): what tests, and the laboratory"
	@$(INSTALL) --require-hashes -r requirements.lock | $(SHOW)
	@$(INSTALL) $(BUILD) -e $(LAB)
	@touch $@

$(DOCS_READY): $(READY) requirements-docs.lock
	@echo "setting up $(VENV): what builds the documentation's site"
	@$(INSTALL) --require-hashes -r requirements-docs.lock | $(SHOW)
	@touch $@

# Torch comes last, when all it needs has come with its hash. Where its own index cannot be reached,
# pip says so and takes what the others have.
$(TRAIN_READY): $(READY) requirements-train.lock requirements-torch.txt
	@echo "setting up $(VENV): what trains"
	@$(INSTALL) --require-hashes -r requirements-train.lock | $(SHOW)
	@$(INSTALL) -r requirements-torch.txt | $(SHOW)
	@touch $@

# In an environment of their own: LeRobot wants a newer Python and older packages than ours.
$(PEERS_READY): requirements-peers.txt pyproject.toml clients/python/pyproject.toml clients/lerobot/pyproject.toml
	@echo "setting up $(PEERS): LeRobot and ROS 2"
	@$(PEERS_PYTHON) -m venv $(PEERS)
	@$(PEERS)/bin/python -m pip install --no-compile -r requirements-peers.txt | $(SHOW)
	@$(PEERS)/bin/python -m pip install --quiet --no-compile --no-build-isolation \
	  -e clients/python -e '.[ros2]' -e clients/lerobot
	@touch $@
