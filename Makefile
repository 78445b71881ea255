# `make demo` and `make test` do all their set-up; `make help` lists the rest.
PYTHON ?= python3
PARALLEL ?= -n 2 --dist loadfile --no-loadscope-reorder
VENV ?= .venv
DEMO ?= problems/two_segment_stiff_x.yaml

BIN := $(VENV)/bin
BENCH := $(VENV)/bench
PEERS := scipy pin-pink soromox
PIP := $(BIN)/python -m pip --quiet --quiet --disable-pip-version-check
PICTURE := docs/images/two_segment_stiff_x.png

# Tests start many processes, and each imports what the others have compiled.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo docs test schemas mutate lint types format picture bench clean

help:  ## say what can be made
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/.installed-plot  ## solve a task and plot the arm
	@mkdir -p out
	$(BIN)/solve-pressure $(DEMO) --plot out/demo.png
	@echo "The plot is in out/demo.png."

test: $(VENV)/.installed-dev  ## run the tests (make test ARGS=--long for the long ones too)
	@# devices and processes answer in time only on a machine that has nothing else to do
	@worst=0; for part in 'not real_time' real_time; do \
	  $(BIN)/python -m pytest $(PARALLEL) $(ARGS) -m "$$part"; code=$$?; \
	  [ $$code -ne 2 ] || exit 2; \
	  [ $$code -eq 0 ] || [ $$code -eq 5 ] || worst=$$code; \
	done; exit $$worst

schemas: $(VENV)/.installed-dev  ## make the JSON Schemas anew from the models
	$(BIN)/python -c "from stiffopt.json_schemas import write_schema_files as w; w()"

docs: $(VENV)/.installed-docs  ## build the documentation into build/docs/html
	@rm -rf docs/auto_gallery build/docs/html
	$(BIN)/python -m sphinx -b html -W --keep-going -q -d build/docs/doctrees docs build/docs/html
	@echo "The documentation is in build/docs/html/index.html."

mutate: $(VENV)/.installed-dev  ## try mutants of the safety package (make mutate ARGS=--short: some)
	$(BIN)/python tests/mutation.py $(ARGS)

lint: $(VENV)/.installed-dev  ## check style, formatting and import layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/lint-imports --no-logo

types: $(VENV)/.installed-dev  ## check the types
	$(BIN)/mypy

format: $(VENV)/.installed-dev  ## format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

picture: $(VENV)/.installed-plot  ## draw the picture of the README again
	@mkdir -p $(dir $(PICTURE))
	$(BIN)/solve-pressure $(DEMO) --plot $(PICTURE)

bench: $(BENCH)/.installed  ## measure speed beside other packages (make bench ARGS=--quick)
	$(BENCH)/bin/python benchmarks/run.py $(ARGS)

clean:  ## remove everything that was made, the virtual environment too
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis \
	  .import_linter_cache
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

# Stamps: each set-up step runs once, and again when what it depends on has changed.

$(VENV)/.created:
	@command -v $(PYTHON) >/dev/null || \
	  { echo "There is no '$(PYTHON)'. Install Python 3.11 or later (Debian: apt install python3 python3-venv)" \
	    "or name one: make PYTHON=python3.12 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "'$(PYTHON)' is older than Python 3.11; name a later one: make PYTHON=python3.12 ..." >&2; exit 1; }
	@if ! $(PIP) --version >/dev/null 2>&1; then \
	  echo "Creating $(VENV) ..."; \
	  $(PYTHON) -m venv --clear $(VENV) || \
	  { echo "$(PYTHON) could not create $(VENV). On Debian and Ubuntu its module comes with:" \
	    "apt install python3-venv" >&2; exit 1; }; \
	fi
	@touch $@

$(VENV)/.installed-plot: $(VENV)/.created pyproject.toml
	@echo "Installing stiffopt and what it needs into $(VENV): pip may take some minutes ..."
	@$(PIP) install --editable '.[plot]'
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.created pyproject.toml
	@echo "Installing stiffopt and its development tools into $(VENV) ..."
	@$(PIP) install --editable '.[dev,plot]'
	@touch $@ $(VENV)/.installed-plot

$(VENV)/.installed-docs: $(VENV)/.created pyproject.toml
	@echo "Installing what builds the documentation into $(VENV) ..."
	@$(PIP) install --editable '.[docs]'
	@touch $@

# The peers of the benchmarks are heavy and have an environment of their own.
$(BENCH)/.installed: $(VENV)/.created pyproject.toml
	@echo "Installing what the benchmarks compare with into $(BENCH) ..."
	@[ -x $(BENCH)/bin/python ] || $(BIN)/python -m venv $(BENCH)
	@pip="$(BENCH)/bin/python -m pip --quiet --quiet --disable-pip-version-check"; \
	$$pip install --editable '.[plan,plot,bench]' || \
	  { $$pip install --editable '.[plan,plot]' && for peer in $(PEERS); do \
	    $$pip install $$peer || echo "$$peer cannot be installed and is left out."; done; }
	@touch $@
