from __future__ import annotations

from functools import partial

import pytest
import torch
import torch.nn.functional as F

from r3dpa.losses import (
    alignment_loss,
    balanced_generator_loss,
    centred_features,
    discriminator_loss,
    flow_matching_loss,
    generator_loss,
    reconstruction_loss,
)


def test_reconstruction_loss_is_a_mean_over_all_pixels():
    image = torch.zeros(2, 1, 1, 2)
    reconstruction = torch.tensor([1.0, -3.0, 0.0, 0.0]).view_as(image)
    assert reconstruction_loss(reconstruction, image).item() == 1.0
    assert reconstruction_loss(reconstruction, image, "l2").item() == 2.5
    with pytest.raises(ValueError, match="'l1' or 'l2', got 'huber'"):
        reconstruction_loss(reconstruction, image, "huber")


def test_generator_loss_is_minus_the_mean_logit():
    assert generator_loss(torch.tensor([1.0, 3.0])).item() == -2.0


def test_a_balanced_gradient_has_a_share_of_the_length_of_that_of_l1():
    image = torch.randn(3, 1, 4, 8, generator=torch.Generator().manual_seed(0)).requires_grad_()
    (expected,) = torch.autograd.grad(reconstruction_loss(image, torch.zeros(3, 1, 4, 8)), image)
    logits = -1e-3 * image.square()
    further = balanced_generator_loss(logits, image, 0.5)
    assert further.item() == generator_loss(logits).item()
    (found,) = torch.autograd.grad(further, image, retain_graph=True)
    lengths = [gradient.flatten(1).norm(dim=1) for gradient in (found, expected)]
    torch.testing.assert_close(lengths[0], 0.5 * lengths[1])
    directions = torch.nn.functional.cosine_similarity(found.flatten(1), image.flatten(1))
    torch.testing.assert_close(directions, torch.ones(3))
    # As of any loss: of two parts of a batch, or scaled against underflow.
    (both,) = torch.autograd.grad(image.sum() + further / 2, image)
    torch.testing.assert_close(both, 1 + found / 2)


def test_discriminator_loss_vanishes_beyond_the_margins():
    assert discriminator_loss(torch.full((4,), 1.5), torch.full((4,), -1.5)).item() == 0.0
    assert discriminator_loss(torch.zeros(4), torch.zeros(4)).item() == 1.0
    # Real patches miss the margin by 0 and 3, fake ones by 0, 1 and 2.
    real, fake = torch.tensor([2.0, -2.0]), torch.tensor([-2.0, 0.0, 1.0])
    assert discriminator_loss(real, fake).item() == 1.25


def test_flow_matching_loss_is_one_mean_per_sample():
    target = torch.zeros(2, 1, 1, 2)
    velocity = torch.tensor([1.0, 3.0, 0.0, 2.0]).view_as(target)
    assert flow_matching_loss(velocity, target).tolist() == [5.0, 2.0]


def test_alignment_loss_is_minus_the_cosine_at_any_length():
    features = torch.randn(3, 5, 16)
    orthogonal = torch.tensor([[[0.0, 2.0]]]), torch.tensor([[[3.0, 0.0]]])
    torch.testing.assert_close(alignment_loss(7 * features, 0.1 * features), -torch.ones(3))
    torch.testing.assert_close(alignment_loss(-features, features), torch.ones(3))
    assert alignment_loss(*orthogonal).tolist() == [0.0]


@pytest.mark.numerics
def test_empty_cells_weaken_the_alignment_loss_unless_skipped():
    features = torch.randn(2, 4, 8)
    grid = features.clone()
    grid[0, :2] = 0.0
    grid[1] = 0.0
    torch.testing.assert_close(alignment_loss(features, grid), torch.tensor([-0.5, 0.0]))
    skipped = alignment_loss(features, grid, skip_empty_cells=True)
    torch.testing.assert_close(skipped, torch.tensor([-1.0, 0.0]))
    torch.testing.assert_close(skipped[:1], alignment_loss(features[:1, 2:], grid[:1, 2:]))


def test_cell_whose_features_sum_to_zero_is_not_empty():
    grid = torch.tensor([[[1.0, -1.0], [0.0, 0.0]]])
    assert alignment_loss(grid, grid, skip_empty_cells=True).item() == pytest.approx(-1)
    centred = centred_features(torch.tensor([[[1.0, -1.0], [3.0, 1.0], [0.0, 0.0]]]))
    assert centred.tolist() == [[[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]]]


@pytest.mark.numerics
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_the_velocity_loss_of_half_precision_is_finite(dtype):
    large = (400 * torch.randn(2, 3, 768)).to(dtype)
    assert flow_matching_loss(large, -large).isfinite().all()
    assert large.half().square().sum(-1).isinf().all()


