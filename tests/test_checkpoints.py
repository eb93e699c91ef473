import argparse
import copy
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from torch import nn

from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    convert,
    from_official,
    load_into,
    read_checkpoint,
    save_checkpoint,
    to_official,
    transfer_rgb,
)
from r3dpa.class_paths import current_network
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn.average_velocity import AverageVelocitySiT
from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT
from r3dpa.nn.unet import UNet
from r3dpa.nn.vae import VAE

EXACT = {"atol": 0, "rtol": 0}
SIT_ARGS = {"input_size": (4, 8), "in_channels": 4, "hidden_size": 8, "depth": 3, "num_heads": 2}
SIT_ARGS |= {"alignment_depth": 2, "feature_dim": 6, "projector_dim": 10}
VAE_ARGS = {"latent_channels": 4, "channels": 32, "channel_multipliers": (1, 2, 2)}
VAE_ARGS |= {"strides": ((1, 2), (2, 2)), "num_res_blocks": 1, "attention_levels": (1,)}
VAE_ARGS |= {"legacy_upsample": True}
GEOMETRY = ScanGeometry(SphericalProjection(LidarSensor(8, 32)), RangeCodec("log2"), (2, 4))
NETWORKS = {
    "vae": (VAE, VAE_ARGS),
    "discriminator": (PatchDiscriminator, {"channels": 4}),
    "sit": (SiT, SIT_ARGS),
    "latent_norm": (LatentNorm, {"channels": 4}),
    "ema": (SiT, SIT_ARGS),
    "ema_latent_norm": (LatentNorm, {"channels": 4}),
}


def randomised(network):
    for value in network.state_dict().values():
        value.copy_(torch.rand_like(value) if value.is_floating_point() else torch.tensor(7))
    return network


@pytest.fixture
def checkpoint():
    torch.manual_seed(0)
    networks = {
        name: NetworkState.of(randomised(kind(**args)), args)
        for name, (kind, args) in NETWORKS.items()
    }
    about = {"step": 30, "geometry": GEOMETRY.to_dict(), "feature_source": "geometric"}
    return Checkpoint(Path("run.ckpt"), "joint", networks, **about)


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


def assert_same_networks(actual, expected):
    assert set(actual.networks) == set(expected.networks)
    for name, state in expected.networks.items():
        own = actual.network(name)
        assert own.class_path == state.class_path
        assert own.arguments == state.arguments
        torch.testing.assert_close(own.state_dict, state.state_dict, **EXACT)


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
        with pytest.raises(ValueError, match=r"a.safetensors, .*a.yaml exists"):
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

    def test_long_lists_are_shortened(self, checkpoint):
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
            ("latent_norm", {"eps": 1e-5}, "eps: checkpoint 0.0001, network 1e-05"),
        ],
    )
    def test_settings_that_no_shape_shows(self, checkpoint, name, changes, message):
        kind, args = NETWORKS[name]
        with pytest.raises(ValueError, match=message):
            load_into({name: kind(**args | changes)}, checkpoint, stage="joint")


@pytest.fixture
def official(checkpoint):
    content = to_official(checkpoint)
    content["args"] = argparse.Namespace(vae="h2p2d4", encoder_depth=2, num_classes=1)
    return content


OFFICIAL_SIT_ARGS = {"num_heads": 2, "input_size": (4, 8)}


