# `make demo` and `make test` set up everything they need on a fresh Debian 12 or Ubuntu 24.04; both are quick when it is there.
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
PYTEST_ARGS ?=
MAPS ?=
# three files of tests at a time: most wait for processes to start, and for video to play; the renderer's share an OpenGL context
TOGETHER := -n 3 --dist loadfile -m "not alone"

.PHONY: help demo test lint check-python check-web e2e bench bench-gpu bench-light bench-presets bench-service bench-truth soak fuzz \
	bench-viewers bench-latency bench-networks setup setup-test setup-truth lock clean

help: ## show the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 16

demo: setup ## a synthetic 360 camera, the service and a sample scene; ARGS="--duration 30 --report demo.json"
	$(BIN)/mr360 demo $(ARGS)

test: lint check-python check-web e2e ## everything: style, types, unit tests, browser and media servers

lint: setup-test ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/mypy

check-python: setup-test ## unit tests
	$(BIN)/python -m pytest tests/renderer $(TOGETHER) $(PYTEST_ARGS)
	$(BIN)/python -m pytest tests/worker tests/server $(TOGETHER) $(PYTEST_ARGS)

check-web: setup-test ## unit tests of the page's modules
	node --test tests/web/*.test.js

e2e: setup-test ## real RTMP and RTSP servers, real Chromium, a real headset runtime
	$(BIN)/python -m pytest tests/e2e tests/web $(TOGETHER) $(PYTEST_ARGS)
	$(BIN)/python -m pytest tests/e2e tests/worker -m alone $(PYTEST_ARGS)

bench-truth: setup-truth ## objects, shadows and silhouettes against a path tracer; MAPS=FOLDER of radiance maps, e.g. ARGS="--only-scenes five"
	$(BIN)/python -m tests.benchmarks.truth --maps $(MAPS) $(ARGS)

setup: $(VENV)/.run-ready ## what the service needs
setup-test: $(VENV)/.test-ready ## what the tests need
setup-truth: $(VENV)/.truth-ready ## what the path tracer needs

$(VENV)/.run-ready: requirements.lock pyproject.toml scripts/apt-packages.sh $(wildcard renderer/native/*.[ch])
	@scripts/apt-packages.sh run
	@echo "setting up the Python environment in $(VENV)"
	@test -x $(BIN)/python || "$$(scripts/find-python.sh)" -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	@PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	@touch $@

$(VENV)/.test-ready: $(VENV)/.run-ready requirements-dev.lock package-lock.json
	@scripts/apt-packages.sh test
	@echo "setting up what the tests need: Python packages, npm packages"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.lock
	@npm ci --silent --no-audit --no-fund
	@touch $@

$(VENV)/.truth-ready: $(VENV)/.run-ready requirements-truth.lock
	@scripts/apt-packages.sh truth
	@echo "setting up the path tracer"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-truth.lock
	@touch $@

bench: setup ## speed against error, every stage and preset; ARGS="--quick --json FILE --plot FILE.png"
	$(BIN)/mr360 bench $(ARGS)

bench-light: setup ## the light stages against their references; MAPS=FOLDER measures its radiance maps too, CLIPS=FOLDER its clips
	$(BIN)/python -m server.bench.light $(if $(MAPS),--maps $(MAPS)) $(if $(CLIPS),--clips $(CLIPS)) $(ARGS)

bench-presets: setup ## error and time of both presets on each radiance map of MAPS=FOLDER
	$(BIN)/python -m server.bench.presets --maps $(MAPS) $(ARGS)

bench-gpu: setup ## stage times by GL timer queries, 2048x1024 to 7680x3840; ARGS="--require-gpu --json FILE"
	$(BIN)/python -m server.bench.gpu $(ARGS)

bench-service: setup ## the whole service beside a plain transcode, by size, objects, triangles, lamps and viewers; ARGS="--quick --json FILE"
	$(BIN)/python -m server.bench.service $(ARGS)

bench-viewers: setup ## what a further WebRTC viewer costs and what each one gets; ARGS="--counts 1,20 --json FILE"
	$(BIN)/python -m server.bench.viewers $(ARGS)

bench-latency: setup-test ## camera to screen in Chromium, by a time code in the picture; ARGS="--seconds 30 --json FILE"
	$(BIN)/python -m server.bench.latency $(ARGS)

bench-networks: setup-test ## Chromium behind loss, delay, an outage and a narrow link at full size; needs root
	BENCH_NETWORKS=full $(BIN)/python -m pytest -rA tests/e2e/test_bad_networks.py $(PYTEST_ARGS)

soak: setup ## memory of the service while its scene, methods and viewers change; ARGS="--minutes 10"
	$(BIN)/python -m server.bench.service_soak $(ARGS)

fuzz: setup-test ## broken models for ten minutes; ARGS="--seconds 60 --seed 1"
	$(BIN)/python -m tests.benchmarks.fuzz_models $(ARGS)

lock: setup-test ## resolve the dependencies of pyproject.toml anew
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --upgrade \
		pyproject.toml -o requirements.lock
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --upgrade --extra dev \
		-c requirements.lock pyproject.toml -o requirements-dev.lock
	$(BIN)/uv pip compile -q --universal --python-version 3.11 --no-emit-index-url --no-header --upgrade --extra truth \
		-c requirements.lock pyproject.toml -o requirements-truth.lock

clean: ## remove what setup made
	rm -rf $(VENV) node_modules build *.egg-info
