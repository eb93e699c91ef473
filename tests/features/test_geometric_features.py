import math
import pickle
from functools import cache

import pytest
import torch

from r3dpa.features import GeometricFeatures
from r3dpa.features.geometric import CENTRES, SPREADS

LINEARITY, PLANARITY, SPHERICITY, ALONG, ACROSS, UP, HEIGHT, LOG_RANGE, INTENSITY = range(9)


def rays(inclinations_deg, azimuths_deg):
    inclination, azimuth = torch.meshgrid(
        torch.deg2rad(inclinations_deg), torch.deg2rad(azimuths_deg), indexing="ij"
    )
    horizontal = inclination.cos()
    parts = [horizontal * azimuth.cos(), horizontal * azimuth.sin(), inclination.sin()]
    return torch.stack(parts, -1).reshape(-1, 3)


def scan(points, intensity=0.3):
    return torch.cat([points, torch.full((len(points), 1), intensity)], dim=1)


@cache
def ground(radius_limit=15.0):
    directions = rays(torch.arange(-24, -6, 0.42), torch.arange(-180, 180, 0.18))
    points = directions * (-1.73 / directions[:, 2:])
    return scan(points[points.norm(dim=1) < radius_limit])


def turned(points, angle):
    """Points turned about z; further columns stay."""
    x, y = points[:, :2].double().T
    cos, sin = math.cos(angle), math.sin(angle)
    xy = torch.stack([x * cos - y * sin, x * sin + y * cos], dim=1)
    return torch.cat([xy.float(), points[:, 2:]], dim=1)


def wall(distance=12.0, azimuth_deg=0.0):
    directions = rays(torch.arange(-7, 3, 0.42), torch.arange(-25, 25, 0.18))
    points = directions * (distance / directions[:, :1])
    return scan(turned(points, math.radians(azimuth_deg)))


def pole():
    directions = rays(torch.arange(-8, 8, 0.42), torch.tensor([0.1]))
    return scan(directions * (10 / directions[:, :1]))


def foliage():
    generator = torch.Generator().manual_seed(0)
    directions = rays(torch.arange(-8, 8, 0.42), torch.arange(-20, 20, 0.18))
    jitter = torch.rand(len(directions), 1, generator=generator)
    return scan(directions * (8 + 0.5 * jitter))


@pytest.fixture(scope="module")
def extractor():
    return GeometricFeatures(dim=96)


def inner(values):
    """Without the few neighbourhoods at the border of the surface."""
    return values.sort().values[len(values) // 10 : -len(values) // 10]


def test_ground_is_a_plane_facing_up_at_height_zero(extractor):
    values = extractor.descriptors(ground())
    assert inner(values[:, PLANARITY]).min() > 0.85
    assert inner(values[:, UP]).min() > 0.99
    assert values[:, HEIGHT].abs().max() < 1e-4
    assert inner(values[:, SPHERICITY]).max() < 0.05


def test_wall_is_a_plane_facing_the_sensor(extractor):
    points = wall()
    values = extractor.descriptors(points)
    assert inner(values[:, PLANARITY]).min() > 0.8
    assert inner(values[:, UP].abs()).max() < 0.05
    # The normal is -x: against the ray in front, aside of it by its azimuth elsewhere. To which
    # side is not told.
    azimuth = torch.atan2(points[:, 1], points[:, 0])
    expected = torch.stack([-azimuth.cos(), azimuth.sin().abs()], dim=1)
    error = (values[:, [ALONG, ACROSS]] - expected).abs().amax(dim=1)
    assert inner(error).max() < 0.05


def test_pole_is_a_line_and_foliage_neither_line_nor_plane(extractor):
    pole_values, foliage_values = (extractor.descriptors(s) for s in (pole(), foliage()))
    assert inner(pole_values[:, LINEARITY]).min() > 0.95
    assert inner(pole_values[:, PLANARITY]).max() < 0.3
    assert foliage_values[:, SPHERICITY].median() > 0.3
    assert foliage_values[:, LINEARITY].median() < 0.5


def test_a_surface_does_not_mix_with_what_is_behind_it(extractor):
    near, far = wall(10.0), wall(20.0)
    column = far[:, 1] / far[:, 0] > 0.05  # the near wall hides the other half
    both = torch.cat([near[near[:, 1] / near[:, 0] <= 0.05], far[column]])
    values = extractor.descriptors(both)
    assert values[:, PLANARITY].quantile(0.02) > 0.7


def test_own_values(extractor):
    points = torch.tensor([[3.0, 4.0, -1.0, 0.7], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 9.0, 1.0]])
    values = extractor.descriptors(points)
    assert values[0, [HEIGHT, LOG_RANGE, INTENSITY]].tolist() == pytest.approx(
        [0.73, 0.5 * math.log(26), 0.7]
    )
    # Single points have no neighbourhood; none of them, the origin included, gives NaN.
    assert values[:, :6].abs().max() == 0
    assert torch.isfinite(extractor(points)).all()
    assert extractor(points[:0]).shape == (0, 96)
    row = scan(rays(torch.tensor([-2.0]), torch.tensor([0.1, 0.46, 0.82])) * 10)
    assert (extractor.descriptors(row[:2])[:, :6] == 0).all()  # the shape needs two neighbours
    assert (extractor.descriptors(row)[1, LINEARITY] - 1).abs() < 0.01


