"""Hard cases of the alignment loss."""

from __future__ import annotations

from functools import partial

import pytest
import torch
import torch.nn.functional as F

from r3dpa.losses import alignment_loss

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
