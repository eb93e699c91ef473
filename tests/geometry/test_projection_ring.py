import math

import numpy as np
import pytest
import torch

from r3dpa.geometry import (
    EMPTY_RANGE_M,
    LidarSensor,
    RingProjection,
    SphericalProjection,
    in_range,
    points_of,
    pool_cells,
    range_image,
)
from r3dpa.geometry.projection import ray_directions

SENSOR = LidarSensor(beams=8, columns=90, inclination_max_deg=5.0, inclination_min_deg=-25.0)
# Uneven pitch on purpose: two neighbouring lasers fall into one row of equal pitch.
INCLINATIONS = (3.0, 2.5, 0.0, -4.0, -8.0, -12.0, -18.0, -24.0)
RING = RingProjection(SENSOR, INCLINATIONS)


def scan_of(inclinations=INCLINATIONS, shots=300, jitter_rad=0.0, seed=0):
    """Scan stored ring after ring, azimuth rising from 0, with noise along the inclination."""
    generator = torch.Generator().manual_seed(seed)
    azimuth = (torch.arange(shots, dtype=torch.float64) + 0.5) * (2 * math.pi / shots)
    azimuth = azimuth.repeat(len(inclinations))
    azimuth = azimuth + jitter_rad * torch.randn(len(azimuth), generator=generator)
    inclination = torch.tensor(inclinations, dtype=torch.float64).deg2rad()
    inclination = inclination.repeat_interleave(shots)
    inclination = inclination + 1e-3 * torch.randn(len(azimuth), generator=generator)
    distance = 5 + 20 * torch.rand(len(azimuth), generator=generator)
    horizontal = distance * inclination.cos()
    points = [horizontal * azimuth.cos(), horizontal * azimuth.sin(), distance * inclination.sin()]
    ring = torch.arange(len(inclinations)).repeat_interleave(shots)
    return torch.stack(points, dim=-1).float(), ring


def test_rows_are_rings_and_columns_are_those_of_the_other_projection():
    points, ring = scan_of()
    row, column = RING.pixel_of(points)
    assert torch.equal(row, ring)
    assert torch.equal(column, SphericalProjection(SENSOR).pixel_of(points)[1])
    by_pitch, _ = SphericalProjection(SENSOR).pixel_of(points)
    assert len(by_pitch.unique()) < 8  # what unfolding by ring is for
    assert (range_image(points, RING)[0] > 0).all()
    means, counts = pool_cells(points, ring.float().unsqueeze(1), RING, (4, 9))
    assert counts.sum() == len(points)
    assert (means.reshape(4, 9) - torch.tensor([0.5, 2.5, 4.5, 6.5]).unsqueeze(1)).abs().max() < 0.1


def test_jitter_of_the_azimuth_and_gaps_make_no_ring():
    points, ring = scan_of(jitter_rad=0.05)  # steps back of up to 0.2 rad, some over the seam
    azimuth = torch.atan2(points[:, 1], points[:, 0]) % (2 * math.pi)
    assert (azimuth.diff() < 0).sum() > 500
    row, _ = RING.pixel_of(points)
    # Points that jitter over the seam belong to the turn on the other side.
    assert (row != ring).float().mean() < 0.02
    points, ring = scan_of()
    azimuth = torch.atan2(points[:, 1], points[:, 0]) % (2 * math.pi)
    kept = (azimuth < 0.7) | (azimuth > 2 * math.pi - 0.8)  # a camera's field of view
    assert torch.equal(RING.pixel_of(points[kept])[0], ring[kept])


