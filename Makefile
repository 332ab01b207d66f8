# The verbs are the steps of continuous integration; each sets up what it needs.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
TEST_PROCESSES ?= 3
RANDOM_TESTS = $(shell grep -rlE '^(from|import) (hypothesis|tests\.exploring)' tests --include='test_*.py' | grep -v tests/peers)
PACKAGES := sern_core sern_runtime sern_relay sern_client sern_sim sern_twin sern_navigation sern_perception sern_tools benchmarks tests

# What a process compiles it keeps (__pycache__) for the next one, whatever the environment says: a daemon starts with a
# quarter less of CPU, and each worker of the tests would rewrite all of them anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup lint format types test wheel compiled test-compiled deb image test-install arm-wheels explore standstills soak fuzz kills lab bench performance endpoints operations figures cellular navigation paper paper-quick picture demo demo-twin demo-navigation schemas clean

help:
	@echo "make setup    create $(VENV) with pinned dependencies"
	@echo "make demo     relay, robot and site over a bad link, on this machine, next to plain ZMQ"
	@echo "make demo-twin  a robot and its twin over a link that is gone for 30 s: how far off it was, and what it said"
	@echo "make demo-navigation  a robot crosses a campus by its sensors, by its twin, by both; over a link that is gone on the way"
	@echo "make test     the tests but the longer ones of make lab;  make lint, make types: static checks"
	@echo "make wheel    a wheel in dist/ whose core is compiled;  make test-compiled: the tests of the core and of the daemons on it"
	@echo "make compiled an environment with that wheel, .venv-compiled, also for benchmarks"
	@echo "make deb      Debian packages in dist/ with that wheel;  make test-install   as root: they install, run under systemd, and go"
	@echo "make image    as root: a container image of the package, localhost/sern"
	@echo "make arm-wheels  which pinned dependencies have wheels for ARM computers, for docs/install.md"
	@echo "make explore  the tests with random input, with new cases and ten times as many; SEED=... repeats a run"
	@echo "make standstills   the tests whose processes stand still for moments, as on a loaded machine; SEED=..."
	@echo "make soak     ten minutes of robots that come and go: memory and open files;  make kills: 1,000 times kill -9"
	@echo "make fuzz     made-up input for what reads bytes of others, a minute each; build/fuzz keeps what it learns"
	@echo "make lab      the whole matrix of bad links, and the longer runs over tc netem, which need root"
	@echo "make performance   as root: measure link, fleet and policies of docs/performance.md anew, two hours of an idle machine"
	@echo "make endpoints, make figures   the other tables: ROS endpoints, 20 minutes; virtual time, summaries and codecs, 30"
	@echo "make operations   the tables of keys and of durable topics, 10 minutes"
	@echo "make cellular RECORDINGS=DIR   the table of recorded cellular links, three minutes; virtual time"
	@echo "make navigation   the tables of navigation and perception, hours; DRIVES=FILE keeps the drives, and goes on with them"
	@echo "make paper    as root: the tables, figures and claims of the paper, in paper-out, hours; it goes on where it was interrupted"
	@echo "make paper-quick   the same from few runs of each, a quarter of an hour"
	@echo "make picture  the demo, and its picture for README.md"
	@echo "make bench    the quick benchmarks;  make schemas: regenerate schemas/ and the configuration reference"

PYTHON_NEEDED := SERN needs 3.11 to 3.13: make PYTHON=python3.11 $(or $(MAKECMDGOALS),setup), or see deploy/README.md, 1
PYTHON_HAS := import sys; print("%d.%d" % sys.version_info[:2]); sys.exit(sys.version_info < (3, 11))

