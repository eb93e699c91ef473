import json
import math

import pytest
import torch

from r3dpa.geometry import (
    NUM_CLASSES,
    UNKNOWN_CLASS,
    LidarSensor,
    RangeCodec,
    RingProjection,
    ScanGeometry,
    SphericalProjection,
)

SENSOR = LidarSensor(beams=4, columns=32)
FAR = LidarSensor(beams=4, columns=32, range_max_m=80.0)
NEAR = LidarSensor(beams=4, columns=32, range_min_m=1.45, range_max_m=80.0)


RINGS = RingProjection(SENSOR, (2.0, -1.0, -8.5, -20.0))


@pytest.mark.parametrize("projection", [SphericalProjection(SENSOR, legacy_seam=True), RINGS])
def test_a_geometry_becomes_plain_values_and_comes_back(projection):
    geometry = ScanGeometry(projection, RangeCodec("log2", 6.0), (2, 8))
    stored = json.loads(json.dumps(geometry.to_dict()))
    assert stored == geometry.to_dict()  # nothing that JSON would change, such as a tuple
    restored = ScanGeometry.from_dict(stored)
    assert restored == geometry
    assert hash(restored.projection) == hash(projection)


def test_limits_of_a_sensor_in_radians():
    sensor = LidarSensor(inclination_max_deg=45.0, inclination_min_deg=-90.0)
    assert sensor.inclination_max_rad == pytest.approx(math.pi / 4)
    assert sensor.field_of_view_rad == pytest.approx(0.75 * math.pi)


def test_impossible_sensors_are_refused():
    for name, value, message in (
        ("beams", 0, "beams=0"),
        ("columns", -3, "columns=-3"),
        ("inclination_max_deg", -25.0, "inclination_max_deg=-25.0"),
        ("inclination_max_deg", 90.5, "90.5"),
        ("inclination_min_deg", math.nan, "nan"),
        ("range_min_m", -0.1, "range_min_m=-0.1"),
        ("range_min_m", 56.0, "range_max_m=56.0"),
        ("range_max_m", math.inf, "inf"),
    ):
        with pytest.raises(ValueError, match=message):
            LidarSensor(**{name: value})


def test_damaged_values_of_a_geometry_are_refused():
    whole = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8)).to_dict()
    for damaged in (
        {key: whole[key] for key in ("projection", "codec")},
        whole | {"projection": whole["projection"] | {"kind": "cubic"}},
        whole | {"projection": whole["projection"] | {"tilt": 1.0}},
        whole | {"codec": {"encoding": "linear", "base": 2}},
        whole | {"grid_size": [2]},
    ):
        with pytest.raises(ValueError, match="not a scan geometry"):
            ScanGeometry.from_dict(damaged)


@pytest.mark.parametrize(
    ("sensor", "short", "enough", "message"),
    [
        (FAR, RangeCodec(), RangeCodec("linear", 80.0), "ends at 56.00 m, but .* up to 80 m"),
        (FAR, RangeCodec("log2"), RangeCodec("log2", math.log2(81)), "ends at 56.28 m"),
        (SENSOR, RangeCodec("linear", 55.9), RangeCodec(), "ends at 55.90 m"),
        (
            SENSOR,
            RangeCodec("inverse"),
            RangeCodec("inverse", 1.0),
            "begins .* 1.45 m, .* from 1 m",
        ),
        (NEAR, RangeCodec("inverse", 1.5), RangeCodec("inverse"), "Lower the scale"),
    ],
)
def test_a_codec_that_would_show_other_points_as_a_wall_is_refused(sensor, short, enough, message):
    ScanGeometry(SphericalProjection(sensor), enough, (2, 8))
    with pytest.raises(ValueError, match=message):
        ScanGeometry(SphericalProjection(sensor), short, (2, 8))


@pytest.mark.parametrize("grid_size", [(3, 8), (2, 5), (0, 8), (2, -8)])
def test_a_grid_that_does_not_divide_the_image_is_refused(grid_size):
    with pytest.raises(ValueError, match=r"does not divide the 4 x 32 range image"):
        ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), grid_size)


