# What one does with this project. `make` alone lists the targets.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help setup system-libraries demo test interop learn notebooks wheel lint format parts docs bench clean

help:  ## this menu
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-18s %s\n", $$1, $$2}'

setup: $(VENV)/.installed  ## make .venv with the synthetless command in it

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[blender,preview,ray,cad,dev]'
	@touch $@

system-libraries:  ## install the shared libraries Blender needs (Debian and Ubuntu, as root)
	apt-get update -qq
	apt-get install -y --no-install-recommends libx11-6 libxrender1 libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libgl1 libegl1 libgomp1

demo: setup  ## a small dataset of the built-in parts, in out/demo
	$(BIN)/synthetless generate configs/demo.yaml --out out/demo

test: setup  ## every test, real renders included
	$(BIN)/pytest --numprocesses logical --dist loadfile --no-loadscope-reorder

interop: setup  ## the exports in trainers' own loaders: Hugging Face datasets, torch, torchvision, ultralytics (installs 1.5 GB)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[interop]'
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt --no-deps ultralytics ultralytics-thop polars polars-runtime-32  # its OpenCV would replace the headless one
	$(BIN)/pytest tests/exports tests/dataset/test_card.py

learn: setup  ## torch and what else the learning system needs, and its tests
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[learn]'
	$(BIN)/pytest tests/learning

notebooks: setup  ## run the notebooks of docs/ (installs Jupyter's kernel)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[notebooks]'
	$(BIN)/pytest tests/docs/test_notebooks.py

wheel: setup  ## the wheel alone, in fresh environments of every Python from 3.10 to 3.13 that is here
	.ci/wheel $(BIN)/python

lint: setup  ## ruff and mypy --strict
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup  ## let ruff rewrite what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

parts: setup  ## model the built-in parts again (assets/parts)
	$(BIN)/python -m synthetless.assets.parts.build

docs: setup  ## write docs/recipe.md and docs/learning_settings.md from the settings' schemas
	$(BIN)/python -c "from synthetless.config import recipe_page; print(recipe_page(), end='')" > docs/recipe.md
	$(BIN)/python -c "from synthetless.learning.settings import training_page; print(training_page(), end='')" > docs/learning_settings.md

bench: setup  ## measure (see benchmarks/)
	@set -e; for script in benchmarks/[a-z]*.py; do echo "== $$script"; $(BIN)/python -m benchmarks.$$(basename $$script .py); done

clean:  ## remove generated datasets and caches
	rm -rf out .pytest_cache .mypy_cache .ruff_cache .hypothesis