HALF = [torch.bfloat16, torch.float16]


def gradient_of(loss, projected, grid):
    leaf = projected.clone().requires_grad_()
    return torch.autograd.grad(loss(leaf, grid).sum(), leaf)[0]


def normalised_loss(projected, grid):
    return -(F.normalize(projected, dim=-1) * F.normalize(grid, dim=-1)).sum(-1).mean(1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.numerics("vectors of length zero")
def test_gradient_at_zero_is_bounded_and_empty_cells_have_none(dtype):
    """Tokens of length zero beside targets, and targets of length zero beside tokens."""
    projected = torch.zeros(2, 4, 768, dtype=dtype)
    grid = torch.randn(2, 4, 768, generator=torch.Generator().manual_seed(0)).to(dtype)
    gradient = gradient_of(alignment_loss, projected, grid)
    assert gradient.isfinite().all()
    assert gradient.float().norm(dim=-1).max() <= 1e6 / 4 * 1.01  # 1 / eps, in a mean of 4
    grid[:, 1:] = 0
    tokens = torch.randn(2, 4, 768, generator=torch.Generator().manual_seed(1)).to(dtype)
    for skip in (False, True):
        loss = partial(alignment_loss, skip_empty_cells=skip)
        gradient = gradient_of(loss, tokens, grid)
        assert (gradient[:, 1:] == 0).all()
        assert (gradient[:, 0] != 0).any()
        assert (gradient_of(loss, projected, 0 * grid) == 0).all()
    wrong = gradient_of(normalised_loss, projected, grid).float().norm(dim=-1).max()
    assert wrong > 1e11


@pytest.mark.numerics("vectors of length zero")
def test_loss_of_float16_zeros_is_zero():
    """Inference only, a gradient of 1 / eps is beyond float16."""
    zeros = torch.zeros(2, 4, 768, dtype=torch.float16)
    assert (alignment_loss(zeros, torch.ones_like(zeros)) == 0).all()
    eps = torch.tensor(1e-12, dtype=torch.float16)
    assert (zeros / zeros.norm(dim=-1, keepdim=True).clamp_min(eps.item())).isnan().all()


@pytest.mark.parametrize("dtype", [torch.float32, *HALF])
@pytest.mark.numerics("cosine in half precision")
def test_cosine_is_exact_to_float32(dtype):
    generator = torch.Generator().manual_seed(0)
    projected, grid = torch.randn(2, 8, 128, 768, generator=generator).to(dtype)
    grid = (grid + projected).to(dtype)
    exact = -F.cosine_similarity(projected.double(), grid.double(), dim=-1).mean(dim=1)
    assert (alignment_loss(projected, grid).double() - exact).abs().max() < 1e-6
    own = alignment_loss(projected, projected)
    assert own.dtype == torch.float32
    assert (own + 1).abs().max() < 1e-6

    half = torch.bfloat16 if dtype == torch.float32 else dtype
    a, b = (F.normalize(values.to(half), dim=-1) for values in (projected, grid))
    cosines = (a * b).sum(dim=-1)
    wide = F.cosine_similarity(projected.to(half).double(), grid.to(half).double(), dim=-1)
    error = (cosines.double() - wide).abs().max()
    assert error > 1e-4
    assert ((a * a).sum(dim=-1) > 1).any()


@pytest.mark.parametrize("dtype", [torch.float32, *HALF])
@pytest.mark.numerics("scale of the features")
def test_large_and_small_features_have_the_cosine_of_their_directions(dtype):
    """Also beyond 2^64 in float32 and bfloat16, where squares are infinite, and at small scales."""
    generator = torch.Generator().manual_seed(0)
    projected, grid = torch.randn(2, 4, 16, 768, generator=generator).to(dtype)
    grid = (grid + projected).to(dtype)
    expected = alignment_loss(projected, grid)
    scales = [2.0**8, 2.0**-4] if dtype == torch.float16 else [2.0**8, 2.0**-4, 2.0**70]
    for scale in scales:  # powers of two: no rounding
        scaled = projected * scale
        torch.testing.assert_close(alignment_loss(scaled, grid), expected, atol=1e-6, rtol=1e-5)
        torch.testing.assert_close(
            alignment_loss(grid, scaled), alignment_loss(grid, projected), atol=1e-6, rtol=1e-5
        )
        assert gradient_of(alignment_loss, scaled, grid).isfinite().all()
    square = (projected * scales[-1 if dtype != torch.float16 else 0]).square().sum(dim=-1)
    assert square.isinf().all()
