#!/usr/bin/env bash
# `make r3dpa-s` and its control on one GPU and 16 cores, in a quarter of an hour: larger batches than on
# a CPU, and side by side what does not wait for each other. The teacher is the one of the package.
#
#   bash conf/launch/r3dpa_s_gpu.sh runs/r3dpa_s_gpu
#
# The weights of each stage lie in FOLDER/weights as soon as it ends. The same call leaves out what is done.
# SCANS, WORKERS and STEPS (percent of the steps below) may be set before it.
set -euo pipefail
out=$1
scans=${SCANS:-4000} workers=${WORKERS:-16} percent=${STEPS:-100}
export OMP_NUM_THREADS=1
mkdir -p "$out/weights"

data=(--config conf/r3dpa_s_2/data.yaml --data.init_args.root "$out/data" --data.init_args.num_scans "$scans"
  --data.init_args.num_workers $((workers / 2)))
teacher=(--data.init_args.extractor '{class_path: r3dpa.features.WaffleIronS2, init_args: {dim: 128}}')

# stage NAME STEPS BATCH WORDS...: train it and export its weights, unless they are there.
stage() {
  local name=$1 steps=$(($2 * percent / 100)) batch=$3
  shift 3
  [ -e "$out/weights/$name.safetensors" ] && return
  r3dpa fit --config conf/trainer.yaml --config conf/r3dpa_s_2/trainer.yaml --ckpt_path last "${data[@]}" "$@" \
    --trainer.max_steps "$steps" --data.init_args.batch_size "$batch" --checkpoint.every_n_train_steps 500 \
    --trainer.enable_progress_bar false --run_dir "$out/$name" >"$out/$name.log" 2>&1
  r3dpa convert "$out/$name/checkpoints/last.ckpt" "$out/weights/$name.safetensors" --half --overwrite
}
vae() {
  stage "${@:1:3}" --config conf/r3dpa_s_2/vae_alignment.yaml --model.init_args.optimizer.lr 1.0e-3 "${@:4}"
}
decoder() {
  vae "${@:1:3}" --config conf/r3dpa_s_2/vae_decoder.yaml \
    --model.init_args.init_from "$out/vae/checkpoints/last.ckpt" "${@:4}"
}
flow() {
  stage "${@:1:3}" --config conf/r3dpa_s_2/flow_matching.yaml --model.init_args.optimizer.lr 1.0e-3 "${@:4}"
}

r3dpa data prepare "${data[@]}" --data.init_args.num_workers "$workers"
r3dpa data features "${data[@]}" "${teacher[@]}" --data.init_args.batch_size 8 >"$out/features.log" 2>&1 &
vae vae 1500 64
decoder control_decoder 700 64 --config conf/r3dpa_s_2/control_vae.yaml &
decoder decoder 700 64
wait

flow control_flow 3600 256 --config conf/r3dpa_s_2/control_flow.yaml \
  --model.init_args.init_from "$out/control_decoder/checkpoints/last.ckpt" \
  --model.init_args.latents_dir "$out/control_latents" &
flow flow 3000 256 "${teacher[@]}" --model.init_args.init_from "$out/decoder/checkpoints/last.ckpt" \
  --model.init_args.latents_dir "$out/latents"
stage joint 600 32 --config conf/r3dpa_s_2/joint.yaml "${teacher[@]}" \
  --model.init_args.init_from "$out/flow/checkpoints/last.ckpt"
stage few_step 800 32 "${teacher[@]}" --config conf/r3dpa_s_2/flow_matching.yaml --config conf/r3dpa_s_2/few_step.yaml \
  --model.init_args.init_from "$out/joint/checkpoints/last.ckpt"
wait
