import math

import pytest
import torch

from r3dpa.geometry import LidarSensor, SphericalProjection, range_image
from r3dpa.metrics.corruption import (
    DROPPED,
    NOISE_M,
    Step,
    add_range_noise,
    corruptions,
    drop_points,
    rotate_about_z,
    steps,
)
from r3dpa.metrics.results import MetricResult

SENSOR = LidarSensor(beams=16, columns=64)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def points():
    """Two thousand points with intensity, 2 to 60 m away."""
    direction = torch.randn(2000, 3, generator=generator(1))
    range_m = 2 + 58 * torch.rand(2000, 1, generator=generator(2))
    xyz = range_m * direction / direction.norm(dim=1, keepdim=True)
    return torch.cat([xyz, torch.rand(2000, 1, generator=generator(3))], dim=1)


def corrupted(points, ladder, name="drive/0"):
    return [c.apply(points, name) for c in corruptions() if c.ladder == ladder]


class TestRangeNoise:
    def test_moves_points_along_their_rays_only(self, points):
        noisy = add_range_noise(points, 0.2, generator())
        cosine = torch.cosine_similarity(points[:, :3], noisy[:, :3])
        torch.testing.assert_close(cosine, torch.ones(2000))
        assert torch.equal(noisy[:, 3], points[:, 3])

    def test_has_the_deviation_asked_for_and_no_bias(self, points):
        moved = add_range_noise(points, 0.2, generator())[:, :3].norm(dim=1)
        moved -= points[:, :3].norm(dim=1)
        # Three standard errors of 2000 normal numbers.
        assert moved.std().item() == pytest.approx(0.2, abs=3 * 0.2 / math.sqrt(2 * 2000))
        assert moved.mean().item() == pytest.approx(0, abs=3 * 0.2 / math.sqrt(2000))

    def test_carries_no_point_through_the_sensor(self):
        near = torch.tensor([[0.01, 0.0, 0.0], [0.0, 0.0, 0.0]]).repeat(50, 1)
        noisy = add_range_noise(near, 1.0, generator())
        assert noisy.isfinite().all()
        assert (noisy[:, 0] >= 0).all()
        assert (noisy[1::2] == 0).all()


class TestDrop:
    def test_drops_the_share_and_changes_nothing_else(self, points):
        kept = drop_points(points, 0.3, generator())
        # Three standard errors of a share.
        assert len(kept) / 2000 == pytest.approx(0.7, abs=3 * math.sqrt(0.21 / 2000))
        assert {tuple(row) for row in kept.tolist()} <= {tuple(row) for row in points.tolist()}
        assert torch.equal(drop_points(points, 0.0, generator()), points)
        assert len(drop_points(points, 1.0, generator())) == 0


class TestRotation:
    def test_quarter_turn_takes_forward_to_the_left(self):
        points = torch.tensor([[1.0, 0.0, 2.0, 0.5], [0.0, 1.0, -1.0, 0.1]])
        turned = rotate_about_z(points, math.pi / 2)
        expected = torch.tensor([[0.0, 1.0, 2.0, 0.5], [-1.0, 0.0, -1.0, 0.1]])
        torch.testing.assert_close(turned, expected)

    def test_quarter_turn_rolls_the_range_image(self, points):
        projection = SphericalProjection(SENSOR)
        before, _ = range_image(points[:, :3], projection)
        after, _ = range_image(rotate_about_z(points, math.pi / 2)[:, :3], projection)
        # Columns run clockwise, so a turn to the left moves the image to lower columns.
        torch.testing.assert_close(after, before.roll(-SENSOR.columns // 4, dims=1))

    def test_turned_back_is_the_same(self, points):
        torch.testing.assert_close(rotate_about_z(rotate_about_z(points, 0.7), -0.7), points)


class TestLadders:
    def test_noise_of_all_levels_is_one_noise_scaled(self, points):
        range_m = points[:, :3].norm(dim=1).double()
        moved = [p[:, :3].double().norm(dim=1) - range_m for p in corrupted(points, "noise")]
        for deviation_m, shift in zip(NOISE_M, moved, strict=True):
            # Float32 coordinates of 60 m are about 4e-6 m apart.
            torch.testing.assert_close(
                shift / deviation_m, moved[-1] / NOISE_M[-1], atol=1e-3, rtol=0
            )

    def test_what_is_dropped_stays_dropped(self, points):
        few, many = ({tuple(row) for row in kept.tolist()} for kept in corrupted(points, "drop"))
        assert many < few
        assert len(DROPPED) == 2

    @pytest.mark.parametrize("ladder", ["noise", "drop"])
    def test_depends_on_the_name_of_the_scan_alone(self, points, ladder):
        first, again, other = (corrupted(points, ladder, name)[0] for name in ("a/0", "a/0", "a/1"))
        assert torch.equal(first, again)
        assert first.shape != other.shape or not torch.equal(first, other)

    def test_levels(self):
        named = [(c.ladder, c.level) for c in corruptions()]
        assert named == [
            *(("noise", level) for level in ("2 cm", "5 cm", "10 cm", "20 cm")),
            *(("drop", level) for level in ("10 %", "30 %")),
            ("rotation", "90 deg"),
        ]


class TestSteps:
    def test_higher_distance_and_lower_share_are_worse(self):
        distance = [MetricResult("JSD", v, interval=(v - 3, v + 3)) for v in (1.0, 2.0, 12.0)]
        small, large = steps(distance)
        # sqrt(3^2 + 3^2), of two half widths.
        assert small == Step(1.0, pytest.approx(math.sqrt(18)))
        assert (small.worse, small.clear) == (True, False)
        assert (large.worse, large.clear) == (True, True)
        (share,) = steps([MetricResult("recall", v, direction="higher") for v in (0.5, 0.25)])
        assert share.worsening == 0.25
        assert share.worse

    def test_what_stays_is_not_worse(self):
        (step,) = steps([MetricResult("JSD", 1.0), MetricResult("JSD", 1.0)])
        assert (step.worse, step.clear) == (False, False)

    def test_refuses_what_is_no_ladder(self):
        with pytest.raises(ValueError, match="results of JSD, TV"):
            steps([MetricResult("JSD", 1.0), MetricResult("TV", 1.0)])
        with pytest.raises(ValueError, match="JSD: a value that is None"):
            steps([MetricResult("JSD", 1.0), MetricResult("JSD", None, note="few")])
