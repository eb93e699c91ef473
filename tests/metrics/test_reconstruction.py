from __future__ import annotations

import math

import pytest
import torch

from r3dpa.metrics.reconstruction import (
    ReconstructionQuality,
    edge_pixels,
    flying_pixels,
)

# A wall at 10 m with a pole at 4 m in columns 3 and 4, and a pixel without a return.
SCAN = torch.tensor([[10.0, 10.0, 10.0, 4.0, 4.0, 10.0, -1.0, 10.0]])


def test_edges_are_on_both_sides_and_wrap_around():
    assert edge_pixels(SCAN).tolist() == [[False, False, True, True, True, True, False, False]]
    seam = torch.tensor([[5.0, 10.0, 10.0, 10.0]])
    assert edge_pixels(seam).tolist() == [[True, True, False, True]]
    rows = torch.tensor([[10.0], [10.0], [5.0]])  # the first row is not above the last
    assert edge_pixels(rows).tolist() == [[False], [True], [True]]


def test_a_pixel_between_near_and_far_flies():
    ramp = SCAN.clone()
    ramp[0, 2] = 7.0
    assert flying_pixels(ramp).tolist() == [[False, False, True] + 5 * [False]]
    assert not flying_pixels(SCAN).any()
    ramp[0, 2] = 9.5  # within 0.6 m of the wall
    assert not flying_pixels(ramp).any()


def test_figures_by_hand():
    found = SCAN.clone()
    found[0, 2], found[0, 0], found[0, 7], found[0, 6] = 7.0, 10.1, -1.0, 10.0
    quality = ReconstructionQuality()
    quality.update(SCAN, found)
    figures = quality.compute()
    assert figures["range_error_m"] == pytest.approx(3.1 / 6, rel=1e-6)
    assert figures["median_error_m"] == pytest.approx(0.0005)
    assert figures["edge_error_m"] == pytest.approx(3.0 / 4)
    assert figures["return_iou"] == pytest.approx(6 / 8)
    assert figures["missing_iou"] == 0
    assert figures["flying"] == pytest.approx(1 / 7)
    assert figures["flying_scans"] == 0


def test_what_nothing_was_compared_for_is_unknown():
    full = torch.full((1, 4, 8), 10.0)
    quality = ReconstructionQuality()
    quality.update(full, -full)
    figures = quality.compute()
    unknown = {name for name, figure in figures.items() if math.isnan(figure)}
    assert unknown == {"range_error_m", "median_error_m", "edge_error_m", "flying"}
    assert figures["return_iou"] == figures["missing_iou"] == 0


def test_merged_states_equal_one_update():
    scans = 20 * torch.rand(4, 8, 32, generator=torch.Generator().manual_seed(0)) - 1
    found = scans + 0.3 * torch.randn(scans.shape, generator=torch.Generator().manual_seed(1))
    whole, first, second = (ReconstructionQuality() for _ in range(3))
    whole.update(scans, found)
    first.update(scans[:1], found[:1])
    second.update(scans[1:], found[1:])
    first.merge_state(second)
    assert first.compute() == pytest.approx(whole.compute())
