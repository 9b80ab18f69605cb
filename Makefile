# stavpr_ros without a ROS installation: every target does the set-up that it needs (see tools/bootstrap.py).
# With /opt/ros/jazzy, colcon builds this package like any other, and none of this is needed.

SHELL := bash
.DEFAULT_GOAL := help
.NOTPARALLEL:

PYTHON ?= python3
TORCH_INDEX ?=
EXTRAS ?=
MAP ?=
QUERY ?=
LOOP ?=
ARGS ?=
export MAP QUERY LOOP

NO_PYTHON = `$(PYTHON)` is not on the PATH: install Python 3.11, 3.12 or 3.13, or name it with PYTHON=PROGRAM
# -E: a sourced ROS puts its own packages on PYTHONPATH
BOOTSTRAP = $(if $(shell command -v '$(PYTHON)'),,$(error $(NO_PYTHON)))$(PYTHON) -E tools/bootstrap.py
READY = --torch-index '$(TORCH_INDEX)'
RUN = $(BOOTSTRAP) run
BUILT := build install log
EXECUTABLES := install/stavpr_ros/lib/stavpr_ros

.PHONY: help setup build demo evaluate test lint bench bench-quick shell clean distclean ready-for-test

help: ## list the targets (this is the default)
	@echo 'make TARGET [NAME=VALUE ...]'
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/  \1\t\2/p' $(firstword $(MAKEFILE_LIST)) | expand -t 14
	@echo 'Names and values:'
	@echo '  PYTHON=python3.12          the Python to use, 3.11 to 3.13 (python3)'
	@echo '  TORCH_INDEX=URL            take torch from this package index, for example one of CPU wheels'
	@echo '  EXTRAS="onnx cuda dev"     setup, build, demo, evaluate, shell: install these as well'
	@echo '  MAP=PATH QUERY=PATH        demo, evaluate: your own folders of images, or bags (or saved maps)'
	@echo '  LOOP=PATH                  demo: your own traverse that closes loops (LOOP=synthetic: a synthetic one)'
	@echo '  ARGS="..."                 demo, evaluate, test, bench, bench-quick: options for the command, for pytest'

setup: ## make .venv with the pinned Python packages and the ROS 2 Jazzy wheels
	@$(BOOTSTRAP) setup $(READY) --with $(EXTRAS)

build: ## setup, and build stavpr_msgs and stavpr_ros with colcon
	@$(BOOTSTRAP) build $(READY) --with $(EXTRAS)

demo: build ## build, and show the node recognizing places over ROS (MAP=, QUERY=, LOOP=, ARGS=)
	@$(RUN) $(EXECUTABLES)/demo $(if $(MAP),--map "$$MAP") $(if $(QUERY),--query "$$QUERY") \
		$(if $(LOOP),--loop "$$LOOP") $(ARGS)

evaluate: override EXTRAS += evaluation
evaluate: build ## build, and judge the recognition of QUERY= on MAP=: numbers, pictures, a page (ARGS=)
	@$(RUN) $(EXECUTABLES)/evaluate $(if $(MAP),--map "$$MAP") $(if $(QUERY),--query "$$QUERY") $(ARGS)

test: lint ## build, lint, and run the tests against the built package (ARGS=)
	@ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(RUN) pytest test/ $(ARGS)

lint: ready-for-test ## check style and types: ruff, mypy
	@$(RUN) ruff check $(addprefix --extend-exclude ,$(BUILT)) .
	@$(RUN) mypy

bench: build ## build, and measure the matching beside its floors and others (ARGS=; see benchmarks/README.md)
	@$(RUN) python benchmarks/matching.py $(ARGS)

bench-quick: build ## the same, sizes up to 20,000 places, in under two minutes (ARGS=)
	@$(RUN) python benchmarks/matching.py --quick $(ARGS)

shell: build ## build, and open a bash in which the built packages are found
	@echo 'The executables are in $(EXECUTABLES)/; leave with exit.'
	@$(RUN) env PS1='(stavpr_ros) \w\$$ ' bash --norc -i || true

clean: ## remove what is built: build/ install/ log/
	@rm -rf $(BUILT)

distclean: clean ## remove .venv, .venv-peers and the tools' caches as well
	@rm -rf .venv .venv-peers .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

ready-for-test:
	@$(BOOTSTRAP) build $(READY) --with onnx evaluation dev
