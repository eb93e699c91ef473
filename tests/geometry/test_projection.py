import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from r3dpa.geometry import (
    EMPTY_RANGE_M,
    BeamProjection,
    LidarSensor,
    RingProjection,
    SphericalProjection,
    describe_share_kept,
    in_range,
    points_of,
    pool_cells,
    project_pixels,
    range_image,
    unproject,
)
from r3dpa.geometry.projection import ray_directions

SMALL = LidarSensor(beams=8, columns=16, inclination_max_deg=20.0, inclination_min_deg=-20.0)


def random_points(count, seed=0, farthest=70.0):
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(count, 3, generator=generator)
    direction = direction * torch.tensor([1.0, 1.0, 0.2])
    distance = farthest * torch.rand(count, 1, generator=generator)
    return torch.nn.functional.normalize(direction, dim=-1) * distance


def test_rows_run_down_and_columns_clockwise():
    """Up is row 0; left of the sensor (+y) is a quarter of the way, right three quarters."""
    points = torch.tensor([[10.0, 0, 9], [10, 0, -9], [-10, 0, 0], [0, 10, 0], [0, -10, 0]])
    row, column = SphericalProjection(SMALL).pixel_of(points)
    assert row[:2].tolist() == [0, 7]
    assert column.tolist() == [8, 8, 0, 4, 12]
    row, column = SphericalProjection(LidarSensor()).pixel_of(torch.tensor([10.0, 0.0, 0.0]))
    assert (row.item(), column.item()) == (6, 512)  # as documented
    assert row.dtype == column.dtype == torch.int64


def test_nearest_return_wins_whatever_the_order_and_the_first_of_equal_ones():
    points = torch.tensor([[30.0, 0, 0], [10.0, 0, 0], [20.0, 0, 0], [10.0, 0, 0]])
    for order, winner in (([0, 1, 2, 3], 1), ([1, 3, 2, 0], 0), ([2, 0, 3, 1], 2)):
        values = torch.arange(4).unsqueeze(1)
        range_m, image = range_image(points[order], SphericalProjection(SMALL), values)
        assert (range_m[4, 8], image[0, 4, 8]) == (10, winner)
        assert image.dtype == torch.int64
        assert (range_m > 0).sum() == 1


def test_range_limits_are_exclusive_and_fov_is_not():
    above, below = math.nextafter(1.0, 2.0), math.nextafter(56.0, 0.0)
    points = torch.tensor([[1.0, 0, 0], [0, 56.0, 0]], dtype=torch.float64)
    assert not in_range(points, LidarSensor()).any()
    # Ranges are float32, so one float64 step inside rounds to the limit itself ...
    points = torch.tensor([[above, 0, 0], [0, below, 0]], dtype=torch.float64)
    assert not in_range(points, LidarSensor()).any()
    # ... and one float32 step inside does not.
    one, far = torch.tensor(1.0), torch.tensor(56.0)
    points = torch.stack([one.nextafter(far), far.nextafter(one)]).diag_embed()
    points = torch.nn.functional.pad(points, (0, 1))
    assert in_range(points, LidarSensor()).all()
    steep = torch.tensor([[0.0, 0.0, 10.0], [1.0, 0.0, -10.0]])
    range_m, _ = range_image(steep, SphericalProjection(LidarSensor()))
    assert (range_m[0] > 0).sum() == (range_m[-1] > 0).sum() == 1


def test_padded_batches_give_the_images_of_single_scans():
    points, projection = random_points(500), SphericalProjection(SMALL)
    values = torch.rand(500, 2, generator=torch.Generator().manual_seed(2))
    padded_points = torch.full((2, 600, 3), math.nan)
    padded_values = torch.full((2, 600, 2), math.nan)
    padded_points[0, :500], padded_values[0, :500] = points, values
    padded_points[1, 50:350], padded_values[1, 50:350] = points[:300], values[:300]
    range_m, image = range_image(padded_points, projection, padded_values)
    assert range_m.shape == (2, 8, 16)
    assert image.shape == (2, 2, 8, 16)
    for index, count in enumerate((500, 300)):
        single_range, single_image = range_image(points[:count], projection, values[:count])
        assert torch.equal(range_m[index], single_range)
        assert torch.equal(image[index], single_image)


