# drivegain: `make demo` and `make test` are all that a fresh machine needs (Python >= 3.11, pip, make).
# PYTHON=python3.12 make setup   chooses another interpreter; the environment is made in .venv.
# make VENV=out/venv-3.12 PYTHON=python3.12 test   leaves .venv as it is, and uses another environment.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.drivegain-stamp
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Linear algebra on all cores at once is slower for matrices of this size, and makes timings wander.
export OMP_NUM_THREADS ?= 1
# Compiled modules are kept: without them every program that a test starts would compile all that it imports.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help setup demo figaroh test test-slow test-processes test-vcan chaos guard-study vcan-tools test-console browser check docs test-docs reference sizes screenshots bench bench-stream ident-study gain-study tls-study coverage-study paper planning-study robot-study pivot-study crash-study kill-study session-kill-study console-study soak drift-study holdout-study loop-noise-study diagnosis-study effects-study tx40-study real-study geometry-study damage-study prior-study pairs-study planner-study contact-study weigh-study stopping-study session-study warm-up-study first-certificate words wheel lock clean chaos-hub write-fault-study mutation-study

help:
	@echo "make demo    set up, then calibrate a simulated six-axis cell end to end into out/demo"
	@echo "make test    set up, then lint, types, import contracts and tests"
	@echo "make figaroh  figaroh 1.0.2 in an environment of its own, 1 GB: with it, make test reads exported URDFs with figaroh"
	@echo "make test-slow  searches, plans and sessions on whole simulated recordings; 35 minutes of processor time"
	@echo "make test-processes  whole jobs: jobs that are killed, two buses, real recordings"
	@echo "make test-vcan  the main job over real SocketCAN (vcan), under User-Mode Linux where this kernel has none"
	@echo "make chaos    random faults at random moments on SocketCAN for 10 minutes; SEED=1 MINUTES=10 or ROUND=7 (docs/evidence/socketcan.md)"
	@echo "make chaos-hub the same over a hub on this machine, where there is no SocketCAN; RESULTS=FILE goes on behind its last round"
	@echo "make test-console  the live console in headless Chromium beside whole recordings, screenshots in out/console; the certificate on paper"
	@echo "make docs    build the documentation site into out/docs, offline, warnings as errors"
	@echo "make test-docs  every command of every page: the tutorial to the letter, then the pages that continue it; the Python of every page; minutes"
	@echo "make reference  write what the pages take from the code into docs/ (verbs, keys, schemas, errors, gates, API); seconds"
	@echo "make sizes   write what drivegain and its extras take on disk into docs/install.md; seconds"
	@echo "make screenshots  refresh the pictures of the documentation from real commands; minutes"
	@echo "make setup   make .venv alone"
	@echo "make check   lint, types, import contracts"
	@echo "make bench   speed and memory: against figaroh 1.0.2 and loops over Pinocchio in Python and C++, growth to 4 million samples, a whole fit; minutes"
	@echo "make bench-stream  six axes at 1 kHz through the stream on SocketCAN, with a busy thread beside (docs/evidence/stream.md); minutes"
	@echo "make ident-study  errors by estimator and noise floor (docs/evidence/estimators.md); half an hour"
	@echo "make tls-study  total least squares beside maximum likelihood, without and with an undeclared effect (docs/evidence/estimators.md); minutes"
	@echo "make loop-noise-study  gain errors and whether error bars are true, also with a disturbance in the position loop (docs/evidence/estimators.md); 10 min"
	@echo "make coverage-study  whether the error bars of the gains are true: clean, disturbed, after the search, without rests (docs/evidence/estimators.md); resumable, an hour"
	@echo "make gain-study  the demonstration on several clean cells; minutes"
	@echo "make paper   the paper's Tables 1 to 8 on the simulated cell (docs/evidence/paper.md); minutes"
	@echo "make planning-study  planned against random moves (docs/evidence/planning.md); minutes"
	@echo "make crash-study  recorders killed at random moments, damaged logs; some minutes"
	@echo "make kill-study  jobs killed at 60 random moments, each finished by the next one; some minutes"
	@echo "make session-kill-study  guided sessions killed at 40 random moments of all stages, each finished by the same command; resumable, some minutes"
	@echo "make write-fault-study  kills, errors and short writes at every changing system call of apply, rollback, recalibrate and calibrate (docs/evidence/write-path.md); VERBS=\"apply calibrate\" EVERY=3 MINUTES=20; resumable, three hours"
	@echo "make guard-study  the axes of a recorder killed by kill -9, with a foreign node on every id from 1 to 127; minutes"
	@echo "make console-study  60 minutes on SocketCAN with the console alternately open and closed: losses, jitter, processor, memory"
	@echo "make soak    recordings at rising rates with the console open and screens stalled: what the host lost, and what drivegain lost (docs/evidence/stream.md); MINUTES=60 REALTIME=1; resumable, more than an hour"
	@echo "make drift-study  detection delay and false alarms of a drifting gain (docs/evidence/drift.md); a minute"
	@echo "make holdout-study  which wrong gains the hold-out gate detects (docs/evidence/hold-out.md); a minute"
	@echo "make diagnosis-study  false alarms of the diagnoses on clean recordings, and planted mistakes that are named; time skews that are printed; ten minutes"
	@echo "make robot-study  gains and a second payload of every shipped robot (docs/evidence/robots.md); resumable, half an hour"
	@echo "make pivot-study  friction of the pivots that closed chains are cut at: named, and the gains (docs/evidence/pivots.md); resumable, a quarter of an hour"
	@echo "make effects-study  undeclared effects of every family: named, error before and after (docs/evidence/effects-study.md); hours, resumable"
	@echo "make tx40-study  the loop closed on a real robot, scored on blocks that were left out (docs/evidence/tx40.md); minutes"
	@echo "make real-study  effects found on real robots, judged where the arm was elsewhere (docs/evidence/real.md); needs the recordings; resumable, half an hour"
	@echo "make geometry-study  wrong zeros, tilted gravity and late signals on four robots: named, and the gains; resumable, hours"
	@echo "make damage-study  held readings of a real arm, a drive that gives less than asked, faults of channels; half an hour"
	@echo "make session-study  motion and errors of a guided session beside the way step by step (docs/evidence/session.md); resumable, hours"
	@echo "make weigh-study  coverage of the error bars of a weighed payload (docs/evidence/estimators.md); resumable, half an hour"
	@echo "make stopping-study  gains and their error bars where a recording ends as soon as every error bar is at its target (docs/evidence/stopping.md); resumable, ten minutes"
	@echo "make warm-up-study  how far friction that falls while the arm warms up bends the gains, by the order of blocks; resumable, an hour"
	@echo "make first-certificate  README's first session at a terminal: words to read, time beside the motion; minutes"
	@echo "make prior-study  full parameters under right and wrong priors: coverage, and what is noticed (docs/evidence/prior.md); resumable, twenty minutes"
	@echo "make pairs-study  gains of independent recordings of one arm beside their error bars, after the search (docs/evidence/pairs.md); resumable, hours"
	@echo "make planner-study  error bars that the planner predicts beside those of the fit, slow noise too (docs/evidence/planning.md); minutes"
	@echo "make contact-study  false alarms an hour and height of the thresholds of contact (docs/evidence/contact.md); minutes"
	@echo "make mutation-study  small faults planted into the product, and whether a test notices (docs/evidence/tests.md); SEED=1 MUTANTS=300 MINUTES=55; resumable, hours"
	@echo "make words   the words that code and prose use more often than well-known packages do; seconds"
	@echo "make wheel   build dist/*.whl"
	@echo "make lock    resolve the dependencies anew into requirements.lock"
	@echo "make clean   remove .venv and everything made"