class TestOfficial:
    @pytest.mark.parametrize(
        ("content", "message"), [({"weights": 1}, r"holds \['weights'\]; exp"), ([1], "holds list")]
    )
    def test_something_else(self, tmp_path, content, message):
        torch.save(content, tmp_path / "a.pt")
        with pytest.raises(ValueError, match=message):
            read_checkpoint(tmp_path / "a.pt")

    def test_files_that_lack_an_argument_or_a_layer(self, official):
        del official["args"]
        with pytest.raises(ValueError, match=r"\['alignment_depth', 'input_size', 'num_heads'\]"):
            from_official(official, Path("a.pt"))
        with pytest.raises(ValueError, match="do not belong to an official network"):
            from_official({**official, "model": {"conv.weight": torch.zeros(1)}}, Path("a.pt"))

    def test_an_image_vae_is_left_out_by_name(self, official):
        official["vae"] = {"encoder.conv_in.weight": torch.zeros(8, 3, 3, 3)}
        read = from_official(official, Path("rgb.pt"), sit_args=OFFICIAL_SIT_ARGS)
        with pytest.raises(ValueError, match=r"no vae \(the file's VAE is not for range images"):
            read.network("vae")

    def test_options_beside_the_file(self, official, tmp_path):
        (tmp_path / "args.json").write_text(json.dumps(vars(official.pop("args"))))
        (tmp_path / "checkpoints").mkdir()
        torch.save(official, tmp_path / "checkpoints" / "a.pt")
        read = read_checkpoint(tmp_path / "checkpoints" / "a.pt", sit_args=OFFICIAL_SIT_ARGS)
        assert read.network("sit").init_args["alignment_depth"] == 2

    @pytest.mark.parametrize(
        ("config", "encoding"), [("kitti", "linear"), ("kitti_logscale", "log2"), ("other", None)]
    )
    def test_latent_size_and_geometry_of_the_official_image(self, checkpoint, config, encoding):
        sit_args = {**SIT_ARGS, "input_size": (32, 256)}
        sit = NetworkState.of(SiT(**sit_args), sit_args)
        networks = {name: checkpoint.network(name) for name in ("vae", "latent_norm")}
        content = to_official(replace(checkpoint, networks=networks | {"sit": sit}))
        content["args"] = argparse.Namespace(encoder_depth=2, dataset_config=f"c/{config}.yaml")
        read = from_official(content, Path("a.pt"), sit_args={"num_heads": 2})
        assert read.network("sit").init_args["input_size"] == [32, 256]
        if encoding is None:
            assert read.geometry is None
        else:
            codec, projection = RangeCodec(encoding), SphericalProjection(LidarSensor())
            expected = ScanGeometry(projection, codec, (16, 128))
            assert ScanGeometry.from_dict(read.geometry) == expected

    def test_a_vae_with_wrapped_upsampling_has_no_counterpart(self, checkpoint):
        args = {**VAE_ARGS, "legacy_upsample": False}
        networks = {"vae": NetworkState.of(VAE(**args), args)}
        with pytest.raises(ValueError, match="legacy_upsample=True"):
            to_official(replace(checkpoint, networks=networks))

    def test_options_are_made_from_our_arguments(self, checkpoint):
        args = vars(to_official(checkpoint)["args"])
        expected = {"vae": "h2p2d4", "num_classes": 1, "cfg_prob": 0.0, "encoder_depth": 2}
        assert args == expected | {"qk_norm": False, "bn_momentum": 0.1}
        official_sensor = ScanGeometry(SphericalProjection(LidarSensor()), RangeCodec(), (2, 4))
        content = to_official(replace(checkpoint, geometry=official_sensor.to_dict()))
        assert content["args"].dataset_config == "configs/kitti.yaml"
        small = {**SIT_ARGS, "hidden_size": 384, "depth": 12}
        sits = {name: replace(checkpoint.network(name), init_args=small) for name in ("sit", "ema")}
        content = to_official(replace(checkpoint, networks={**checkpoint.networks, **sits}))
        assert content["args"].model == "SiT-S/2"


class TestConvert:
    def test_a_vae_and_its_neighbours(self, checkpoint, tmp_path):
        kept = ("vae", "discriminator", "latent_norm")
        part = replace(checkpoint, networks={name: checkpoint.network(name) for name in kept})
        ours = save_checkpoint(part, tmp_path / "a.safetensors")
        report = convert(ours, tmp_path / "vae.pt", "official")
        names = {"vae.pt", "vae-latents-stats.pt", "vae-discriminator-ckpt.pt"}
        assert {path.name for path in tmp_path.glob("*.pt")} == names
        assert "not converted: sensor and encoding (official files of a VAE" in report
        statistics = torch.load(tmp_path / "vae-latents-stats.pt", weights_only=True)
        norm = checkpoint.network("latent_norm").state_dict
        assert statistics["latents_scale"].shape == (1, 4, 1, 1)
        scale = statistics["latents_scale"].flatten()
        torch.testing.assert_close(scale, 1 / norm["running_var"].sqrt())
        assert torch.equal(statistics["latents_bias"].flatten(), norm["running_mean"])
        back = read_checkpoint(tmp_path / "vae.pt")
        assert set(back.networks) == set(kept)
        for name in ("vae", "discriminator"):
            states = (each.network(name).state_dict for each in (back, part))
            torch.testing.assert_close(*states, **EXACT)
        norm_back = back.network("latent_norm").build()
        torch.testing.assert_close(norm_back.running_var, norm["running_var"])
        assert norm_back.fitted

    def test_a_training_checkpoint_and_back_keeps_all_facts(self, checkpoint, tmp_path):
        """Sensor, encoding, path and arguments; the official code finds its own entries only."""
        full = replace(checkpoint, interpolant="cosine")
        ours = save_checkpoint(full, tmp_path / "a.safetensors")
        convert(ours, tmp_path / "a.pt", "official")
        content = torch.load(tmp_path / "a.pt", weights_only=False)
        expected = to_official(read_checkpoint(ours))
        assert set(content) == {*expected, "r3dpa"}
        assert vars(content["args"]) == vars(expected["args"])
        convert(tmp_path / "a.pt", tmp_path / "b.safetensors")
        back = read_checkpoint(tmp_path / "b.safetensors")
        assert_same_networks(back, full)
        for name in ("stage", "step", "geometry", "feature_source", "interpolant"):
            assert getattr(back, name) == getattr(read_checkpoint(ours), name), name
        changed = from_official(content, Path("a.pt"), sit_args={"alignment_depth": 1})
        assert changed.network("ema").arguments["alignment_depth"] == 1

    def test_report_and_refusals(self, official, tmp_path):
        official["opt"] = {"state": {}}
        torch.save(official, tmp_path / "a.pt")
        out = tmp_path / "a.safetensors"
        table = convert(tmp_path / "a.pt", out, sit_args=OFFICIAL_SIT_ARGS)
        assert all(name in table for name in NETWORKS)
        assert "not converted: opt (optimiser of the SiT" in table
        read = read_checkpoint(out)
        assert (read.stage, read.step) == ("official", 30)
        assert read.official_args == vars(official["args"])
        assert read.network("latent_norm").init_args["legacy_inverse"] is True
        with pytest.raises(ValueError, match=r"a.pt exists already"):
            convert(out, tmp_path / "a.pt", "official")
        with pytest.raises(ValueError, match=r"<name>.pt"):
            convert(out, tmp_path / "b.ckpt", "official")


