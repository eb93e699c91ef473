from __future__ import annotations

import pytest
import torch

from r3dpa.losses import (
    alignment_loss,
    balanced_gradient,
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
    further = balanced_gradient(image, 0.5).square().sum() * 1e-3
    (found,) = torch.autograd.grad(further, image, retain_graph=True)
    lengths = [gradient.flatten(1).norm(dim=1) for gradient in (found, expected)]
    torch.testing.assert_close(lengths[0], 0.5 * lengths[1])
    directions = torch.nn.functional.cosine_similarity(found.flatten(1), image.flatten(1))
    torch.testing.assert_close(directions, torch.ones(3))
    (both,) = torch.autograd.grad(image.sum() + further, image)
    torch.testing.assert_close(both, 1 + found)  # another loss keeps its gradient


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
