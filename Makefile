# Everything runs in .venv, made from lock files by uv, which pip brings; only python3 with venv and
# make need to be there.
PYTHON ?= python3
BIN := .venv/bin
UV := .venv/.uv
FLY := .venv/.ready-to-fly
STAMP := .venv/.ready
BENCH_STAMP := .venv/.ready-to-bench
FUZZ_STAMP := .venv/.ready-to-fuzz
DOCS_STAMP := .venv/.ready-to-document
COMPILE := $(BIN)/uv pip compile --quiet --upgrade --universal --fork-strategy fewest \
	--python-version 3.11 --generate-hashes --no-header --no-annotate --no-emit-index-url
# From pip's index, where pip is told of another one. Where uv can reach none, pip may know more.
INDEX = $${PIP_INDEX_URL:-$$($(BIN)/pip config get global.index-url 2>/dev/null)}
INSTALL = install() { \
	index="$(INDEX)"; \
	$(BIN)/uv pip install --quiet --python .venv $${index:+--default-index "$$index"} "$$@" || \
	$(BIN)/pip install --quiet --disable-pip-version-check "$$@"; \
	}; install

# Tests start hundreds of processes; none shall compile anew what another has.
unexport PYTHONDONTWRITEBYTECODE

# Kernels are compiled and the tests' asserts rewritten once, side by side, before workers need both.
READY = $(BIN)/pytest --collect-only -qq >/dev/null & $(BIN)/python -P tests/warm_kernels.py; wait
PYTEST = $(BIN)/pytest -q -p no:rerunfailures --durations=20
TWO = -n 2 --dist loadfile --no-loadscope-reorder
# One test at a time, nothing beside it; only in real time a test may try again, and says why.
ALONE = $(BIN)/pytest -q -rsR --reruns 1 --rerun-show-tracebacks --durations=20
VIRTUAL = not realtime and not docker and not browser and not autopilot

.PHONY: help setup demo reproduce test realtime-test long-test nightly check format lock dist keys docs docker-test page-test tour-pictures autopilot-test bench figures fuzz clean

help:  ## what can be made
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/\1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

setup: $(STAMP)  ## make the environment alone

$(UV): locks/setup.lock
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r $<
	touch $@

$(FLY): $(UV) locks/fly.lock pyproject.toml
	$(INSTALL) --require-hashes -r locks/fly.lock
	$(INSTALL) --no-deps --no-build-isolation --editable .
	touch $@

$(STAMP): $(FLY) locks/dev.lock locks/openpi.lock
	$(INSTALL) --require-hashes -r locks/dev.lock
	$(INSTALL) --require-hashes --no-deps -r locks/openpi.lock  # its own client, for tests: it asks for numpy below 2
	touch $@

demo: $(FLY)  ## fly the demonstration for three minutes, with a page to play with
	$(BIN)/skytether fly demo --duration 180 --figure demo.png \
		--beside demo-paper --beside demo-no-compensation
	@echo "The flight is drawn in demo.png."

reproduce: setup  ## the paper's table and figures, and more, in results/report.html (15 minutes)
	$(BIN)/skytether reproduce --out results

test: setup  ## behaviour, values and safeguards in virtual time, in four minutes on two cores
	@$(READY)
	$(PYTEST) -m "not long and $(VIRTUAL)" $(TWO)

realtime-test: setup  ## what needs a real clock or several processes
	@$(READY)
	$(ALONE) -m "realtime and not long and not docker and not browser and not autopilot"

long-test: setup  ## the commands of the documents, benchmarks and studies, in virtual time
	@$(READY)
	$(PYTEST) -m "long and $(VIRTUAL)" $(TWO)

nightly: $(BENCH_STAMP) $(FUZZ_STAMP) $(DOCS_STAMP)  ## all that make test leaves out, and inputs nobody has tried; a table in nightly/
	bash -c '. .ci/tools; exec $(BIN)/python .ci/nightly.py'

check: setup  ## style, types, who imports whom, and the forge's files
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/zizmor --offline --quiet .github
	$(BIN)/check-jsonschema --quiet --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --quiet --builtin-schema vendor.citation-file-format CITATION.cff

format: setup  ## format the code as `check` wants it
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

dist: $(UV)  ## the wheel and the source distribution, in dist/
	$(BIN)/python -m hatchling build

keys: setup  ## docs/keys.md, from the sections of a scenario
	$(BIN)/python -m skytether.lab.pages.keys_document > docs/keys.md

# Open site/index.html; its search works only through a server, as of `python -m http.server -d site`.
docs: $(DOCS_STAMP)  ## a site of docs/ in site/, offline; a link that leads nowhere fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --clean

$(DOCS_STAMP): $(STAMP) locks/docs.lock
	$(INSTALL) --require-hashes -r locks/docs.lock
	touch $@

docker-test: setup  ## the three containers, and what they survive; needs a Docker engine
	$(ALONE) -m docker

page-test: setup  ## the page in a real browser; needs Chromium, says so where there is none
	$(ALONE) -m browser

TOUR = flight-dark-wide network-light-wide cut-dark-wide duel-dark-wide policy-dark-wide
tour-pictures: setup  ## pictures of README, the tour and docs/policy.md anew, from the page in a real browser
	$(ALONE) -m browser -k light_and_dark
	$(ALONE) -m browser -k "cutting_the_link or a_duel or a_hold"
	cp $(TOUR:%=page-test/%.png) docs/tour/

autopilot-test: setup  ## actual autopilots in simulation: ARDUCOPTER=, PX4= name their programs
	$(BIN)/pytest -q -rs -m autopilot

bench: $(BENCH_STAMP)  ## every benchmark; the tables of docs/performance.md anew
	$(BIN)/python -m bench

figures: $(BENCH_STAMP)  ## the measured numbers of README and docs/, beside those made anew; goes on after Ctrl-C (75 minutes)
	$(BIN)/python -m bench.figures

$(BENCH_STAMP): $(STAMP) locks/bench.lock
	$(INSTALL) --require-hashes -r locks/bench.lock
	touch $@

SECONDS ?= 60
fuzz: $(FUZZ_STAMP)  ## hostile inputs of every kind, guided by what they reach, for SECONDS=60
	$(BIN)/python -m fuzz --seconds $(SECONDS)

$(FUZZ_STAMP): $(STAMP) locks/fuzz.lock
	$(INSTALL) --require-hashes -r locks/fuzz.lock || \
		echo "atheris cannot be installed here: inputs are random, and not guided"
	touch $@

lock: $(UV)  ## pin what pyproject.toml asks for: one version of each package, whoever needs it
	$(COMPILE) --extra dev pyproject.toml -o locks/dev.lock
	$(COMPILE) --group setup -o locks/setup.lock
	for need in fly client mavlink ros2 page server bench fuzz docs; do \
		case "$$need" in \
			fly) extras="--extra server --extra page --extra plot --extra record";; \
			client) extras="";; \
			*) extras="--extra $$need";; \
		esac; \
		$(COMPILE) $$extras --constraint locks/dev.lock pyproject.toml \
			-o locks/$$need.lock || exit; \
	done

clean:  ## remove the environment and what was built
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
