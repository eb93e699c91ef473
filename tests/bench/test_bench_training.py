"""Sizes of the shipped network configurations, and the bench of training steps at smoke size."""

from __future__ import annotations

import json
import os
import signal
from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml

from r3dpa.bench.training import STAGES, StepSettings, _measure, training

CONF = Path(__file__).resolve().parents[2] / "conf"
SIZES = {"s": (384, 12, 6), "b": (768, 12, 12), "l": (1024, 24, 16), "xl": (1152, 28, 16)}
SITS = [f"sit_{size}{patch}" for size in SIZES for patch in (1, 2, 4, 8)]
LATENTS = {
    "vae_h2p4d8": (8, 16, 128),
    "vae_h1p4d4": (4, 16, 256),
    "vae_h16d4": (4, 64, 64),
    "vae_h16p2d16": (16, 32, 32),
}


def build(name):
    """Network of conf/net without memory for its weights."""
    config = yaml.safe_load((CONF / "net" / f"{name}.yaml").read_text())
    module, _, kind = config["class_path"].rpartition(".")
    with torch.device("meta"):
        return getattr(import_module(module), kind)(**config["init_args"])


def count(network):
    return sum(parameter.numel() for parameter in network.parameters())


def test_every_shipped_network_is_checked_here():
    shipped = {path.stem for path in (CONF / "net").glob("*.yaml")}
    small = {"discriminator", "discriminator_demo", "sit_demo", "vae_demo"}
    # Built by the tests of the UNet, of image networks and of ablations.
    elsewhere = {"unet_lidm", "unet_small", "unet_demo", "sd_vae", "image_vae_demo"}
    elsewhere |= {"sit_rgb_b2", "sit_rgb_demo"}
    assert shipped == {*SITS, *LATENTS} | small | elsewhere


def test_parameters_of_the_paper_configuration():
    sit, vae = build("sit_b2"), build("vae_h2p4d8")
    with_position = count(sit) + sit.pos_embed.numel()
    assert with_position == 137_298_208
    assert with_position - count(sit.projector) == 129_953_312
    assert count(vae) == 59_660_649


