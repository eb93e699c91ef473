from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from r3dpa.editing.regions import (
    angle_box,
    box3d,
    box3d_front_m,
    check_mask,
    dilated,
    dropped_beams,
    in_box3d,
    mask_of_tokens,
    sector,
    sector_weights,
    sensor_pair,
    token_mask,
)
from r3dpa.geometry import BeamProjection, LidarSensor, RingProjection, SphericalProjection
from r3dpa.geometry.projection import ray_directions, unproject

# Rays at inclination 15, 5, -5, -15 and azimuth 175, 165, ..., -175 degrees.
COARSE = SphericalProjection(LidarSensor(4, 36, 20.0, -20.0))
FINE = SphericalProjection(LidarSensor(32, 128, 20.0, -30.0))
DENSE = SphericalProjection(LidarSensor(16, 72, 20.0, -20.0, range_max_m=25.0))
INCLINATIONS = tuple(17.0 - 2 * row - row**2 / 70 for row in range(16))
DENSE_RINGS = RingProjection(DENSE.sensor, INCLINATIONS)
# Optical centres a metre above and half a metre beside the origin.
DENSE_BEAMS = BeamProjection(
    DENSE.sensor,
    INCLINATIONS,
    height_m=(1.0,) * 16,
    lateral_m=(0.5,) * 16,
    azimuth_shift_deg=(1.0,) * 16,
)
ABOVE = SphericalProjection(LidarSensor(4, 36, 60, 25))
RINGS = RingProjection(LidarSensor(4, 36, 20.0, -20.0), (18.0, 2.0, -1.0, -19.0))


def selected(mask, dim):
    """Rows (0) or columns (1) with a selected pixel."""
    return mask.any(dim=1 - dim).nonzero()[:, 0].tolist()


@pytest.mark.parametrize(
    ("azimuths", "columns"),
    [
        ((-20, 20), [16, 17, 18, 19]),
        ((0, 20), [16, 17]),  # 15 and 5 degrees: to the left
        ((170, -170), [0, 35]),
        ((170, 190), [0, 35]),
        ((350, 20), [16, 17, 18]),
        ((-180, 180), list(range(36))),
        ((5, 15), [17]),  # the first border belongs to it, the second does not
    ],
)
def test_azimuths_count_to_the_left_and_across_the_seam(azimuths, columns):
    mask = angle_box(COARSE, *azimuths, -10, 10)
    assert selected(mask, 0) == [1, 2]
    assert selected(mask, 1) == columns
    assert mask.sum() == 2 * len(columns)
    assert selected(angle_box(RINGS, *azimuths, -2, 3), 0) == [1, 2]
    assert selected(angle_box(RINGS, *azimuths, -30, -5), 0) == [3]


def test_a_box_includes_its_lower_inclination_and_not_its_upper_one():
    """Rays at 15, 5, -5 and -15 degrees, two of them on the borders."""
    assert selected(angle_box(COARSE, 0, 20, -5, 5), 0) == [2]
    assert selected(angle_box(COARSE, 0, 20, -15, 15), 0) == [1, 2, 3]