@pytest.mark.parametrize("shape", [(0, 3), (2, 0, 3), (0, 5, 3), (1, 3)], ids=str)
@pytest.mark.numerics("scans of 0, 1 and 2 points")
def test_scans_of_no_or_one_point(shape):
    points, projection = torch.full(shape, 5.0), SphericalProjection(SMALL)
    count = points.numel() // 3
    range_m, image = range_image(points, projection, torch.ones(*shape[:-1], 4))
    assert range_m.shape == (*shape[:-2], 8, 16)
    assert image.shape == (*shape[:-2], 4, 8, 16)
    assert (range_m != EMPTY_RANGE_M).sum() == image.count_nonzero() // 4 == count
    if len(shape) == 2:
        means, counts = pool_cells(points, points, projection, (2, 4))
        assert counts.sum() == count
        assert means.isfinite().all()


def test_unproject_batches_and_gradients():
    projection = SphericalProjection(SMALL)
    empty = unproject(torch.full((8, 16), EMPTY_RANGE_M), projection)
    assert not empty.any()  # the origin, which is dropped like any other near point
    range_m = (10 * torch.rand(2, 3, 8, 16) + 2).requires_grad_()
    points = unproject(range_m, projection)
    assert points.shape == (2, 3, 8, 16, 3)
    assert torch.equal(points[1, 2], unproject(range_m[1, 2], projection))
    points.square().sum().backward()
    torch.testing.assert_close(range_m.grad, 2 * range_m.detach())


@pytest.mark.parametrize("of_pixels", [unproject, points_of])
@pytest.mark.parametrize("projection", [SphericalProjection(SMALL), BeamProjection.of("vlp16", 16)])
def test_images_of_another_size_are_refused(of_pixels, projection):
    with pytest.raises(ValueError, match=r"must be \(\.\.\., \d+, 16\) .* got shape \(1, 16\)"):
        of_pixels(torch.ones(1, 16), projection)


def test_rays_cached_in_inference_mode_take_part_in_a_backward_pass():
    projection = SphericalProjection(LidarSensor(beams=3, columns=7))
    with torch.inference_mode():  # the first call fills the cache
        unproject(torch.ones(3, 7), projection)
    range_m = torch.ones(3, 7, requires_grad=True)
    unproject(range_m, projection).sum().backward()
    assert range_m.grad.isfinite().all()


