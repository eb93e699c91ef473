from __future__ import annotations

import copy

import pytest
import torch
from draws import drawn
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from r3dpa.nn.latent_norm import LatentNorm


def raw_latents(batch=4, seed=0):
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([0.5, 1.0, 4.0])[:, None, None]
    return 3 + scale * torch.randn(batch, 3, 4, 6, generator=generator)


def test_update_and_normalise_are_the_two_modes_of_batch_norm():
    ours = LatentNorm(3).eval()  # the mode of the module plays no part
    plain = nn.BatchNorm2d(3, eps=1e-4, momentum=0.1, affine=False)
    assert list(ours.state_dict()) == list(plain.state_dict())
    for seed in range(3):
        latents = raw_latents(seed=seed).requires_grad_()
        twin = latents.detach().clone().requires_grad_()
        actual, expected = ours.update(latents), plain(twin)
        torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-5)
        actual.sin().sum().backward()
        expected.sin().sum().backward()
        torch.testing.assert_close(latents.grad, twin.grad, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(ours.state_dict(), plain.state_dict())
    before = copy.deepcopy(ours.state_dict())
    torch.testing.assert_close(ours.train().normalise(latents), plain.eval()(latents))
    ours.denormalise(latents)
    torch.testing.assert_close(ours.state_dict(), before, atol=0, rtol=0)


@pytest.mark.numerics
@pytest.mark.parametrize("value", [torch.inf, -torch.inf, torch.nan])
@pytest.mark.parametrize("replace", [False, True])
def test_a_broken_latent_leaves_the_statistics_alone(value, replace):
    norm = LatentNorm(3, replace_non_finite=replace)
    norm.update(raw_latents())
    before, broken = copy.deepcopy(norm.state_dict()), raw_latents(seed=1)
    broken[1, 2, 0, 3] = value
    result = norm.update(broken)
    assert result.isfinite().all() == replace
    assert norm.normalise(broken).isfinite().all() == replace
    torch.testing.assert_close(norm.state_dict(), before, atol=0, rtol=0)
    naive = nn.BatchNorm2d(3, affine=False)
    naive(torch.nan_to_num(torch.full((2, 3, 2, 2), torch.inf)) * torch.rand(2, 3, 2, 2))
    assert naive.running_var.isinf().all()  # and stays so for good


@pytest.mark.numerics
def test_statistics_survive_a_large_mean():
    latents = raw_latents() - 3
    far = 3000 + latents
    norm = LatentNorm(3, momentum=1.0)
    norm.update(far)
    expected = far.double().var((0, 2, 3))
    torch.testing.assert_close(norm.running_var.double(), expected, atol=0, rtol=1e-6)
    count = far.numel() // 3
    naive = (far.square().mean((0, 2, 3)) - far.mean((0, 2, 3)).square()) * count / (count - 1)
    assert ((naive - expected).abs() / expected).max() > 0.1


@pytest.mark.numerics
def test_a_later_update_does_not_change_the_backward_of_an_earlier_pass():
    def gradient(normalise, update):
        latents = raw_latents().requires_grad_()
        normalised = normalise(latents)
        update(raw_latents(seed=1))
        normalised.sum().backward()
        return latents.grad

    norm = LatentNorm(3)
    expected = torch.full((4, 3, 4, 6), 1.0001**-0.5)  # variance 1 of the fresh norm
    torch.testing.assert_close(gradient(norm.normalise, norm.update), expected)

    plain = nn.BatchNorm2d(3, affine=False)
    naive = gradient(lambda x: plain.eval()(x), lambda x: plain.train()(x))
    assert (naive - 1).abs().max() > 0.1


def test_half_precision_latents_are_normalised_in_float32():
    norm, latents = LatentNorm(3), raw_latents().bfloat16()
    with torch.autocast("cpu", torch.bfloat16):
        for result in (norm.update(latents), norm.normalise(latents), norm.denormalise(latents)):
            assert result.dtype == torch.float32
    twin = LatentNorm(3)
    twin.update(latents.float())
    assert torch.equal(norm.running_var, twin.running_var)


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
        for layer in (norm, legacy):
            layer.running_var.copy_(scale.square())
            layer.running_mean.copy_(torch.tensor(means) * scale)
        latents = latents_of(scale, norm.running_mean).to(dtype)
        unit = (norm.running_var + norm.eps).sqrt()[:, None, None]
        restored = norm.denormalise(norm.normalise(latents))
        assert ((restored - latents.float()) / unit).abs().max() < 1e-5
        off = (legacy.denormalise(legacy.normalise(latents)) - latents.float()) / unit
        worst.append(off.abs().max().item())

    check()
    assert max(worst) > 0.01


@pytest.mark.numerics("batch of one")
def test_statistics_of_one_number_per_channel_are_refused():
    single = drawn(0, 1, 3, 1, 1)
    norm = LatentNorm(3)
    with pytest.raises(ValueError, match=r"at least two values per channel.*larger batch"):
        norm.update(single)
    assert not norm.fitted
    squares = (single - single.mean((0, 2, 3), keepdim=True)).square().sum((0, 2, 3))
    assert (squares / (single.numel() / 3 - 1)).isnan().all()
