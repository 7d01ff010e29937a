# `make` needs git, make and Python 3.10 or newer; everything else it brings into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: search test check lint types format bench clean

search: $(INSTALLED)  ## the most accurate RTS2Net that holds 10 frames a second on a Jetson TX2
	$(BIN)/rts2-search --device tx2 --target-fps 10

test: $(INSTALLED)  ## every test
	$(BIN)/python -m pytest

check: lint types test  ## the one gate, for people and for CI

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)
	@mkdir -p $(VENV)/types/rts2
	@for room in model profiles quant search; do ln -sfn ../../../$$room $(VENV)/types/rts2/$$room; done
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(INSTALLED)  ## every speed table
	@for table in benchmarks/*.py; do $(BIN)/python $$table || exit 1; done

clean:
	rm -rf $(VENV) build dist *.egg-info rts2-out

# matplotlib lists the fonts of a machine once; done here, no command waits for it.
$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	$(BIN)/python -c 'import matplotlib.font_manager'
	@touch $@
