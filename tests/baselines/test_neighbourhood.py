"""Neighbourhood attention against explicit loops over queries."""

from __future__ import annotations

import itertools

import pytest
import torch

from r3dpa.baselines.neighbourhood import neighbourhood_attention


def window(index, length, kernel, dilation):
    """Pixels of a window of natten: those of the same phase, ``kernel`` of them in a row."""
    phase = list(range(index % dilation, length, dilation))
    first = min(max(index // dilation - kernel // 2, 0), len(phase) - kernel)
    return phase[first : first + kernel]


def brute_force(query, key, value, kernel, dilation, wrap):
    result = torch.empty_like(query)
    height, width = query.shape[1:3]
    for i, j in itertools.product(range(height), range(width)):
        rows = window(i, height, kernel[0], dilation[0])
        columns = window(j, width, kernel[1], dilation[1])
        if wrap:
            columns = [(j + step) % width for step in range(-(kernel[1] // 2), kernel[1] // 2 + 1)]
        keys, values = (x[:, rows][:, :, columns].flatten(1, 2) for x in (key, value))
        weights = torch.einsum("bhd,bnhd->bnh", query[:, i, j], keys).softmax(dim=1)
        result[:, i, j] = torch.einsum("bnh,bnhd->bhd", weights, values)
    return result


CASES = [
    (size, kernel, dilation, wrap)
    for size, kernel, dilation, wrap in itertools.product(
        [(3, 9), (4, 20), (6, 33)],
        [(3, 9), (3, 3), (1, 5)],
        [(1, 1), (2, 1), (1, 2), (2, 3)],
        [False, True],
    )
    if (not wrap or dilation[1] == 1)
    and size[0] >= kernel[0] * dilation[0]
    and size[1] >= kernel[1] * dilation[1]
] + [
    ((4, 5), (3, 9), (1, 1), True),
    ((4, 8), (3, 9), (1, 1), True),
    ((3, 9), (1, 1), (2, 1), False),
]


@pytest.mark.parametrize(("size", "kernel", "dilation", "wrap"), CASES)
def test_equals_loops_over_the_windows(size, kernel, dilation, wrap):
    generator = torch.Generator().manual_seed(0)
    shape = (2, *size, 2, 4)
    inputs = [torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(3)]
    gradient = torch.randn(shape, generator=generator, dtype=torch.float64)
    for x in inputs:
        x.requires_grad_()
    found = neighbourhood_attention(*inputs, kernel, dilation, wrap)
    expected = brute_force(*inputs, kernel, dilation, wrap)
    torch.testing.assert_close(found, expected)
    for ours, loops in zip(
        torch.autograd.grad(found, inputs, gradient),
        torch.autograd.grad(expected, inputs, gradient),
        strict=True,
    ):
        torch.testing.assert_close(ours, loops)


@pytest.mark.parametrize(
    ("kernel", "dilation", "wrap", "message"),
    [
        ((3, 4), (1, 1), False, "odd"),
        ((5, 3), (1, 1), True, "need 5 rows and 1 columns, but the image has 4 and 8"),
        ((3, 3), (1, 4), False, "need 3 rows and 12 columns"),
        ((3, 3), (1, 2), True, "dilation of 1"),
    ],
)
def test_impossible_windows_are_refused(kernel, dilation, wrap, message):
    x = torch.zeros(1, 4, 8, 1, 2)
    with pytest.raises(ValueError, match=message):
        neighbourhood_attention(x, x, x, kernel, dilation, wrap)
