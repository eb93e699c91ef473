"""DINOv2 against facts of its architecture."""

from __future__ import annotations

import pytest
import torch

from r3dpa.features import DINOv2

SMALL = {"dim": 16, "depth": 2, "num_heads": 2, "grid_size": 4}


@pytest.fixture
def network():
    torch.manual_seed(0)
    return DINOv2(**SMALL).eval()


def test_the_default_has_the_keys_and_size_of_vitb14():
    with torch.device("meta"):
        state = DINOv2().state_dict()
    assert (len(state), sum(value.numel() for value in state.values())) == (175, 86_580_480)
    assert state["pos_embed"].shape == (1, 1370, 768)
    assert state["patch_embed.proj.weight"].shape == (768, 3, 14, 14)
    assert {"mask_token", "blocks.11.attn.qkv.bias", "blocks.0.ls1.gamma"} <= state.keys()


@torch.no_grad()
def test_features_of_any_grid_are_normalised_and_use_the_image(network):
    image = torch.rand(2, 3, 32, 32) * 2 - 1
    for grid_size in ((4, 4), (2, 6)):
        features = network(image, grid_size)
        assert features.shape == (2, grid_size[0] * grid_size[1], 16)
        assert torch.allclose(features.mean(dim=-1), torch.zeros(()), atol=1e-5)
    assert not torch.allclose(features[0], features[1])


@torch.no_grad()
def test_weights_are_loaded_strictly(network, tmp_path):
    path = tmp_path / "dinov2.pth"
    torch.save(network.state_dict(), path)
    image = torch.rand(1, 3, 28, 28)
    twin = DINOv2(str(path), **SMALL).eval()
    assert torch.equal(twin(image, (2, 2)), network(image, (2, 2)))
    assert twin.trained
    assert not network.trained
    state = dict(network.state_dict(), register_tokens=torch.zeros(1, 4, 16))
    torch.save(state, path)
    with pytest.raises(ValueError, match=r"dinov2\.pth as DINOv2 of width 16 and 2 .*register_tok"):
        DINOv2(str(path), **SMALL)
    with pytest.raises(ValueError, match=r"no such file; give a released dinov2_vit.14_pretrain"):
        DINOv2(str(tmp_path / "none.pth"), **SMALL)
