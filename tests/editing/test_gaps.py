"""What a scan lacks: refused where it is of another sensor, interpolated where it is a gap."""

from __future__ import annotations

import math

import pytest
import torch

from r3dpa.data import read_scan
from r3dpa.editing.gaps import (
    blend_completion,
    check_view,
    interpolate_gaps,
    median_draw,
    range_error_m,
    unseen_pixels,
)
from r3dpa.geometry import LidarSensor, Pixels, SphericalProjection, in_view, range_image

PROJECTION = SphericalProjection(LidarSensor(beams=16, columns=64))


def rows_missing(every):
    missing = torch.ones(16, 64, dtype=torch.bool)
    missing[::every] = False
    return missing


def a_plane():
    """Ground 1.7 m below the sensor in the rows that look down steeply enough to be in range."""
    down = -PROJECTION.ray_angles()[0].sin()
    range_m = torch.where(down > 1.7 / 50, 1.7 / down.clamp(min=1e-3), -1.0)
    return range_m.float()[:, None].repeat(1, 64)


class TestInterpolation:
    def test_known_pixels_and_scans_without_gaps_stay(self):
        range_m, missing = a_plane(), rows_missing(4)
        for how in ("inverse", "linear", "nearest"):
            assert interpolate_gaps(range_m, missing, how)[~missing].equal(range_m[~missing])
            assert interpolate_gaps(range_m, torch.zeros_like(missing), how).equal(range_m)

    def test_inverse_range_is_exact_on_the_ground_but_for_the_curvature_of_angles(self):
        """Between beams 3.5 degrees apart 1 / range follows a sine, straight to 1e-3."""
        range_m, missing = a_plane(), rows_missing(2)
        errors = {}
        for how in ("inverse", "linear", "nearest"):
            made = interpolate_gaps(range_m, missing, how)
            errors[how] = ((made - range_m).abs() / range_m)[4:15].max().item()
        assert errors["inverse"] < 1e-3 < errors["linear"] < errors["nearest"]

    def test_interpolation_between_beams_by_hand(self):
        range_m = torch.full((16, 64), -1.0)
        range_m[0], range_m[4], range_m[8] = 10.0, 40.0, -1.0
        missing = rows_missing(4)
        linear, nearest = (
            interpolate_gaps(range_m, missing, "linear"),
            interpolate_gaps(range_m, missing, "nearest"),
        )
        assert linear[:5, 0].tolist() == [10.0, 17.5, 25.0, 32.5, 40.0]
        assert nearest[:5, 0].tolist() == [10.0, 10.0, 10.0, 40.0, 40.0]
        assert interpolate_gaps(range_m, missing)[2, 0].item() == pytest.approx(
            16.0
        )  # 1 / mean(.1, .025)
        # Beside a beam without a return nothing is averaged with its -1.
        assert linear[4:9, 0].tolist() == [40.0, 40.0, 40.0, -1.0, -1.0]

    def test_a_sector_is_filled_across_the_seam(self):
        range_m = torch.full((16, 64), 10.0)
        range_m[:, 32:] = 20.0
        missing = torch.zeros(16, 64, dtype=torch.bool)
        missing[:, [0, 1, 62, 63]] = True
        made = interpolate_gaps(range_m, missing, "linear")
        assert made[0, [62, 63, 0, 1]].tolist() == [18.0, 16.0, 14.0, 12.0]

    def test_a_sector_is_filled_from_pixels_that_were_filled_between_beams(self):
        range_m = torch.full((16, 64), 10.0)
        range_m[2::4] = 20.0
        range_m[:, 32:] = 40.0
        missing = rows_missing(2)
        missing[:, 5] = True
        made = interpolate_gaps(range_m, missing, "linear")
        assert made[:4, 5].tolist() == [10.0, 15.0, 20.0, 15.0]