@pytest.mark.parametrize("name", SITS)
def test_sit_config(name):
    sit, (width, depth, num_heads) = build(name), SIZES[name[4:-1]]
    patch = int(name[-1])
    values = 8 * patch**2  # of one token
    block = 18 * width**2 + 15 * width  # qkv 3, output 1, MLP 4 + 4, modulation 6
    embedders = values * width + width + 256 * width + width + width**2 + width + width
    head = 2 * width**2 + 2 * width + width * values + values
    projector = width * 2048 + 2048 + 2048**2 + 2048 + 2048 * 768 + 768
    assert count(sit) == depth * block + embedders + head + projector
    assert {block.attn.num_heads for block in sit.blocks} == {num_heads}
    assert (sit.in_channels, *sit.input_size) == LATENTS["vae_h2p4d8"]
    assert sit.grid_size == (16 // patch, 128 // patch)
    assert sit.feature_dim == 768


@pytest.mark.parametrize("name", LATENTS)
def test_vae_config(name):
    vae = build(name)
    image = torch.empty(1, 1, 64, 1024, device="meta")
    latents = vae.encode(image).mean
    assert latents.shape == (1, *LATENTS[name])
    assert (vae.latent_channels, *vae.latent_size((64, 1024))) == LATENTS[name]
    assert vae.decode(latents).shape == image.shape


@pytest.fixture(scope="module")
def small_conf(tmp_path_factory):
    """The shipped experiments with the networks of conf/smoke.yaml."""
    conf = tmp_path_factory.mktemp("conf")
    smoke = yaml.safe_load((CONF / "smoke.yaml").read_text())["model"]["init_args"]
    (conf / "experiment").mkdir()
    for stage in STAGES:
        config = yaml.safe_load((CONF / "experiment" / f"{stage}.yaml").read_text())
        arguments = config["model"]["init_args"] | smoke
        if "discriminator" in arguments:
            arguments["discriminator"] = str(CONF / "net" / "discriminator_demo.yaml")
        config["model"]["init_args"] = arguments
        (conf / "experiment" / f"{stage}.yaml").write_text(yaml.safe_dump(config))
        smaller = {"model": {"init_args": {"sit": {"init_args": {"hidden_size": 16}}}}}
        (conf / "experiment" / f"{stage}_demo.yaml").write_text(yaml.safe_dump(smaller))
    return conf


@pytest.fixture(scope="module")
def figures(small_conf, tmp_path_factory):
    out = tmp_path_factory.mktemp("bench") / "figures.json"
    settings = StepSettings(batch_size=2, steps=3, device="cpu")
    table = training(small_conf, ("vae_alignment", "flow_matching"), settings, out)
    return table, json.loads(out.read_text())


def test_bench_runs_every_step_of_every_stage(figures):
    _, content = figures
    assert [stage["stage"] for stage in content["stages"]] == ["vae_alignment", "flow_matching"]
    for stage in content["stages"]:
        assert len(stage["step_seconds"]) == 3
        assert all(0 < seconds < 60 for seconds in stage["step_seconds"])
        assert 0 < stage["loss"] < 100
        assert 2**27 < stage["peak_host_bytes"] < 2**32
        assert stage["peak_gpu_bytes"] is None


def test_bench_counts_what_each_stage_trains(figures):
    _, content = figures
    vae, flow = (stage["num_parameters"] for stage in content["stages"])
    position, patch_embed = 2 * 8 * 32, 4 * 2 * 2 * 32 + 32  # of the SiT in conf/smoke.yaml
    projector = 32 * 32 + 32 + 32 * 32 + 32 + 32 * 16 + 16
    for counts in (vae, flow):
        assert counts["sit"] - counts["sit_without_projector"] == projector
    assert vae["discriminator"] == count(build("discriminator_demo"))
    assert vae["trained"] == vae["vae"] + vae["discriminator"] + projector + patch_embed
    assert flow["discriminator"] == 0
    assert flow["trained"] == flow["sit_without_projector"] - position


def test_bench_table_says_the_same_as_the_file(figures):
    table, content = figures
    header, _, *rows = table.splitlines()
    assert header.split()[0] == "stage"
    for stage, row in zip(content["stages"], rows[:2], strict=True):
        cells = row.split()
        assert cells[0] == stage["stage"]
        assert cells[1] == f"{stage['num_parameters']['vae'] / 1e6:.2f}"
        assert cells[6] == f"{stage['step_seconds'][0]:.3g}"
        assert cells[7] == f"{sum(stage['step_seconds'][1:]) / 2:.3g}"  # median of two
        assert cells[8] == f"{stage['peak_host_bytes'] / 2**30:.2f}"
    assert f"torch {torch.__version__}" in rows[-1]
    assert content["settings"]["batch_size"] == 2
    assert content["machine"]["cpu"]


def test_speeds_follow_from_what_was_measured(figures):
    table, content = figures
    rows = [line.split() for line in table.splitlines()]
    for stage in content["stages"]:
        usual = sum(stage["step_seconds"][1:]) / 2
        assert stage["images_per_second"] == pytest.approx(2 / usual)
        assert stage["flop"] == sum(part["flop"] for part in stage["parts"].values()) > 0
        assert stage["loader_images_per_second"] > 0
        assert stage["variants"] is None
        (row,) = (r for r in rows if r[0] == stage["stage"] and r[1] == f"{2 / usual:.3g}")
        assert row[3] == f"{stage['flop'] / 2 / 1e9:.4g}"
    vae, flow = (set(stage["parts"]) for stage in content["stages"])
    parts = {"VAE encode", "VAE decode", "adversarial", "discriminator", "alignment", "optimiser"}
    assert vae == parts
    assert flow == {"SiT", "optimiser"}  # its latents are cached


def test_quick_compares_settings_on_the_small_networks(small_conf, tmp_path, monkeypatch):
    """In this process, so that two rounds do."""
    monkeypatch.setattr("r3dpa.bench.training._QUICK_ROUNDS", 2)
    monkeypatch.setattr("r3dpa.bench.training._in_new_process", _measure)
    settings, out = StepSettings(batch_size=2, steps=1, device="cpu"), tmp_path / "quick.json"
    table = training(small_conf, ("joint",), settings, out, quick=True)
    (stage,) = json.loads(out.read_text())["stages"]
    assert stage["num_parameters"]["sit"] < 40_000  # 72 384 at hidden size 32, here 16
    ratios = stage["variants"]["over_first"]
    assert len(ratios) == 4
    assert all(0 < r["low"] <= r["value"] <= r["high"] for r in ratios.values())
    assert "first case again" in table
    assert "fp32, contiguous, not fused" in table


def test_bench_names_a_missing_experiment(tmp_path):
    with pytest.raises(ValueError, match=r"experiment/joint\.yaml.*conf"):
        training(tmp_path, ("joint",))


def test_bench_refuses_no_steps():
    with pytest.raises(ValueError, match="at least 1, got 1 and 0"):
        StepSettings(steps=0)


def killed(*args):
    os.kill(os.getpid(), signal.SIGKILL)


def test_bench_says_which_stage_was_killed(small_conf, monkeypatch):
    monkeypatch.setattr("r3dpa.bench.training._measure", killed)
    with pytest.raises(RuntimeError, match=r"joint was killed.*batch_size 1"):
        training(small_conf, ("joint",))