setup: $(STAMP)

# Where PYTHON is named and the environment is of another interpreter, the environment is made again.
# Without PYTHON an environment stays as it is, whatever interpreter it was made by.
IDENTITY := import sys; print(sys.version, sys.base_prefix)
ifneq ($(origin PYTHON),file)
ifneq ($(shell $(PYTHON) -c '$(IDENTITY)' 2>&1),$(shell $(BIN)/python -c '$(IDENTITY)' 2>/dev/null))
OTHER_PYTHON := yes
.PHONY: $(STAMP)
endif
endif

# The stamp is written last: a set-up that was interrupted is taken up again. Where Debian's python3 comes without
# python3-venv, pip is put into the environment from outside.
$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "drivegain needs Python 3.11 or later; found: $$($(PYTHON) --version 2>&1)." >&2; \
		echo "Install one (Debian, Ubuntu: apt install python3 python3-pip) or name it: make PYTHON=python3.12 ..." >&2; \
		exit 1; }
	@[ -z "$(OTHER_PYTHON)" ] || [ ! -e $(VENV) ] || { \
		echo "$(VENV) is of another interpreter than $(PYTHON) and is made again"; rm -rf $(VENV); }
	@echo "setting up $(VENV), once: 1.6 GB of tools and locked packages"
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { rm -rf $(VENV); $(PYTHON) -m venv $(VENV) >/dev/null 2>&1; } || { \
		rm -rf $(VENV); $(PYTHON) -m venv --without-pip $(VENV) && \
		$(PYTHON) -m pip --python $(BIN)/python install -qq pip; } || { \
		echo "$(PYTHON) can make no environment with pip in it (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; }
	@$(BIN)/python .ci/set_up.py requirements.lock
	@$(BIN)/python -m pip install -qq --no-deps --no-build-isolation --editable .
	@touch $@
	@echo 'drivegain is in $(BIN). In each terminal: export PATH="$(abspath $(BIN)):$$PATH"'

demo: setup
	$(BIN)/drivegain demo --out out/demo

test: check
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m "not processes and not slow" --ignore tests/pages

# Its Pinocchio is another one than ours.
figaroh: setup
	$(BIN)/python -m tests.bench.figaroh_environment

test-slow: setup
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m "slow and not processes" --ignore tests/pages

test-processes: setup
	$(BIN)/python -m pytest -q -m processes tests/pipeline tests/daq/jobs tests/faults tests/bench

test-vcan: setup vcan-tools
	@if command -v npm >/dev/null; then npm ci --prefix tests/vcan/foreign --no-audit --no-fund; \
		else echo "no npm: the foreign stack's tests are skipped"; fi
	$(BIN)/python -m tests.vcan.run $(BIN)/python -m pytest -q -m vcan tests/vcan

mutation-study: setup
	$(BIN)/python -m tests.mutation.study $(if $(SEED),--seed $(SEED)) $(if $(MUTANTS),--mutants $(MUTANTS)) $(if $(MINUTES),--minutes $(MINUTES))

chaos: setup vcan-tools
	@mkdir -p out
	DRIVEGAIN_VCAN_OUT=$(CURDIR)/out $(BIN)/python -m tests.vcan.run $(BIN)/python -m tests.chaos \
		$(if $(SEED),--seed $(SEED)) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(ROUND),--round $(ROUND))

