# `make help` lists the targets. Every target sets up what it needs.

PYTHON ?= python3
# The release that the tests run on. Another build, say for your CUDA: make install TORCH="torch==..."
TORCH ?= torch==2.13.0
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.installed
LOWEST := .venv-lowest
DEFAULT_TESTS := "not slow and not gpu and not weights and not bench"

# What `make demo` reads: simulated scans, or every .bin below DATA. SCRATCH=1 trains small networks
# from nothing instead of starting from the weights of the package.
DATA ?=
SCRATCH ?=
OUT ?= runs/demo
ifneq ($(SCRATCH),)
ifeq ($(DATA),)
SOURCE := --config conf/data/demo.yaml --data.init_args.root '$(OUT)/data'
else
SOURCE := --config conf/data/demo_folder.yaml --data.init_args.scans '$(DATA)' \
	--data.init_args.features_dir '$(OUT)/feature_grids'
endif
FIT := $(BIN)/r3dpa fit --config conf/trainer.yaml --config conf/demo/trainer.yaml $(SOURCE)
else
ifeq ($(DATA),)
SOURCE := --config conf/r3dpa_s/demo_data.yaml
REAL := conf/r3dpa_s/demo_data.yaml
HELD_OUT := --split val
else
SOURCE := --config conf/r3dpa_s/demo_folder.yaml --data.init_args.scans '$(DATA)'
REAL := $(DATA)
HELD_OUT :=
endif
FIT := $(BIN)/r3dpa fit --config conf/trainer.yaml --config conf/r3dpa_s/trainer.yaml $(SOURCE)
endif
# The long training of r3dpa-s; the same command continues an interrupted run. The shipped weights are
# of r3dpa-s-first on other streets, trained on by r3dpa-s-more.
SECOND := runs/r3dpa_s_2
FIT_SECOND := OMP_NUM_THREADS=1 nice -n 19 $(BIN)/r3dpa fit --config conf/trainer.yaml \
	--config conf/r3dpa_s_2/trainer.yaml --ckpt_path last
SCANS ?= 8000
FROM ?= r3dpa-s
SECOND_DATA := --config conf/r3dpa_s_2/data.yaml --data.init_args.num_scans $(SCANS)
SECOND_ALIGNED := $(SECOND_DATA) --config conf/r3dpa_s_2/teacher.yaml
FIT_FIRST := nice -n 19 $(BIN)/r3dpa fit --config conf/trainer.yaml --config conf/r3dpa_s/trainer.yaml \
	--config conf/r3dpa_s/data.yaml --ckpt_path last

.DEFAULT_GOAL := help
.PHONY: help install format lint types test test-lowest test-all test-numerics \
	test-faults test-nodes fuzz notebooks demo my-sensor gallery r3dpa-s \
	r3dpa-s-more r3dpa-s-control r3dpa-s-rgb r3dpa-s-first r3dpa-s-scores docs clean bench bench-training \
	bench-sampling bench-gpu ablations

help: ## list the targets
	@grep -hE '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "%-16s %s\n", $$1, $$2}'

install: $(READY) ## set .venv up; does nothing when it is up to date

$(READY): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet $(TORCH)
	$(BIN)/pip install --quiet --editable ".[dev]"
	touch $@

format: $(READY) ## format the code
	$(BIN)/ruff format src tests
	$(BIN)/ruff check --fix src tests

lint: $(READY) ## ruff and mypy
	$(BIN)/ruff format --check src tests
	$(BIN)/ruff check src tests
	$(BIN)/mypy

types: $(READY) ## mypy alone
	$(BIN)/mypy

# Bytecode is kept, or every process would compile all files again.
test: $(READY) ## default tests, a few minutes on two cores
	OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/pytest -n 2 --dist worksteal -p no:nbmake -m $(DEFAULT_TESTS)