def test_pooling_equals_a_loop():
    points, projection = random_points(2000), SphericalProjection(SMALL)
    values = torch.randn(2000, 5, generator=torch.Generator().manual_seed(3))
    means, counts = pool_cells(points, values, projection, (4, 8))
    row, column = projection.pixel_of(points)
    kept = in_range(points, SMALL)
    for cell in range(32):
        members = kept & (row // 2 == cell // 8) & (column // 2 == cell % 8)
        assert counts[cell] == members.sum()
        expected = values[members].double().mean(dim=0) if members.any() else torch.zeros(5)
        torch.testing.assert_close(means[cell], expected.float())
    for dtype, expected in (("float16", "float32"), ("float32", "float32"), ("float64", "float64")):
        means, _ = pool_cells(points, values.to(getattr(torch, dtype)), projection, (4, 8))
        assert means.dtype == getattr(torch, expected)
    unfiltered = pool_cells(points, values, projection, (4, 8), range_filter=False)[1]
    assert unfiltered.sum() == len(points) > counts.sum()


def test_points_and_images_of_wrong_shapes_are_refused():
    projection, points = SphericalProjection(SMALL), torch.zeros(5, 3)
    for function, arguments, message in (
        (projection.pixel_of, (torch.zeros(7, 4),), r"\(7, 4\)"),
        (range_image, (points.numpy(), projection), "got ndarray; torch.from_numpy makes one"),
        (range_image, (torch.zeros(2, 2, 5, 3), projection), r"\(2, 2, 5, 3\)"),
        (range_image, (points, projection, torch.ones(4, 1)), r"values must be \(5, F\).*\(4, 1\)"),
        (range_image, (points, projection, torch.ones(6, 1)), r"values must be \(5, F\).*\(6, 1\)"),
        (range_image, (points, projection, torch.ones(5)), r"values must be \(5, F\).*\(5,\)"),
        (project_pixels, (points, projection, torch.ones(4)), r"labels must be \(5,\).*\(4,\)"),
        (points_of, (torch.zeros(1, 8, 16), projection), "one by one"),
        (pool_cells, (points, torch.zeros(5, 1), projection, (3, 4)), "3 x 4"),
        (pool_cells, (points, torch.zeros(4, 1), projection, (2, 4)), r"\(4, 1\)"),
    ):
        with pytest.raises(ValueError, match=message):
            function(*arguments)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_equals_cpu():
    points, projection = random_points(50_000), SphericalProjection(LidarSensor())
    values = torch.rand(50_000, 3, generator=torch.Generator().manual_seed(4))
    range_m, image = range_image(points, projection, values)
    cuda_range, cuda_image = range_image(points.cuda(), projection, values.cuda())
    # libm and CUDA may round an angle on a pixel border differently.
    assert (cuda_range.cpu() != range_m).sum() <= 2
    assert (cuda_image.cpu() != image).sum() <= 6
    expected, _ = pool_cells(points, values, projection)
    means, again = (pool_cells(points.cuda(), values.cuda(), projection)[0] for _ in range(2))
    torch.testing.assert_close(means.cpu(), expected, atol=1e-3, rtol=0)
    assert torch.equal(again, means)
    range_again, image_again = range_image(points.cuda(), projection, values.cuda())
    assert torch.equal(range_again, cuda_range)
    assert torch.equal(image_again, cuda_image)
    torch.testing.assert_close(
        unproject(cuda_range, projection).cpu(), unproject(cuda_range.cpu(), projection)
    )


# Hard numerical cases of the design notes, section 3, each with the naive computation.


@pytest.mark.numerics
def test_points_without_a_direction_are_dropped_and_counted():
    bad = [
        [0.0, 0.0, 0.0],
        [1e-30, 1e-30, 1e-30],
        [math.inf, 0.0, 0.0],
        [1.0, -math.inf, math.inf],
        [math.nan, 1.0, 1.0],
        [3e38, 3e38, 3e38],
    ]
    points = torch.tensor([*bad, [10.0, 0.0, 0.0]])
    naive = torch.arcsin(points[:, 2] / points.square().sum(dim=-1).sqrt())
    assert naive[:5].isnan().sum() == 4
    projection = SphericalProjection(LidarSensor())
    row, column = projection.pixel_of(points)
    assert ((row >= 0) & (row < 64) & (column >= 0) & (column < 1024)).all()
    assert row[[0, 2, 3, 4]].unique().tolist() == [6]  # not finite: the pixel of the origin
    assert column[[0, 2, 3, 4]].unique().tolist() == [512]
    assert (~in_range(points, projection.sensor)).sum() == len(bad)
    range_m, _ = range_image(points, projection)
    assert (range_m > 0).sum() == 1
    means, counts = pool_cells(points, points, projection, range_filter=False)
    assert counts.sum() == 4  # the finite ones: the origin, a denormal, a far and a good point
    assert means.isfinite().all()


@pytest.mark.numerics
def test_inclination_near_the_zenith():
    """float32 arcsin is off by up to 4e-4 rad towards the pole, a row of a fine sensor."""
    angle_to_pole = torch.logspace(-6, -2, 2000, dtype=torch.float64)
    points = torch.stack(
        [10 * angle_to_pole.sin(), 0 * angle_to_pole, 10 * angle_to_pole.cos()], dim=-1
    ).float()
    x, _, z = points.double().unbind(-1)
    exact = math.pi / 2 - torch.atan(x / z)
    unit = points / points.norm(dim=-1, keepdim=True)
    naive = torch.arcsin(unit[:, 2].clamp(-1, 1))
    assert (naive - exact).abs().max() > 1e-4
    pitch = 1e-6  # rows of 1e-6 rad below the pole measure the inclination itself
    fine = LidarSensor(20_000, 4, 90.0, 90.0 - math.degrees(20_000 * pitch))
    row, _ = SphericalProjection(fine).pixel_of(points)
    assert (math.pi / 2 - (row + 0.5) * pitch - exact).abs().max() < 1e-6
    for pole in ([0.0, 0.0, 5.0], [0.0, 0.0, -5.0]):
        assert (range_image(torch.tensor([pole]), SphericalProjection(SMALL))[0] > 0).sum() == 1


@pytest.mark.numerics
def test_eight_compass_directions():
    """arctan(y / x), as printed in the paper, loses the quadrant and divides by zero."""
    azimuth = math.pi - (torch.arange(8, dtype=torch.float64) + 0.5) * (2 * math.pi / 8)
    compass = torch.stack([azimuth.cos(), azimuth.sin(), 0 * azimuth], dim=-1)
    naive = torch.arctan(compass[:, 1] / compass[:, 0])
    assert ((naive - azimuth).abs() > 1).sum() == 4
    assert torch.arctan(torch.tensor(0.0) / torch.tensor(0.0)).isnan()
    _, column = SphericalProjection(LidarSensor(4, 8)).pixel_of(compass)
    assert column.tolist() == list(range(8))


@pytest.mark.numerics
def test_signed_zero_behind_the_sensor():
    points = torch.tensor([[-1.0, 0.0, 0.0], [-1.0, -0.0, 0.0]])
    azimuth = torch.atan2(points[:, 1], points[:, 0]).double()
    naive = ((math.pi - azimuth.clamp(-math.pi, math.pi)) / (2 * math.pi) * 1024).floor()
    assert naive.clamp(0, 1023).tolist() == [0, 1023]
    _, column = SphericalProjection(LidarSensor()).pixel_of(points)
    assert column.tolist() == [0, 0]
    _, column = SphericalProjection(LidarSensor(), legacy_seam=True).pixel_of(points)
    assert column.tolist() == [0, 1023]
    beside = torch.tensor([[-13.0, 1e-7, 0.0], [-13.0, -1e-7, 0.0]])
    assert torch.atan2(beside[1, 1], beside[1, 0]) == -torch.tensor(math.pi)  # float32
    assert SphericalProjection(LidarSensor()).pixel_of(beside)[1].tolist() == [0, 1023]


@pytest.mark.numerics
def test_mean_angle_of_a_round_trip():
    """Pixel corners turn every point up by half a row and aside by half a column."""
    sensor = LidarSensor()
    projection = SphericalProjection(sensor)
    generator = torch.Generator().manual_seed(0)
    inclination, azimuth = torch.rand(2, 20_000, generator=generator, dtype=torch.float64)
    inclination = (inclination * 28 - 25).deg2rad()
    azimuth = (azimuth * 359.6 - 179.8).deg2rad()  # clear of the seam, so that angles subtract
    horizontal = inclination.cos()
    points = torch.stack(
        [horizontal * azimuth.cos(), horizontal * azimuth.sin(), inclination.sin()], dim=-1
    )
    row, column = projection.pixel_of(points)

    def mean_residual_deg(corner):
        rays = ray_directions(projection, corner, torch.float64)[row, column]
        up = torch.asin(rays[:, 2]) - inclination
        aside = torch.atan2(rays[:, 1], rays[:, 0]) - azimuth
        aside = torch.remainder(aside + math.pi, 2 * math.pi) - math.pi
        return up.rad2deg().mean().item(), aside.rad2deg().mean().item()

    assert mean_residual_deg(corner=True) == pytest.approx((0.219, 0.176), abs=0.01)
    assert mean_residual_deg(corner=False) == pytest.approx((0.0, 0.0), abs=0.01)


@pytest.mark.numerics
def test_pooling_is_as_exact_as_it_says():
    """Far from zero, cancelling, of large and opposite values: a running float32 sum is not."""
    count, cells = 150_000, 4
    generator = torch.Generator().manual_seed(5)
    values = 1e4 + torch.randn(count, 4, generator=generator)
    values[:, 1] = torch.randn(count, generator=generator) * 1e-3  # cancels
    values[:, 2] = torch.where(torch.arange(count) % 2 == 0, 1e6, -1e6) + values[:, 1]
    values[:, 3] = 0.1
    azimuth = math.pi / 4 + math.pi / 2 * torch.randint(cells, (count,), generator=generator)
    points = 10 * torch.stack([azimuth.cos(), azimuth.sin(), 0 * azimuth], dim=-1)
    projection = SphericalProjection(SMALL)
    means, counts = pool_cells(points, values, projection, (1, cells))
    assert counts.min() > count / 5
    cell = projection.pixel_of(points)[1] // 4
    naive = 0.0
    for index in range(cells):
        members = values[cell == index]
        for feature in range(4):
            column = members[:, feature]
            exact = math.fsum(column.tolist()) / len(column)
            bound = 33 * 2**-24 * column.double().abs().mean().item()
            assert abs(means[index, feature].item() - exact) <= bound
            running = column.numpy().cumsum()[-1].item() / len(column)
            naive = max(naive, abs(running - exact) / bound)
    assert naive > 3


def test_values_of_points_that_do_not_count_are_not_seen():
    points = torch.tensor([[10.0, 0, 0], [0.1, 0, 0], [90.0, 0, 0], [math.nan, 0, 0]])
    values = torch.tensor([[3.0], [math.nan], [math.inf], [math.nan]])
    means, counts = pool_cells(points, values, SphericalProjection(SMALL), (2, 4))
    assert counts.sum() == counts[6] == 1
    assert means[6].item() == 3
    assert means.sum() == 3


def test_pooling_does_not_depend_on_threads():
    points, projection = random_points(10_000), SphericalProjection(LidarSensor())
    values = torch.randn(10_000, 32, generator=torch.Generator().manual_seed(6))
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(pool_cells(points, values, projection)[0])
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


exhaustive = settings(derandomize=True, max_examples=25, deadline=None)


@pytest.mark.numerics("rows of equal pitch and real beams")
def test_nominal_beams_leave_rows_of_equal_pitch_empty():
    """HDL-64E: 32 beams of 1/3 degree pitch from +2 down, 32 of 1/2 degree from -8.83 down.

    0.01 degrees are taken off, so that no beam meets the border of a row.
    """
    upper, lower = 2 - torch.arange(32) / 3, -8.83 - torch.arange(32) / 2
    inclinations = torch.cat([upper, lower]).double() - 0.01
    azimuth = (torch.arange(2083).double() + 0.5) * (2 * math.pi / 2083)
    up = inclinations.deg2rad()[:, None]
    xyz = up.cos() * azimuth.cos(), up.cos() * azimuth.sin(), up.sin().expand(64, 2083)
    points = (20 * torch.stack(xyz, dim=-1)).reshape(-1, 3).float()  # ring after ring, as a file

    sensor = LidarSensor()
    hit = range_image(points, SphericalProjection(sensor))[0] > 0
    pitch = 28 / 64
    expected = {math.floor((3 - angle) / pitch) for angle in inclinations.tolist()}
    assert set(hit.any(dim=1).nonzero().flatten().tolist()) == expected
    assert len(expected) == 56
    assert hit[hit.any(dim=1)].all()  # a row is either full or empty: nothing was dropped
    by_ring = range_image(points, RingProjection(sensor, tuple(inclinations.tolist())))[0] > 0
    assert by_ring.all()

    assert hit.any(dim=1).sum() < len(inclinations)  # "each beam has its row"
    survive = hit.sum() / len(points)
    assert survive == pytest.approx(0.43, abs=0.005)


@st.composite
def sensors(draw):
    low = draw(st.floats(-85, 60))
    return LidarSensor(
        beams=draw(st.integers(1, 40)),
        columns=draw(st.integers(1, 200)),
        inclination_max_deg=low + draw(st.floats(1, 25)),
        inclination_min_deg=low,
        range_max_m=draw(st.floats(2, 500)),
    )


@pytest.mark.numerics
@exhaustive
@given(sensor=sensors(), seed=st.integers(0, 2**32))
def test_an_image_comes_back_from_its_points(sensor, seed):
    """Centres of pixels lie in their pixels, whatever the sensor; ranges to float32 rounding."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(sensor.beams, sensor.columns, generator=generator)
    width = sensor.range_max_m - sensor.range_min_m
    range_m = sensor.range_min_m + width * (0.001 + 0.998 * share)
    range_m[torch.rand(range_m.shape, generator=generator) < 0.3] = EMPTY_RANGE_M
    projection = SphericalProjection(sensor)
    again, _ = range_image(points_of(range_m, projection), projection)
    torch.testing.assert_close(again, range_m, rtol=3e-7, atol=0)
    whole = unproject(range_m.clamp(min=2), projection)
    row, column = projection.pixel_of(whole)
    assert torch.equal(row, torch.arange(sensor.beams)[:, None].expand_as(row))
    assert torch.equal(column, torch.arange(sensor.columns).expand_as(column))


def test_the_share_that_an_image_gives_back_is_a_mean_over_scans():
    """Two points share a pixel, and one beyond the range limits does not count."""
    ahead = torch.tensor([[10.0, 0.1, 0.1], [20.0, 0.2, 0.2]])
    beyond = torch.tensor([[500.0, 0.0, 0.0]])
    scans = [torch.cat([ahead, beyond]), ahead[:1]]
    assert describe_share_kept(scans, SphericalProjection(SMALL)) == (
        "75.0% of the points of 2 scans within the range limits come back from the range image "
        "of 8 x 16"
    )
