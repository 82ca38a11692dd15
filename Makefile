# `make demo`, `make test` and `make docs` do all the set-up on first use.
PYTHON ?= python3
VENV := .venv
# What is tested is the built wheel, in an environment outside the checkout: MSGS_SLAM_TESTED names another place.
CACHE := $(if $(XDG_CACHE_HOME),$(XDG_CACHE_HOME),$(HOME)/.cache)
TESTED := $(or $(MSGS_SLAM_TESTED),$(CACHE)/msgs-slam/tested-$(shell pwd | cksum | cut -d' ' -f1))
PIP := -m pip install --quiet --disable-pip-version-check

# What PyPI has for Linux brings several gigabytes of CUDA, which a machine without an NVIDIA driver has no use for.
CPU_TORCH := 'torch>=2.6,<2.14' --index-url https://download.pytorch.org/whl/cpu

.PHONY: demo test lint docs wheel clean

demo:
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	nvidia-smi > /dev/null 2>&1 || $(VENV)/bin/python -c 'import torch' 2> /dev/null || \
		{ echo "No NVIDIA driver: PyTorch for the CPU."; $(VENV)/bin/python $(PIP) --retries 1 $(CPU_TORCH); } || \
		echo "download.pytorch.org cannot be reached: the PyTorch of PyPI, with CUDA."
	$(VENV)/bin/python $(PIP) .
	$(VENV)/bin/msgs-slam models pull --yes || echo "Continuing without networks: fewer class names, less certain scale."
	$(VENV)/bin/msgs-slam demo

test: lint wheel
	$(TESTED)/bin/python $(PIP) --force-reinstall --no-deps build/dist/*.whl
	cd $(TESTED) && MSGS_SLAM_CHECKOUT=$(CURDIR) bin/python -m pytest --rootdir $(CURDIR) -c $(CURDIR)/pyproject.toml \
		--numprocesses auto --maxprocesses 4 --dist loadfile $(CURDIR)/tests

wheel: $(TESTED)/.installed # by way of the source distribution, which is released too
	rm -rf build/dist
	$(TESTED)/bin/python -m build --no-isolation --outdir build/dist . > build/wheel.log || (cat build/wheel.log; exit 1)

lint: $(TESTED)/.installed
	$(TESTED)/bin/ruff check .
	$(TESTED)/bin/ruff format --check .
	$(TESTED)/bin/mypy

docs: $(TESTED)/.installed
	NO_MKDOCS_2_WARNING=1 $(TESTED)/bin/mkdocs build --strict

$(TESTED)/.installed: pyproject.toml
	$(PYTHON) -m venv $(TESTED)
	$(TESTED)/bin/python $(PIP) '.[dev,docs,cuda-check]'
	touch $@

clean:
	rm -rf $(VENV) $(TESTED) build *.egg-info