$(VENV)/.ready: pyproject.toml constraints.txt
	@has=$$($(PYTHON) -c '$(PYTHON_HAS)') || { echo "$(PYTHON) is Python $$has, $(PYTHON_NEEDED)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,bench,report,lossy,dds,zenoh,twin,geo,sim,viz,seg,foxglove]'
	@touch $@

setup: $(VENV)/.ready

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: setup
	$(BIN)/mypy

# The lab measures a link: it has the machine for itself.
test: setup
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist loadgroup --ignore tests/lab
	$(BIN)/python -m pytest tests/lab

# Needs a C compiler, and the headers of the Python that it is for. What an earlier build left does not get into it.
wheel: setup
	rm -rf build/lib.* build/bdist.* dist/sern-*.whl
	SERN_COMPILE=1 $(BIN)/python -m pip wheel --disable-pip-version-check --no-deps --no-build-isolation -w dist .

# The wheel in an environment of its own, and no source beside it: of the checkout only the tests are to be found.
COMPILED := $(VENV)-compiled
CORE_TESTS := tests/sern_core tests/sern_sim tests/fuzz tests/test_vectors.py tests/test_compiled.py
compiled: wheel
	$(PYTHON) -m venv $(COMPILED)
	$(COMPILED)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt "$$(ls dist/sern-*.whl)[dev,bench,report,lossy,dds,zenoh,twin,geo,sim,viz,seg,foxglove]"
	$(COMPILED)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --force-reinstall dist/sern-*.whl
	mkdir -p build/checkout
	ln -sfn ../../tests build/checkout/tests
	ln -sfn ../../benchmarks build/checkout/benchmarks

test-compiled: compiled
	SERN_CORE=compiled PYTHONSAFEPATH=1 PYTHONPATH=$(CURDIR)/build/checkout $(COMPILED)/bin/python -m pytest \
		-o pythonpath=build/checkout -n $(TEST_PROCESSES) --dist loadgroup $(CORE_TESTS) tests/loopback

# The Debian packages, for the Python of Debian itself: it has to be of the version of PYTHON, whose compiler made the wheel.
deb: wheel
	deploy/debian/build dist/sern-*.whl

# As root: a container image of that package, localhost/sern, by buildah.
image: deb
	deploy/image/build dist/sern_*.deb

# Some minutes, and five more at the first time, for a Debian to install them in (.rootfs).
test-install: deb
	SERN_PACKAGES=dist $(BIN)/python -m pytest tests/install

# Asks pip, for some minutes, and downloads nothing.
arm-wheels: setup
	$(BIN)/python -m benchmarks.arm_wheels --write

# One look at the clock: all that takes the seed has the same one.
SEED := $(or $(SEED),$(shell date +%s))
explore: setup
	@echo "SEED=$(SEED)"
	SERN_EXPLORE=$(SEED) $(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist loadgroup --hypothesis-seed=$(SEED) $(RANDOM_TESTS)

# Those with processes of their own. Not the lab: it measures, and has the machine for itself.
standstills: setup
	$(BIN)/python -m tests.standstills $(SEED) -q -n $(TEST_PROCESSES) --dist loadgroup tests/sern_client tests/sern_relay \
		tests/sern_runtime tests/sern_tools tests/loopback tests/hazards tests/peers tests/deploy tests/benchmarks

# Of the matrix also the quarter that is in every `make test`.
lab: setup
	$(BIN)/python -m pytest tests/matrix -m 'lab_long or not lab_long' --figures build/matrix.json
	$(BIN)/python -m pytest tests/lab -m lab_long

# What finds what tests of a known case do not. Inputs that the fuzzer has learned from stay in build/fuzz.
soak: setup
	mkdir -p build
	$(BIN)/python -m benchmarks.soak --json build/soak.json
	$(BIN)/python -m benchmarks.document build/soak.json

fuzz: setup
	$(BIN)/python -m tests.fuzz

kills: setup
	$(BIN)/python -m tests.hazards.kills

bench: setup
	$(BIN)/python -m benchmarks.scheduler --quick
	$(BIN)/python -m benchmarks.relay --quick

# Whatever a step lacks is told before the first begins.
performance: setup
	$(BIN)/python -m benchmarks.ready
	mkdir -p build
	$(BIN)/python -m benchmarks.link --plots docs/images --json build/link.json
	$(BIN)/python -m benchmarks.sensors --json build/sensors.json
	$(BIN)/python -m benchmarks.robots --figure docs/images/perf-robots.png --json build/robots.json
	$(BIN)/python -m benchmarks.relay --json build/relay.json
	$(BIN)/python -m benchmarks.mmcf_lab --runs 20 --json build/mmcf_lab.json
	$(BIN)/python -m benchmarks.sync_lab --json build/sync_lab.json
	$(BIN)/python -m benchmarks.fabric --json build/fabric.json
	$(BIN)/python -m benchmarks.document build/link.json build/sensors.json build/robots.json build/relay.json build/mmcf_lab.json build/sync_lab.json build/fabric.json

endpoints: setup
	mkdir -p build
	$(BIN)/python -m benchmarks.endpoints --json build/endpoints.json
	$(BIN)/python -m benchmarks.viewers --json build/viewers.json
	$(BIN)/python -m benchmarks.document build/endpoints.json build/viewers.json

# Of NATS too where its server is installed (Debian's nats-server).
operations: setup
	mkdir -p build
	$(BIN)/python -m benchmarks.curve --json build/curve.json
	$(BIN)/python -m benchmarks.durable --json build/durable.json
	$(BIN)/python -m benchmarks.document build/curve.json build/durable.json

# Neither root nor ROS is needed.
figures: setup
	mkdir -p build
	$(BIN)/python -m benchmarks.footprint --json build/footprint.json
	$(BIN)/python -m benchmarks.thin_link --json build/thin_link.json
	$(BIN)/python -m benchmarks.spool --json build/spool.json
	$(BIN)/python -m benchmarks.codecs --json build/codecs.json
	$(BIN)/python -m benchmarks.summaries --plots docs/images --json build/summaries.json
	$(BIN)/python -m benchmarks.mmcf_recovery --json build/mmcf_recovery.json
	$(BIN)/python -m benchmarks.mmcf_replay --plots docs/images --json build/mmcf_replay.json
	$(BIN)/python -m benchmarks.mmcf --plots docs/images --json build/mmcf.json
	$(BIN)/python -m benchmarks.sync --json build/sync.json
	$(BIN)/python -m benchmarks.document $(addprefix build/,$(addsuffix .json,footprint thin_link spool codecs summaries mmcf_recovery mmcf_replay mmcf sync))

# The recordings are not ours to ship: make cellular RECORDINGS=DIR.
RECORDINGS := ../shared/data/cellular
cellular: setup
	mkdir -p build
	$(BIN)/python -m benchmarks.cellular --data $(RECORDINGS) --json build/cellular.json
	$(BIN)/python -m benchmarks.document build/cellular.json

# Hours of drives: what was interrupted goes on where it was. Those of docs/ are of the planner as it is; remove the file
# where that has changed.
DRIVES := docs/navigation-drives.jsonl
navigation: setup
	mkdir -p build
	$(BIN)/python -m benchmarks.navigation --resume $(DRIVES) --json build/navigation.json
	$(BIN)/python -m benchmarks.perception --json build/perception.json
	$(BIN)/python -m benchmarks.document build/navigation.json build/perception.json

# The tables, figures and claims of the paper, in paper-out: hours, as root where the lab is to be had; it goes on
# where it was interrupted. paper-quick: a quarter of an hour.
paper: setup
	$(BIN)/python -m benchmarks.paper

paper-quick: setup
	$(BIN)/python -m benchmarks.paper --quick

picture: setup
	$(BIN)/sern demo --out build/demo --picture docs/images/demo.png
	$(BIN)/python -m benchmarks.document build/demo/result.json

demo: setup
	$(BIN)/sern demo

demo-twin: setup
	$(BIN)/sern demo-twin

# DEM and STREETS: an elevation model and a map (.osm), whose ground and buildings are taken.
DEM ?= $(wildcard ../shared/data/dem_1arcsec.tif)
STREETS ?= $(wildcard ../shared/data/streets.osm)
demo-navigation: setup
	$(BIN)/sern demo-navigation --view 8090 $(DEM:%=--dem %) $(STREETS:%=--streets %)

schemas: setup
	$(BIN)/python -m sern_runtime.config.export schemas docs/configuration.md

clean:
	rm -rf $(VENV) $(COMPILED) build dist .rootfs *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
