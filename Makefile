# `make install` creates the virtual environment .venv from pinned versions, and every target below uses it.
# It is installed once: the stamp is renewed only when a pinned version changes.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
MAKEFLAGS += --no-builtin-rules

# Where this is set, each command compiles the package anew, and each process of the tests all tests.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip install --disable-pip-version-check --progress-bar off --constraint constraints.txt
DEMO := outputs/demo
DEMO_RUN := $(DEMO)/run/cone-and-cylinder/sl-neus/demo
DEMO_TRAINED = $(DEMO_RUN)/nerfstudio_models/step-000000999.ckpt
IMAGES := outputs/demo-images
# DEMO_TRAINED: the last checkpoint of a complete training.

# Takes the first of these that runs, has a supported version and can create virtual environments.
# `make install PYTHON=/path/to/python3.12` selects another.
PYTHONS := python3.11 python3.12 python3.10 python3 python
SUITABLE := import ensurepip, sys, venv; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))

.PHONY: help install demo demo-images test test-slow bench lint format docs clean

help:
	@echo "make install   create .venv with pinned dependencies and this package"
	@echo "make demo      synthesise, train, export and evaluate a scan: outputs/demo/report.html (minutes);"
	@echo "                 if it was interrupted, it goes on where it was"
	@echo "make demo-images   the same from images alone, by sl-scan (minutes)"
	@echo "make test      run the tests that every change needs (minutes)"
	@echo "make test-slow run the others: trainings, whole commands, sweeps over many cases"
	@echo "make bench     run the benchmarks that take minutes; results in benchmarks/results/"
	@echo "make lint      check with ruff and pyright"
	@echo "make format    format the code and sort the imports with ruff"
	@echo "make docs      build the documentation as a site and check its links: build/site/index.html"
	@echo "make clean     remove .venv, the output of the demos and caches; keeps your own outputs"

install: $(STAMP)

$(BIN)/python:
	@python="$(PYTHON)"; \
	for candidate in $(PYTHONS); do \
	  if [ -z "$$python" ] && "$$candidate" -c '$(SUITABLE)' >/dev/null 2>&1; then python="$$candidate"; fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "error: no suitable Python found (tried: $(PYTHONS))." >&2; \
	  echo "       Needed: Python 3.10, 3.11 or 3.12 with its venv and ensurepip modules, for example" >&2; \
	  echo "       'apt-get install python3.11 python3.11-venv' on Debian 12; or choose one: make install PYTHON=/path/to/python3" >&2; \
	  exit 1; \
	fi; \
	echo "creating $(VENV) with $$python ($$("$$python" --version))"; \
	"$$python" -m venv --clear $(VENV)

$(STAMP): $(BIN)/python pyproject.toml constraints.txt
	@# Everything comes as wheels except pyliblzfse (viser needs it for iPhone recordings, unused here); without a C compiler it is left out.
	@if $(PIP) --quiet pyliblzfse >/dev/null 2>&1; then \
	  $(PIP) --editable '.[dev]'; \
	else \
	  echo "no C compiler: installing the pinned list without pyliblzfse"; \
	  grep -v '^pyliblzfse==' constraints.txt >$(VENV)/wheels.txt; \
	  $(PIP) --no-deps --requirement $(VENV)/wheels.txt; \
	  $(PIP) --no-deps --editable .; \
	fi
	@$(BIN)/python -c 'import cv2, open3d, torch, torchvision' || { \
	  echo "error: the packages are installed, but some of them cannot be loaded (see above)." >&2; \
	  echo "       If a shared library is missing (libGL.so.1, libgomp.so.1): 'apt-get install libgl1 libgomp1'." >&2; \
	  exit 1; \
	}
	@echo "compiling, by a small scan (once; minutes)"
	@folder="$$(mktemp -d)"; export SL_CACHE="$$folder/cache"; \
	{ $(BIN)/sl-synth --output "$$folder/captures" --images-only --frames 5 --resolution 300 && \
	  $(BIN)/sl-scan "$$folder/captures/images" --pattern "$$folder/captures/pattern.json" \
	    --intrinsics "$$folder/captures/intrinsics.json" --output "$$folder/result" --quality draft; \
	} >$(VENV)/small-scan.log 2>&1 </dev/null || \
	  echo "not everything is compiled (why: $(VENV)/small-scan.log): the first commands take a minute longer"; \
	rm -rf "$$folder"
	@touch $@

