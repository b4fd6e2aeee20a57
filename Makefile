# Everything here works on a fresh machine with Python 3.11 or 3.12, git, make and an EGL driver.
PYTHON ?= python3
VENV ?= .venv
BENCH_VENV ?= .venv-bench
BIN := $(VENV)/bin
SEED ?= 0
METHOD ?= halgan
OUT ?= runs/navigate-$(METHOD)-seed$(SEED)-$(shell date +%Y%m%d-%H%M%S)

.PHONY: navigate test test-slow check format bench weights gpu-check clean

navigate: $(VENV)/ready  ## train a navigating agent (make navigate SEED=1 METHOD=oracle)
	$(BIN)/python recipes/ddpg_navigate.py --method $(METHOD) --seed $(SEED) --out $(OUT)

test: $(VENV)/ready check  ## all checks and the test suite, under ten minutes
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses 2 --dist worksteal

test-slow: $(VENV)/ready  ## the tests that train for minutes
	$(BIN)/python -m pytest -m slow

check: $(VENV)/ready  ## lint, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(BENCH_VENV)/ready  ## speed and memory side by side with the peers, in an environment of their own
	for benchmark in env_speed replay updates update_cost frame_time overlap; do \
	  $(BENCH_VENV)/bin/python -m benchmarks.$$benchmark || exit 1; done

weights: $(VENV)/ready  ## train the shipped generators again (ten minutes)
	for pair in navigate-2m:default navigate-4m:default pick-and-place-2m:default pebble:pebble; do \
	  environment=$${pair%:*} preset=$${pair#*:}; \
	  run=runs/weights-$$environment shipped=halgan_rl/hallucination/shipped/$$environment; \
	  OMP_NUM_THREADS=1 $(BIN)/python recipes/train_generator.py --preset $$preset --environment $$environment \
	    --seed 0 --out $$run && \
	  cp $$run/generator.safetensors $$shipped.safetensors && \
	  cp $$run/generator.json $$shipped.json && \
	  cp $$run/hallucinations.png $$shipped.png || exit 1; done

gpu-check: $(VENV)/ready  ## on a machine with a GPU, ten minutes: its tests, and update and generator timings
	$(BIN)/python -m pytest -m gpu tests/gpu
	$(BIN)/python -m benchmarks.gpu

$(VENV)/ready: pyproject.toml setup.py constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

$(BENCH_VENV)/ready: pyproject.toml setup.py constraints.txt benchmarks/requirements-peers.txt
	$(PYTHON) -m venv $(BENCH_VENV)
	$(BENCH_VENV)/bin/python -m pip install --quiet --constraint constraints.txt torch
	$(BENCH_VENV)/bin/python -m pip install --quiet --constraint constraints.txt --requirement benchmarks/requirements-peers.txt --editable .
	touch $@

clean:
	rm -rf $(VENV) $(BENCH_VENV) build *.egg-info
