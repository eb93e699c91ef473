"""Checkpoints in the official layout, and conversion both ways."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from whole_checkpoint import (
    EXACT,
    NETWORKS,
    OFFICIAL_SIT_ARGS,
    SIT_ARGS,
    VAE_ARGS,
    assert_same_networks,
)

from r3dpa.checkpoints import (
    NetworkState,
    convert,
    from_official,
    read_checkpoint,
    save_checkpoint,
    to_official,
)
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn.sit import SiT
from r3dpa.nn.vae import VAE


class TestOfficial:
    @pytest.mark.parametrize(
        ("content", "message"), [({"weights": 1}, r"holds \['weights'\]; exp"), ([1], "holds list")]
    )
    def test_files_of_another_layout_are_refused(self, tmp_path, content, message):
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

    def test_options_beside_an_official_file_are_read(self, official, tmp_path):
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

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"in_channels": 2}, "has in_channels 2: only one with in_channels 1"),
            ({"in_channels": 2, "modes": 2}, "has in_channels 2"),
            ({"stem": (2, 2)}, r"has stem \(2, 2\): only one with stem \(1, 1\)"),
        ],
    )
    def test_a_vae_that_the_official_code_cannot_run_is_refused(self, checkpoint, changes, message):
        args = VAE_ARGS | changes
        networks = {"vae": NetworkState.of(VAE(**args), args)}
        with pytest.raises(ValueError, match=message):
            to_official(replace(checkpoint, networks=networks))

    def test_a_convolutional_projector_has_no_counterpart(self, checkpoint):
        args = SIT_ARGS | {"projector": "conv"}
        networks = dict(checkpoint.networks) | {"sit": NetworkState.of(SiT(**args), args)}
        with pytest.raises(ValueError, match=r"sit of .* has a convolutional projector"):
            to_official(replace(checkpoint, networks=networks))

    def test_an_export_of_averaged_weights_has_a_counterpart(self, checkpoint):
        names = ("vae", "ema", "ema_latent_norm")
        exported = replace(checkpoint, networks={name: checkpoint.network(name) for name in names})
        content = to_official(exported)
        assert {"vae", "ema"} <= set(content)
        assert content["args"].bn_momentum == 0.1

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

    def test_a_conversion_reports_what_it_left_out_and_overwrites_nothing(self, official, tmp_path):
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
