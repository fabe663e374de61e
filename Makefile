# make run: installs what running needs and prints the first score. make test, make lint, make docs: the checks of CI.
# make bench: the speed figures, half an hour. make licences: the licence of all that is installed. make wheel-check: the wheel in an
# environment of its own. All but `run` install what development needs.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
HAS_BROWSER := (for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit 0; done; exit 1)
RUN_STAMP := $(VENV)/installed-to-run
DEV_STAMP := $(VENV)/installed-to-develop

.PHONY: run test lint tree docs page publish bench soak findings licences wheel-check install install-dev browser debian-browser clean

run: install
	$(BIN)/bench run attack=zo defense=advtrain

test: install-dev browser
	$(BIN)/python -m pytest -n 2 --dist worksteal

lint: install-dev tree
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# build/tree/cavbench: the folders as they are installed, by links, for tools that read the source without importing it.
tree:
	rm -rf build/tree
	mkdir -p build/tree/cavbench
	for name in bench/* attacks defenses envs leaderboard; do ln -s ../../../$$name build/tree/cavbench; done

# The site, in docs/_build/html. A broken link, a page missing from the contents, an unknown component or a sentence of more than 30 words
# (docs/prose.py) is an error.
docs: install-dev page
	rm -rf docs/_build
	$(BIN)/python docs/prose.py
	$(BIN)/python -m sphinx -W --keep-going -q -d docs/_build/doctrees docs docs/_build/html

# The leaderboard of the published records: leaderboard/index.html, .json, .csv and .tex. From there, so that no folder `results` counts.
page: install-dev
	cd leaderboard && ../$(BIN)/bench report html=index.html >/dev/null

# What the published leaderboard of driving lacks, the cheapest row first: says the hours, and goes on where it was killed.
# HOURS=2 drives what fits in two hours of CPU.
HOURS := 1000
publish: install-dev
	$(BIN)/python -m cavbench.leaderboard.job --hours $(HOURS)

# The wheel in an environment of its own: installs it, and runs a first command. Takes minutes and 2 GB.
wheel-check: install-dev
	CAVBENCH_WHEEL_CHECK=1 $(BIN)/python -m pytest tests/packaging/test_packaging.py

# Each figure is a ratio to a peer that the same run measured. The experiments are in studies/: they take options and hours.
bench: install-dev
	for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

# What is surprising about real libraries, each in an environment of its own: one line each, with ok or CHANGED. A quarter of an hour, 3 GB at a
# time. Not part of `test`.
findings:
	@failed=0; for script in $(filter-out findings/fresh.sh,$(wildcard findings/*.sh)); do \
		if seen=$$(bash $$script); then state=ok; else state=CHANGED; failed=1; fi; echo "$$state $$(basename $$script .sh): $$seen"; done; exit $$failed

install: $(RUN_STAMP)

install-dev: $(DEV_STAMP)

# Every distribution has its hash in a lock (locks/lock.py). torch has one for its CPU build, and one for that of the package index.
LOCKED := $(BIN)/python -m pip install --quiet --require-hashes --no-deps --no-build-isolation

$(RUN_STAMP): pyproject.toml setup.py constraints.txt locks/build.txt locks/run.txt locks/torch.txt locks/torch-cpu.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(LOCKED) -r locks/build.txt
	$(LOCKED) -r locks/run.txt
	$(BIN)/python locks/install_torch.py
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $@

$(DEV_STAMP): $(RUN_STAMP) locks/develop.txt
	$(LOCKED) -r locks/develop.txt
	touch $@

# The licence of every installed distribution; fails for one that nobody has looked at.
licences: install-dev
	$(BIN)/python locks/licences.py

# The browser for the tests of the leaderboard's page: one on the PATH, else Debian's (as root), else Playwright's own.
# Without a browser these tests are skipped, and say why.
browser: debian-browser install-dev
	@$(HAS_BROWSER) || $(BIN)/python -m playwright install chromium || echo "no browser: the tests of the page will be skipped"

# It needs nothing of the environment, so with `make --jobs` both are installed at the same time.
debian-browser:
	@$(HAS_BROWSER) || [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null || \
		{ apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium; } || true

clean:
	rm -rf $(VENV) build dist docs/_build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

# Random kills, bad places, bad command lines, bad plug-ins, changed files and a long run, with a table of figures for docs/reliability.md; three hours
# on two idle cores. Not part of `test`.
soak: install-dev
	$(BIN)/python -m tests.soak kills=100 inputs=1000 plugins=60 fuzzing=60 minutes=60
