"""MinkowskiNet and SPVCNN: batches, order, precision, checkpoints; voxels and pooling of a scan."""

from __future__ import annotations

import math

import pytest
import torch

from r3dpa.metrics.networks.minkowski import (
    SPVCNN,
    MinkowskiNet,
    Points,
    corners,
    scaled_widths,
    to_points,
    to_voxels,
)
from r3dpa.metrics.networks.sparse import Voxels, pool_voxels, voxelize

WIDTHS = scaled_widths(0.125)


@pytest.fixture(scope="module", params=[MinkowskiNet, SPVCNN])
def network(request):
    """Small network whose batch norms are not the identity."""
    torch.manual_seed(0)
    network = request.param(WIDTHS)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            torch.nn.init.normal_(module.running_mean, std=0.1)
            torch.nn.init.uniform_(module.running_var, 0.05, 0.2)
            torch.nn.init.normal_(module.bias, std=0.1)
    return network.eval()


def cloud(batch, num_voxels=400, seed=0):
    """Distinct voxels ``(N, 4)`` near each other, and their inputs ``(N, 4)``."""
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.randint(0, 24, (num_voxels, 3), generator=generator).unique(dim=0)
    xyz = xyz[torch.randperm(len(xyz), generator=generator)]
    features = torch.randn(len(xyz), 4, generator=generator)
    return torch.nn.functional.pad(xyz, (0, 1), value=batch), features


