"""Our checkpoint files, those of Lightning, and what does not fit a network."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from torch import nn
from whole_checkpoint import EXACT, GEOMETRY, NETWORKS, SIT_ARGS, VAE_ARGS, assert_same_networks

from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    load_into,
    read_checkpoint,
    save_checkpoint,
)
from r3dpa.class_paths import current_network
from r3dpa.geometry import ScanGeometry
from r3dpa.nn.average_velocity import AverageVelocitySiT
from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT
from r3dpa.nn.vae import VAE


@pytest.fixture
def lightning_content(checkpoint):
    prefixes = {name: f"{name}." for name in NETWORKS}
    prefixes |= {"ema": "ema.sit.", "ema_latent_norm": "ema.latent_norm."}
    configs = {
        name: json.loads(json.dumps(state.config))
        for name, state in checkpoint.networks.items()
        if "ema" not in name
    }
    return {
        "pytorch-lightning_version": "2.6.6",
        "global_step": 30,
        "state_dict": {
            prefixes[name] + key: value
            for name, state in checkpoint.networks.items()
            for key, value in state.state_dict.items()
        },
        "hyper_parameters": {**configs, "_class_path": "r3dpa.modules.JointAlignment"},
        "r3dpa": {"stage": "joint", "geometry": GEOMETRY.to_dict(), "feature_source": "scalr"},
    }


def change_description(path, change):
    description = path.with_suffix(".yaml")
    about = yaml.safe_load(description.read_text())
    change(about)
    description.write_text(yaml.safe_dump(about))


class TestOurFiles:
    def test_round_trip(self, checkpoint, tmp_path):
        """Also of networks that share memory."""
        networks = {**checkpoint.networks, "ema": checkpoint.network("sit")}
        checkpoint = replace(checkpoint, networks=networks)
        path = save_checkpoint(checkpoint, tmp_path / "new" / "run.v1.safetensors")
        read = read_checkpoint(path)
        assert_same_networks(read, checkpoint)
        assert (read.stage, read.step) == ("joint", 30)
        assert ScanGeometry.from_dict(read.geometry) == GEOMETRY
        assert read.feature_source == "geometric"
        assert {p.name for p in path.parent.iterdir()} == {"run.v1.safetensors", "run.v1.yaml"}

    def test_nothing_is_overwritten_unless_asked(self, checkpoint, tmp_path):
        path = save_checkpoint(checkpoint, tmp_path / "a.safetensors")
        before = path.read_bytes()
        with pytest.raises(
            ValueError,
            match=r"a.safetensors and .*a.yaml exist already; .*--overwrite true .*=True",
        ):
            save_checkpoint(replace(checkpoint, networks={}), path)
        assert path.read_bytes() == before
        save_checkpoint(replace(checkpoint, step=31), path, overwrite=True)
        assert read_checkpoint(path).step == 31

    def test_a_failed_save_leaves_no_file(self, checkpoint, tmp_path):
        odd = replace(checkpoint, official_args={"device": torch.device("cpu")})
        with pytest.raises(yaml.YAMLError, match="cannot represent"):
            save_checkpoint(odd, tmp_path / "a.safetensors")
        with pytest.raises(ValueError, match=r"<name>.safetensors"):
            save_checkpoint(checkpoint, tmp_path / "a.pt")
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        ("damage", "message"),
        [
            (lambda p: p.write_bytes(p.read_bytes()[:-1] + b"x"), "SHA-256"),
            (lambda p: p.with_suffix(".yaml").unlink(), "not beside it"),
            (lambda p: p.with_suffix(".yaml").write_text("a: [1"), "damaged"),
            (lambda p: p.with_suffix(".yaml").write_text("a: 1"), "does not describe"),
            (lambda p: p.unlink(), "no checkpoint file"),
        ],
    )
    def test_damaged_files(self, checkpoint, tmp_path, damage, message):
        path = save_checkpoint(checkpoint, tmp_path / "a.safetensors")
        damage(path)
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            read_checkpoint(path)

    @pytest.mark.parametrize(
        "class_path",
        ["torch.nn.Linear", "r3dpa.nnx.SiT", "r3dpa.nn.sit.nn.Linear", "r3dpa.nn.vae.math", "SiT"],
    )
    def test_only_our_networks_are_built(self, checkpoint, tmp_path, class_path):
        path = save_checkpoint(checkpoint, tmp_path / "a.safetensors")
        networks = {"sit": {"class_path": class_path}}
        change_description(path, lambda about: about["networks"].update(networks))
        with pytest.raises(ValueError, match=class_path):
            read_checkpoint(path)

    def test_a_damaged_number_of_layers_is_refused_before_all_are_built(self, checkpoint, tmp_path):
        path = save_checkpoint(checkpoint, tmp_path / "a.safetensors")
        change_description(
            path, lambda about: about["networks"]["sit"]["init_args"].update(depth=3000)
        )
        with pytest.raises(ValueError, match=r"sit: depth of .* is 3000, far more than its"):
            read_checkpoint(path)

    def test_a_class_imported_into_our_package_is_not_ours(self, monkeypatch):
        monkeypatch.setattr("r3dpa.nn.Linear", nn.Linear, raising=False)
        state = NetworkState("r3dpa.nn.Linear", {"in_features": 1, "out_features": 1}, {})
        with pytest.raises(ValueError, match="not allowed"):
            state.new()
        with pytest.raises(ValueError, match="not allowed"):
            NetworkState.of(nn.Sequential(nn.Linear(1, 1)), {})

    def test_arguments_that_do_not_rebuild_the_network(self):
        with pytest.raises(ValueError, match=r"shape of main.0.weight.*\(4, 1, 4, 4\).*\(8, 1"):
            NetworkState.of(PatchDiscriminator(channels=4), {"channels": 8})
        with pytest.raises(ValueError, match="does not accept the arguments"):
            NetworkState.of(PatchDiscriminator(channels=4), {"width": 4})


class TestLightning:
    def test_round_trip(self, checkpoint, lightning_content, tmp_path):
        lightning_content["state_dict"]["metric.total"] = torch.zeros(1)
        torch.save(lightning_content, tmp_path / "last.ckpt")
        read = read_checkpoint(tmp_path / "last.ckpt")
        assert_same_networks(read, checkpoint)
        assert (read.stage, read.step, set(read.left_out)) == ("joint", 30, {"metric"})
        assert read.feature_source == "scalr"
        assert ScanGeometry.from_dict(read.geometry) == GEOMETRY

    def test_no_discriminator_and_a_default_latent_norm(self, lightning_content, tmp_path):
        weights = lightning_content["state_dict"]
        lightning_content["state_dict"] = {
            key: value for key, value in weights.items() if not key.startswith("discriminator.")
        }
        lightning_content["hyper_parameters"] |= {"discriminator": None, "latent_norm": None}
        torch.save(lightning_content, tmp_path / "last.ckpt")
        read = read_checkpoint(tmp_path / "last.ckpt")
        assert "discriminator" not in read.networks
        assert read.network("latent_norm").build().channels == 4

    @pytest.mark.parametrize(
        ("sit", "message"),
        [
            (None, r"which class and arguments its sit has.*r3dpa fit"),
            (SiT(**SIT_ARGS), r"would run r3dpa.nn.sit.SiT when loaded.*r3dpa fit"),
        ],
    )
    def test_networks_without_plain_arguments(self, lightning_content, tmp_path, sit, message):
        lightning_content["hyper_parameters"]["sit"] = sit
        torch.save(lightning_content, tmp_path / "last.ckpt")
        with pytest.raises(ValueError, match=message):
            read_checkpoint(tmp_path / "last.ckpt")


class TestLoadInto:
    def test_everything_that_does_not_fit_in_one_error(self, checkpoint):
        networks = {k: v for k, v in checkpoint.networks.items() if k != "discriminator"}
        source = replace(checkpoint, networks=networks, stage="flow_matching")
        sit = SiT(**{**SIT_ARGS, "feature_dim": 5, "depth": 2})
        targets = {"vae": VAE(**VAE_ARGS), "discriminator": PatchDiscriminator()}
        targets |= {"sit": sit, "latent_norm": LatentNorm(5)}
        before = copy.deepcopy(targets["vae"].state_dict())
        with pytest.raises(ValueError, match="joint cannot start") as caught:
            load_into(targets, source, stage="joint")
        text = str(caught.value)
        assert "of stage 'flow_matching' and has no discriminator" in text
        assert "joint needs: vae, discriminator, sit, latent_norm" in text
        assert "sit: shape of projector.4.weight: checkpoint (6, 10), network (5, 10)" in text
        assert "sit: unknown to the network: blocks.2.attn.qkv.weight (24, 8)" in text
        assert "latent_norm: shape of running_mean: checkpoint (4,), network (5,)" in text
        assert "vae:" not in text
        torch.testing.assert_close(targets["vae"].state_dict(), before, **EXACT)

    def test_long_lists_of_differences_are_shortened(self, checkpoint):
        deeper = SiT(**{**SIT_ARGS, "depth": 5})
        with pytest.raises(ValueError, match=r"sit: \.\.\. and 10 more"):
            load_into({"sit": deeper}, checkpoint, stage="joint")  # 20 keys: 10 per block

    @pytest.mark.parametrize(
        ("name", "changes", "message"),
        [
            ("sit", {"num_heads": 4}, "num_heads: checkpoint 2, network 4"),
            ("sit", {"alignment_depth": 3}, "alignment_depth: checkpoint 2"),
            ("sit", {"input_size": (8, 4)}, r"input_size: checkpoint \(4, 8\)"),
            ("vae", {"legacy_upsample": False}, "legacy_upsample: checkpoint True, network False"),
            ("vae", {"least_scale": 0.01}, r"least_scale: checkpoint 0\.00\d+, network 0\.01"),
            ("latent_norm", {"eps": 1e-5}, "eps: checkpoint 0.0001, network 1e-05"),
        ],
    )
    def test_settings_that_no_shape_shows(self, checkpoint, name, changes, message):
        kind, args = NETWORKS[name]
        with pytest.raises(ValueError, match=message):
            load_into({name: kind(**args | changes)}, checkpoint, stage="joint")


def test_guidance_among_the_arguments_of_a_sit_is_read_as_a_sampling_setting(tmp_path):
    """As version 0.1.0 wrote it, with the blocks of average velocities beside it."""
    sit = AverageVelocitySiT(1, **SIT_ARGS)
    state = NetworkState.of(sit, {"average_blocks": 1, **SIT_ARGS})
    content = Checkpoint(Path("few"), "few_step", {"ema": state})
    path = save_checkpoint(content, tmp_path / "few.safetensors")
    about = yaml.safe_load(path.with_suffix(".yaml").read_text())
    old = {"average_blocks": 1, "guidance_block": 2, "guidance_scale": 1.5}
    about["networks"]["ema"] = {"class_path": "r3dpa.nn.sit.SiT", "init_args": {**SIT_ARGS, **old}}
    del about["sampling"]
    path.with_suffix(".yaml").write_text(yaml.safe_dump(about))
    checkpoint = read_checkpoint(path)
    assert checkpoint.sampling == {"perturbed_attention": {"block": 2, "scale": 1.5}}
    assert isinstance(checkpoint.network("ema").build(), AverageVelocitySiT)
    about["networks"]["ema"]["init_args"] |= {"average_blocks": 0, "guidance_block": 0}
    plain = current_network(about["networks"]["ema"])
    assert plain == {"class_path": "r3dpa.nn.sit.SiT", "init_args": SIT_ARGS}
    shipped = read_checkpoint("r3dpa-s")
    assert shipped.sampling == {"perturbed_attention": {"block": 6, "scale": 1.2}}


@pytest.mark.parametrize("given", [{"encoding": "linear"}, {"sit_args": {"depth": 2}}])
def test_options_of_official_files_are_refused_for_ours(
    tmp_path, checkpoint, lightning_content, given
):
    """They would change nothing: the file records its encoding and its networks."""
    ours, lightning = tmp_path / "ours.safetensors", tmp_path / "last.ckpt"
    save_checkpoint(checkpoint, ours)
    torch.save(lightning_content, lightning)
    for path in (ours, lightning):
        read_checkpoint(path)
        message = rf"cannot read .*{path.name}: only official files need {next(iter(given))}, and"
        with pytest.raises(ValueError, match=message):
            read_checkpoint(path, **given)
