"""The velocity of a SiT, and that with identity attention in one block."""

from __future__ import annotations

import copy

import pytest
import torch
from tiny_networks import SIT_ARGS
from torch import nn

from r3dpa.nn import SiT
from r3dpa.nn.perturbed_attention import velocity_and_perturbed

DEPTH = 3


class OwnValue(nn.Module):
    """Attention of each token to itself alone: its value, projected."""

    def __init__(self, attention):
        super().__init__()
        self.qkv, self.proj = attention.qkv, attention.proj

    def forward(self, tokens, identity_attention):
        width = tokens.shape[-1]
        return self.proj(tokens @ self.qkv.weight[2 * width :].T + self.qkv.bias[2 * width :])


def network():
    torch.manual_seed(0)
    sit = SiT(**SIT_ARGS | {"depth": DEPTH})
    for parameter in sit.parameters():
        nn.init.normal_(parameter, std=0.3)
    return sit


@pytest.mark.parametrize("block", range(1, DEPTH + 1))
@pytest.mark.parametrize("times", [1, 3], ids=["one time", "a time of each sample"])
@torch.no_grad()
def test_they_are_the_velocity_and_that_without_attention_in_one_block(block, times):
    sit = network()
    x, rows = torch.randn(3, 4, 4, 16), sit.modulations(torch.tensor([0.3, 0.6, 0.9])[:times])
    strong, weak = velocity_and_perturbed(sit, x, rows, block)
    torch.testing.assert_close(strong, sit.velocity_at(x, rows), atol=1e-5, rtol=1e-5)

    changed = copy.deepcopy(sit)
    changed.blocks[block - 1].attn = OwnValue(sit.blocks[block - 1].attn)
    expected = changed.velocity_at(x, rows)
    torch.testing.assert_close(weak, expected, atol=1e-5, rtol=1e-5)
    assert not torch.allclose(weak, strong, atol=1e-2)


@torch.no_grad()
def test_halved_networks_have_them_in_float32():
    sit = network()
    x, rows = torch.randn(2, 4, 4, 16), sit.modulations(torch.tensor([0.5]))
    exact = velocity_and_perturbed(sit, x, rows, 2)
    rounded = velocity_and_perturbed(sit.to_bfloat16_(), x, rows, 2)
    for half, whole in zip(rounded, exact, strict=True):
        assert half.dtype == torch.float32
        assert (half - whole).norm() < 0.05 * whole.norm()  # 8 bits of mantissa
