"""Hard cases of the latent statistics and of the averages of the weights."""

from __future__ import annotations

import copy

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import LATENT_CHANNELS, TinyData, batch_of, drawn, fit, module, vae
from torch import nn

from r3dpa.generation import SceneGenerator
from r3dpa.nn import EMA, LatentNorm

pytestmark = pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")
FEW = settings(derandomize=True, max_examples=15, deadline=None, database=None)
DTYPES = [torch.float32, torch.bfloat16, torch.float16]
EXPONENTS = st.lists(st.floats(-6.0, 6.0), min_size=3, max_size=3)


def latents_of(scale, mean, seed=0):
    return mean[:, None, None] + scale[:, None, None] * drawn(seed, 2, len(scale), 4, 6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.numerics("infinite latent")
def test_a_variance_beyond_float32_leaves_the_statistics_alone(dtype):
    """Latents of 1e20 are finite, but their variance of 1e40 is not in float32."""
    ours, plain = LatentNorm(3), nn.BatchNorm2d(3, affine=False)
    ours.update(drawn(0, 2, 3, 4, 6).to(dtype))
    before, far = copy.deepcopy(ours.state_dict()), (1e20 * drawn(1, 2, 3, 4, 6)).to(dtype)
    assert far.isfinite().all()
    assert ours.update(far).isfinite().all()
    torch.testing.assert_close(ours.state_dict(), before, atol=0, rtol=0)
    for latents in (far, drawn(2, 2, 3, 4, 6)):
        plain(latents.float())
    assert not plain.running_var.isfinite().any()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("tiny variance")
def test_denormalising_undoes_normalising_whatever_the_statistics(dtype):
    """Variances of 1e-6 to 1e6 and means of up to 10 deviations, latents of any precision."""
    worst = []

    @FEW
    @given(exponents=EXPONENTS, means=st.lists(st.floats(-10, 10), min_size=3, max_size=3))
    def check(exponents, means):
        scale = 10 ** torch.tensor([e / 2 for e in exponents])
        norm, legacy = LatentNorm(3), LatentNorm(3, legacy_inverse=True)
        for one in (norm, legacy):
            one.running_var.copy_(scale.square())
            one.running_mean.copy_(torch.tensor(means) * scale)
        latents = latents_of(scale, norm.running_mean).to(dtype)
        unit = (norm.running_var + norm.eps).sqrt()[:, None, None]
        restored = norm.denormalise(norm.normalise(latents))
        assert ((restored - latents.float()) / unit).abs().max() < 1e-5
        off = (legacy.denormalise(legacy.normalise(latents)) - latents.float()) / unit
        worst.append(off.abs().max().item())

    check()
    assert max(worst) > 0.01


@pytest.mark.numerics("batch of one")
def test_a_batch_of_one_scan_trains_and_one_number_is_refused():
    made = fit(module(), [batch_of(0, size=1)])
    assert made.latent_norm.num_batches_tracked == 1
    assert all(value.isfinite().all() for value in made.state_dict().values())
    single = drawn(0, 1, 3, 1, 1)
    norm = LatentNorm(3)
    with pytest.raises(ValueError, match=r"at least two values per channel.*larger batch"):
        norm.update(single)
    assert not norm.fitted
    squares = (single - single.mean((0, 2, 3), keepdim=True)).square().sum((0, 2, 3))
    running = torch.ones(3).lerp(squares / (single.numel() / 3 - 1), 0.1)
    assert running.isnan().all()


@pytest.mark.numerics("integer buffers")
def test_the_count_of_batches_is_copied():
    """Averaged and rounded down, a count that grows by one would never reach the next number."""
    made = module(ema_decay=0.9999)
    for kind in ("copy", "decay"):
        norm = LatentNorm(LATENT_CHANNELS)
        ema = EMA(made.sit, norm, 0.9999, kind)
        averaged = norm.num_batches_tracked.clone()
        for seed in range(20):
            norm.update(drawn(seed, 2, LATENT_CHANNELS, 4, 8))
            ema.update(made.sit, norm)
            averaged = (0.9999 * averaged + 0.0001 * norm.num_batches_tracked).long()
        assert torch.equal(ema.latent_norm.num_batches_tracked, norm.num_batches_tracked)
        assert ema.latent_norm.fitted
    assert averaged == 0
    with pytest.raises(RuntimeError, match="can't be cast"):
        norm.num_batches_tracked.mul_(0.9999)


@pytest.mark.numerics("statistics before any update")
def test_sampling_with_fresh_statistics_is_refused():
    made = module()
    norm, raw = LatentNorm(LATENT_CHANNELS), 0.2 * drawn(0, 8, LATENT_CHANNELS, 4, 8) + 3
    with pytest.raises(ValueError, match=r"never fitted.*joint or flow_matching"):
        SceneGenerator(vae(), made.sit, norm, TinyData.geometry)
    norm.update(raw)
    SceneGenerator(vae(), made.sit, norm, TinyData.geometry)
    silent = nn.BatchNorm2d(LATENT_CHANNELS, affine=False).eval()(raw)
    assert silent.mean() > 2.9
    assert silent.std() < 0.21


@pytest.mark.parametrize("stage", ["joint", "vae_alignment"])
@pytest.mark.numerics("statistics updated twice in a step")
def test_a_step_moves_the_statistics_once(stage):
    """Both passes see the latents; after two steps the count is 2, the momentum applied twice."""
    batches = [batch_of(0), batch_of(7)]
    seen = []
    made = module(stage)
    update = made.latent_norm.update
    made.latent_norm.update = lambda latents: (seen.append(latents.clone()), update(latents))[1]
    fit(made, batches)
    assert made.latent_norm.num_batches_tracked == len(seen) == 2
    once, twice = nn.BatchNorm2d(LATENT_CHANNELS), nn.BatchNorm2d(LATENT_CHANNELS)
    for latents in seen:
        once(latents)
        twice(latents)
        twice(latents)
    torch.testing.assert_close(made.latent_norm.running_var, once.running_var)
    assert ((twice.running_var - once.running_var) / once.running_var).abs().max() > 0.03
