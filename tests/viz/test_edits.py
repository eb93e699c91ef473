"""Sheets of edits: which lines and ticks are drawn, and where."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from matplotlib.contour import ContourSet

from r3dpa.geometry import LidarSensor, SphericalProjection
from r3dpa.viz import EditRow, edit_sheet

PROJECTION = SphericalProjection(LidarSensor(beams=8, columns=16))
RANGE_M = torch.full((8, 16), 10.0)


def contours(parts):
    """Places ``(x, y)`` of the outline of parts; pixel centres have whole numbers."""
    sheet = edit_sheet([EditRow("after", RANGE_M, outline=parts)], ("kept", "new"), PROJECTION)
    found = [c for c in sheet.axes[0].collections if isinstance(c, ContourSet)]
    return {
        tuple(place) for c in found for path in c.get_paths() for place in path.vertices.tolist()
    }


def test_the_outline_of_one_pixel_goes_around_it():
    parts = np.zeros((8, 16), np.uint8)
    parts[3, 5] = 1
    assert contours(parts) == {(4.5, 3), (5.5, 3), (5, 2.5), (5, 3.5)}


def test_no_outline_hides_a_picture_of_dropped_beams():
    parts = np.zeros((8, 16), np.uint8)
    parts[1::2] = 1
    assert not contours(parts)


def test_azimuths_stand_below_their_columns():
    """16 columns of 22.5 degrees from 180 down: 0 degrees is the border before column 8."""
    sheet = edit_sheet([EditRow("scan", RANGE_M)], (), PROJECTION)
    axes = sheet.axes[0]
    places = dict(
        zip([t.get_text() for t in axes.get_xticklabels()], axes.get_xticks(), strict=True)
    )
    assert places["0°"] == pytest.approx(7.5, abs=0.5)
    assert places["135°"] == pytest.approx(1.5, abs=0.5)
    assert places["-90°"] == pytest.approx(11.5, abs=0.5)


def test_a_mask_is_drawn_on_grey_and_colours_its_part_alone():
    parts = np.zeros((8, 16), np.uint8)
    parts[:, 8:] = 1
    sheet = edit_sheet([EditRow("mask", RANGE_M, parts)], ("kept", "new"), PROJECTION)
    picture = np.asarray(sheet.axes[0].images[0].get_array(), int)
    assert (np.ptp(picture[:, :8], axis=-1) <= 1).all()
    assert (picture[:, 8:, 0] > picture[:, 8:, 1] + 20).all()