# Lower bounds of pyproject.toml as constraints, in an environment of its own.
test-lowest: ## default tests with the lowest versions that pyproject.toml allows
	test -x $(LOWEST)/bin/python || $(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python tests/lowest_versions.py dev hub > $(LOWEST)/constraints.txt
	$(LOWEST)/bin/pip install --quiet --constraint $(LOWEST)/constraints.txt --editable ".[dev,hub]"
	OMP_NUM_THREADS=1 $(LOWEST)/bin/pytest -n 2 --dist worksteal -p no:nbmake -m $(DEFAULT_TESTS)

test-all: $(READY) ## every test that this machine can run
	OMP_NUM_THREADS=1 $(BIN)/pytest

test-numerics: $(READY) ## hard numerical cases
	$(BIN)/pytest -m numerics

test-faults: $(READY) ## kill, fill, cut: what is lost, and what the user sees
	$(BIN)/pytest -m faults

test-nodes: $(READY) ## two nodes on one machine, in network namespaces
	OMP_NUM_THREADS=1 $(BIN)/pytest -m nodes

fuzz: $(READY) ## 100000 damaged files for all readers: about 6 minutes
	nice -n 15 env OMP_NUM_THREADS=1 FUZZ_INPUTS=5000 $(BIN)/pytest -q tests/test_fuzz_readers.py

notebooks: $(READY) ## run the notebooks, keeping their outputs
	$(BIN)/pytest --nbmake --nbmake-timeout=300 --overwrite notebooks

ifneq ($(SCRATCH),)
demo: $(READY) ## the weights of the package, then trained on: make demo [DATA=folder of .bin scans] [SCRATCH=1]
	rm -rf '$(OUT)/vae_alignment' '$(OUT)/joint'
	$(FIT) --config conf/experiment/vae_alignment.yaml \
		--config conf/demo/vae_alignment.yaml --run_dir '$(OUT)/vae_alignment'
	$(FIT) --config conf/experiment/joint.yaml --config conf/demo/joint.yaml \
		--run_dir '$(OUT)/joint' \
		--model.init_args.init_from '$(OUT)/vae_alignment/checkpoints/last.ckpt'
	$(BIN)/r3dpa sample --ckpt '$(OUT)/joint/checkpoints/last.ckpt' --out '$(OUT)/scenes' \
		--num 16 --steps 64 --batch_size 16 --overwrite true
	$(BIN)/r3dpa report '$(OUT)/vae_alignment'
	$(BIN)/r3dpa report '$(OUT)/joint'
	$(BIN)/r3dpa test --config '$(OUT)/joint/config.yaml' \
		--ckpt_path '$(OUT)/joint/checkpoints/last.ckpt'
else
demo: $(READY)
	rm -rf '$(OUT)/vae' '$(OUT)/flow' '$(OUT)/reference.safetensors'
	$(BIN)/r3dpa sample --num 16 --out '$(OUT)/r3dpa-s' --overwrite true
	$(BIN)/r3dpa edit inpaint --scan '$(OUT)/r3dpa-s/bin/000000.bin' --box -30 30 -25 3 --num 2 \
		--out '$(OUT)/edit' --overwrite true
	$(BIN)/r3dpa data reference --data '$(REAL)' $(HELD_OUT) --num 32 --out '$(OUT)/reference.safetensors'
	$(BIN)/r3dpa evaluate --samples '$(OUT)/r3dpa-s' --reference '$(OUT)/reference.safetensors' \
		--allow_few --label before --out '$(OUT)/before'
	$(FIT) --config conf/r3dpa_s/vae_alignment.yaml --config conf/r3dpa_s/demo_vae.yaml --run_dir '$(OUT)/vae'
	$(FIT) --config conf/r3dpa_s/flow_matching.yaml --config conf/r3dpa_s/demo_flow.yaml \
		--run_dir '$(OUT)/flow' --model.init_args.init_from '$(OUT)/vae/checkpoints/last.ckpt'
	$(BIN)/r3dpa sample --ckpt '$(OUT)/flow/checkpoints/last.ckpt' --num 16 --out '$(OUT)/scenes' \
		--overwrite true
	$(BIN)/r3dpa evaluate --samples '$(OUT)/scenes' --reference '$(OUT)/reference.safetensors' \
		--allow_few --label after --beside '$(OUT)/before/evaluation.json' --out '$(OUT)/after'
endif

# MINUTES of simulation and training on two cores. SENSOR: a preset or YAML, in place of an estimate.
MINUTES ?= 10
SENSOR ?= $(MINE)/sensor.yaml
MINE := runs/my_sensor
ESTIMATED := $(filter file,$(origin SENSOR))
MY_FIT := $(BIN)/r3dpa fit --config conf/trainer.yaml --config conf/r3dpa_s/trainer.yaml \
	--config '$(MINE)/data.yaml'
my-sensor: $(READY) ## r3dpa-s in the geometry of your sensor: make my-sensor DATA=folder of scans [MINUTES=60]
	$(if $(ESTIMATED),,$(if $(filter $(MINE)/%,$(SENSOR)),$(error $(MINE) is made anew: copy $(SENSOR) out of it)))
	rm -rf '$(MINE)'
	$(if $(ESTIMATED),$(BIN)/r3dpa data sensor '$(DATA)' --out '$(SENSOR)')
	$(BIN)/r3dpa data plan '$(SENSOR)' --scans '$(DATA)' --out '$(MINE)' --minutes $(MINUTES)
	$(BIN)/r3dpa data simulate --out '$(MINE)/simulated' --config '$(MINE)/simulate.yaml'
	$(MY_FIT) --config conf/r3dpa_s/vae_alignment.yaml --config conf/r3dpa_s/demo_vae.yaml \
		--config '$(MINE)/vae.yaml' --run_dir '$(MINE)/vae'
	$(MY_FIT) --config conf/r3dpa_s/flow_matching.yaml --config conf/r3dpa_s/demo_flow.yaml \
		--config '$(MINE)/flow.yaml' --run_dir '$(MINE)/flow' \
		--model.init_args.init_from '$(MINE)/vae/checkpoints/last.ckpt'
	$(BIN)/r3dpa data reference --data '$(MINE)/data.yaml' --split val --out '$(MINE)/reference.safetensors'
	$(BIN)/r3dpa sample --out '$(MINE)/r3dpa-s'
	$(BIN)/r3dpa sample --ckpt '$(MINE)/flow/checkpoints/last.ckpt' --out '$(MINE)/scenes'
	$(BIN)/r3dpa evaluate --samples '$(MINE)/r3dpa-s' --reference '$(MINE)/reference.safetensors' \
		--allow_few --label before --out '$(MINE)/before'
	$(BIN)/r3dpa evaluate --samples '$(MINE)/scenes' --reference '$(MINE)/reference.safetensors' \
		--allow_few --label after --beside '$(MINE)/before/evaluation.json' --out '$(MINE)/after'
	@cat '$(MINE)/more.txt'

gallery: $(READY) ## one page of 64 scenes in order, their nearest training scans, edits, weather
	$(BIN)/r3dpa gallery --out runs/gallery.html $(if $(wildcard $(SECOND)/data),--data conf/r3dpa_s_2/data.yaml)

r3dpa-s: $(READY) ## train the second edition of r3dpa-s: 20 hours of a core; stop and repeat at any time [SCANS=8000]
	OMP_NUM_THREADS=1 nice -n 19 $(BIN)/r3dpa data prepare $(SECOND_DATA)
	OMP_NUM_THREADS=1 nice -n 19 $(BIN)/r3dpa data prepare $(SECOND_ALIGNED)
	$(FIT_SECOND) $(SECOND_DATA) --config conf/r3dpa_s_2/vae_alignment.yaml --run_dir $(SECOND)/vae
	$(FIT_SECOND) $(SECOND_DATA) --config conf/r3dpa_s_2/vae_alignment.yaml \
		--config conf/r3dpa_s_2/vae_decoder.yaml --run_dir $(SECOND)/decoder \
		--model.init_args.init_from $(SECOND)/vae/checkpoints/last.ckpt
	$(FIT_SECOND) $(SECOND_ALIGNED) --config conf/r3dpa_s_2/flow_matching.yaml --run_dir $(SECOND)/flow \
		--model.init_args.init_from $(SECOND)/decoder/checkpoints/last.ckpt
	$(FIT_SECOND) $(SECOND_ALIGNED) --config conf/r3dpa_s_2/joint.yaml --run_dir $(SECOND)/joint \
		--model.init_args.init_from $(SECOND)/flow/checkpoints/last.ckpt
	$(FIT_SECOND) $(SECOND_ALIGNED) --config conf/r3dpa_s_2/flow_matching.yaml \
		--config conf/r3dpa_s_2/few_step.yaml --run_dir $(SECOND)/few_step \
		--model.init_args.init_from $(SECOND)/joint/checkpoints/last.ckpt
	$(BIN)/r3dpa convert $(SECOND)/few_step/checkpoints/last.ckpt $(SECOND)/r3dpa-s.safetensors \
		--networks vae ema ema_latent_norm --half --overwrite
	$(BIN)/r3dpa data objects --data conf/r3dpa_s_2/data.yaml --ckpt $(SECOND)/r3dpa-s.safetensors \
		--out $(SECOND)/r3dpa-s.objects

r3dpa-s-more: $(READY) ## train weights on, in six hours of a core: encoder, decoder, SiT, few steps [FROM=r3dpa-s]
	OMP_NUM_THREADS=1 nice -n 19 $(BIN)/r3dpa data prepare $(SECOND_ALIGNED)
	$(FIT_SECOND) $(SECOND_DATA) --config conf/r3dpa_s_2/vae_alignment.yaml \
		--config conf/r3dpa_s_2/encoder.yaml --run_dir $(SECOND)/encoder \
		--model.init_args.init_from '$(FROM)'
	$(FIT_SECOND) $(SECOND_DATA) --config conf/r3dpa_s_2/vae_alignment.yaml \
		--config conf/r3dpa_s_2/decoder_labels.yaml --config conf/r3dpa_s_2/perceptual.yaml \
		--run_dir $(SECOND)/perceptual --model.init_args.init_from $(SECOND)/encoder/checkpoints/last.ckpt
	$(FIT_SECOND) $(SECOND_ALIGNED) --config conf/r3dpa_s_2/flow_matching.yaml \
		--config conf/r3dpa_s_2/aligned.yaml --run_dir $(SECOND)/aligned \
		--model.init_args.init_from $(SECOND)/perceptual/checkpoints/last.ckpt
	$(FIT_SECOND) $(SECOND_ALIGNED) --config conf/r3dpa_s_2/flow_matching.yaml \
		--config conf/r3dpa_s_2/few_step.yaml --run_dir $(SECOND)/aligned_few_step \
		--model.init_args.init_from $(SECOND)/aligned/checkpoints/last.ckpt
	$(BIN)/r3dpa convert $(SECOND)/aligned_few_step/checkpoints/last.ckpt $(SECOND)/more.safetensors \
		--networks vae ema ema_latent_norm --half --overwrite

r3dpa-s-control: $(READY) ## its control without alignment, latent noise and joint stage: after make r3dpa-s
	$(FIT_SECOND) $(SECOND_DATA) --config conf/r3dpa_s_2/vae_alignment.yaml \
		--config conf/r3dpa_s_2/vae_decoder.yaml --config conf/r3dpa_s_2/control_vae.yaml \
		--run_dir $(SECOND)/control_vae --model.init_args.init_from $(SECOND)/vae/checkpoints/last.ckpt
	$(FIT_SECOND) $(SECOND_DATA) --config conf/r3dpa_s_2/flow_matching.yaml \
		--config conf/r3dpa_s_2/control_flow.yaml --run_dir $(SECOND)/control_flow \
		--model.init_args.init_from $(SECOND)/control_vae/checkpoints/last.ckpt

RGB_STAGE = OMP_NUM_THREADS=1 nice -n 19 $(BIN)/r3dpa fit --config conf/trainer.yaml \
	--config conf/r3dpa_s_2/trainer.yaml --config conf/data/dead_leaves.yaml --ckpt_path last
r3dpa-s-rgb: $(READY) ## VAE and flow from an RGB prior, in the hours of both without: after make r3dpa-s
	$(RGB_STAGE) --config conf/experiment/image_vae.yaml --trainer.max_steps 500 \
		--data.init_args.num_workers 0 --run_dir $(SECOND)/image_vae
	$(RGB_STAGE) --config conf/experiment/rgb_pretraining.yaml \
		--model.init_args.sit conf/r3dpa_s/sit.yaml --config conf/r3dpa_s_2/rgb_prior.yaml \
		--run_dir $(SECOND)/rgb_prior --model.init_args.init_from $(SECOND)/image_vae/checkpoints/last.ckpt
	$(FIT_SECOND) $(SECOND_ALIGNED) --config conf/r3dpa_s_2/vae_alignment.yaml \
		--config conf/r3dpa_s_2/vae_rgb.yaml --run_dir $(SECOND)/rgb_vae \
		--model.init_args.rgb_weights $(SECOND)/rgb_prior/checkpoints/last.ckpt
	$(FIT_SECOND) $(SECOND_ALIGNED) --config conf/r3dpa_s_2/flow_matching.yaml --trainer.max_steps 5000 \
		--run_dir $(SECOND)/rgb_flow --model.init_args.latents_dir $(SECOND)/rgb_latents \
		--model.init_args.init_from $(SECOND)/rgb_vae/checkpoints/last.ckpt

r3dpa-s-first: $(READY) ## train the first edition of r3dpa-s: an hour of a GPU, days of two cores
	$(FIT_FIRST) --config conf/r3dpa_s/vae_alignment.yaml --run_dir runs/r3dpa_s/vae
	$(FIT_FIRST) --config conf/r3dpa_s/vae_alignment.yaml --config conf/r3dpa_s/vae_more.yaml \
		--run_dir runs/r3dpa_s/vae_more \
		--model.init_args.init_from runs/r3dpa_s/vae/checkpoints/last.ckpt
	$(FIT_FIRST) --config conf/r3dpa_s/vae_alignment.yaml --config conf/r3dpa_s/vae_decoder.yaml \
		--run_dir runs/r3dpa_s/vae_decoder \
		--model.init_args.init_from runs/r3dpa_s/vae_more/checkpoints/last.ckpt
	$(FIT_FIRST) --config conf/r3dpa_s/flow_matching.yaml --run_dir runs/r3dpa_s/flow \
		--model.init_args.init_from runs/r3dpa_s/vae_decoder/checkpoints/last.ckpt
	$(FIT_FIRST) --config conf/r3dpa_s/flow_matching.yaml --config conf/r3dpa_s/few_step.yaml \
		--run_dir runs/r3dpa_s/few_step \
		--model.init_args.init_from runs/r3dpa_s/flow/checkpoints/last.ckpt \
		--model.init_args.latents_dir runs/r3dpa_s/flow/latents
	$(BIN)/r3dpa convert runs/r3dpa_s/few_step/checkpoints/last.ckpt runs/r3dpa_s/r3dpa-s.safetensors \
		--networks vae ema ema_latent_norm --half --overwrite

# Held-out scans are those of conf/r3dpa_s_2/data.yaml, which `make r3dpa-s` and `r3dpa-s-more` hold out too.
SCENES ?= 2000
SCORES := runs/r3dpa_s_scores
KEPT := notebooks/results/r3dpa_s
MEASURE := OMP_NUM_THREADS=1 nice -n 19 $(BIN)
r3dpa-s-scores: $(READY) ## measure the weights of the package: hours of a core [SCENES=2000]
	$(MEASURE)/r3dpa data prepare --config conf/r3dpa_s_2/data.yaml
	$(MEASURE)/r3dpa sample --num $(SCENES) --batch_size 8 --formats '[]' --out $(SCORES)/r3dpa-s
	test -e $(SCORES)/reference.safetensors || $(MEASURE)/r3dpa data reference \
		--data conf/r3dpa_s_2/data.yaml --split val --spaces fwid,fwid_judge,fgeo \
		--out $(SCORES)/reference.safetensors
	$(MEASURE)/r3dpa evaluate --samples $(SCORES)/r3dpa-s --reference $(SCORES)/reference.safetensors \
		--label r3dpa-s --out $(SCORES)/evaluation
	cp $(SCORES)/evaluation/evaluation.json $(KEPT)/evaluation.json
	$(MEASURE)/python tests/bench/scene_scores.py --scenes $(SCORES)/r3dpa-s \
		--data conf/r3dpa_s_2/data.yaml --num $(SCENES) --out $(KEPT)/scene_scores.json
	$(MEASURE)/python tests/bench/reconstruction_quality.py --data conf/r3dpa_s_2/data.yaml \
		--num 200 --out $(KEPT)/reconstruction.json
	$(MEASURE)/python tests/bench/wall_straightness.py --scenes $(SCORES)/r3dpa-s \
		--data conf/r3dpa_s_2/data.yaml --out $(KEPT)/walls.json

bench: $(READY) ## micro-benchmarks of simulation, data, features, metrics, VAE, sampling, guidance
	OMP_NUM_THREADS=1 $(BIN)/pytest tests/bench -m bench

bench-training: $(READY) ## one full-size training step of each stage: time and peak memory
	$(BIN)/r3dpa bench training

bench-sampling: $(READY) ## what accuracy costs in time, for an exact velocity: minutes
	OMP_NUM_THREADS=1 $(BIN)/r3dpa bench sampling --quick --out runs/bench_sampling

ablations: $(READY) ## tables I to IV at the demo's size: hours on two cores; goes on where it stopped
	OMP_NUM_THREADS=1 $(BIN)/r3dpa ablate conf/ablation --scale demo --workers 2

# A checkpoint that fits, for the picture of a trained model: make bench-gpu CKPT=...
CKPT ?=
bench-gpu: $(READY) ## on a GPU: training steps at full size, and sampling from CKPT
	mkdir -p runs/bench_gpu
	$(BIN)/r3dpa bench training --device cuda --precision bf16-mixed --batch_size 32 --steps 10 \
		--out runs/bench_gpu/training.json
	$(if $(CKPT),$(BIN)/r3dpa bench sampling --device cuda --ckpt $(CKPT) --out runs/bench_gpu/sampling)

docs: $(READY) ## API pages in build/docs
	$(BIN)/python tests/write_api_pages.py build/docs

clean: ## remove caches and runs, keep .venv
	rm -rf runs build .pytest_cache .mypy_cache .ruff_cache
