# Two commands: `make demo` and `make test`. Both make .venv first, from the pinned requirements.lock and requirements-dev.lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
LIBRARY := library
# Of the demo and of the results: fast, balanced (what plain `snakemake` runs) or accurate.
PRESET := fast
# Of the benchmark of long video: a clip whose camera goes on, and the first frames of it that are measured.
LONG_SCENE := long_walk
LONG_FRAMES := 50 200 1000

.PHONY: install demo results priced train-masks test test-long test-slurm bench bench-long lint clean

install: $(INSTALLED)

$(INSTALLED): requirements.lock requirements-dev.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python >= 3.11 is needed; try make PYTHON=python3.12")'
	@echo "Installing the pinned packages into $(VENV): a few minutes, once."
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --requirement requirements-dev.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

demo: $(INSTALLED)
	$(BIN)/snakemake --config preset=$(PRESET)

# By default Snakemake's scheduler wakes once a second for every job that has ended: over these 500 jobs that took a
# quarter of two cores. Once a minute is enough, at the price of a wait of up to a minute at the end. One thread a job, as
# COLMAP has: two scenes side by side keep both cores busy, where a job of two threads leaves up to half of them idle.
IN_LIBRARY := $(BIN)/snakemake --directory $(LIBRARY) --max-jobs-per-timespan 1000/1m --max-threads 1

# The whole scene library and its page of figures; begun again, it goes on where it stopped.
results: $(INSTALLED)
	$(IN_LIBRARY) --config scenes=all preset=$(PRESET); ended=$$?; \
	$(BIN)/python -m stages.results --results $(LIBRARY)/results/simulated --manifests $(LIBRARY)/simulated \
		--scenes stages/simulate/scenes --output docs/results.md --readme README.md \
		--command "make results PRESET=$(PRESET)" && exit $$ended

# Decided effects against all and none on scenes of the library (SCENES=all, test or [demo, soft_body]), beside the
# results of `make results`, whose runs it shares. Begun again, it goes on where it stopped.
SCENES := tuned
priced: $(INSTALLED)
	$(IN_LIBRARY) --config 'scenes=$(SCENES)' preset=$(PRESET) \
		'sweep={sequences: all, groups: [effects]}' -- results/simulated/sweep/costs.parquet; ended=$$?; \
	$(BIN)/python -m stages.results.priced --results $(LIBRARY)/results/simulated --output docs/priced.md \
		--chart docs/priced.png --readme README.md --command "make priced PRESET=$(PRESET) SCENES='$(SCENES)'" && exit $$ended

# The network at the borders of masks, from nothing (training/masks/README.md). Begun again, it goes on where it stopped,
# with what other code has made, too. A random scene that cannot be solved is left out.
TRAINING := training_masks
IN_TRAINING := $(BIN)/snakemake --directory $(TRAINING) --max-jobs-per-timespan 1000/1m --max-threads 1 --rerun-triggers mtime
train-masks: $(INSTALLED)
	$(BIN)/python -m training.masks --work $(TRAINING) --scenes
	-$(IN_TRAINING) --configfile $(TRAINING)/tuned.yaml -- masks
	-$(IN_TRAINING) --configfile $(TRAINING)/random.yaml -- masks
	$(BIN)/python -m training.masks --work $(TRAINING)

# Two processes, each with whole files: much of a test is one thread, or waits for Slurm or Snakemake.
test: lint
	$(BIN)/pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/snakefmt --check Snakefile workflow
	$(BIN)/snakemake --lint

test-long: $(INSTALLED)
	$(BIN)/pytest -m long

# With the part that plain `make test` leaves out; skipped, with a reason, where a Slurm cannot be had.
test-slurm: $(INSTALLED)
	$(BIN)/pytest -m slurm -rs

bench: $(INSTALLED)
	for bench in $(filter-out %/bench_long.py,$(wildcard benchmarks/bench_*.py)); do $(BIN)/python -m benchmarks.$$(basename $$bench .py) || exit 1; done

# Begun again, it goes on where it stopped; with further numbers of frames it measures those alone.
bench-long: $(INSTALLED)
	$(BIN)/python -m benchmarks.bench_long --scene $(LONG_SCENE) --frames $(LONG_FRAMES) \
		--page docs/long_video.md --chart docs/long_video.png --config preset=$(PRESET) rounds=2

clean:
	rm -rf results simulated decoded logs .snakemake $(LIBRARY) library_balanced bench_long $(TRAINING)
