"""Sheets of edits: which lines and ticks are drawn, and where."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection

from r3dpa.geometry import LidarSensor, SphericalProjection
from r3dpa.viz import EditRow, edit_sheet

PROJECTION = SphericalProjection(LidarSensor(beams=8, columns=16))
RANGE_M = torch.full((8, 16), 10.0)


def lines(parts):
    sheet = edit_sheet([EditRow("after", RANGE_M, outline=parts)], ("kept", "new"), PROJECTION)
    (found,) = (c for c in sheet.axes[0].collections if isinstance(c, LineCollection))
    return {tuple(map(tuple, segment.astype(int).tolist())) for segment in found.get_segments()}


def test_the_outline_of_one_pixel_is_its_four_sides():
    parts = np.zeros((8, 16), np.uint8)
    parts[3, 5] = 1
    assert lines(parts) == {
        *(((5, 3), (5, 4)), ((6, 3), (6, 4))),
        *(((5, 3), (6, 3)), ((5, 4), (6, 4))),
    }


def test_no_outline_hides_a_picture_of_dropped_beams():
    parts = np.zeros((8, 16), np.uint8)
    parts[1::2] = 1
    assert not lines(parts)


def test_azimuths_stand_below_their_columns():
    """16 columns of 22.5 degrees from 180 down: 0 degrees is the border before column 8."""
    sheet = edit_sheet([EditRow("scan", RANGE_M)], (), PROJECTION)
    axes = sheet.axes[0]
    places = dict(
        zip([t.get_text() for t in axes.get_xticklabels()], axes.get_xticks(), strict=True)
    )
    assert places["0°"] == pytest.approx(8, abs=0.5)
    assert places["135°"] == pytest.approx(2, abs=0.5)
    assert places["-90°"] == pytest.approx(12, abs=0.5)


def test_a_mask_is_drawn_on_grey_and_colours_its_part_alone():
    parts = np.zeros((8, 16), np.uint8)
    parts[:, 8:] = 1
    sheet = edit_sheet([EditRow("mask", RANGE_M, parts)], ("kept", "new"), PROJECTION)
    picture = np.asarray(sheet.axes[0].images[0].get_array(), int)
    assert (np.ptp(picture[:, :8], axis=-1) <= 1).all()
    assert (picture[:, 8:, 0] > picture[:, 8:, 1] + 20).all()