@pytest.mark.parametrize("dummy", [[0.0, 0.0, 0.0], [5.0, 0.1, 0.0]], ids=["origin", "stray"])
def test_an_extra_wrap_at_the_end_makes_no_ring(dummy):
    """Some drives end with a point at the origin, whose azimuth counts as 0."""
    points, ring = scan_of()
    azimuth = torch.atan2(points[:, 1], points[:, 0]) % (2 * math.pi)
    assert (azimuth.diff() < -math.pi).sum() == 7
    points = torch.cat([points, torch.tensor([dummy])])
    row, _ = RING.pixel_of(points)
    assert torch.equal(row[:-1], ring)
    assert RingProjection.fit([points], SENSOR).ring_inclinations_deg == pytest.approx(
        INCLINATIONS, abs=0.02
    )


def test_missing_rings_are_found_by_their_inclination():
    points, ring = scan_of()
    for missing in ([0], [7], [3], [1, 2, 6], [0, 1, 2, 3, 4, 5, 7]):
        kept = ~torch.isin(ring, torch.tensor(missing))
        row, _ = RING.pixel_of(points[kept])
        assert torch.equal(row, ring[kept])


def test_scans_with_hardly_any_point():
    points, ring = scan_of()
    for index in ([], [1000], [700, 2000]):
        range_m, _ = range_image(points[index], RING)
        assert (range_m > 0).sum() == len(index)
        assert torch.equal(RING.pixel_of(points[index])[0], ring[index])


def test_fit_is_the_median_of_all_scans():
    scans = [scan_of(seed=seed)[0] for seed in range(3)]
    scans[1][5] = torch.tensor([1.0, 0.01, 15.0])  # an outlier does not move a median
    incomplete = scan_of(INCLINATIONS[1:])[0] + 0.0
    fitted = RingProjection.fit([*scans, incomplete], SENSOR)
    assert fitted.ring_inclinations_deg == pytest.approx(INCLINATIONS, abs=0.01)
    assert RingProjection.fit(scans, SENSOR) == fitted
    with pytest.raises(ValueError, match=r"\[7\]"):
        RingProjection.fit([incomplete], SENSOR)
    with pytest.raises(ValueError, match="no scan"):
        RingProjection.fit([], SENSOR)


@pytest.mark.parametrize("empty_rows", [[], [0], [0, 1, 2, 5]])
def test_points_of_an_image_are_read_back_as_that_image(empty_rows):
    range_m, _ = range_image(scan_of()[0], RING)
    range_m[empty_rows] = EMPTY_RANGE_M
    range_m[3, 10:40] = EMPTY_RANGE_M
    read_back, _ = range_image(points_of(range_m, RING), RING)
    torch.testing.assert_close(read_back, range_m, atol=1e-4, rtol=0)


def test_rays_look_along_the_rings_and_a_corner_moves_columns_only():
    inclination, azimuth = RING.ray_angles()
    assert inclination.rad2deg().tolist() == pytest.approx(INCLINATIONS)
    corner_inclination, corner_azimuth = RING.ray_angles(corner=True)
    assert torch.equal(inclination, corner_inclination)
    assert (corner_azimuth - azimuth).tolist() == pytest.approx([math.pi / 90] * 90)


def test_batches_and_padding():
    points, _ = scan_of()
    batch = torch.full((2, len(points) + 50, 3), math.nan)
    batch[0, : len(points)] = points
    batch[1, 30:1230] = points[:1200]  # the first four rings, padded on both sides
    range_m, _ = range_image(batch, RING)
    assert torch.equal(range_m[0], range_image(points, RING)[0])
    assert torch.equal(range_m[1], range_image(points[:1200], RING)[0])
    assert (range_m[1, 4:] == EMPTY_RANGE_M).all()


def in_ring_orders(points, ring):
    """Points of a whole scan, stored ring after ring but not as KITTI stores them."""
    clockwise = torch.cat([points[ring == beam].flip(0) for beam in ring.unique()])
    lowest_first = torch.cat([points[ring == beam] for beam in ring.unique().flip(0)])
    return {"lowest first": lowest_first, "clockwise": clockwise, "both": points.flip(0)}


