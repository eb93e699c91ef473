"""Import paths of earlier versions: checkpoints, YAML files and command lines that name them."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest
import torch

from r3dpa.checkpoints import NetworkState, read_checkpoint
from r3dpa.class_paths import MOVED, current_path, with_current_paths
from r3dpa.cli.parser import Parser
from r3dpa.features import WaffleIron
from r3dpa.pretrained import DEFAULT_WEIGHTS

# As version 0.1.0 writes them to checkpoints and configurations, or has them in its own YAML.
WRITTEN_BEFORE = [
    "r3dpa.nn.VAE",
    "r3dpa.nn.SiT",
    "r3dpa.nn.UNet",
    "r3dpa.nn.ImageVAE",
    "r3dpa.nn.ThinDecoder",
    "r3dpa.nn.PatchDiscriminator",
    "r3dpa.nn.LatentNorm",
    "r3dpa.nn.vae.VAE",
    "r3dpa.nn.sit.SiT",
    "r3dpa.nn.latent_norm.LatentNorm",
    "r3dpa.nn.velocity_network.EMA",
    "r3dpa.nn.backbones.DINOv2",
    "r3dpa.nn.backbones.GeometricFeatures",
    "r3dpa.nn.backbones.Masking",
    "r3dpa.nn.backbones.ScaLR",
    "r3dpa.nn.backbones.WaffleIron",
    "r3dpa.nn.backbones.WaffleIronS",
    "r3dpa.nn.backbones.waffleiron.WaffleIron",
    "r3dpa.nn.backbones.point_features.WaffleIronS",
    "r3dpa.nn.backbones.vit.DINOv2",
    "r3dpa.baselines.LiDM",
    "r3dpa.baselines.LiDMFirstStage",
    "r3dpa.baselines.ReflowPairs",
    "r3dpa.baselines.efficient_unet.EfficientUNet",
    "r3dpa.baselines.hdit.HDiT",
    "r3dpa.baselines.lidm_networks.LiDMUNet",
    "r3dpa.baselines.lidm_networks.VQAutoencoder",
    "r3dpa.flow.diffusion.DiffusionPath",
    "r3dpa.geometry.RingProjection",
    "r3dpa.geometry.scan_geometry.RangeCodec",
    "r3dpa.data.LidarDataModule",
    "r3dpa.data.SimulatedDataModule",
    "r3dpa.data.SimulatedImageDataModule",
    "r3dpa.data.objects.ObjectLibrary",
    "r3dpa.modules.JointAlignment",
    "r3dpa.simulation.Simulator",
    "r3dpa.simulation.SpinningLidar",
    "r3dpa.simulation.sensor.SpinningLidar",
    "r3dpa.weather.Weather",
    "r3dpa.weather.WeatherPrior",
    "r3dpa.weather.weather.WeatherPrior",
    "r3dpa.callbacks.StepGuard",
]


def class_at(path: str) -> type:
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)


@pytest.mark.parametrize("path", WRITTEN_BEFORE)
def test_a_class_of_an_earlier_version_is_found(path):
    assert class_at(current_path(path)).__name__ == path.rpartition(".")[2]


def test_the_weather_of_the_simulator_has_another_name():
    """It was one of two classes called Weather."""
    for old in ("r3dpa.simulation.Weather", "r3dpa.simulation.scene.Weather"):
        assert current_path(old) == "lidarsim.scene.Conditions"
    assert current_path("r3dpa.weather.Weather") == "lidarsim.Weather"


@pytest.mark.parametrize(
    "text", ["r3dpa", "r3dpa.nn.backbonesque.X", "runs/r3dpa.nn.backbones", ""]
)
def test_other_text_stays(text):
    assert current_path(text) == text


def test_every_new_place_exists_and_the_table_is_short():
    for new in MOVED.values():
        module, _, name = new.rpartition(".")
        assert hasattr(import_module(module), name) if name[0].isupper() else import_module(new)
    assert len(MOVED) <= 40


def test_values_of_yaml_are_searched_through():
    before = {"a": [{"class_path": "r3dpa.nn.backbones.ScaLR.from_checkpoint"}, 3, None]}
    assert with_current_paths(before) == {
        "a": [{"class_path": "r3dpa.features.ScaLR.from_checkpoint"}, 3, None]
    }


def test_shipped_weights_are_read():
    checkpoint = read_checkpoint(DEFAULT_WEIGHTS)
    assert {"vae", "ema"} <= set(checkpoint.networks)
    checkpoint.networks["ema"].build()


def test_a_network_with_its_old_path_is_built_and_written_with_the_new_one():
    arguments = {"width": 16, "depth": 1, "cells": (8, 8, 4)}
    network = WaffleIron(**arguments)
    old = "r3dpa.nn.backbones.waffleiron.WaffleIron"
    state = NetworkState(old, arguments, network.state_dict())
    rebuilt = state.build()
    assert type(rebuilt) is WaffleIron
    assert all(map(torch.equal, rebuilt.state_dict().values(), network.state_dict().values()))
    assert state.config["class_path"] == "r3dpa.features.waffleiron.WaffleIron"


@pytest.mark.parametrize(
    "words",
    [
        ["--extractor", "r3dpa.nn.backbones.GeometricFeatures"],
        ["--extractor=r3dpa.nn.backbones.GeometricFeatures"],
        ["--config", "old.yaml"],
    ],
)
def test_a_configuration_with_old_paths_is_understood(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = "extractor: {class_path: r3dpa.nn.backbones.GeometricFeatures, init_args: {dim: 8}}\n"
    Path("old.yaml").write_text(text)
    parser = Parser(prog="test")
    parser.add_argument("--config", action="config")
    parser.add_argument("--extractor", type=torch.nn.Module)
    parsed = parser.parse_args(words)
    assert parsed.extractor.class_path == "r3dpa.features.GeometricFeatures"