def test_a_sector_and_the_rest_of_the_turn_share_no_pixel_and_leave_none():
    for border in (-175.0, -33.3, 5.0, 120.0):
        first, second = sector(COARSE, border, 45), sector(COARSE, 45, border)
        assert (first ^ second).all()
        assert (first == first[:1]).all()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: angle_box(COARSE, 0, 10, 30, 40), r"no ray meets it.* -15\.0 to 15\.0"),
        (lambda: angle_box(COARSE, 0, 10, 5, 5), "lower inclination first"),
        (lambda: angle_box(COARSE, -180, 180, -90, 90), "all of 4 x 36"),
        (lambda: sector(COARSE, -180, 180), "all of 4 x 36"),
        (lambda: sector(COARSE, 1, 2), "between two columns, which are 10 degrees"),
        (lambda: sector(COARSE, 10, 10), "give -180 and 180"),
        (lambda: sector(COARSE, 180, -180), "is empty: for a full turn give -180 and 180"),
        (lambda: sector(COARSE, -200, 200), "at most 360 apart"),
        (lambda: sector(COARSE, math.nan, 20), r"-360\.\.360"),
        (lambda: sector(COARSE, 20, math.nan), r"-360\.\.360"),
        (lambda: box3d(COARSE, (100, 0, 0), (4, 2, 2)), r"no ray meets it.* 1 to 56 m"),
        (lambda: box3d(COARSE, (0, 0.5, 0.5), (0.1, 0.1, 0.1)), r"no ray meets it.* 1 to 56 m"),
        (lambda: box3d(COARSE, (10, 0, 9.5), (4, 2, 1)), r"no ray meets it.* -15\.0 to 15\.0"),
        (lambda: box3d(COARSE, (20, 0, 0), (0.1, 0.1, 0.1)), "no ray meets it"),
        (lambda: box3d(COARSE, (0.5, 0, 0), (4, 2, 2)), "contains the sensor"),
        (lambda: box3d(COARSE, (10, 0, 0), (4, 0, 2)), "above 0"),
        (lambda: box3d(COARSE, (10, 0, math.nan), (4, 1, 2)), "finite"),
        (lambda: box3d(COARSE, (10, 0), (4, 1, 2)), "needs x, y, z"),
        (lambda: dropped_beams(COARSE, range(4)), "selects nothing"),
        (lambda: dropped_beams(COARSE, [-1]), "row -1 is kept, but the images have rows 0 to 3"),
        (lambda: dropped_beams(COARSE, [0, 4]), "row 4 is kept"),
        (lambda: dropped_beams(COARSE, []), "selects all"),
        (lambda: sensor_pair(COARSE, COARSE), "selects nothing"),
        (lambda: sensor_pair(COARSE, ABOVE), "selects all"),
        # Every token has a pixel of every second beam.
        (lambda: token_mask(dropped_beams(FINE, range(0, 32, 2)), (8, 16)), "selects all of 128"),
        (lambda: check_mask(torch.zeros(2, 3, dtype=torch.bool), "mask a.png"), "mask a.png: sel"),
        (lambda: check_mask(torch.ones(2, 3), "mask"), "mask: must be of bool, got torch.float32"),
    ],
)
def test_a_mask_that_cannot_be_used_is_refused_with_its_numbers(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_box_ahead_takes_the_pixels_it_fills():
    # At 10 m a side of 5.3 m spans 14.8 degrees to each side (rays at 5, but not at 15), and one
    # of 5.4 m 15.1 degrees. Upwards, 2 * 1.8 m spans the rows at 5 degrees, not those at 15.
    assert selected(box3d(COARSE, (10.5, 0, 0), (1, 5.3, 3.6)), 1) == [17, 18]
    assert selected(box3d(COARSE, (10.5, 0, 0), (1, 5.4, 3.6)), 1) == [16, 17, 18, 19]
    assert selected(box3d(COARSE, (10.5, 0, 0), (1, 5.3, 3.6)), 0) == [1, 2]
    assert selected(box3d(RINGS, (10.5, 0, 0), (1, 5.3, 3.6)), 0) == [1, 2]
    # To the left, and turned by a quarter: length and width change places.
    left = box3d(COARSE, (0, 10.5, 0), (5.3, 1, 3.6))
    assert selected(left, 1) == [8, 9]
    assert left.equal(box3d(COARSE, (0, 10.5, 0), (1, 5.3, 3.6), yaw_deg=90))
    # Behind, across the seam.
    assert selected(box3d(COARSE, (-10.5, 0, 0), (1, 5.3, 3.6)), 1) == [0, 35]


def test_the_near_side_of_a_box_is_where_rays_enter_it():
    """A wall at 10 m ahead: 10 m / (cos 5 cos 5) along the rays at 5 degrees; 0 beside it."""
    front_m = box3d_front_m(COARSE, (10.5, 0, 0), (1, 5.3, 3.6))
    mask = box3d(COARSE, (10.5, 0, 0), (1, 5.3, 3.6))
    assert front_m.gt(0).equal(mask)
    expected = 10 / math.cos(math.radians(5)) ** 2
    torch.testing.assert_close(front_m[mask], torch.full((4,), expected), atol=1e-5, rtol=0)


def test_the_near_side_of_a_box_before_rays_that_start_beside_the_origin():
    """A wall 10 m ahead: where the rays enter it is their range from the origin."""
    front_m = box3d_front_m(DENSE_BEAMS, (10.5, 0, 0), (1, 40, 20))
    mask = box3d(DENSE_BEAMS, (10.5, 0, 0), (1, 40, 20))
    points = unproject(front_m.double(), DENSE_BEAMS)[mask]
    assert len(points) > 200
    torch.testing.assert_close(points[:, 0], torch.full_like(points[:, 0], 10), atol=1e-4, rtol=0)


def test_points_in_a_turned_box():
    """A box of 4 x 2 x 1 m turned by 90 degrees is 2 m long along x and 4 m along y."""
    points = torch.tensor([[10.9, 1.9, 0.4], [11.1, 0, 0], [10, 2.1, 0], [10, 0, 0.6], [10, 0, 0]])
    box = ((10, 0, 0), (4, 2, 1), 90)
    exact = {"margin_m": 0, "ground_m": 0}
    assert in_box3d(points, *box, **exact).tolist() == [True, False, False, False, True]
    assert in_box3d(points, *box).all()
    low = torch.tensor([[10.0, 0, -0.26], [10, 0, -0.24]])  # the bottom is 0.5 m below the centre
    assert in_box3d(low, *box).tolist() == [False, True]


def test_box_beyond_the_range_counts_only_as_far_as_the_sensor_sees():
    near = box3d(COARSE, (56, 0, 0), (4, 30, 30))  # from 54 m on: corners lie beyond 56 m
    assert near.any()
    # At 15 degrees to the side the wall at 54.5 m is 56.4 m away, at 5 degrees 54.7 m.
    far = box3d(COARSE, (55, 0, 0), (1, 60, 30))
    assert selected(far, 1) == [17, 18]


def marched(projection, centre, size, yaw_deg, step=0.01):
    """Pixels of which one of many places along the ray lies inside the box."""
    sensor = projection.sensor
    places = torch.arange(sensor.range_min_m + step, sensor.range_max_m, step, dtype=torch.float64)
    yaw = math.radians(yaw_deg)
    directions = ray_directions(projection, dtype=torch.float64)
    origins = torch.zeros_like(directions)
    if isinstance(projection, BeamProjection):
        origins = projection.origins()
    mask = torch.zeros(directions.shape[:2], dtype=torch.bool)
    for row in range(len(directions)):
        rays = origins[row, :, None] + directions[row, :, None] * places[:, None]
        x, y, z = rays.unbind(-1)
        x, y, z = x - centre[0], y - centre[1], z - centre[2]
        u, v = x * math.cos(yaw) + y * math.sin(yaw), y * math.cos(yaw) - x * math.sin(yaw)
        inside = (u.abs() < size[0] / 2) & (v.abs() < size[1] / 2) & (z.abs() < size[2] / 2)
        mask[row] = inside.any(dim=-1)
    return mask


@pytest.mark.parametrize(
    "projection", [DENSE, DENSE_RINGS, DENSE_BEAMS], ids=["spherical", "rings", "beams"]
)
@pytest.mark.parametrize("seed", range(3))
def test_box_is_what_marching_along_the_rays_finds(projection, seed):
    draw = torch.Generator().manual_seed(seed)
    centre = (torch.rand(3, generator=draw, dtype=torch.float64) - 0.5) * torch.tensor([16, 16, 3])
    size = 2 + 6 * torch.rand(3, generator=draw, dtype=torch.float64)
    yaw = 360 * torch.rand((), generator=draw).item()
    centre[0] += torch.sign(centre[0]) * 8  # the sensor stands outside
    mask = box3d(projection, centre.tolist(), size.tolist(), yaw)
    found = marched(projection, centre, size, yaw)
    assert (mask | ~found).all()
    # A ray through a box that is 5 cm smaller is at least 5 cm in this one: no step misses it.
    smaller = box3d(projection, centre.tolist(), (size - 0.05).tolist(), yaw)
    assert (found | ~smaller).all()


def test_beams_are_dropped_by_row():
    assert selected(~dropped_beams(COARSE, [1, 3, 3]), 0) == [1, 3]
    assert dropped_beams(FINE, range(0, 32, 4)).sum() == 24 * 128


def test_sensor_with_fewer_beams_fills_some_pixels():
    half = SphericalProjection(LidarSensor(2, 18, 20.0, -20.0))
    seen = ~sensor_pair(COARSE, half)
    # Its beams at 10 and -10 lie between two of ours: the upper one is filled. Likewise columns.
    assert selected(seen, 0) == [0, 2]
    assert selected(seen, 1) == list(range(0, 36, 2))
    # 6.67 and 0 degrees down to -13.3: the first two are nearest to ours at 5.
    narrow = SphericalProjection(LidarSensor(4, 36, 10.0, -16.68))
    assert selected(~sensor_pair(COARSE, narrow), 0) == [1, 2, 3]
    wide = SphericalProjection(LidarSensor(2, 36, 85.0, -20.0))  # at 58.8 and 6.2 degrees
    assert selected(~sensor_pair(COARSE, wide), 0) == [1]


def test_tokens_with_any_pixel():
    pixels = torch.zeros(4, 8, dtype=torch.bool)
    pixels[0, 0] = True
    pixels[2:, 4:6] = True
    assert token_mask(pixels, (2, 4)).nonzero()[:, 0].tolist() == [0, 6]
    # The neighbours of token 0 are 1, those of the next row 4 and 5, and over the seam 3 and 7.
    grown = token_mask(pixels[:2].repeat(2, 1) & (torch.arange(4) < 1)[:, None], (2, 4), dilation=1)
    assert grown.nonzero()[:, 0].tolist() == [0, 1, 3, 4, 5, 7]
    with pytest.raises(ValueError, match=r"tokens with any of their 4 .*selects nothing"):
        token_mask(pixels & False, (2, 4))


def test_mask_of_tokens_covers_their_patches():
    tokens = torch.rand(3, 8, generator=torch.Generator().manual_seed(0)) > 0.5
    pixels = mask_of_tokens(tokens, (2, 4), (6, 8))
    assert pixels.shape == (3, 6, 8)
    for row in range(6):
        for column in range(8):
            assert pixels[:, row, column].equal(tokens[:, row // 3 * 4 + column // 2])
    assert token_mask(pixels[0], (2, 4)).equal(tokens[0])


def test_dilation_crosses_the_seam_but_not_the_horizon():
    mask = torch.zeros(5, 6, dtype=torch.bool)
    mask[0, 0] = True
    grown = dilated(mask, 1)
    assert grown.nonzero().tolist() == [[r, c] for r in (0, 1) for c in (0, 1, 5)]
    assert dilated(mask, 2).equal(dilated(grown, 1))
    assert dilated(mask, 0).equal(mask)
    with pytest.raises(ValueError, match="got -1"):
        dilated(mask, -1)


def test_left_and_right_half_have_soft_seams_ahead_and_behind():
    # Columns of the tokens at 157.5, 112.5, 67.5, 22.5, -22.5, ..., -157.5 degrees.
    hard = sector_weights([(0, 0), (180, 1)], (1, 8))
    assert hard.tolist() == [[1, 1, 1, 1, 0, 0, 0, 0], [0, 0, 0, 0, 1, 1, 1, 1]]
    # 22.5 degrees from a seam of 90: (45 + 22.5) / 90 of the surroundings are on its own side.
    soft = sector_weights([(0, 0), (180, 1)], (2, 8), blend_deg=90)
    left = [0.75, 1, 1, 0.75, 0.25, 0, 0, 0.25]
    torch.testing.assert_close(soft[0], torch.tensor(left + left))
    torch.testing.assert_close(soft[1], 1 - soft[0])
    # Blended over a whole turn, each has its share of the turn everywhere.
    torch.testing.assert_close(
        sector_weights([(10, 0), (100, 1)], (2, 8), 360)[0], torch.full((16,), 0.25)
    )


@settings(max_examples=50, deadline=None)
@given(
    starts=st.lists(st.integers(-360, 359), min_size=2, max_size=6, unique_by=lambda s: s % 360),
    blend=st.floats(0, 360),
    turn=st.integers(0, 15),
)
def test_shares_sum_to_one_and_turn_with_the_layout(starts, blend, turn):
    layout = [(start + 0.1, place % 2) for place, start in enumerate(starts)]
    weights = sector_weights(layout, (2, 16), blend)
    assert weights.min() >= -1e-6
    torch.testing.assert_close(weights.sum(dim=0), torch.ones(32))
    turned = sector_weights([(start - 22.5 * turn, s) for start, s in layout], (2, 16), blend)
    expected = weights.unflatten(1, (2, 16)).roll(turn, dims=-1).flatten(1)
    torch.testing.assert_close(turned, expected, atol=1e-5, rtol=0)


def test_a_layout_that_cannot_be_used_is_refused():
    for layout, blend, message in (
        ([(0, 0), (180, 0)], 0, r"two or more sources, numbered from 0; got \[0\]"),
        ([(0, 0), (180, 2)], 0, r"got \[0, 2\]"),
        ([(0, 0), (360, 1)], 0, "start at one azimuth"),
        ([(0, 0), (math.inf, 1)], 0, "finite"),
        ([(0, 0), (180, 1)], -1, "blend must be 0 to 360 degrees, got -1"),
    ):
        with pytest.raises(ValueError, match=message):
            sector_weights(layout, (2, 8), blend)