@pytest.mark.parametrize("missing", [[], [3]], ids=["whole", "a ring missing"])
def test_points_in_another_order_are_refused(missing):
    points, ring = scan_of()
    kept = ~torch.isin(ring, torch.tensor(missing))
    for wrong in in_ring_orders(points[kept], ring[kept]).values():
        with pytest.raises(ValueError, match=r"ring after ring.*projection: spherical, which"):
            RING.pixel_of(wrong)
        if not missing:
            with pytest.raises(ValueError, match="not stored ring after ring"):
                RingProjection.fit([wrong], SENSOR)
    shuffled = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    by_column = torch.arange(len(points)).reshape(8, 300).T.flatten()
    for order in (shuffled, by_column, points.norm(dim=-1).argsort()):
        with pytest.raises(ValueError, match="not stored ring after ring"):
            RING.pixel_of(points[order])


def test_near_walls_all_around_do_not_look_like_another_order():
    """Lasers 0.2 m above the frame origin see a wall at 4 m 2.9 degrees above their beam."""
    points, ring = scan_of()
    unit = torch.nn.functional.normalize(points, dim=-1)
    near = unit * 4 / unit[:, :2].norm(dim=-1, keepdim=True) + torch.tensor([0.0, 0.0, 0.2])
    assert torch.equal(RING.pixel_of(near)[0], ring)


def test_wrong_settings_and_scans_with_other_rings_are_refused():
    with pytest.raises(ValueError, match="got 2"):
        RingProjection(SENSOR, (1.0, 2.0))
    with pytest.raises(ValueError, match="nan"):
        RingProjection(SENSOR, (math.nan, *INCLINATIONS[1:]))
    behind = scan_of()[0] * torch.tensor([-1.0, -1.0, 1.0])  # rings that start behind the sensor
    for points in (scan_of((*INCLINATIONS, -24.8))[0], behind):
        with pytest.raises(ValueError, match="9 rings but the sensor has 8 beams"):
            RING.pixel_of(points)
    listed = RingProjection(SENSOR, list(INCLINATIONS))  # as read from YAML
    assert hash(listed) == hash(RING)


@pytest.fixture(scope="module")
def real_scans(real_scans_dir):
    """The projection fitted to every third scan; points, rows and columns of each of these."""
    paths = sorted(real_scans_dir.glob("**/*.bin"))[::3]
    scans = [
        torch.from_numpy(np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]) for path in paths
    ]
    ring = RingProjection.fit(scans, LidarSensor())
    return ring, [(points, *ring.pixel_of(points)) for points in scans]


@pytest.mark.data
def test_real_scans_fill_the_image_by_ring(real_scans):
    """0.85-0.92 of the pixels by ring, 0.71-0.80 by equal pitch, each +-0.01."""
    sensor = LidarSensor()
    ring, scans = real_scans
    pitch = torch.tensor(ring.ring_inclinations_deg).diff()
    assert pitch.max() < 0  # every fitted laser lies below the one before it
    assert pitch.min() > -1
    for points, row, column in scans:
        assert len(row.unique()) == 64
        for projection, low, high in ((ring, 0.84, 0.93), (SphericalProjection(sensor), 0.7, 0.8)):
            assert low < (range_image(points, projection)[0] > 0).float().mean() < high
        # Round trip: parallax and the mounting of the car tilt single rings, not the scan.
        kept = in_range(points, sensor)
        rays = ray_directions(ring, dtype=torch.float64)[row[kept], column[kept]]
        unit = torch.nn.functional.normalize(points[kept].double(), dim=-1)
        residual = (rays * unit).sum(dim=-1).clamp(max=1).arccos().rad2deg()
        assert residual.median() < 0.7


@pytest.mark.data
def test_a_real_scan_in_other_orders_is_refused(real_scans):
    ring, [(points, row, _), *_] = real_scans
    for wrong in in_ring_orders(points, row).values():
        with pytest.raises(ValueError, match="not stored ring after ring"):
            ring.pixel_of(wrong)
