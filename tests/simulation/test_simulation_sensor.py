import dataclasses

import numpy as np
import pytest

from r3dpa.simulation import HDL64E


def test_two_blocks_with_the_inclinations_of_the_calibration():
    lasers = HDL64E().lasers
    degrees = np.degrees(lasers.inclination_rad)
    np.testing.assert_allclose(degrees[[0, 31, 32, 63]], [1.96, -8.56, -8.78, -24.56], atol=1e-9)
    steps = -np.diff(degrees)
    assert (steps > 0).all()
    assert steps[:31].mean() == pytest.approx(0.339, abs=5e-4)
    assert steps[32:].mean() == pytest.approx(0.509, abs=5e-4)
    # Standard deviation of 31 normal draws: within 3 standard errors (13 % each).
    assert steps[:31].std() == pytest.approx(0.042, rel=0.4)
    assert steps[32:].std() == pytest.approx(0.094, rel=0.4)


def test_optical_centres_and_azimuth_offsets():
    lasers = HDL64E().lasers
    upper, lower = lasers.height_m[:32], lasers.height_m[32:]
    assert (upper.min(), upper.max()) == (0.204, 0.217)
    assert (lower.min(), lower.max()) == (0.144, 0.163)
    assert set(np.abs(lasers.lateral_m)) == {0.026}
    offset = np.degrees(lasers.azimuth_offset_rad)
    assert offset.min() >= -8.5
    assert offset.max() <= 9.9
    assert len(np.unique(np.round(offset / 6.1))) == 4


def test_rays_are_unit_and_start_at_their_laser():
    sensor = HDL64E(shots=100)
    origin, direction = sensor.rays
    assert origin.shape == direction.shape == (3, 64, 100)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=0), 1, atol=1e-6)
    np.testing.assert_allclose(np.hypot(origin[0], origin[1]), 0.026, atol=1e-6)
    inclination = np.arcsin(direction[2])
    expected = np.broadcast_to(sensor.lasers.inclination_rad[:, None], (64, 100))
    np.testing.assert_allclose(inclination, expected, atol=1e-6)
    # The optical centre lies sideways of the beam, not along it.
    across = origin[0] * direction[0] + origin[1] * direction[1]
    np.testing.assert_allclose(across, 0, atol=1e-7)


def test_azimuth_grows_by_one_step_from_shot_to_shot():
    _, direction = HDL64E(shots=360).rays
    azimuth = np.unwrap(np.arctan2(direction[1], direction[0]), axis=1)
    np.testing.assert_allclose(np.diff(azimuth, axis=1), np.radians(1), atol=2e-6)
    assert (azimuth[:, 0] >= 0).all()
    assert (azimuth[:, 0] < np.radians(1) + 1e-6).all()


def test_frozen_and_checked():
    sensor = HDL64E()
    assert sensor.shots == 2083
    with pytest.raises(dataclasses.FrozenInstanceError):
        sensor.shots = 10
    with pytest.raises(ValueError, match="shots must be at least 8 per turn, got 7"):
        HDL64E(shots=7)
    with pytest.raises(ValueError, match="mount_height_m"):
        HDL64E(mount_height_m=0.0)
    with pytest.raises(ValueError, match="calibration_seed"):
        HDL64E(calibration_seed=-1)
