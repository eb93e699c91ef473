"""Our networks, scenes and training steps against those of a checkout of the official code."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from official_code import load_official
from official_networks import noise_of, random_networks, relative, sits, vaes
from official_scripts import save_for_official, write_official_scenes

from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import ScanGeometry

SIT = {
    "input_size": [4, 8],
    "hidden_size": 32,
    "depth": 2,
    "num_heads": 2,
    "alignment_depth": 1,
    "feature_dim": 12,
    "projector_dim": 16,
}
VAE = {"channels": 32, "num_res_blocks": 1}


@pytest.fixture(scope="module")
def repo() -> Path:
    """A checkout of valeoai/R3DPA, which is never part of this repository."""
    return Path(os.environ["R3DPA_OFFICIAL_REPO"])


@pytest.fixture(scope="module")
def code(repo):
    return load_official(repo)


@pytest.fixture
def networks():
    torch.manual_seed(0)
    return random_networks(SIT, VAE)


def test_another_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"is no unchanged checkout of commit aa08e6d"):
        load_official(tmp_path)


def test_import_leaves_no_module_and_no_file_behind(repo):
    def times():
        files = (path for path in repo.rglob("*") if ".git" not in path.parts)
        return {path: path.stat().st_mtime_ns for path in files}

    before = times()
    path, modules = list(sys.path), set(sys.modules)
    code = load_official(repo)
    assert code["samplers"].__file__ == str(repo / "samplers.py")
    assert not {name for name in set(sys.modules) - modules if "samplers" in name or "timm" in name}
    assert sys.path == path
    assert times() == before


def test_velocity_and_image_are_the_official_ones(code, networks):
    latents, time_ = torch.randn(2, 8, 4, 8), torch.tensor([0.9, 0.2])
    labels = torch.zeros(2, dtype=torch.long)
    net = sits(code, networks)
    with torch.no_grad():
        expected = net.theirs.inference(latents, time_, labels)
        assert relative(net.ours.velocity(latents, time_), expected) < 1e-5
        net = vaes(code, networks)
        assert relative(net.ours.decode(latents), net.theirs.decode(latents).sample) < 1e-5


def test_generate_script_writes_the_scenes_of_our_generator(code, networks, tmp_path):
    save_for_official(code, networks, tmp_path / "experiment")
    noise = noise_of(networks, 4, seed=0)
    range_m = write_official_scenes(
        code, networks, tmp_path / "experiment", tmp_path / "out", 4, 2, 3, noise
    )
    nets = [networks.network(name).build() for name in ("vae", "ema", "ema_latent_norm")]
    geometry = ScanGeometry.from_dict(networks.geometry)
    ours = SceneGenerator(*nets, geometry, SamplerConfig("euler", 3)).generate(range(4), 0).range_m
    valid = ours > 0
    assert valid.float().mean() > 0.5
    assert torch.allclose(torch.from_numpy(range_m)[valid], ours[valid], atol=1e-3)
    assert len(list((tmp_path / "out").glob("*/pcd/*.txt"))) == 4
    assert torch.is_grad_enabled()