class TestTransfer:
    def source(self, **changes):
        args = {**SIT_ARGS, **changes}
        norm_args = {"channels": args["in_channels"]}
        networks = {
            "sit": NetworkState.of(randomised(SiT(**args)), args),
            "latent_norm": NetworkState.of(randomised(LatentNorm(**norm_args)), norm_args),
        }
        return Checkpoint(Path("rgb.pt"), "rgb", networks)

    def results(self, report):
        return {row.group: row.result for row in report}

    def test_a_twin_keeps_everything(self):
        source, sit, norm = self.source(), SiT(**SIT_ARGS), LatentNorm(4)
        report = transfer_rgb(source, sit, norm, keep_projector=True)
        assert set(self.results(report).values()) == {"kept"}
        torch.testing.assert_close(sit.state_dict(), source.network("sit").state_dict, **EXACT)
        norm_there = source.network("latent_norm").state_dict
        assert torch.equal(norm.running_mean, norm_there["running_mean"])

    @pytest.mark.parametrize(
        ("changes", "expected"),
        [
            # a new head may look at another block; as many tokens in another grid
            ({"feature_dim": 5, "alignment_depth": 1}, {"projector": "fresh"}),
            ({"input_size": (8, 4)}, {"pos_embed": "resized"}),
            (
                {"patch_size": 1},
                {"x_embedder": "fresh", "final_layer.linear": "fresh", "pos_embed": "resized"},
            ),
        ],
    )
    def test_what_does_not_fit_is_fresh(self, changes, expected):
        sit = randomised(SiT(**SIT_ARGS))
        before = {key: value.clone() for key, value in sit.state_dict().items()}
        rows = transfer_rgb(self.source(**changes), sit, LatentNorm(4), True)
        assert {row.group: row.result for row in rows if row.result != "kept"} == expected
        for key, value in sit.state_dict().items():
            assert torch.equal(value, before[key]) == key.startswith(tuple(expected)), key

    @pytest.mark.parametrize(("rows_there", "rows_here"), [(1001, 1), (1, 1), (2, 2)])
    def test_label_tables_of_other_lengths(self, rows_there, rows_here):
        def labels(rows):
            return {"num_classes": max(1, rows - 1), "class_dropout": rows > 1}

        source = self.source(**labels(rows_there))
        sit = randomised(SiT(**SIT_ARGS | labels(rows_here)))
        key = "y_embedder.embedding_table.weight"
        table = source.network("sit").state_dict[key]
        report = transfer_rgb(source, sit, LatentNorm(4), keep_projector=False)
        assert torch.equal(sit.state_dict()[key], table[:rows_here])
        kept = rows_there == rows_here
        assert self.results(report)["y_embedder"] == ("kept" if kept else "truncated")

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"depth": 4}, "unknown to the network: blocks.3"),
            ({"depth": 2}, "missing in the checkpoint: blocks.2"),
            ({"alignment_depth": 1}, "alignment_depth: checkpoint 1, network 2"),
            (
                {"hidden_size": 16, "num_classes": 2},  # label tables of other lengths and widths
                r"shape of y_embedder.embedding_table.weight: checkpoint \(2, 16\), network \(4, 8",
            ),
        ],
    )
    def test_anything_else_is_an_error_before_any_change(self, changes, message):
        sit = SiT(**SIT_ARGS | ({"num_classes": 4} if "num_classes" in changes else {}))
        before = copy.deepcopy(sit.state_dict())
        with pytest.raises(ValueError, match=message):
            transfer_rgb(self.source(**changes), sit, LatentNorm(4), keep_projector=True)
        torch.testing.assert_close(sit.state_dict(), before, **EXACT)

    def test_only_a_sit_has_rgb_weights(self):
        args = {"in_channels": 4, "input_size": (4, 8), "channels": 32, "feature_dim": 8}
        networks = {
            "sit": NetworkState.of(UNet(**args), args),
            "latent_norm": NetworkState.of(LatentNorm(4), {"channels": 4}),
        }
        source = Checkpoint(Path("unet.ckpt"), "flow_matching", networks)
        with pytest.raises(ValueError, match=r"unet\.ckpt holds a UNet, but .* to a SiT"):
            transfer_rgb(source, SiT(**SIT_ARGS), LatentNorm(4), keep_projector=False)


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
    assert shipped.sampling == {"perturbed_attention": {"block": 6, "scale": 1.5}}
