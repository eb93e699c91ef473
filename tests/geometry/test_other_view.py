"""Images as another sensor would see them: exact on planes, refused where nothing is known."""

import math
from dataclasses import replace

import pytest
import torch

from lidarsim import load_sensor
from r3dpa.geometry import BeamProjection, LidarSensor, SphericalProjection, unproject
from r3dpa.geometry.other_view import projection_for, values_in, view_of

MODEL = SphericalProjection(LidarSensor())


def some_beams(keep_every, **changes):
    """HDL-64E with every n-th beam."""
    lidar = load_sensor("hdl64e")
    lasers = type(lidar.lasers)(
        *(getattr(lidar.lasers, name)[::keep_every] for name in lidar.lasers.__dataclass_fields__)
    )
    return replace(lidar, lasers=lasers, **changes)


def ground(projection, height_m=1.73):
    """Ranges of a horizontal plane below the sensor, -1 above the horizon."""
    rows = projection.ray_angles()[0]
    range_m = torch.where(rows < math.radians(-2), -height_m / rows.sin(), -1.0)
    return range_m[:, None].expand(-1, projection.sensor.columns).float()[None]


def test_a_plane_stays_a_plane():
    target = projection_for(some_beams(2), MODEL)
    range_m, _ = view_of(ground(MODEL), MODEL, target)
    assert range_m.shape == (1, 32, 1024)
    points = unproject(range_m, target)[range_m > 0]
    assert len(points) > 20_000
    height_m = points[:, 2]
    assert (height_m + 1.73).abs().median() < 0.002
    assert (height_m + 1.73).abs().quantile(0.99) < 0.02
    assert target.sensor.range_max_m == 56.0


def test_rows_that_no_beam_met_are_filled_but_not_single_losses():
    image = ground(MODEL).clone()
    image[:, 40] = -1
    image[:, 31, 100] = -1
    range_m, _ = view_of(image, MODEL, projection_for("hdl64e", MODEL))
    whole, _ = view_of(ground(MODEL), MODEL, projection_for("hdl64e", MODEL))
    lost = ((range_m < 0) & (whole > 0)).sum()
    assert 1 <= lost <= 2
    range_m, whole = range_m[..., :90], whole[..., :90]  # beside the loss, rows are not blended
    torch.testing.assert_close(range_m, whole, rtol=0.01, atol=0)


def test_filled_rows_have_the_values_beside_them():
    range_m, labels = torch.full((1, 64, 1024), 10.0), torch.full((1, 64, 1024), 7)
    range_m[:, 5:60:6], labels[:, 5:60:6] = -1, 0
    seen, view = view_of(range_m, MODEL, projection_for("hdl64e", MODEL))
    assert (values_in(labels, view, seen)[seen > 0] == 7).all()


def test_values_come_from_the_nearest_pixel():
    target = projection_for(some_beams(4), MODEL)
    image = ground(MODEL)
    rows = torch.arange(64)[None, :, None].expand(1, 64, 1024)
    range_m, view = view_of(image, MODEL, target)
    picked = values_in(rows, view, range_m)
    inclination = torch.asin(unproject(range_m, target)[..., 2] / range_m.clamp(min=1))
    expected = (math.radians(3.0) - inclination) / math.radians(28 / 64) - 0.5
    seen = range_m > 0
    assert (picked[seen] - expected[seen]).abs().max() < 0.6
    assert (picked[~seen] == 0).all()


def test_from_beams_to_beams():
    source = BeamProjection.of("os1_128", 1024)
    target = projection_for("os1_32", source)
    range_m, _ = view_of(ground(source), source, target)
    points = unproject(range_m, target)[range_m > 0]
    assert (points[:, 2] + 1.73).abs().median() < 0.01


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "hdl32e",
            r"hdl32e looks from -30\.7 to 10\.7 degrees, but the model knows -25\.0 to 3\.0",
        ),
        ("waymo_top", r"waymo_top has a beam every 0\.32 degrees, but the model every 0\.44"),
    ],
)
def test_what_the_model_cannot_know_is_refused(name, message):
    with pytest.raises(ValueError, match=message):
        projection_for(name, MODEL)


def test_the_sensor_of_the_model_is_one_of_those_it_knows():
    assert projection_for("hdl64e", MODEL).sensor.beams == 64
