# Everything sets itself up in .venv from requirements.lock (hashes pinned); only Python 3.11+ and make are needed.
# PYTHON picks the interpreter that makes the environment: make setup PYTHON=python3.12
PYTHON ?= python3
BIN := .venv/bin
ACCEPTANCE ?=

.PHONY: help setup demo test slow check docs console acceptance lock wheels schema clean

help: ## what there is
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/\t/'

setup: .venv/.done ## a virtual environment in .venv with the mrasfm command

.venv/.done: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else 0'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/python -m compileall -q mrasfm_engine schemas service worker  # else every start does, if PYTHONDONTWRITEBYTECODE is set
	@touch $@

demo: setup ## render two drives of a street, get their scenes and the map of both through the service, compare with the truth
	rm -rf demo
	$(BIN)/mrasfm demo --out demo

test: setup ## the fast suite and one real drive
	$(BIN)/python -m pytest -m "not slow" -n 3 --dist loadfile --no-loadscope-reorder

slow: setup ## the tests that make test leaves out for their time: an hour or two
	$(BIN)/python -m pytest -m slow -n 2 --dist loadfile --no-loadscope-reorder

check: setup ## lint, types, import contracts, links and generated pages of the documentation
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.documentation --check

docs: setup ## rewrite the generated pages of docs/
	$(BIN)/python -m tests.documentation

console: setup ## build the web console and the report's script from service/console/src (needs node 20 or newer and npm)
	mkdir -p service/console/build
	$(BIN)/python -m service.api.openapi_export service/console/build/openapi.json
	cd service/console && npm ci --ignore-scripts && npm run build

acceptance: setup ## the headline figures of README.md as a table (real drives needed; ACCEPTANCE="--only 5,7", ACCEPTANCE=--thorough)
	$(BIN)/python -m tests.benchmarks.acceptance $(ACCEPTANCE)

lock: ## renew the locks: of pyproject.toml all, and what the container image needs; readers of others (needs uv)
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" --quiet -o requirements.lock
	uv pip compile pyproject.toml --extra build --constraints requirements.lock --universal --python-version 3.11 \
	  --generate-hashes --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" --quiet \
	  -o requirements-runtime.lock
	for readers in requirements datasets; do uv pip compile tests/foreign_readers/$$readers.in --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" --quiet \
	  -o tests/foreign_readers/$$readers.lock || exit 1; done

wheels: setup ## the wheels of mrasfm and of mrasfm-client, in dist/
	rm -rf build/lib build/bdist.*
	$(BIN)/python .ci/build_client.py build/client
	$(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist . ./build/client

schema: setup ## export the JSON Schema of the drive manifest
	$(BIN)/python -m schemas.export

clean: ## remove what make made
	rm -rf .venv demo build dist *.egg-info
