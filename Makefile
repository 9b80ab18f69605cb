# stavpr_ros without a ROS installation: every target does the set-up that it needs, by
# tools/setup_venv.py. With /opt/ros/jazzy, colcon builds this package and none of this is needed.

SHELL := bash
.DEFAULT_GOAL := help
.NOTPARALLEL:

PYTHON ?= python3
TORCH_INDEX ?=
EXTRAS ?=
FEATURES ?=
MAP ?=
QUERY ?=
LOOP ?=
TRUTH ?=
HOURS ?= 1
ARM_ROOT ?= build/arm/root
ARM_SITE ?= build/arm/site
QEMU ?= qemu-aarch64-static
ARGS ?=
export MAP QUERY LOOP SLAM TRUTH

# -E: a sourced ROS adds its own packages to PYTHONPATH
SETUP = $(PYTHON) -E tools/setup_venv.py
RUN = $(SETUP) run
OPTIONS = --torch-index '$(TORCH_INDEX)' --with
LEARNED = $(filter learned hybrid efficientnet_lite1,$(FEATURES))
TESTS := test stavpr_fleet/test stavpr_slam/test stavpr_nav/test stavpr_lab/test
PYTEST = pytest -n 2 --dist loadfile --durations=10 $(TESTS)
SOURCES := $(subst $() $(),:,$(CURDIR) $(addprefix $(CURDIR)/stavpr_,fleet slam nav lab))
TEST = ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST $(RUN)
# Package and least percentage of its lines and branches that the tests reach.
COVERAGE := stavpr_ros:95 stavpr_fleet:93 stavpr_slam:88 stavpr_nav:88 stavpr_lab:91
EXECUTABLES := install/stavpr_ros/lib/stavpr_ros
LAB := install/stavpr_lab/lib/stavpr_lab

.PHONY: help setup build demo animation days repeat evaluate test test-long test-arm coverage crash-test check lint ceilings docs bench bench-quick \
	accuracy fit protocol off-map pose-graphs shell clean distclean development

help: ## list the targets (the default)
	@echo 'make TARGET [NAME=VALUE ...]'
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/  \1\t\2/p' $(firstword $(MAKEFILE_LIST)) | expand -t 14
	@echo 'Names and values:'
	@echo '  PYTHON=python3.12          the Python to use, 3.11 to 3.13 (default: python3)'
	@echo '  TORCH_INDEX=URL            package index for torch, for example one of CPU wheels; none: without'
	@echo '  EXTRAS="onnx slam"         optional packages: onnx, hdf5, heif, faiss, fleet, ray, slam, evaluation, bench, dev, docs'
	@echo '  MAP=PATH QUERY=PATH        demo, evaluate: your images, videos, bags or saved maps'
	@echo '  TRUTH=identity, TRUTH=FILE demo, evaluate: ground truth, for metrics (default: none)'
	@echo '  FEATURES=hybrid            demo: features of its maps (default: gradient)'
	@echo '  LOOP=PATH                  demo: your sequence with loops, or synthetic for the street'
	@echo '  REPEAT=street              demo: a robot repeats a taught route in a simulator'
	@echo '  SLAM=world                 demo: three laps, odometry corrected by a pose graph'
	@echo '  ARGS="..."                 options for the program of the target (test: pytest)'

setup: ## create .venv with the pinned Python packages and the ROS 2 Jazzy wheels
	@$(SETUP) setup $(OPTIONS) $(EXTRAS)

build: ## setup, then build the packages with colcon
	@$(SETUP) build $(OPTIONS) $(EXTRAS)

ifneq ($(SLAM)$(REPEAT),)
demo: override EXTRAS += slam
endif
ifneq ($(LEARNED),)
demo: override EXTRAS += learned
endif
demo: build ## run the node on the synthetic street, or on your images (MAP= QUERY= LOOP= ARGS=)
ifdef REPEAT
	@$(RUN) python -m stavpr_lab.demonstration.repeat demo_output/repeat --length 150 --laps 1
else
	@$(RUN) $(LAB)/demo $(if $(FEATURES),--features $(FEATURES:learned=hybrid)) $(if $(MAP),--map "$$MAP") $(if $(QUERY),--query "$$QUERY") \
		$(if $(LOOP),--loop "$$LOOP") $(if $(SLAM),--slam "$$SLAM") \
		$(if $(TRUTH),--truth "$$TRUTH") $(ARGS)
endif

animation: demo ## write the animation of the README, docs/demo.webp
	@$(RUN) python -m stavpr_lab.demonstration.animation demo_output docs/demo.webp

repeat: override EXTRAS += slam
repeat: build ## teach and repeat in a simulator, benchmarks/results/repeat_table.md
	@$(RUN) python -m stavpr_lab.demonstration.repeat benchmarks/results

days: build ## update a map by 30 synthetic days, and by real sessions, benchmarks/results/days.md
	@$(RUN) python -m stavpr_lab.demonstration.days 31 benchmarks/results/days
	@$(RUN) python benchmarks/sessions.py

