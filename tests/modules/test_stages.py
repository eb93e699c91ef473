"""The stages through the real command line, at the size of conf/smoke.yaml."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import pytest
import torch
import yaml
from stage_runs import QUICK, STAGES, load
from tiny_networks import SIT_ARGS, VAE_ARGS

from r3dpa.cli import main
from r3dpa.data import read_scan
from r3dpa.modules import FlowMatching, JointAlignment
from r3dpa.nn import VAE, SiT

CSV = "--trainer.logger={class_path: CSVLogger, init_args: {save_dir: x, name: ''}}"


@pytest.fixture
def trained_run(request, smoke_args, from_previous, tmp_path):
    """``trained_run(stage)``: folder of a training, shared with other tests where there is one."""

    def folder(stage):
        if stage == "joint":
            return request.getfixturevalue("joint_run")
        if stage == "few_step":
            main(smoke_args(stage, tmp_path, *from_previous(stage), CSV))
            return tmp_path
        fixtures = {"vae_alignment": "vae_checkpoint", "flow_matching": "flow_checkpoint"}
        return request.getfixturevalue(fixtures[stage]).parents[1]

    return folder


@pytest.mark.parametrize("stage", STAGES)
def test_stage_trains_logs_and_draws(stage, trained_run, vae_checkpoint):
    run_dir = trained_run(stage)
    content = load(run_dir)
    assert content["global_step"] == 3
    assert content["r3dpa"]["stage"] == stage
    (metrics,) = run_dir.glob("version_*/metrics.csv")
    columns = set(metrics.read_text().splitlines()[0].split(","))
    expected = {
        "vae_alignment": {"reconstruction", "kl", "adversarial", "discriminator", "vae_alignment"},
        "joint": {"reconstruction", "vae_alignment", "discriminator", "denoising", "sit_alignment"},
        "flow_matching": {"denoising"},
        "few_step": {"denoising", "reconstruction"},
    }[stage]
    assert {f"train/{name}" for name in expected} <= columns
    networks = {"vae_alignment": 3, "joint": 3, "flow_matching": 1, "few_step": 2}[stage]
    assert sum(column.startswith("grad_norm/") for column in columns) == networks
    assert "val/range_error_m" in columns
    pictures = {path.name for path in (run_dir / "pictures").iterdir()}
    assert "val_reconstruction_0000003.png" in pictures
    assert ("val_samples_0000003.png" in pictures) == (stage != "vae_alignment")
    assert any(run_dir.glob("wandb/offline-run-*")) == (stage == "joint")
    if stage == "few_step":
        assert {"val/endpoint_1", "val/endpoint_4", "val/thin_return_iou"} <= columns
    elif stage == "flow_matching":  # VAE and latent statistics stay
        before = torch.load(vae_checkpoint, weights_only=True)["state_dict"]
        kept = [key for key in before if key.startswith(("vae.", "latent_norm."))]
        assert kept
        for key in kept:
            assert torch.equal(before[key], content["state_dict"][key]), key
    elif stage == "vae_alignment":
        assert content["state_dict"]["latent_norm.num_batches_tracked"] == 3


def starting(kind, vae_checkpoint, names):
    """A stage with the VAE of conf/smoke.yaml that starts from these networks."""
    networks = VAE(**VAE_ARGS), SiT(**SIT_ARGS)
    return kind(*networks, init_from=str(vae_checkpoint), init_networks=names)


def test_flow_matching_without_latent_statistics_is_refused(vae_checkpoint):
    module = starting(FlowMatching, vae_checkpoint, ["vae"])
    with pytest.raises(ValueError, match="init_networks name latent_norm"):
        module.load_previous_stage()


def test_networks_to_start_from_that_a_stage_lacks(vae_checkpoint):
    module = starting(JointAlignment, vae_checkpoint, ["ema"])
    with pytest.raises(ValueError, match="names 'ema', but the networks of this stage are vae, "):
        module.load_previous_stage()


def test_a_readout_trains_the_projection_head_alone(
    smoke_args, vae_checkpoint, from_previous, tmp_path
):
    more = [*QUICK, *from_previous("flow_matching"), "--model.init_args.train_blocks=false"]
    more += ["--model.init_args.init_networks=[vae,sit,latent_norm]"]
    more += ["--model.init_args.optimizer.lr=0.01"]
    with pytest.raises(ValueError, match=r"needs weights\.sit_alignment"):
        FlowMatching(VAE(**VAE_ARGS), SiT(**SIT_ARGS), train_blocks=False)
    weights = "--model.init_args.weights={denoising: 0.0, sit_alignment: 1.0}"
    main(smoke_args("flow_matching", tmp_path / "run", *more, weights))
    before = torch.load(vae_checkpoint, weights_only=True)["state_dict"]
    after = load(tmp_path / "run")["state_dict"]
    kept = [key for key in before if key in after]
    assert any(key.startswith("sit.blocks.") for key in kept)
    changed = {key for key in kept if not torch.equal(after[key], before[key])}
    assert changed
    assert all(key.startswith("sit.projector.") for key in changed)


def test_joint_starts_from_the_stage_before(smoke_args, vae_checkpoint, from_previous, tmp_path):
    """Without its discriminator. At learning rate 0 the weights are still there after a step."""
    still = ["--model.init_args.optimizer.lr", "0", *QUICK, "--trainer.max_steps=1"]
    still += ["--model.init_args.discriminator=null"]
    main(smoke_args("joint", tmp_path, *from_previous("joint"), *still))
    before = torch.load(vae_checkpoint, weights_only=True)["state_dict"]
    after = load(tmp_path)["state_dict"]
    for prefix in ("vae.", "sit."):
        keys = [key for key in before if key.startswith(prefix)]
        assert keys
        for key in keys:
            torch.testing.assert_close(after[key], before[key])
    torch.testing.assert_close(after["ema.sit.pos_embed"], before["sit.pos_embed"])


@pytest.mark.ddp
@pytest.mark.slow
@pytest.mark.parametrize("stage", STAGES)
def test_two_processes_equal_one_with_the_global_batch(stage, smoke_args, from_previous, tmp_path):
    """Same data, same draws, synchronised batch statistics: only the order of sums differs.

    A sum in another order changes a float32 gradient by about 1e-7 of its terms. AdamW divides by
    the gradient's own size, so where the true gradient is zero (biases in front of a group norm of
    one channel) it would turn that rounding into a full step; eps = 1e-3 keeps such steps at
    lr * 1e-7 / 1e-3. The leaky ReLUs of the discriminator have kinks: where rounding moves a value
    over one, a gradient moves by more (1.2e-5 of weight seen). Steps of about lr = 1e-2 must thus
    agree to 1e-4; batch norm over the own process alone would differ by more than 1e-3.
    """
    runs = {"one": (1, "2", "auto"), "two": (2, "1", "ddp")}
    contents = {}
    for name, (devices, batch_size, strategy) in runs.items():
        more = ["--trainer.devices", str(devices), "--data.init_args.batch_size", batch_size]
        more += ["--trainer.strategy", strategy, *QUICK, *from_previous(stage)]
        more += ["--model.init_args.optimizer", "{lr: 1.0e-2, eps: 1.0e-3}"]
        command = [sys.executable, "-m", "r3dpa", *smoke_args(stage, tmp_path / name, *more)]
        subprocess.run(command, check=True, timeout=300, capture_output=True)
        contents[name] = load(tmp_path / name)["state_dict"]
    torch.testing.assert_close(contents["two"], contents["one"], atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize(
    "command", [pytest.param("validate", marks=pytest.mark.slow), "test", "predict"]
)
def test_a_checkpoint_is_evaluated(command, smoke_args, vae_checkpoint, tmp_path, capsys, caplog):
    arguments = smoke_args("vae_alignment", tmp_path, "--ckpt_path", str(vae_checkpoint))
    with caplog.at_level("INFO"):
        main([command, *arguments[1:], "--trainer.logger=false"])
    assert ("vae_alignment has nothing to sample" in caplog.text) == (command == "test")
    assert not (tmp_path / "evaluation").exists()
    assert ("range_error_m" in capsys.readouterr().out) == (command != "predict")
    pictures = list((tmp_path / "pictures").glob(f"{command[:3]}*_reconstruction_*.png"))
    assert len(pictures) == (command != "predict")
    written = list((tmp_path / "reconstructions").rglob("*.bin"))
    assert len(written) == (12 if command == "predict" else 0)
    named = f"reconstructions: {tmp_path / 'reconstructions'}" in caplog.text
    assert named == (command == "predict")
    assert not (tmp_path / "config.yaml").exists()  # that of the training would be replaced
    assert all(len(read_scan(path)) > 0 for path in written)


def test_saved_config_names_what_ran(joint_run):
    config = yaml.safe_load((joint_run / "config.yaml").read_text())
    assert config["model"]["class_path"] == "r3dpa.modules.JointAlignment"
    assert config["trainer"]["max_steps"] == 3
    json.dumps(config)


def test_a_second_fit_does_not_mix_with_the_first(joint_run, smoke_args):
    before = (joint_run / "checkpoints" / "last.ckpt").read_bytes()
    with pytest.raises(ValueError, match=r"holds an earlier run.*--ckpt_path"):
        main(smoke_args("joint", joint_run, *QUICK))
    assert (joint_run / "checkpoints" / "last.ckpt").read_bytes() == before


def test_the_first_run_of_a_resumable_command_says_that_it_starts(smoke_args, tmp_path, caplog):
    more = [*QUICK, "--ckpt_path=last", "--model.init_args.sit.init_args.in_channels=8"]
    with caplog.at_level("INFO"), pytest.raises(ValueError, match="in_channels"):
        main(smoke_args("joint", tmp_path, *more))
    assert f"no checkpoint in {tmp_path}: training starts at step 0" in caplog.text


def test_a_refused_resume_keeps_the_configuration_of_the_run(joint_run, smoke_args, tmp_path):
    shutil.copytree(joint_run, tmp_path / "run")
    before = (tmp_path / "run" / "config.yaml").read_text()
    words = [*QUICK, "--ckpt_path=last", "--model.init_args.sit.init_args.projector_dim=24"]
    message = r"other networks: ema\.sit\.projector\..* is \[.*\] there, \[24.* here"
    with pytest.raises(ValueError, match=message):
        main(smoke_args("joint", tmp_path / "run", *words))
    assert (tmp_path / "run" / "config.yaml").read_text() == before


def test_resuming_keeps_the_given_settings(joint_run, smoke_args, tmp_path):
    """The command line decides, not the checkpoint, and config.yaml says what ran."""
    last = str(joint_run / "checkpoints" / "last.ckpt")
    resume = ["--trainer.max_steps", "4", "--model.init_args.optimizer.lr", "0.5"]
    resume += ["--model.init_args.ema_decay=0.7"]
    main(smoke_args("joint", tmp_path, *QUICK, *resume, "--ckpt_path", last))
    groups = load(tmp_path)["optimizer_states"][0]["param_groups"]
    assert [group["lr"] for group in groups] == [0.5, 0.5, 0.5]
    assert "ema_decay: 0.7" in (tmp_path / "config.yaml").read_text()