@torch.no_grad()
def test_batch_is_as_its_clouds(network):
    """Also where a cloud in between is empty, and where rows of the clouds are mixed."""
    clouds = [cloud(0), cloud(3, seed=1)]
    single = torch.cat([network(*each) for each in clouds])
    coordinates, features = (torch.cat(parts) for parts in zip(*clouds, strict=True))
    torch.testing.assert_close(network(coordinates, features), single, atol=1e-5, rtol=1e-5)
    order = torch.randperm(len(features), generator=torch.Generator().manual_seed(2))
    shuffled = network(coordinates[order], features[order])
    torch.testing.assert_close(shuffled, single[order], atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_steps_of_the_coarsest_stride_change_nothing(network):
    """A cloud moved by multiples of 16 falls into the same coarser voxels, also below zero."""
    coordinates, features = cloud(0)
    moved = coordinates + torch.tensor([-48, 16, 160, 1])
    expected = network(coordinates, features)
    # SPVCNN takes coordinates through metres in float32, off by 1e-5 of a voxel here.
    torch.testing.assert_close(network(moved, features), expected, atol=1e-3, rtol=0)


@torch.no_grad()
def test_small_clouds(network):
    assert network(torch.zeros(0, 4, dtype=torch.int64), torch.zeros(0, 4)).shape == (0, WIDTHS[-1])
    one = network(torch.tensor([[7, 8, 9, 0]]), torch.ones(1, 4))
    assert one.shape == (1, WIDTHS[-1])
    assert one.isfinite().all()


@torch.no_grad()
def test_bfloat16_is_close(network):
    coordinates, features = cloud(0)
    expected = network(coordinates, features)
    with torch.autocast("cpu", torch.bfloat16):
        actual = network(coordinates, features)
    error = (actual.float() - expected).square().mean().sqrt() / expected.std()
    assert 0 < error < 0.05  # 2^-9 per rounding, over 42 layers in a row


def test_gradients_reach_every_weight_and_input(network):
    coordinates, features = cloud(0)
    features.requires_grad_()
    network.head(network(coordinates, features)).square().sum().backward()
    missing = [name for name, weight in network.named_parameters() if not weight.grad.any()]
    network.zero_grad()
    assert not missing
    assert features.grad.any(dim=1).float().mean() > 0.9  # a ReLU may close for a voxel


def test_what_a_voxel_may_hold():
    coordinates, features = cloud(0)
    twice = torch.cat([coordinates, coordinates[:1]]), torch.cat([features, features[:1]])
    with pytest.raises(ValueError, match=f"{len(features) + 1} rows are only {len(features)}"):
        MinkowskiNet(WIDTHS)(*twice)
    torch.manual_seed(0)
    network = SPVCNN(WIDTHS).eval()
    with torch.no_grad():  # the mean of two equal rows is that row
        torch.testing.assert_close(
            network(*twice)[:-1], network(coordinates, features), atol=1e-5, rtol=1e-5
        )


def test_points_between_voxels():
    """By hand: means, weights of a corner each, and voxels that are not there."""
    voxels, _ = Voxels.from_coordinates(torch.tensor([[0, 0, 0, 0], [1, 0, 0, 0], [0, 0, 2, 1]]))
    points = Points(
        torch.tensor([[0.25, 0, 0], [0.75, 0, 0], [0.5, 0.5, 0], [9, 9, 9]]), torch.zeros(4).long()
    )
    values = torch.tensor([[1.0], [3], [5], [100]])
    assert to_voxels(values, points, voxels).tolist() == [[3.0], [0], [0]]
    rows, weights = corners(points, voxels)
    assert rows[0].tolist() == [0, 3, 3, 3, 1, 3, 3, 3]
    torch.testing.assert_close(weights[:3, 0], torch.tensor([0.75, 0.25, 0.5]))
    torch.testing.assert_close(weights[:3, 4], torch.tensor([0.25, 0.75, 0.5]))
    result = to_points(torch.tensor([[10.0], [20], [7]]), points, voxels)
    torch.testing.assert_close(result, torch.tensor([[12.5], [17.5], [15], [0]]))


def test_voxelize():
    points = torch.tensor(
        [
            [2.0, 0, 0, 9],  # voxel 40, 0, 0
            [1.0, -1, 0.5, 9],  # 20, -20, 10
            [2.02, 0.01, 0, 9],  # as the first one
            [0.5, 0, 0, 9],  # too near
            [56.1, 0, 0, 9],  # too far
        ]
    )
    coordinates, features = voxelize(points)
    assert coordinates.tolist() == [[0, 0, 10], [20, 20, 0]]
    assert features.tolist() == [[1, -1, 0.5, -1], [2, 0, 0, -1]]
    assert [len(part) for part in voxelize(points[:0])] == [0, 0]
    points[1, 2] = math.nan
    with pytest.raises(ValueError, match="1 of 5 points are NaN or infinite"):
        voxelize(points)


def test_pooling_by_hand():
    """Four voxels around their mean, 3 m and 10 m away; cloud 1 has none."""
    near, far = 60, 200
    coordinates = torch.tensor(
        [[near, 0, 0, 0], [-near, 0, 0, 0], [-5, far, 0, 2], [5, -far, 0, 2]]
    )
    features = torch.tensor([[1.0, 10], [3, 30], [5, 50], [9, 70]])
    rings = pool_voxels(features, coordinates, 3).view(3, 16, 2)
    assert rings[0, 0].tolist() == [2, 20]
    assert rings[2, 1].tolist() == [7, 60]  # 7.25 <= 10 < 10.5
    assert rings.count_nonzero() == 4
    alone = pool_voxels(features[:1], coordinates[:1], 1).view(16, 2)  # at the mean itself
    assert alone[0].tolist() == [1, 10]
    beyond = torch.tensor([[1200, 0, 0, 0], [-1200, 0, 0, 0]])  # 60 m
    assert not pool_voxels(features[:2], beyond, 1).any()
    above = torch.tensor([[120, 0, 160, 0], [-120, 0, -160, 0]])  # 6 m aside, 10 m in space
    assert pool_voxels(features[:2], above, 1).view(16, 2)[1].tolist() == [2, 20]


def test_pooled_features_do_not_depend_on_the_order_of_voxels():
    """The mean of the coordinates is exact, so that no voxel changes its ring."""
    generator = torch.Generator().manual_seed(0)
    xyz = torch.randint(2000, (20_000, 3), generator=generator)
    coordinates = torch.cat([xyz, torch.randint(2, (20_000, 1), generator=generator)], dim=1)
    features = torch.randn(20_000, 2, generator=generator)
    pooled = pool_voxels(features, coordinates, 2)
    order = torch.randperm(20_000, generator=generator)
    again = pool_voxels(features[order], coordinates[order], 2)
    torch.testing.assert_close(again, pooled, rtol=0, atol=1e-7)
    moved = coordinates + torch.tensor([30_000, -30_000, 11, 0])  # float32 sums would round by 0.1
    torch.testing.assert_close(pool_voxels(features, moved, 2), pooled, rtol=0, atol=1e-6)