def test_inverse_range_and_reflectance():
    codec = RangeCodec("inverse", 1.45, reflectance=True)
    sensor = LidarSensor(beams=1, columns=4, range_min_m=1.45, range_max_m=80.0)
    range_m = torch.tensor([[2.9, 79.0, -1.0, 1.5]])
    image = codec.to_image(range_m, torch.tensor([[0.0, 1.0, 0.7, 0.25]]))
    # 2 * 1.45 / 2.9 - 1 = 0; no return is -1 in both channels.
    assert image[:, 0, 0].tolist() == pytest.approx([0.0, -1.0], abs=1e-6)
    assert image[:, 0, 2].tolist() == [-1.0, -1.0]
    torch.testing.assert_close(codec.ranges_of(image, sensor), range_m)
    assert image[1].tolist() == [[-1.0, 1.0, -1.0, -0.5]]
    with pytest.raises(ValueError, match="needs scans with a reflectance"):
        codec.to_image(range_m)
    with pytest.raises(ValueError, match="exclude each other"):
        RangeCodec(return_channel=True, reflectance=True)


def test_intensity_and_class_survive_the_round_trip():
    codec = RangeCodec("log2", return_channel=True, intensity_channel=True, num_classes=NUM_CLASSES)
    sensor = LidarSensor(beams=1, columns=4)
    range_m = torch.tensor([[2.0, -1.0, 30.0, 5.5]])
    intensity = torch.tensor([[0.0, 0.7, 1.0, 0.25]])
    classes = torch.tensor([[0, 3, NUM_CLASSES - 1, UNKNOWN_CLASS]])
    image = codec.to_image(range_m, intensity, classes)
    assert image.shape == (codec.channels, 1, 4) == (4, 1, 4)
    assert torch.equal(image[:2], RangeCodec("log2", return_channel=True).to_image(range_m))
    assert image[2].tolist() == [[-1.0, -1.0, 1.0, -0.5]]
    assert image[3].tolist() == [[0.0, -1.0, NUM_CLASSES - 1, -1.0]]
    found = codec.pixels_of(image, sensor)
    torch.testing.assert_close(found.range_m, range_m)
    assert found.intensity.tolist() == [[0.0, 0.0, 1.0, 0.25]]
    assert found.classes.tolist() == [[0, UNKNOWN_CLASS, NUM_CLASSES - 1, UNKNOWN_CLASS]]
    assert torch.equal(codec.returns_of(image), range_m[None] > 0)
    assert (codec.to_image(range_m, intensity)[3] == UNKNOWN_CLASS).all()  # without labels


def test_intensity_and_class_need_a_return_channel_and_their_values():
    with pytest.raises(ValueError, match=r"need codec\.return_channel"):
        RangeCodec(intensity_channel=True)
    with pytest.raises(ValueError, match=f"must be {NUM_CLASSES}, or 0 for none, got 3"):
        RangeCodec(return_channel=True, num_classes=3)
    with pytest.raises(ValueError, match="needs scans with an intensity"):
        RangeCodec(return_channel=True, intensity_channel=True).to_image(torch.ones(1, 4))


def test_a_recorded_geometry_without_the_newer_options_is_read():
    geometry = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(return_channel=True), (2, 8))
    values = geometry.to_dict()
    del values["codec"]["intensity_channel"], values["codec"]["num_classes"]
    assert ScanGeometry.from_dict(values) == geometry


@pytest.mark.parametrize(
    ("returns", "kept"), [(0.9, 900), (0.995, 995), (0.69, 1000), (0.3, 0)], ids=str
)
def test_likely_returns_are_kept_as_often_as_their_scaled_logit_says(returns, kept):
    codec = RangeCodec(return_channel=True)
    image = torch.full((3, 2, 1, 1000), 0.2)
    image[:, 1] = torch.tensor(returns).logit() / 1.3
    uniform = (torch.arange(1000) + 0.5).expand(3, 1, 1000) / 1000
    found = codec.drop_returns(image, uniform)
    assert codec.returns_of(found).sum(dim=(1, 2, 3)).tolist() == [kept] * 3
    same, empty = (found == image).all(dim=1), (found == -1).all(dim=1)
    assert (same ^ empty).all()