class TestBlend:
    def blend(self, generated_m, range_m, missing):
        return blend_completion(torch.full((16, 64), generated_m), range_m, missing)

    def test_one_surface_is_interpolated_and_the_generated_image_says_where_returns_are(self):
        range_m, missing = torch.full((16, 64), 10.0), rows_missing(2)
        assert (self.blend(11.0, range_m, missing) == 10).all()
        without = self.blend(-1.0, range_m, missing)
        assert (without[missing] == -1).all()
        assert (without[~missing] == 10).all()

    def test_an_edge_is_the_mean_of_generated_and_interpolated_ranges(self):
        """Between 10 and 30 m: 15 m halfway in 1 / range; 12 m lie between them, 50 m do not."""
        range_m, missing = torch.full((16, 64), 10.0), rows_missing(2)
        range_m[2:] = 30.0
        for generated_m, expected in ((12.0, 13.5), (50.0, 22.5), (2.0, 12.5)):
            edge = self.blend(generated_m, range_m, missing)[1]
            torch.testing.assert_close(edge, torch.full((64,), expected))

    @pytest.mark.parametrize(("ratio", "is_one_surface"), [(1.29, True), (1.31, False)])
    def test_one_surface_ends_at_a_ratio_of_1_3(self, ratio, is_one_surface):
        """Generated pixels at the nearer neighbour pull the mean of an edge to it."""
        range_m, missing = torch.full((16, 64), 10.0), rows_missing(2)
        range_m[2:] = 10 * ratio
        interpolated = 2 / (1 / 10 + 1 / (10 * ratio))
        expected = interpolated if is_one_surface else (interpolated + 10) / 2
        edge = self.blend(10.0, range_m, missing)[1]
        torch.testing.assert_close(edge, torch.full((64,), expected))

    def test_pixels_without_interpolation_are_as_generated(self):
        range_m, missing = torch.full((16, 64), -1.0), rows_missing(2)
        assert (self.blend(12.0, range_m, missing)[1] == 12).all()


def test_the_median_draw_has_a_return_where_half_of_the_draws_have():
    range_m = torch.tensor([[[1.0, 2.0, -1.0]], [[5.0, -1.0, -1.0]], [[3.0, 4.0, 9.0]]])
    classes = torch.arange(9).view(3, 1, 3)
    median = median_draw(Pixels(range_m, None, classes))
    assert median.range_m.tolist() == [[3.0, 2.0, -1.0]]
    assert median.classes[0, :2].tolist() == [6, 1]


def test_two_of_four_draws_make_a_return():
    range_m = torch.tensor([3.0, -1.0, 5.0, -1.0]).view(4, 1, 1)
    assert median_draw(Pixels(range_m, None, None)).range_m.item() == 3
    assert median_draw(Pixels(-range_m.abs(), None, None)).range_m.item() == -1


def test_narrow_gaps_reach_over_eight_rows_from_return_to_return():
    range_m = torch.full((16, 64), 10.0)
    range_m[4:11, 0] = -1  # rows 3 and 11 are 8 apart
    range_m[4:12, 1] = -1
    unseen = unseen_pixels(range_m)
    assert unseen[4:11, 0].all()
    assert not unseen[:, 1].any()


def test_unseen_are_empty_rows_and_narrow_gaps_between_returns():
    """Beams in rows 0, 3 and 15: two rows between the first, eleven between the last two."""
    range_m = torch.full((16, 64), -1.0)
    range_m[[0, 3, 15]] = 10.0
    range_m[6, 0] = range_m[3, 5] = -1
    range_m[8, 1] = 10.0
    unseen = unseen_pixels(range_m)
    assert not unseen[range_m > 0].any()
    assert unseen[[1, 2, 4, 5, 6]].all()  # rows without a return
    assert unseen[8].nonzero()[:, 0].tolist() == []  # gaps of 11 rows in a row that is not empty
    assert not unseen[3, 5]  # 15 rows from return to return
    range_m[7, 2] = range_m[9, 2] = 10.0
    assert unseen_pixels(range_m)[8].nonzero()[:, 0].tolist() == [2]


def cloud(lowest_deg, highest_deg, beams=64, azimuths_deg=(-180.0, 180.0)):
    inclination = torch.linspace(lowest_deg, highest_deg, beams).deg2rad()
    azimuth = torch.linspace(*azimuths_deg, 256).deg2rad()
    up, around = torch.meshgrid(inclination, azimuth, indexing="ij")
    flat = up.cos()
    return (10 * torch.stack([flat * around.cos(), flat * around.sin(), up.sin()], -1)).view(-1, 3)