# The same over a hub on 127.0.0.1, on any machine; RESULTS=FILE keeps a row for each round and goes on behind the last.
chaos-hub: setup
	@mkdir -p out
	DRIVEGAIN_VCAN_OUT=$(CURDIR)/out $(BIN)/python -m tests.chaos --hub $(if $(RESULTS),--results $(RESULTS)) \
		$(if $(SEED),--seed $(SEED)) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(ROUND),--round $(ROUND))

# What brings a kernel with vcan where this one has none.
vcan-tools:
	@[ -e /sys/class/net/vcan0 ] || { command -v linux.uml && command -v ip && command -v candump; } >/dev/null || { \
		[ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && \
		apt-get install -y -qq --no-install-recommends user-mode-linux iproute2 can-utils; } || { \
		echo "this needs vcan0, or as root: apt-get install user-mode-linux iproute2 can-utils" >&2; exit 1; }

CHROMIUM = $$(command -v chromium || command -v chromium-browser || command -v google-chrome)

test-console: setup browser
	DRIVEGAIN_CHROMIUM="$(CHROMIUM)" $(BIN)/python -m pytest -q -m browser tests/daq/console tests/daq/report

browser:
	@[ -n "$(CHROMIUM)" ] || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq && \
		apt-get install -y -qq --no-install-recommends chromium; } || { \
		echo "this needs Chromium, or as root: apt-get install chromium" >&2; exit 1; }

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: setup
	$(BIN)/python -m sphinx -q -W --keep-going -b html -d out/docs-doctrees docs out/docs

test-docs: setup
	$(BIN)/python -m tests.pages
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder tests/pages

reference: setup
	$(BIN)/python -m docs.reference_pages

sizes: setup
	$(BIN)/python -m docs.sizes

# The pictures are committed: a build of the site runs no robot.
screenshots: demo test-console
	$(BIN)/python docs/screenshots.py --demo out/demo

bench: setup
	$(BIN)/python -m tests.bench