evaluate: override EXTRAS += evaluation
evaluate: build ## report the matches of QUERY= on MAP=; metrics with TRUTH= (ARGS=)
	@$(RUN) $(LAB)/evaluate $(if $(MAP),--map "$$MAP") $(if $(QUERY),--query "$$QUERY") \
		$(if $(TRUTH),--truth "$$TRUTH") $(ARGS)

test: lint docs ## lint, build the documentation, and run the tests but the long ones (ARGS=)
	@$(TEST) $(PYTEST) -m 'not long' $(ARGS)

check: ceilings ## ruff, mypy, and the tests without ROS and processes, on the sources (ARGS=)
	@test -d .venv || $(MAKE) development
	@$(RUN) ruff check .
	@$(RUN) mypy
	@$(RUN) bash -c 'PYTHONPATH="$(SOURCES):$$PYTHONPATH" $(PYTEST) -m "quick and not slow and not long" $(ARGS)'

test-long: development ## run the tests that take minutes each (ARGS=)
	@$(TEST) $(PYTEST) -m long $(ARGS)

test-arm: build ## compare aarch64, emulated, with this processor (set up by CONTRIBUTING.md)
	@$(RUN) python tools/arm.py --root '$(ARM_ROOT)' --site '$(ARM_SITE)' --qemu '$(QEMU)'

coverage: development ## run the tests, and require the lines and branches that they reach (ARGS=)
	@rm -f .coverage .coverage.*
	@$(TEST) coverage run --data-file=$(CURDIR)/.coverage .venv/bin/$(PYTEST) -m 'not long' $(ARGS)
	@$(RUN) coverage combine --quiet
	@for row in $(COVERAGE); do \
		echo "$${row%:*}: at least $${row#*:} %"; \
		$(RUN) coverage report --skip-covered --fail-under="$${row#*:}" \
			--include="$${row%:*}/*" || exit 1; \
	done

crash-test: development ## kill, stop and disturb a recording node for HOURS=; nothing may be lost
	@$(RUN) bash -c 'PYTHONPATH="test/shared:$$PYTHONPATH" python test/crash_run.py $(HOURS)'

lint: development ceilings ## check style and types with ruff and mypy, sizes, and the language of docs
	@$(PYTHON) -E tools/language.py
	@$(RUN) ruff check .
	@$(RUN) mypy

ceilings:
	@$(PYTHON) -E tools/ceilings.py

docs: development ## build the documentation into docs/_build; warnings are errors
	@$(RUN) sphinx-build -E -W --keep-going -q -b html docs docs/_build

bench bench-quick: override EXTRAS += bench
bench: override EXTRAS += faiss evaluation
bench: build ## measure speed and memory beside lower bounds and peers (ARGS=)
	@$(RUN) python benchmarks/cost.py
	@$(RUN) python benchmarks/peer_cost.py
	@$(RUN) python benchmarks/matching.py $(ARGS)

bench-quick: build ## the same for up to 20,000 places, in two to three minutes (ARGS=)
	@$(RUN) python benchmarks/matching.py --quick $(ARGS)

protocol: override EXTRAS += evaluation
protocol: build ## measure recalls by method, tolerance and sequence length (ARGS=)
	@OMP_WAIT_POLICY=PASSIVE $(RUN) python benchmarks/protocol.py $(ARGS)

accuracy: override EXTRAS += evaluation
accuracy: build ## measure the accuracy on the data sets (ARGS=)
	@$(RUN) python benchmarks/accuracy.py $(ARGS)

fit: override EXTRAS += evaluation
fit: build ## fit the evidence of mode robust, left out, and its error rates (ARGS=)
	@OMP_WAIT_POLICY=PASSIVE $(RUN) python benchmarks/fit.py $(ARGS)

off-map: override EXTRAS += evaluation
off-map: build ## measure mode robust off the map, at night, at other speeds (ARGS=)
	@OMP_WAIT_POLICY=PASSIVE $(RUN) python benchmarks/off_map.py $(ARGS)

pose-graphs: override EXTRAS += slam
pose-graphs: build ## measure the pose graph on KITTI in groups, and on public graphs (ARGS=)
	@$(RUN) python benchmarks/graph_methods.py --drives
	@$(RUN) python benchmarks/graph_files.py $(ARGS)

shell: override EXTRAS += evaluation
shell: build ## open a bash in which the built packages are found
	@echo 'The executables are in $(EXECUTABLES)/ and $(LAB)/. Leave with exit.'
	@echo 'Nodes run here, as stavpr COMMAND; ros2 launch, topic and bag need ROS 2 Jazzy: README, On a robot.'
	@$(RUN) env PS1='(stavpr_ros) \w\$$ ' bash --norc -i || true

clean: ## remove build/ install/ log/ docs/_build/
	@rm -rf build install log docs/_build

distclean: clean ## also remove .venv and the caches of tools
	@rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

development:
	@$(SETUP) build $(OPTIONS) onnx learned hdf5 heif faiss fleet slam evaluation dev docs