class TestView:
    def check(self, points, missing=None):
        check_view(points, range_image(points, PROJECTION)[0], PROJECTION, missing)

    def test_a_scan_of_the_same_view_passes(self):
        self.check(cloud(-24.5, 4.0))

    @pytest.mark.parametrize(
        ("points", "message"),
        [
            (cloud(-25, 15), r"28% of the points lie outside .*-24.1 to 2.1 .*from -25.0 to 15.0"),
            (cloud(-8, 2.5), r"fills 44% of the 16 beams .*-24.1 to 2.1 degrees"),
            (cloud(-24.5, 2.5, azimuths_deg=(-45, 45)), r"fills 2\d% of the 64 columns"),
            (cloud(-24.1, 2.1, beams=8), r"only 0% of the returns .*fewer beams"),
        ],
        ids=["looks up", "looks ahead only", "part of a turn", "fewer beams"],
    )
    def test_scans_of_another_view_are_refused_with_the_numbers(self, points, message):
        with pytest.raises(ValueError, match=message):
            self.check(points)

    def test_scans_just_beyond_a_limit_are_refused(self):
        """Just beyond each of them; the table of refusals above has cases far beyond."""
        outside = torch.cat([cloud(10, 20, beams=16), cloud(-24, 2.0, beams=48)])  # 25 %
        with pytest.raises(ValueError, match="25% of the points lie outside"):
            self.check(outside)
        with pytest.raises(ValueError, match="fills 72% of the 64 columns"):
            self.check(cloud(-24.5, 2.5, azimuths_deg=(-125, 125)))
        points = cloud(-24.5, 2.5)
        range_m = range_image(points, PROJECTION)[0]
        range_m[1::2, :40] = -1  # 47 % of the returns have nothing right below them
        with pytest.raises(ValueError, match=r"only 5\d% of the returns"):
            check_view(points, range_m, PROJECTION)

    def test_more_than_three_fifths_outside_are_refused_of_another_sensor_too(self):
        points = torch.cat([cloud(10, 20, beams=45), cloud(-24, 2.0, beams=15)])
        with pytest.raises(ValueError, match="75% of the points lie outside"):
            self.check(points, torch.zeros(16, 64, dtype=torch.bool))

    def test_few_neighbours_below_say_nothing_of_the_number_of_beams(self):
        """Of every second row and one more that is empty."""
        points, missing = cloud(-24.5, 2.5), rows_missing(2)
        range_m = range_image(points, PROJECTION)[0]
        missing[1], range_m[1] = False, -1.0
        check_view(points, range_m, PROJECTION, missing)

    def test_a_scan_of_fewer_beams_passes_where_the_others_are_missing(self):
        """A third of its points lies beyond the field of view of the checkpoint."""
        points = torch.cat([cloud(10, 20, beams=4), cloud(-24, 2.0, beams=8)])
        assert 0.2 < 1 - in_view(points, PROJECTION).float().mean() < 0.6
        range_m = range_image(points[in_view(points, PROJECTION)], PROJECTION)[0]
        check_view(points, range_m, PROJECTION, unseen_pixels(range_m))
        with pytest.raises(ValueError, match="outside the field of view"):
            check_view(points, range_m, PROJECTION)

    def test_a_missing_sector_needs_no_returns(self):
        missing = torch.ones(16, 64, dtype=torch.bool)
        missing[:, 24:40] = False  # 90 degrees ahead
        self.check(cloud(-24.5, 2.5, azimuths_deg=(-50, 50)), missing)

    @pytest.mark.data
    def test_real_scans_pass_and_half_their_beams_do_not(self, real_scans_dir):
        """Of the 64 lasers, stored one after the other, every second one is left out."""
        projection = SphericalProjection(LidarSensor())
        for path in sorted(real_scans_dir.rglob("*.bin"))[::3]:
            points = torch.from_numpy(read_scan(path)[:, :3])
            check_view(points, range_image(points, projection)[0], projection)
        azimuth = torch.atan2(points[:, 1], points[:, 0]) % (2 * math.pi)
        laser = torch.cat([torch.zeros(1), (azimuth.diff() < -math.pi).cumsum(0)])
        half = points[laser % 2 == 0]
        with pytest.raises(ValueError, match="fewer beams than the checkpoint"):
            check_view(half, range_image(half, projection)[0], projection)


def test_error_counts_pixels_with_returns_in_both():
    first = torch.tensor([[10.0, -1.0, 5.0, 7.0]])
    second = torch.tensor([[12.0, 4.0, -1.0, 6.0]])
    assert range_error_m(first, second) == 1.5
    assert range_error_m(first, second, torch.tensor([[True, True, True, False]])) == 2
    assert math.isnan(range_error_m(first, -torch.ones(1, 4)))
