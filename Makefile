# Two commands: `make demo` and `make test`. Both set up first, again and again without harm.
PYTHON ?= python3
VENV ?= .venv
DEMO ?= demo
BIN = $(VENV)/bin

export OMP_WAIT_POLICY = PASSIVE
unexport PYTHONDONTWRITEBYTECODE # tests start many processes: each would compile every module

.PHONY: install demo web test test-all check results

install: $(VENV)/installed

$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: install
	$(BIN)/python -m instant_avatar.sample $(DEMO)/capture --size 256 --overwrite
	$(BIN)/python -m instant_avatar.ingest $(DEMO)/capture/video.mp4 --poses $(DEMO)/capture/poses.npz --out $(DEMO)/run --seconds 60 --overwrite
	cp $(DEMO)/capture/video.mp4 $(DEMO)/video.mp4
	$(BIN)/python -m instant_avatar.ingest $(DEMO)/video.mp4 --out $(DEMO)/from-video --seconds 60 --overwrite
	$(BIN)/python -m instant_avatar.evaluate $(DEMO)/run $(DEMO)/from-video
	$(BIN)/python -m instant_avatar.play $(DEMO)/run/avatar.iavatar --poses $(DEMO)/capture/dance.npz --out $(DEMO)/dance.mp4 --overwrite

web: install # what `ia-play --web` needs: onnxruntime-web, pinned, through npm
	$(BIN)/python -m instant_avatar.animation.web_server

results: install # docs/results.md: 16 minutes of training on two cores, and scoring; MOTION=track.npz films a track of poses
	$(BIN)/python -m benchmarks.results --write docs/results.md $(if $(MOTION),--motion $(MOTION))

test: install # on one thread: these tests are small, a second thread costs more CPU time than it saves
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m pytest -q -m "not slow"

test-all: install # the slow ones, too: long trainings, the browser, a fresh installation
	-$(BIN)/python -m instant_avatar.animation.web_server # without it the browser's tests are skipped
	-npm install --silent --no-save --prefix build/npm three@0.187 @sparkjsdev/spark@2.2 @pixiv/three-vrm@3.5 gltf-validator@2.0.0-dev.3.10 # for tests of the examples and of exported files
	$(BIN)/python -m pytest -q

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright --pythonpath $(BIN)/python
