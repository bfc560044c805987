# Everything happens in .venv; nothing is installed elsewhere but the system libraries that Debian and
# Ubuntu have packages for.

PYTHON ?= python3
STEPS ?= 5500
RATE ?= 0.004
DEVICE ?= cpu
WORKERS ?= 1
BIN := .venv/bin

SEED ?= 0
INPUTS ?= 1000
KILLS ?= 30
.PHONY: demo test browsers clusters lint wheel-test docs gallery bench soak reader reader-tissue system chromium clean

demo: system .venv/installed
	$(BIN)/pipeline run data_samples/three_photos -w runs/demo

# Kernels first, on all cores: in the tests one process would wait for another that compiles.
test: system chromium .venv/installed-dev
	$(BIN)/pipeline warmup
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# What the pages' tests ask in Chromium, in Firefox and in WebKitGTK (Safari's engine) as well.
browsers: system chromium .venv/installed-dev
	@tools/system-packages browsers
	for engine in firefox webkit; do \
	    PAGES_IN=$$engine xvfb-run -a -s "-screen 0 1600x1200x24" $(BIN)/python -m pytest \
	        tests/stages/test_viewer_tools.py tests/stages/test_viewer_steering.py \
	        tests/stages/test_viewer_marks.py tests/studies/test_register_command.py || exit 1; \
	done

# The recipes for SLURM and Kubernetes of docs/batch.md, run as far as one machine can.
clusters: system .venv/installed-dev
	@tools/system-packages clusters
	$(BIN)/python -m pip install --quiet --constraint constraints.txt dask-kubernetes
	$(BIN)/python -m pytest tests/studies/test_batch_slurm.py tests/studies/test_batch_kubernetes.py

lint: .venv/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

# The wheel, installed into an environment of its own, makes a scene from another folder.
wheel-test: .venv/installed-dev
	$(BIN)/python tools/wheel_test.py

# The site, into runs/site: open runs/site/index.html. Links that lead nowhere are errors.
docs: .venv/installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --site-dir runs/site

# The pictures of the site's gallery, its page, and README's picture: from the sample data, in some minutes.
gallery: chromium .venv/installed
	$(BIN)/python tools/gallery.py

bench: .venv/installed-dev
	for script in align fit rasterizer; do $(BIN)/python benchmarks/$$script.py || exit 1; done

# What takes too long for the test suite: kills, full disks, and damaged files by the thousand.
soak: .venv/installed-dev
	$(BIN)/python tests/soak/fuzz_media.py --seed $(SEED) --count $(INPUTS)
	$(BIN)/python tests/soak/fuzz_numbers.py --seed $(SEED) --count $(INPUTS) --quiet
	$(BIN)/python tests/soak/kill_resume.py --seed $(SEED) --count $(KILLS)

# The tooth reader's weights again, from the labelled photographs in DATA and generated mouths: half an
# hour for the mouths on two cores, then ten minutes on a card (DEVICE=cuda WORKERS=15) or fifteen hours
# without. START=FILE goes on from weights of an earlier training (STEPS=1600 RATE=0.002 then do).
reader: .venv/installed-dev
	@test -d "$(DATA)" || { echo "make reader DATA=FOLDER: a folder with train/, valid/, fdi.json"; exit 2; }
	for sort in "anybody 1 900" "orthodontic 2 500" "children 3 350"; do \
	    set -- $$sort; \
	    $(BIN)/python data_samples/mouths/__main__.py --patients $$1 --seed $$2 --count $$3 --jobs 2 \
	        --out runs/mouths/$$1 || exit 1; \
	done
	$(BIN)/python tools/reader/unlabelled.py --data "$(DATA)" --out runs/unlabelled
	$(BIN)/python tools/reader/train.py --data "$(DATA)" --labels tools/reader/labels.json \
	    --unlabelled runs/unlabelled --mouths runs/mouths/* --steps $(STEPS) --rate $(RATE) \
	    --device $(DEVICE) --workers $(WORKERS) $(if $(START),--start $(START)) --out runs/reader.pt
	$(MAKE) reader-tissue DATA="$(DATA)" START=runs/reader.pt

# Its last part alone, which tells teeth and gum from lips, cheeks and retractors: twenty minutes on two
# cores, with the mouths that are there.
reader-tissue: START ?= stages/teeth/reader.onnx
reader-tissue: .venv/installed-dev
	MALLOC_MMAP_THRESHOLD_=4000000000 MALLOC_TRIM_THRESHOLD_=8000000000 \
	    $(BIN)/python tools/reader/train_tissue.py --data "$(DATA)" --tissue tools/reader/tissue.json \
	    --mouths runs/mouths/* --start $(START) --out runs/reader.pt
	$(BIN)/python tools/reader/export.py runs/reader.pt stages/teeth/reader.onnx
	$(BIN)/python tools/reader/score.py --data "$(DATA)"

# Shared libraries that Python wheels expect from the system, and the module that makes environments.
system:
	@tools/system-packages required

# Only the tests of the pages need a browser. One apt at a time.
chromium: | system
	@tools/system-packages browser

# With the newest pip: the one that Python 3.11 brings takes twice as long to choose versions.
.venv/bin/python: | system
	$(PYTHON) -m venv --upgrade-deps .venv

# Open3D comes without CUDA (tools/requirements.py), which pip, asked for the package, would not do.
# Compiled by all cores at once: pip does it with one. Some packages hold files for other Pythons;
# of the large ones left out here little is ever imported. setuptools warns of every editable install.
RARELY := tests|pip|torch|torchgen|sympy|mpmath|plotly|mypy|mypyc|fontTools|pygments|IPython|jedi
define install
$(BIN)/python tools/requirements.py $(1) > .venv/requirements.txt
$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt \
    --requirement .venv/requirements.txt
PYTHONWARNINGS=ignore:Editable $(BIN)/python -m pip install --quiet --no-compile --no-deps --editable .
$(BIN)/python -m compileall -q -j 0 -x '/($(RARELY))/' .venv/lib > /dev/null || true
endef

.venv/installed: .venv/bin/python setup.cfg constraints.txt tools/requirements.py
	$(call install)
	touch $@

.venv/installed-dev: .venv/bin/python setup.cfg constraints.txt tools/requirements.py
	$(call install,dev)
	touch .venv/installed $@

# Not what else is in runs: people's cases are there.
clean:
	rm -rf .venv build dist *.egg-info runs/demo runs/site runs/gallery
