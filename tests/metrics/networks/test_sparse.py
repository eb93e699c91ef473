"""Sparse convolution against dense convolution, and what holds for any cloud."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from r3dpa.metrics.networks.sparse import (
    MAX_CLOUDS,
    MAX_COORDINATE,
    MAX_STRIDE,
    SparseConv,
    Voxels,
    kernel_offsets,
    voxel_keys,
)

SIZE = 8  # of the dense volumes, along each axis
LOWEST = -6  # coordinate of their first cell: even, so that pairs of cells are voxels of stride 2
EXACT = {"atol": 1e-12, "rtol": 0.0}  # float64 sums of fewer than 1000 products


def random_voxels(share=0.3, clouds=2, seed=0):
    """Coordinates ``(N, 4)`` in random order, at a share of the cells of each volume."""
    generator = torch.Generator().manual_seed(seed)
    occupied = torch.rand(SIZE, SIZE, SIZE, clouds, generator=generator) < share
    coordinates = occupied.nonzero() + torch.tensor([LOWEST, LOWEST, LOWEST, 0])
    return coordinates[torch.randperm(len(coordinates), generator=generator)]


def cells(voxels):
    """Index of each voxel in a dense volume ``(B, x, y, z, C)`` of its stride."""
    x, y, z, batch = voxels.coordinates.T
    first, stride = LOWEST, voxels.stride
    return batch, (x - first) // stride, (y - first) // stride, (z - first) // stride


def dense(features, voxels, clouds=2):
    """Volume ``(B, C, x, y, z)`` with zeros where no voxel is."""
    side = SIZE // voxels.stride
    volume = features.new_zeros(clouds, side, side, side, features.shape[1])
    return volume.index_put(cells(voxels), features).movedim(-1, 1)


def dense_kernel(kernel):
    """The matrices of all offsets as ``(in, out, x, y, z)``, each put where its offset is."""
    size = round(len(kernel) ** (1 / 3))
    offsets = torch.tensor(kernel_offsets(size)) + size // 2 * (size == 3)
    weight = kernel.new_zeros(size, size, size, *kernel.shape[1:])
    return weight.index_put(tuple(offsets.T), kernel).movedim((-2, -1), (0, 1))


def layer_case(kind, voxels):
    """Input and output voxels, the map between them, kernel size, and the dense layer."""
    coarse = voxels.coarser
    swapped = {"stride": 2}
    return {
        "k3": (voxels, voxels, voxels.neighbors, 3, {"padding": 1}),
        "k3 at stride 2": (coarse, coarse, coarse.neighbors, 3, {"padding": 1}),
        "down": (voxels, coarse, voxels.to_coarser, 2, swapped),
        "up": (coarse, voxels, voxels.to_coarser.transposed(), 2, swapped),
    }[kind]


@pytest.mark.parametrize("kind", ["k3", "k3 at stride 2", "down", "up"])
@pytest.mark.parametrize("share", [0.02, 0.3, 1.0])
def test_same_as_a_dense_convolution(kind, share):
    """Results, and gradients of the features and of the kernel."""
    voxels, _ = Voxels.from_coordinates(random_voxels(share))
    source, target, kernel_map, size, options = layer_case(kind, voxels)
    torch.manual_seed(1)
    layer = SparseConv(3, 5, size).double()
    features = torch.randn(len(source), 3, dtype=torch.float64, requires_grad=True)
    result = layer(features, kernel_map)
    weight, volume = dense_kernel(layer.kernel), dense(features, source)
    if kind == "up":
        expected = functional.conv_transpose3d(volume, weight, **options)
    else:
        expected = functional.conv3d(volume, weight.transpose(0, 1), **options)
    expected = expected.movedim(1, -1)[cells(target)]
    torch.testing.assert_close(result, expected, **EXACT)
    inputs = (features, layer.kernel)
    seed = torch.randn_like(result)
    actual = torch.autograd.grad(result, inputs, seed)
    for own, other in zip(actual, torch.autograd.grad(expected, inputs, seed), strict=True):
        torch.testing.assert_close(own, other, atol=1e-11, rtol=0.0)


def test_kernel_of_size_1_is_a_matrix():
    layer = SparseConv(3, 2, 1)
    layer.load_state_dict({"kernel": torch.arange(6.0).view(3, 2)})
    assert layer(torch.tensor([[1.0, 0, 2]])).tolist() == [[0 + 8, 1 + 10]]


def test_coarser_voxels_are_the_floor_of_the_coordinates():
    coordinates = torch.cat([random_voxels(), random_voxels()[:9]])  # nine voxels twice
    level, rows = Voxels.from_coordinates(coordinates)
    assert len(level) == len(coordinates) - 9
    assert torch.equal(level.coordinates[rows], coordinates)
    for stride in (2, 4, 8):
        level = level.coarser
        lowest = coordinates[:, :3].div(stride, rounding_mode="floor") * stride
        expected = {tuple(row) for row in torch.cat([coordinates[:, 3:], lowest], dim=1).tolist()}
        assert [tuple(row) for row in level.coordinates.roll(1, 1).tolist()] == sorted(expected)
        assert level.stride == stride


@pytest.mark.parametrize("half", ["weights", "autocast"])
def test_half_precision_sums_in_float32(half):
    """27 equal products: a running sum in bfloat16 would stop growing by as much."""
    voxels, _ = Voxels.from_coordinates(random_voxels(1.0))
    torch.manual_seed(0)
    layer = SparseConv(32, 16, 3)
    features = torch.randn(len(voxels), 32)
    expected = layer(features, voxels.neighbors)
    if half == "weights":
        actual = layer.bfloat16()(features.bfloat16(), voxels.neighbors)
    else:
        with torch.autocast("cpu", torch.bfloat16):
            actual = layer(features, voxels.neighbors)
    assert actual.dtype == torch.bfloat16
    # 2^-9 per rounding of inputs, kernel and each product; errors of 27 products average out.
    error = (actual.float() - expected).square().mean().sqrt()
    assert error < 2**-8 * expected.square().mean().sqrt()


def test_keys_at_the_bounds():
    """No voxel takes a far one for its neighbour, and coordinates survive."""
    low, high = -MAX_COORDINATE, MAX_COORDINATE - 1
    corners = torch.cartesian_prod(
        *[torch.tensor([low, high])] * 3, torch.tensor([0, MAX_CLOUDS - 1])
    )
    level, rows = Voxels.from_coordinates(corners)
    assert torch.equal(level.coordinates[rows], corners)
    while level.stride < MAX_STRIDE:
        for index, pair in enumerate(level.neighbors.pairs):
            assert (pair is None) if index == 13 else len(pair[0]) == 0
        level = level.coarser
    assert len(level) == len(corners)


def test_coordinates_that_would_collide_are_refused():
    places = [MAX_COORDINATE, 0, 0, 0], [0, -MAX_COORDINATE - 1, 0, 0], [0, 0, 2**32, 0]
    for row in (*places, [0, 0, 0, -1], [0, 0, 0, MAX_CLOUDS]):
        with pytest.raises(ValueError, match="1 of 2 voxels are out of bounds"):
            voxel_keys(torch.tensor([[1, 2, 3, 0], row]))
