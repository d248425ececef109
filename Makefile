# make demo   sets up, makes furnished rooms, trains on them and shows the results
# make test   sets up and runs the tests, 3 to 5 minutes on two cores
# make test-all  with the slow ones and the coverage, 35 to 50 minutes; what CI runs
# make real ZIND=zind/sample_tour NETWORK=net.onnx  the tables of docs/results/real_panoramas.md, in hours
# make docs  builds the documentation site in site/, offline, in under a minute
# make bench  measures speed and memory, under 10 minutes; make bench-compare looks for regressions
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
DEMO := runs/demo/first
AGAIN := status=$$?; echo "tangent-train ended with an error, see above; make demo goes on where it stopped."; exit $$status

.PHONY: install demo test test-all lint docs real bench bench-compare

install: $(READY)

$(READY): pyproject.toml constraints.txt
	@echo "Setting up .venv (about 7 GB, some minutes; only when the dependencies change) …"
	@$(PYTHON) -c 'import sys; sys.exit(None if (3, 11) <= sys.version_info < (3, 14) else "Python 3.11 to 3.13 is needed: make PYTHON=python3.12 …")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@# The metadata of torch-harmonics 0.9.3 excludes torch 2.15, with which it works; that of Depth Anything 3 NumPy 2.
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --no-deps \
		torch-harmonics depth-anything-3 addict einops
	@touch $@

demo: install
	@if [ -f $(DEMO)/results.md ]; then \
		cat $(DEMO)/results.md; \
		echo; echo "The demo has run; its pictures are in $(DEMO)/panels. Delete $(DEMO) to run it again."; \
	elif [ -f $(DEMO)/checkpoints/last.ckpt ]; then \
		echo "Going on with the interrupted demo …"; \
		$(BIN)/tangent-train resume=$(DEMO) || { $(AGAIN); }; \
	else \
		echo "Rendering rooms, training and evaluating (3 to 5 minutes on two cores) …"; \
		$(BIN)/tangent-train experiment=rooms/demo hydra.run.dir=$(DEMO) || { $(AGAIN); }; \
	fi

test: install
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

# The security tests run apart, without coverage: they add an audit hook, and below Python 3.12 coverage cannot start
# tracing in one thread while such a hook runs in another.
test-all: install
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal --cov --cov-report=term:skip-covered --ignore=tests/security
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal tests/security

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: install
	rm -rf site
	$(BIN)/python -m docs.tools.site site
	@echo "The site is in site/: open site/index.html. With the search: $(BIN)/python -m http.server -d site"

# NETWORK was written by tangent-import; repeated, both commands go on where they were interrupted.
real: install
	$(BIN)/tangent-transfer experiment=zero_shot name=real/$(basename $(notdir $(NETWORK))) checkpoint=$(NETWORK) \
		data=zind data.root=$(ZIND) data.test_fraction=1 data.doors=ignore \
		label_map=ade20k_to_zind_layout unmapped=never
	$(BIN)/tangent-keypoints data=zind_pairs data.root=$(ZIND) data.max_distance_m=3 \
		output=runs/real/keypoints

bench: install
	$(BIN)/python -m benchmarks

# RESULTS=runs/bench/results.json compares what was measured; without it everything is measured.
bench-compare: install
	$(BIN)/python -m benchmarks compare $(RESULTS)
