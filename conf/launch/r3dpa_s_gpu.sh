#!/usr/bin/env bash
# `make r3dpa-s` and its control on one GPU and 16 cores, planned for a quarter of an hour and not run yet: larger
# batches than on a CPU, and side by side what does not wait for each other.
#
#   bash conf/launch/r3dpa_s_gpu.sh runs/r3dpa_s_gpu
#   TRIAL=1 bash conf/launch/r3dpa_s_gpu.sh runs/trial # two steps of each stage, on a CPU too
#
# The weights of each stage lie in FOLDER/weights as soon as it ends. The same call leaves out what is done and goes on
# where a stage was stopped.
set -euo pipefail
out=$1
scans=4000 workers=$(nproc)
[ -z "${TRIAL:-}" ] || scans=16
export OMP_NUM_THREADS=1
mkdir -p "$out/weights"

data=(--config conf/r3dpa_s_2/data.yaml --data.init_args.root "$out/data" --data.init_args.num_scans "$scans")
teacher=(--config conf/r3dpa_s_2/teacher.yaml)

# stage NAME STEPS BATCH WORDS...: train it and export its weights, unless they are there.
stage() {
  local name=$1 steps=$2 batch=$3
  shift 3
  [ ! -e "$out/weights/$name.safetensors" ] || return 0
  [ -z "${TRIAL:-}" ] || steps=2 batch=2
  r3dpa fit --config conf/trainer.yaml --config conf/r3dpa_s_2/trainer.yaml --ckpt_path last "${data[@]}" "$@" \
    --data.init_args.num_workers $((workers / 2)) --data.init_args.batch_size "$batch" \
    --trainer.max_steps "$steps" --trainer.enable_progress_bar false --checkpoint.every_n_train_steps 500 \
    --run_dir "$out/$name" >"$out/$name.log" 2>&1
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

r3dpa data prepare "${data[@]}" --data.init_args.num_workers "$workers" >"$out/data.log" 2>&1
r3dpa data features "${data[@]}" "${teacher[@]}" --data.init_args.num_workers $((workers / 2)) >"$out/features.log" 2>&1 &
features=$!
vae vae 1500 64
decoder control_decoder 700 64 --config conf/r3dpa_s_2/control_vae.yaml &
control=$!
decoder decoder 700 64
wait "$features"
wait "$control"

flow control_flow 3600 256 --config conf/r3dpa_s_2/control_flow.yaml \
  --model.init_args.init_from "$out/control_decoder/checkpoints/last.ckpt" \
  --model.init_args.latents_dir "$out/control_latents" &
control=$!
flow flow 3000 256 "${teacher[@]}" --model.init_args.init_from "$out/decoder/checkpoints/last.ckpt" \
  --model.init_args.latents_dir "$out/latents"
stage joint 600 32 "${teacher[@]}" --config conf/r3dpa_s_2/joint.yaml \
  --model.init_args.init_from "$out/flow/checkpoints/last.ckpt"
few=()
[ -z "${TRIAL:-}" ] || few=(--model.init_args.trajectories 4)
stage few_step 800 32 "${teacher[@]}" --config conf/r3dpa_s_2/flow_matching.yaml --config conf/r3dpa_s_2/few_step.yaml \
  --model.init_args.init_from "$out/joint/checkpoints/last.ckpt" "${few[@]}"
wait "$control"
