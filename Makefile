# Targets set up what they need: a fresh clone needs only Python 3.11, make and git.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: system-libraries demo test check bench bench-update results clean

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "graphloc needs Python 3.11 or newer; $$($(PYTHON) --version) is on PATH: call make PYTHON=python3.11"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "setting up .venv (once)"
	@PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]' \
		> .venv/setup.log 2>&1 || { cat .venv/setup.log; exit 1; }
	@$(BIN)/python -c 'import open3d' 2> .venv/open3d.log || $(MAKE) --no-print-directory system-libraries
	@touch $@

# open3d is linked with libraries of a desktop, which a server or a boat's computer may lack.
LIBRARIES := libegl1 libgl1 libgomp1 libidn2-0 libudev1 libusb-1.0-0 libx11-6
system-libraries:
	@echo "installing system libraries for open3d: $(LIBRARIES)"
	@if command -v apt-get > /dev/null && [ "$$(id -u)" = 0 ]; then \
		(apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends $(LIBRARIES)) \
			> .venv/system.log 2>&1 || cat .venv/system.log; \
	fi
	@$(BIN)/python -c 'import open3d' 2> .venv/open3d.log || \
		echo "open3d cannot be loaded: $$(tail -1 .venv/open3d.log). All but simulated LiDARs works; for these install" \
			"(Debian names) $(LIBRARIES)"

demo: $(STAMP)
	@$(BIN)/graphloc demo --overwrite

test: $(STAMP)
	@$(BIN)/python -m pytest

check: $(STAMP)
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy

bench: $(STAMP)
	@$(BIN)/python benchmarks/bench.py

bench-update: $(STAMP)
	@$(BIN)/python benchmarks/bench.py --update

results: $(STAMP)
	@$(BIN)/python benchmarks/results.py

clean:
	rm -rf .venv build *.egg-info runs
