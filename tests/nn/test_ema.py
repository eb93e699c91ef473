"""Averages of SiT and latent statistics: how far they move, and what of them is copied."""

from __future__ import annotations

import math

import pytest
import torch
from tiny_networks import SIT_ARGS

from r3dpa.nn import EMA, LatentNorm, SiT

DECAY = 0.9999


@pytest.fixture
def sit():
    torch.manual_seed(0)
    return SiT(**SIT_ARGS)


@pytest.fixture
def norm():
    return LatentNorm(4)


@torch.no_grad()
def fill(network, value):
    for parameter in network.parameters():
        parameter.fill_(value)
    return network


def spread(network):
    """Smallest and largest of all parameters."""
    values = torch.cat([parameter.flatten() for parameter in network.parameters()])
    return values.min().item(), values.max().item()


@pytest.mark.numerics
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_thousand_updates_move_by_the_exact_amount(dtype, sit, norm):
    """From 1 towards 2 in 1000 steps of 1e-4: 2 - 0.9999^1000 = 1.09516712.

    The average of bfloat16 weights is float32: numbers of theirs near 1 are 2^-8 apart, so that a
    bfloat16 average would never leave 1.
    """
    ema = EMA(fill(sit, 1.0).to(dtype), norm, decay=DECAY)
    fill(sit, 2.0)
    for _ in range(1000):
        ema.update(sit, norm)
    assert {value.dtype for value in ema.sit.parameters()} == {torch.float32}
    exact = 1 - math.expm1(1000 * math.log1p(-(1 - DECAY)))
    assert spread(ema.sit) == pytest.approx((exact, exact), abs=2e-6)
    assert spread(sit) == (2.0, 2.0)


@pytest.mark.numerics("integer buffers")
@pytest.mark.parametrize(("buffers", "expected"), [("copy", 5.0), ("decay", 2.0)])
def test_floating_point_buffers_are_copied_or_decayed(buffers, expected, sit, norm):
    """Statistic 1 becomes 5: copied 5, decayed 0.75 * 1 + 0.25 * 5 = 2. Counts are copied."""
    norm.running_mean.fill_(1.0)
    ema = EMA(sit, norm, decay=0.75, buffers=buffers)
    norm.running_mean.fill_(5.0)
    norm.num_batches_tracked.fill_(7)
    ema.update(sit, norm)
    assert ema.latent_norm.running_mean.tolist() == [expected] * 4
    assert ema.latent_norm.num_batches_tracked.item() == 7
    assert ema.latent_norm.num_batches_tracked.dtype == torch.long


@pytest.mark.numerics
def test_copied_statistics_keep_up_with_a_drifting_vae(sit, norm):
    """Latents whose standard deviation grows from 1 to 1.1 in 20 000 steps of momentum 0.1.

    Copied statistics end within 0.5 % of the truth; averaged ones, with the official decay, lag
    by 3.9 % (numerics.md section 5).
    """
    averages = {kind: EMA(sit, norm, DECAY, kind) for kind in ("copy", "decay")}
    num_steps, stride = 20_000, 100
    for step in range(0, num_steps, stride):
        # 100 steps at once, of batch norm and of the average: both are geometric sums.
        true_std = 1.0 + 0.1 * (step + stride) / num_steps
        norm.running_var.lerp_(torch.tensor(true_std**2), 1 - 0.9**stride)
        for average in averages.values():
            average.decay = DECAY**stride
            average.update(sit, norm)
    deviation = {
        kind: average.latent_norm.running_var.sqrt().max().item() / 1.1 - 1
        for kind, average in averages.items()
    }
    assert abs(deviation["copy"]) < 0.005
    assert deviation["decay"] == pytest.approx(-0.039, abs=0.003)


def test_reset_takes_the_present_weights(sit, norm):
    ema = EMA(fill(sit, 2.0), norm)
    fill(sit, 6.0)
    norm.update(torch.randn(2, 4, 2, 4))
    ema.reset(sit, norm)
    for own, weights in ((ema.sit, sit), (ema.latent_norm, norm)):
        torch.testing.assert_close(own.state_dict(), weights.state_dict(), atol=0, rtol=0)


def test_averages_are_frozen_copies_in_evaluation_mode(sit, norm):
    ema = EMA(sit.train(), norm)
    own = {tensor.data_ptr() for tensor in (*ema.parameters(), *ema.buffers())}
    given = (*sit.parameters(), *sit.buffers(), *norm.buffers())
    assert own.isdisjoint(tensor.data_ptr() for tensor in given)
    torch.nn.ModuleList([ema]).train()
    assert not any(module.training for module in ema.modules())
    assert not any(parameter.requires_grad for parameter in ema.parameters())
    assert sit.training
    assert all(parameter.requires_grad for parameter in sit.parameters())


def test_arguments_out_of_range_are_refused(sit, norm):
    for decay in (1.0, -0.1):
        with pytest.raises(ValueError, match=rf"decay must be in \[0, 1\), got {decay}"):
            EMA(sit, norm, decay=decay)
