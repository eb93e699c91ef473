"""Files of released weights: what is read of them, and errors that name file and weight."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import Any

import pytest
import torch

from r3dpa.features import ScaLR, WaffleIron, scalr
from r3dpa.features.official import key_renamer
from r3dpa.geometry import LidarSensor
from r3dpa.metrics.networks import (
    SPVCNN,
    LIPLoc,
    MinkowskiNet,
    RangeViT,
    liploc,
    minkowski,
    rangevit,
)

SENSOR = LidarSensor(beams=16, columns=64)
TRAINED = (16, 32)
WIDTHS = minkowski.scaled_widths(0.125)


@dataclass
class Release:
    """A network, the names in its released file, and how it is loaded."""

    build: Any
    official_name: Any
    load: Any
    removed: str  # weight that a broken file lacks
    cut: str  # weight that a broken file holds without its last row
    entry: str = "state_dict"  # of the file, that holds the weights

    def weights(self):
        torch.manual_seed(0)
        state = self.build().state_dict()
        return {self.official_name(key): value.clone() for key, value in state.items()}


VIT = {"width": 24, "depth": 2, "num_heads": 3}
RELEASES = {
    "rangevit": Release(
        lambda: RangeViT(SENSOR, 4, **VIT, skip_channels=6, trained_size=TRAINED),
        key_renamer(rangevit._NAMES),
        lambda path: RangeViT.from_checkpoint(path, SENSOR, num_heads=3, trained_size=TRAINED),
        "rangevit.encoder.blocks.1.norm2.bias",
        "rangevit.encoder.blocks.0.mlp.fc1.bias",
    ),
    "liploc": Release(
        lambda: LIPLoc(picture_side=32, patch_side=8, **VIT),
        lambda key: liploc._ENCODER + key_renamer(liploc._NAMES)(key),
        lambda path: LIPLoc.from_checkpoint(path, num_heads=3),
        "encoder_lidar.model.blocks.1.norm2.bias",
        "encoder_lidar.model.blocks.0.mlp.fc1.bias",
    ),
    "minkowski": Release(
        lambda: MinkowskiNet(WIDTHS),
        minkowski.official_name,
        MinkowskiNet.from_checkpoint,
        "stem.1.bias",
        "stem.1.weight",
    ),
    "spvcnn": Release(
        lambda: SPVCNN(WIDTHS),
        minkowski.official_name,
        SPVCNN.from_checkpoint,
        "point_transforms.0.0.bias",
        "stem.1.weight",
    ),
    "scalr": Release(
        lambda: WaffleIron(width=4, depth=3, head_dim=5),
        lambda key: "module." + scalr.official_name(key),
        ScaLR.from_checkpoint,
        "module.waffleiron.spatial_mix.1.scale.weight",
        "module.embed.final.bias",
        "model_point",
    ),
}


@pytest.fixture(params=RELEASES)
def release(request):
    return RELEASES[request.param]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "model.ckpt"


def assert_equal_weights(network, release, weights):
    loaded = {release.official_name(k): v for k, v in network.state_dict().items()}
    assert all(torch.equal(value, weights[key]) for key, value in loaded.items())


def test_networks_come_back_from_files(release, path):
    """The file may hold more than the weights, and a ScaLR loses its head."""
    weights = release.weights()
    torch.save({release.entry: weights, "epoch": 3, "optim": {"state": {}}}, path)
    network = release.load(path)
    assert_equal_weights(getattr(network, "network", network), release, weights)


def test_weights_that_do_not_fit_are_named(release, path):
    def refused(weights, message):
        torch.save({release.entry: weights}, path)
        with pytest.raises(ValueError, match=rf"model\.ckpt: .*{message}"):
            release.load(path)

    weights, name = release.weights(), release.removed.removeprefix("module.")
    value = weights.pop(release.removed)
    refused(weights, rf"1 missing .*{name.removeprefix(liploc._ENCODER)}")
    weights[release.removed] = value
    weights[release.cut] = weights[release.cut][:-1]
    refused(weights, r"has shape \(\d+,\), but \(\d+,\)")
    refused({}, r"(holds no|must hold one network|has neither)")


def test_files_that_are_no_checkpoint_are_named(release, path):
    with pytest.raises(ValueError, match=r"model\.ckpt: no such file"):
        release.load(path)
    torch.save({release.entry: release.weights()}, path, _use_new_zipfile_serialization=False)
    whole = path.read_bytes()
    for length in (1, 2, len(whole) // 2):  # each stops the reader in another way
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"model\.ckpt: is damaged"):
            release.load(path)
    path.write_bytes(pickle.dumps(print, protocol=2))  # would be imported by a plain torch.load
    with pytest.raises(ValueError, match=r"model\.ckpt: is damaged, or holds more"):
        release.load(path)
    torch.save({"other": 1}, path)
    with pytest.raises(ValueError, match=r"model\.ckpt: (holds no|must hold|has neither)"):
        release.load(path)


def test_left_over_weights_are_named(path):
    for name in ("minkowski", "scalr"):
        release = RELEASES[name]
        torch.save({release.entry: release.weights() | {"extra": torch.ones(1)}}, path)
        with pytest.raises(ValueError, match=r"0 missing .* 1 unexpected \['extra'\]"):
            release.load(path)
    torch.save({"state_dict": RELEASES["minkowski"].weights()}, path)
    with pytest.raises(ValueError, match=r"do not fit this SPVCNN: 21 missing \['point_trans"):
        SPVCNN.from_checkpoint(path)


def test_a_sparse_network_among_other_modules(path):
    """Its prefix is removed, other weights are ignored, and two networks are refused."""
    release = RELEASES["minkowski"]
    weights = release.weights()
    wrapped = {f"model.{key}": value for key, value in weights.items()}
    torch.save({"state_dict": wrapped | {"loss.weight": torch.ones(2)}}, path)
    assert_equal_weights(release.load(path), release, weights)
    torch.save(weights | {"ema.stem.0.kernel": torch.ones(1)}, path)
    with pytest.raises(ValueError, match="2 weights are named"):
        release.load(path)


def test_constants_may_be_absent_from_the_file_of_rangevit(path):
    release = RELEASES["rangevit"]
    weights = {k: v for k, v in release.weights().items() if not k.startswith("image_")}
    torch.save({"state_dict": weights}, path)
    mean = release.load(path).image_mean.flatten()
    assert mean.tolist() == pytest.approx([11.274, 0.076, 0.246, -1.041, 0.215])


def test_number_of_heads_is_that_of_released_networks(path):
    """Heads are 64 wide in every released ViT; other widths need to be told."""
    release = RELEASES["liploc"]
    network = LIPLoc(picture_side=16, patch_side=8, width=128, depth=1, num_heads=2)
    state = {release.official_name(k): v for k, v in network.state_dict().items()}
    torch.save({"state_dict": state}, path)
    assert LIPLoc.from_checkpoint(path).encoder.blocks[0].attn.num_heads == 2
    torch.save({"state_dict": release.weights()}, path)
    with pytest.raises(ValueError, match="width 24 do not divide into heads of 64"):
        LIPLoc.from_checkpoint(path)


def test_scalr_of_a_file_is_frozen_and_known_by_its_weights(path):
    release = RELEASES["scalr"]
    torch.save({"model_points": release.weights()}, path)
    scalr = release.load(path)
    assert (scalr.dim, scalr.network.depth, scalr.name) == (4, 3, "scalr")
    assert not any(p.requires_grad for p in scalr.parameters())
    assert not scalr.train().network.embedding.norm.training
    assert release.load(path).settings == scalr.settings
    assert ScaLR(WaffleIron(width=4, depth=3)).settings != scalr.settings
    weights = release.weights()
    del weights["module.classif.weight"]
    torch.save({"model_point": weights}, path)
    with pytest.raises(ValueError, match="holds no WaffleIron with a head"):
        release.load(path)