# Every step of the demos is a target: `make demo` goes on after what is complete. Each command writes its file that is
# the target last, and removes by itself what an interrupted one left. `make clean` starts anew.
demo: $(DEMO)/report.html
	@echo
	@echo "surface  $(DEMO)/mesh.ply"
	@echo "poses    $(DEMO)/refined/transforms.json"
	@echo "figures  $(DEMO)/evaluation.json"
	@echo "report   $(abspath $(DEMO)/report.html) (open it in a browser)"

$(DEMO)/scan/transforms.json: | install
	$(BIN)/sl-synth --output $(DEMO)/scan

$(DEMO_TRAINED): $(DEMO)/scan/transforms.json
	if [ -e $(DEMO_RUN)/config.yml ]; then $(BIN)/ns-train sl-neus --load-config $(DEMO_RUN)/config.yml; \
	else $(BIN)/ns-train sl-neus --data $(DEMO)/scan --output-dir $(DEMO)/run \
	  --experiment-name cone-and-cylinder --timestamp demo; fi

$(DEMO)/refined/training.json: $(DEMO_TRAINED)
	$(BIN)/sl-export --load-config $(DEMO_RUN)/config.yml --output $(DEMO)/mesh.ply --poses $(DEMO)/refined --overwrite

$(DEMO)/report.html: $(DEMO)/refined/training.json
	$(BIN)/sl-eval --mesh $(DEMO)/mesh.ply --data $(DEMO)/scan --poses $(DEMO)/refined/transforms.json \
	  --json $(DEMO)/evaluation.json --report $@

demo-images: $(IMAGES)/truth.html
	@echo "report   $(abspath $(IMAGES)/result/report.html) (open it in a browser)"
	@echo "compared with the true surface: $(abspath $(IMAGES)/truth.html)"

$(IMAGES)/captures/intrinsics.json: | install
	$(BIN)/sl-synth --output $(IMAGES)/captures --scene head --frames 22 --images-only \
	  --appearance realistic --background table

$(IMAGES)/result/report.html: $(IMAGES)/captures/intrinsics.json
	$(BIN)/sl-scan $(IMAGES)/captures/images --pattern $(IMAGES)/captures/pattern.json \
	  --intrinsics $(IMAGES)/captures/intrinsics.json --output $(IMAGES)/result --object-only

# No earlier step sees the truth. No length is known, so the scale is free.
$(IMAGES)/truth.html: $(IMAGES)/result/report.html
	$(BIN)/sl-eval --mesh $(IMAGES)/result/mesh.ply --data $(IMAGES)/result/scan \
	  --poses $(IMAGES)/result/poses/transforms.json --reference $(IMAGES)/captures/ground_truth/mesh.ply \
	  --json $(IMAGES)/truth.json --report $@

# On up to four cores. The tests of one file run together, because they share what was trained for them.
PYTEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

test: install
	$(PYTEST) -m "not slow"

test-slow: install
	$(PYTEST) -m slow

bench: install
	$(BIN)/python -m benchmarks

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: install
	$(BIN)/ruff check --fix --select I .
	$(BIN)/ruff format .

# Strict: a link or an anchor that leads nowhere ends the build.
docs: install
	$(PIP) --quiet --editable '.[docs]'
	$(BIN)/python docs/make_site.py

clean:
	rm -rf $(VENV) $(DEMO) $(IMAGES) build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
