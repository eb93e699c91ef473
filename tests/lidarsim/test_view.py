"""Range, angles and pixels of points without torch, beside those of r3dpa's projections."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import r3dpa
from lidarsim import LidarSensor, Simulator, ring_order
from lidarsim.recorded import RecordedScan
from lidarsim.sensors import view
from lidarsim.weather import Weather
from r3dpa.geometry import SphericalProjection, in_range, range_image
from r3dpa.geometry.rings import rings_in_order
from r3dpa.geometry.sensor import angles_of

SENSOR = LidarSensor()


@pytest.fixture
def points() -> np.ndarray:
    """Points around the sensor, some out of range, at the seam or not finite."""
    cloud = np.random.default_rng(0).normal(size=(20_000, 3)) * (20, 20, 3)
    cloud[:5] = [[-5, 0, 0], [-5, -0.0, 0], [56, 0, 0], [np.nan, 1, 1], [np.inf, 1, 1]]
    return cloud.astype(np.float32)


def test_the_same_points_are_in_range(points):
    expected = in_range(torch.from_numpy(points), SENSOR).numpy()
    assert np.array_equal(view.in_range(points, SENSOR), expected)


def test_the_same_pixels_are_hit(points):
    range_m, _ = range_image(torch.from_numpy(points), SphericalProjection(SENSOR))
    assert np.array_equal(view.hit_pixels(points, SENSOR), range_m.numpy() > 0)


def test_angles_agree_to_their_rounding(points):
    finite = points[np.isfinite(points).all(axis=1)]
    expected = [angle.numpy() for angle in angles_of(torch.from_numpy(finite))]
    assert np.allclose(view.angles_of(finite), expected, rtol=0, atol=1e-15)


def test_rings_are_the_same_for_arrays_and_tensors():
    cloud = Simulator(seed=0, drive=0).scan(0).points
    inclination, azimuth = view.angles_of(cloud[:, :3])
    ring, num_rings = ring_order.rings_in_order(inclination, azimuth, SENSOR)
    tensors = torch.from_numpy(inclination), torch.from_numpy(azimuth)
    as_tensor, same_number = rings_in_order(*tensors, SENSOR)
    assert num_rings == same_number == 64
    assert np.array_equal(as_tensor.numpy(), ring)


def test_r3dpa_passes_the_classes_on():
    assert r3dpa.Simulator is Simulator
    assert r3dpa.Weather is Weather
    assert r3dpa.RecordedScan is RecordedScan


def test_an_image_around_points_holds_nearly_all_of_them():
    """Points at the origin and with NaN have no say."""
    angles = np.radians(np.linspace(-12.0, 20.0, 400))
    points = 30.0 * np.stack([np.cos(angles), np.zeros(400), np.sin(angles)], axis=1)
    points = np.concatenate([points, np.zeros((50, 3)), np.full((50, 3), np.nan)])
    sensor = LidarSensor.around(points)
    assert sensor.inclination_min_deg == pytest.approx(-12, abs=0.5)
    assert sensor.inclination_max_deg == pytest.approx(20, abs=0.5)
    assert sensor.range_max_m == pytest.approx(30.5, abs=0.6)
    with pytest.raises(ValueError, match="nothing to draw"):
        LidarSensor.around(points[400:])
