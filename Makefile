# Everything on a fresh Debian or Ubuntu machine with Python >= 3.11, make and a compiler:
#   make demo   set up what the demo needs, then the main job on a simulated flight: bag -> runs -> evaluation, plots and a view
#   make test   set up what the tests need, then lint, types and the tests; make test-all: those that take minutes as well
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
INSTALLED_FOR_DEMO := $(VENV)/.installed-demo

DEMO := build/demo
FLIGHT ?= inspection
FLIGHT_BAG := $(DEMO)/$(FLIGHT).bag
DETECTORS := shi_tomasi fast orb sift keypointnet
RUNS := $(DETECTORS:%=$(DEMO)/%) $(DEMO)/sliding_window

# What the wheels of Open3D and pyrealsense2 need from the system, and the browser that the tests open a report's page in.
SYSTEM_LIBRARIES := libusb-1.0-0 libgl1 libgomp1 libx11-6 libegl1
BROWSER := chromium chromium-driver

# The tests begin many programs, each of which would compile every module anew.
unexport PYTHONDONTWRITEBYTECODE
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

.PHONY: demo test test-all test-fast lint install system-libraries browser clean

test: lint browser
	$(BIN)/pytest -n 2 --dist worksteal -m "not very_slow"

test-all: lint browser
	$(BIN)/pytest -n 2 --dist worksteal

test-fast: lint
	$(BIN)/pytest -n 2 --dist worksteal -m "not slow and not very_slow"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Every detector with the filter, and the optimiser with loop closure, on the same simulated flight; no data is downloaded.
demo: $(INSTALLED_FOR_DEMO) system-libraries
	@mkdir -p $(DEMO)
	$(BIN)/vioframe simulate $(FLIGHT_BAG) --flight $(FLIGHT) --duration 25 --overwrite
	for detector in $(DETECTORS); do \
		$(BIN)/vioframe run $(FLIGHT_BAG) --detector $$detector --backend msckf --out $(DEMO)/$$detector --overwrite || exit; \
	done
	$(BIN)/vioframe run $(FLIGHT_BAG) --backend sliding_window --loop-closure pose_graph --out $(DEMO)/sliding_window --overwrite
	$(BIN)/vioframe evaluate $(RUNS)
	$(BIN)/vioframe plot $(RUNS) --out $(DEMO)/plots
	$(BIN)/vioframe view $(DEMO)/$(firstword $(DETECTORS)) $(DEMO)/sliding_window --world $(FLIGHT_BAG).simulation/world.ply --save $(DEMO)/plots/view.rrd

install: $(INSTALLED) system-libraries

# What the demo needs, and what the tests need: the latter holds the former. Versions are those of constraints.txt.
$(INSTALLED_FOR_DEMO): EXTRAS := open3d,openvino,view
$(INSTALLED): EXTRAS := test,open3d
$(INSTALLED_FOR_DEMO) $(INSTALLED): pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[$(EXTRAS)]"
	@touch $@

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "vioframe needs Python 3.11 or newer: make PYTHON=/path/to/python3.11"; exit 2; }
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "cannot create $(VENV); on Debian or Ubuntu: apt-get install python3-venv"; exit 2; }

# Only Open3D and pyrealsense2 need these, so what cannot be installed is said and not fatal.
system-libraries:
	@$(call debian_packages,$(SYSTEM_LIBRARIES),Open3D and RealSense cameras need system libraries)

# Without it the tests of a report's page are skipped.
browser:
	@$(call debian_packages,$(BROWSER),the tests of the report's page need a browser)

# Installs those of the packages $(1) that are missing; where it cannot, says what for, $(2), and the command.
define debian_packages
	command -v dpkg >/dev/null || exit 0; \
	missing=""; for package in $(1); do \
		dpkg -s $$package >/dev/null 2>&1 || missing="$$missing $$package"; done; \
	test -z "$$missing" && exit 0; \
	command="apt-get update && apt-get install -y --no-install-recommends$$missing"; \
	if [ "$$(id -u)" = 0 ] && sh -c "$$command" >/dev/null 2>&1; then echo "installed:$$missing"; \
	else echo "$(2): sudo sh -c '$$command'"; fi
endef

clean:
	rm -rf build .mypy_cache .pytest_cache .ruff_cache
