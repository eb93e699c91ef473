"""The two velocities of a SiT that guidance extrapolates from."""

from __future__ import annotations

import copy

import pytest
import torch
from tiny_networks import SIT_ARGS
from torch import nn

from r3dpa.nn import SiT

DEPTH = 3


class OwnValue(nn.Module):
    """Attention of each token to itself alone: its value, projected."""

    def __init__(self, attention):
        super().__init__()
        self.qkv, self.proj = attention.qkv, attention.proj

    def forward(self, tokens, mixed):
        width = tokens.shape[-1]
        return self.proj(tokens @ self.qkv.weight[2 * width :].T + self.qkv.bias[2 * width :])


def network(guidance_block):
    torch.manual_seed(0)
    sit = SiT(**SIT_ARGS | {"depth": DEPTH}, guidance_block=guidance_block)
    for parameter in sit.parameters():
        nn.init.normal_(parameter, std=0.3)
    return sit


@pytest.mark.parametrize("block", range(1, DEPTH + 1))
@pytest.mark.parametrize("times", [1, 3], ids=["one time", "a time of each sample"])
@torch.no_grad()
def test_they_are_the_velocity_and_that_without_attention_in_one_block(block, times):
    sit = network(block)
    x, rows = torch.randn(3, 4, 4, 16), sit.modulations(torch.tensor([0.3, 0.6, 0.9])[:times])
    strong, weak = sit.velocity_pair_at(x, rows)
    torch.testing.assert_close(strong, sit.velocity_at(x, rows), atol=1e-5, rtol=1e-5)

    changed = copy.deepcopy(sit)
    changed.blocks[block - 1].attn = OwnValue(sit.blocks[block - 1].attn)
    expected = changed.velocity_at(x, rows)
    torch.testing.assert_close(weak, expected, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(weak, strong, atol=1e-2)


@torch.no_grad()
def test_halved_networks_have_them_in_float32():
    sit = network(2)
    x, rows = torch.randn(2, 4, 4, 16), sit.modulations(torch.tensor([0.5]))
    exact = sit.velocity_pair_at(x, rows)
    for half, whole in zip(sit.halve_().velocity_pair_at(x, rows), exact, strict=True):
        assert half.dtype == torch.float32
        assert (half - whole).norm() < 0.05 * whole.norm()  # 8 bits of mantissa


def test_a_block_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match=r"guidance_block must lie in 0..depth = 0..3.*got 4 and"):
        network(4)
    with pytest.raises(ValueError, match="names no guidance_block"):
        network(0).velocity_pair_at(torch.randn(1, 4, 4, 16), torch.zeros(1, 1))
    with pytest.raises(ValueError, match=r"guidance_scale 2 needs a guidance_block"):
        SiT(**SIT_ARGS, guidance_scale=2.0)
    with pytest.raises(ValueError, match=r"guidance_scale be at least 1, got 1 and 0.5"):
        SiT(**SIT_ARGS, guidance_block=1, guidance_scale=0.5)