def test_turned_and_mirrored_scans_have_the_same_features(extractor):
    turn = 2 * math.pi * 129 / 1024  # whole columns, so that the pixels move as one
    # A wall at 40 degrees to the viewing direction: without the absolute value the normal across
    # the ray would be about 0.6 here and -0.6 in the mirror.
    points = torch.cat([wall(9.0, azimuth_deg=40), ground(8.0), foliage()])
    features = extractor(points)
    for changed in (turned(points, turn), points * torch.tensor([1.0, -1.0, 1.0, 1.0])):
        similarity = (features * extractor(changed)).sum(dim=1)
        assert similarity.quantile(0.02) > 0.99
    assert extractor.descriptors(points)[:, ACROSS].min() >= 0
    assert extractor.mirror_invariant
    assert extractor.settings["version"] == 2  # grids of version 1 told left from right


def test_features_have_unit_norm_and_follow_the_kernel():
    # Inner products are a Gaussian kernel, of width 2, of the standardised descriptors, up to the
    # error of 32 random frequencies (standard deviation below 1 / sqrt(2 * 32) = 0.125).
    extractor = GeometricFeatures(dim=128)
    points = torch.cat([wall(), ground(), pole(), foliage()])
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(1))[:300]]
    features = extractor(points)
    assert torch.allclose(features.norm(dim=1), torch.ones(300), atol=1e-5)
    standard = (extractor.descriptors(points) - torch.tensor(CENTRES)) / torch.tensor(SPREADS)
    expected = torch.exp(-(torch.cdist(standard, standard) ** 2) / (2 * 2**2))
    error = features @ features.T - expected
    assert error.square().mean().sqrt() < 0.125


def test_lift_is_linear():
    scans = [wall(), pole(), pole()[:0]]
    one = GeometricFeatures(64)
    # As for a loader process.
    prepare = pickle.loads(pickle.dumps(GeometricFeatures(64).prepare))  # noqa: S301
    together = one.point_features([prepare(points) for points in scans])
    for points, features in zip(scans, together, strict=True):
        assert torch.equal(one.lift(features), one(points))
    pooled = one.lift(together[0].mean(dim=0, keepdim=True))
    assert torch.allclose(pooled, one(scans[0]).mean(dim=0, keepdim=True), atol=1e-5)
    assert not list(one.parameters())
    assert not one.state_dict()
    with pytest.raises(ValueError, match="dim must be even and at least 2, got 3"):
        GeometricFeatures(3)
