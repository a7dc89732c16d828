# Everything runs in .venv, made from requirements.lock; only python3 with venv, make and a compiler
# need to be there.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.ready
BENCH_STAMP := .venv/.ready-to-bench
FUZZ_STAMP := .venv/.ready-to-fuzz
COMPILE := $(BIN)/pip-compile --quiet --strip-extras --generate-hashes --allow-unsafe --no-header \
	--no-emit-index-url --no-emit-trusted-host --no-emit-find-links

.PHONY: setup demo reproduce test long-test check format lock docker-test page-test bench fuzz clean

setup: $(STAMP)  ## the environment alone

$(STAMP): requirements.lock requirements-dev.lock pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes \
		-r requirements.lock -r requirements-dev.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $@

demo: setup  ## fly the demonstration for three minutes, with a page to play with
	$(BIN)/skytether fly demo --duration 180 --beside demo-no-compensation --figure demo.png
	@echo "The flight is drawn in demo.png."

reproduce: setup  ## the paper's table and figures, and more, in results/report.html (15 minutes)
	$(BIN)/skytether reproduce --out results

test: setup  ## everything but Docker and what takes long, in five minutes on two cores
	@$(BIN)/python -c "import server.__main__"  # kernels are compiled once, not by each worker
	$(BIN)/pytest -q -m "not docker and not long and not browser" -n 3 --dist loadfile

long-test: setup  ## the commands of the documents, benchmarks, and flights of many processes
	@$(BIN)/python -c "import server.__main__"
	$(BIN)/pytest -q -m "long and not docker and not browser" -n 3 --dist loadfile

check: setup  ## style, types, and who imports whom
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup  ## as `check` wants it
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docker-test: setup  ## the three containers, and what they survive; needs a Docker engine
	$(BIN)/pytest -q -rs -m docker

page-test: setup  ## the page in a real browser; needs Chromium, says so where there is none
	@$(BIN)/python -c "import server.__main__"
	$(BIN)/pytest -q -rs -m browser

bench: $(BENCH_STAMP)  ## every benchmark; the tables of docs/performance.md anew
	$(BIN)/python -m benchmarks

$(BENCH_STAMP): $(STAMP) requirements-bench.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-bench.lock
	touch $@

SECONDS ?= 30
fuzz: $(FUZZ_STAMP)  ## hostile datagrams, guided by what they reach, for SECONDS=30
	$(BIN)/python -m fuzz --seconds $(SECONDS)

$(FUZZ_STAMP): $(STAMP) requirements-fuzz.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements-fuzz.lock || \
		echo "atheris cannot be installed here: datagrams are random, and not guided"
	touch $@

lock:  ## pin what pyproject.toml asks for
	$(BIN)/pip install --quiet pip-tools
	$(COMPILE) --upgrade --output-file requirements.lock pyproject.toml
	$(COMPILE) --upgrade --extra dev --constraint requirements.lock \
		--output-file requirements-dev.lock pyproject.toml
	$(COMPILE) --upgrade --extra bench --constraint requirements.lock \
		--output-file requirements-bench.lock pyproject.toml
	$(COMPILE) --upgrade --extra fuzz --constraint requirements.lock \
		--output-file requirements-fuzz.lock pyproject.toml

clean:
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
