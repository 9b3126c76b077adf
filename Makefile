# Everything runs in .venv, from the pinned and hashed versions in the lock files.

HOST ?= 127.0.0.1
PORT ?= 8000

# The first interpreter on the path that is new enough.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python3.14 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)

bin := .venv/bin
artifact := artifacts/turbinate.h5

pip := $(bin)/pip --disable-pip-version-check --quiet

.DELETE_ON_ERROR:
.PHONY: help serve test lint format bench lock clean

help:
	@echo "make serve   serve a pad, train the turbinate beside it; open http://$(HOST):$(PORT)"
	@echo "make test    style, types, import rules and every test"
	@echo "make lint    the same without the tests"
	@echo "make format  put the code in the project's style"
	@echo "make bench   time the artifact's queries and the timed tests"
	@echo "make lock    resolve the dependencies anew"
	@echo "make clean   remove .venv and the caches; artifacts stay"

serve: .venv/run
	$(bin)/palpate demo --beside turbinate --no-browser --host $(HOST) --port $(PORT)

# A file of tests stays in one process, which has its set-ups.
test: lint
	$(bin)/pytest -q -n auto --maxprocesses 4 --dist loadfile

lint: .venv/dev
	$(bin)/ruff check
	$(bin)/ruff format --check
	@# The links in .package must lead mypy to every file.
	$(bin)/mypy | tee .mypy_said
	@checked=$$(sed -n 's/.* in \([0-9]*\) source files/\1/p' .mypy_said); \
	test $${checked:-0} -ge $$(find offline online shared -name '*.py' | wc -l)
	@rm .mypy_said
	$(bin)/lint-imports

format: .venv/dev
	$(bin)/ruff check --fix
	$(bin)/ruff format

bench: .venv/dev | $(artifact)
	$(bin)/palpate bench $(artifact)
	$(bin)/pytest -q -rN --benchmark-enable --benchmark-only --benchmark-columns=median,iqr,rounds

# Trained once, and anew where another release wrote it; delete the file to train anew.
$(artifact): | .venv/run
	$(bin)/palpate train turbinate --out $@

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed; set PYTHON=/path/to/it" >&2; exit 1; }
	$(PYTHON) -m venv .venv

.venv/run: requirements.lock pyproject.toml | .venv/bin/python
	$(pip) install --require-hashes -r requirements.lock
	$(pip) install --no-deps --no-build-isolation --editable .
	@touch $@

.venv/dev: requirements-dev.lock .venv/run
	$(pip) install --require-hashes -r requirements-dev.lock
	@touch $@

resolve := $(bin)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-header --no-annotate --group build pyproject.toml

all := --extra train --extra loadtest

lock: | .venv/bin/python
	$(pip) install uv
	$(resolve) $(all) --extra anatomy --extra test --extra dev --output-file requirements-dev.lock
	$(resolve) $(all) --constraint requirements-dev.lock --output-file requirements.lock

clean:
	rm -rf .venv .benchmarks .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find offline online shared tests -name __pycache__ -prune -exec rm -rf {} +
