"""Perceptual loss: its value, cell by cell, and its gradient."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from test_range_losses import LabelledData, RangeData, range_module
from tiny_stages import QUIET, train

from r3dpa.features import WaffleIronS2, collate_scans
from r3dpa.geometry import (
    NUM_CLASSES,
    LidarSensor,
    RangeCodec,
    RingProjection,
    ScanGeometry,
    SphericalProjection,
    points_of,
)
from r3dpa.modules.perceptual import PerceptualLoss

pytestmark = QUIET
CODEC = RangeCodec("log2", return_channel=True, intensity_channel=True, num_classes=NUM_CLASSES)
GEOMETRY = ScanGeometry(SphericalProjection(LidarSensor(16, 128)), CODEC, (2, 4))


def images(seed, num=1):
    """Images of a round room of 10 m with bumps of half a metre, a tenth of its returns lost."""
    generator = torch.Generator().manual_seed(seed)
    bumps, intensity, lost = torch.rand(3, num, 16, 128, generator=generator)
    range_m = torch.where(lost < 0.1, -1.0, 10 + 0.5 * bumps)
    return CODEC.to_image(range_m, intensity)


def test_value_is_that_of_the_mean_tokens_of_cells_and_scan():
    made, scan = images(0), images(1)
    made[:, 1, 8:, 32:64] = -1.0  # no return in the sixth cell, which does not count
    network = WaffleIronS2()
    means, totals = [], []
    for image in (made, scan):
        pixels = CODEC.pixels_of(image[0], GEOMETRY.projection.sensor)
        points = points_of(pixels.range_m, GEOMETRY.projection, intensity=pixels.intensity)
        prepared = network.prepare(points)
        tokens = network.tokens(collate_scans([prepared]))
        row, column = GEOMETRY.projection.pixel_of(points[prepared.kept, :3])
        cells = row // 8 * 4 + column // 32
        means.append(torch.stack([tokens[cells == cell].mean(dim=0) for cell in range(8)]))
        totals.append(tokens.mean(dim=0))
    distances = (means[0] - means[1]).square().sum(dim=1)
    assert distances.isnan().nonzero().flatten().tolist() == [5]
    expected = distances.nanmean()
    expected += 10 * (totals[0] - totals[1]).square().sum()
    assert expected > 1
    loss = PerceptualLoss(GEOMETRY)(made, scan)
    torch.testing.assert_close(loss, expected, rtol=1e-4, atol=0)


def test_gradient_is_the_slope_of_the_loss():
    made, scan = images(0).requires_grad_(), images(1)
    loss = PerceptualLoss(GEOMETRY)
    (gradient,) = torch.autograd.grad(loss(made, scan), made)
    ranges, returns, intensity, classes = gradient[0]
    lost = made[0, 1] < 0
    for values in (ranges, intensity):
        assert values[~lost].abs().max() > 0
        assert not values[lost].any()
    assert not returns.any()
    assert not classes.any()

    step = 1e-3 * gradient / gradient.norm()
    with torch.no_grad():
        rise = loss(made + step, scan) - loss(made - step, scan)
    torch.testing.assert_close(rise / 2e-3, gradient.norm(), rtol=0.05, atol=0)


def test_same_images_have_no_distance_and_images_without_points_no_gradient():
    made, loss = images(0).requires_grad_(), PerceptualLoss(GEOMETRY)
    assert loss(made, made.detach()) == 0
    empty = CODEC.to_image(torch.full((1, 16, 128), -1.0), torch.zeros(1, 16, 128))
    (gradient,) = torch.autograd.grad(loss(made, empty), made)
    assert not gradient.any()


def test_images_of_rings_have_the_cells_of_their_pixels():
    """Their points are not in the order of rings that the projection needs."""
    rings = RingProjection(LidarSensor(16, 128), tuple(np.linspace(2, -24, 16)))
    loss = PerceptualLoss(ScanGeometry(rings, CODEC, (2, 4)))
    assert loss(images(0), images(1)) > 1


def test_half_precision_has_the_loss_of_float32():
    """With tokens a hundred times as large, their sum is beyond float16."""
    loss = PerceptualLoss(GEOMETRY)
    of_images = [loss._cell_means(images(seed)[0]) for seed in (0, 1)]
    large = itertools.cycle([(100 * means, counts) for means, counts in of_images])
    loss._cell_means = lambda image: next(large)
    expected = loss(images(0), images(1))
    with torch.autocast("cpu", torch.float16):
        torch.testing.assert_close(loss(images(0), images(1)), expected, rtol=0.05, atol=0)


def test_three_scans_of_a_batch_count():
    made, scan = images(0, num=5), images(1, num=5)
    loss = PerceptualLoss(GEOMETRY)
    each = torch.stack([loss(made[i : i + 1], scan[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(loss(made, scan), each.mean())


@pytest.mark.parametrize("labelled", [False, True])
def test_a_stage_has_the_loss_only_if_it_weighs(labelled):
    data = LabelledData if labelled else RangeData
    without = train(range_module(2, labelled=labelled), data(1))
    assert "perceptual" not in without.parts[0]
    module = train(range_module(2, labelled=labelled, perceptual=0.01), data(2))
    assert all(parts["perceptual"] > 0 for parts in module.parts)
    assert not any("perceptual" in key for key in module.state_dict())