bench-stream: setup vcan-tools
	@mkdir -p out
	DRIVEGAIN_VCAN_OUT=$(CURDIR)/out $(BIN)/python -m tests.vcan.run $(BIN)/python -m tests.bench.stream
	DRIVEGAIN_VCAN_OUT=$(CURDIR)/out $(BIN)/python -m tests.bench.stream_cost

ident-study: setup
	$(BIN)/python -m tests.studies.ident_study

tls-study: setup
	$(BIN)/python -m tests.studies.tls_study

gain-study: setup
	$(BIN)/python -m tests.studies.clean_cells

paper: setup
	$(BIN)/python -m tests.studies.paper_tables --seeds 1 2 3

planning-study: setup
	$(BIN)/python -m tests.studies.planning

robot-study: setup
	$(BIN)/python -m tests.studies.any_robot

pivot-study: setup
	$(BIN)/python -m tests.studies.pivot_friction

tx40-study: setup
	$(BIN)/python -m tests.studies.tx40_study

real-study: setup
	$(BIN)/python -m tests.studies.real_study

geometry-study: setup
	$(BIN)/python -m tests.studies.geometry_study

damage-study: setup
	$(BIN)/python -m tests.studies.damaged_recordings

prior-study: setup
	$(BIN)/python -m tests.studies.prior_study

weigh-study: setup
	$(BIN)/python -m tests.studies.weigh_study --arm three
	$(BIN)/python -m tests.studies.weigh_study --arm tx40

stopping-study: setup
	$(BIN)/python -m tests.studies.stopping_study

session-study: setup
	$(BIN)/python -m tests.studies.session_study --minutes 1000 --tables docs/evidence/data

pairs-study: setup
	$(BIN)/python -m tests.studies.pairs_study --tables docs/evidence/data

planner-study: setup
	$(BIN)/python -m tests.studies.planner_study --tables docs/evidence/data

contact-study: setup
	$(BIN)/python -m tests.studies.contact_study --tables docs/evidence/data

first-certificate: setup
	$(BIN)/python -m tests.studies.first_certificate

warm-up-study: setup
	$(BIN)/python -m tests.studies.warm_up_study

loop-noise-study: setup
	$(BIN)/python -m tests.studies.loop_noise

coverage-study: setup
	$(BIN)/python -m tests.studies.coverage_cases

effects-study: setup
	$(BIN)/python -m tests.studies.effects_study

diagnosis-study: setup
	$(BIN)/python -m tests.studies.diagnosis_study
	$(BIN)/python -m tests.studies.skew_study

holdout-study: setup
	$(BIN)/python -m tests.studies.holdout_study

drift-study: setup
	$(BIN)/python -m tests.studies.drift_study

crash-study: setup
	$(BIN)/python -m tests.studies.crash_study

kill-study: setup
	$(BIN)/python -m tests.studies.recalibration_study --moments 60

session-kill-study: setup
	$(BIN)/python -m tests.studies.session_kills

write-fault-study: setup
	$(BIN)/python -m tests.studies.write_faults --tables docs/evidence/data \
		$(if $(VERBS),--verbs $(VERBS)) $(if $(EVERY),--every $(EVERY)) $(if $(MINUTES),--minutes $(MINUTES))

guard-study: setup
	$(BIN)/python -m tests.faults.test_killed

console-study: setup vcan-tools
	@mkdir -p out
	DRIVEGAIN_VCAN_OUT=$(CURDIR)/out $(BIN)/python -m tests.vcan.run $(BIN)/python -m tests.studies.console_study

# Where there is no vcan0, over a hub on 127.0.0.1. REALTIME=1, as root, for a machine with other work.
soak: setup
	$(BIN)/python -m tests.studies.soak --results docs/evidence/data/soak.csv $(if $(MINUTES),--minutes $(MINUTES)) $(if $(REALTIME),--realtime)

words: setup
	$(BIN)/python -m tests.tools.words

wheel: setup
	$(BIN)/python -m pip wheel -qq --no-deps --no-build-isolation --wheel-dir dist .

# One lock for all platforms and both kinds of user; no index address in it, so that any mirror serves.
lock:
	@rm -rf out/lock-venv
	@$(PYTHON) -m venv out/lock-venv
	@out/lock-venv/bin/python -m pip install -qq uv
	out/lock-venv/bin/uv pip compile pyproject.toml --group dev --group docs --universal --generate-hashes --no-emit-index-url \
		--no-annotate --no-header --python-version 3.11 --output-file requirements.lock
	@rm -rf out/lock-venv

clean:
	rm -rf $(VENV) out dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
