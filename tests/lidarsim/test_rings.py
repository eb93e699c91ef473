"""Rings by the order, the inclination and the column of a file."""

import numpy as np
import pytest
from sweeps import organised_turn

from lidarsim import Street, load_sensor, simulate_scan
from lidarsim.faults import Fault
from lidarsim.recorded import RecordedScan
from lidarsim.rings import rings_of
from lidarsim.scene import Conditions
from lidarsim.weather import Weather


def simulated(model, shots):
    """Points of a scan, and the laser of each, by their place: a laser ends where azimuth falls."""
    sensor = load_sensor(model, shots=shots)
    scene = Street(5, 0, Conditions()).scene(3, sensor.mount_height_m)
    points = simulate_scan(scene, sensor, ("rings",), {"rolling_shutter": "off"}).points[:, :3]
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    return points.copy(), np.append(0, (np.diff(azimuth) < -1).cumsum())


@pytest.mark.parametrize(("model", "beams"), [("hdl64e", 64), ("hdl32e", 32)])
def test_rings_by_the_order_of_the_file_in_any_direction(model, beams):
    points, ring = simulated(model, 520)
    forward, backward = (rings_of(RecordedScan(p)) for p in (points, points[::-1].copy()))
    assert (forward.ring == ring).all()
    assert (backward.ring[::-1] == ring).mean() > 0.998
    for found in (forward, backward):
        assert (found.how, found.num_rings, found.num_shots) == ("order", beams, 520)
        assert found.sure > 0.98


@pytest.mark.parametrize("model", ["hdl32e", "os1_64", "vlp16"])
def test_shots_at_multiples_of_the_step_are_told_apart(model):
    """Rounding moves an azimuth to either side of a border that lies at the shots themselves."""
    points, _ = simulated(model, 520)
    found = rings_of(RecordedScan(points))
    assert found.num_shots == 520
    assert len(np.unique(found.ring * 520 + found.shot)) > 0.999 * len(points)


@pytest.mark.parametrize("turn_deg", [40, 90, 200, 300])
@pytest.mark.parametrize("way", [1, -1])
def test_rings_may_start_at_any_azimuth(turn_deg, way):
    points, ring = simulated("hdl64e", 520)
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]], np.float32)
    found = rings_of(RecordedScan((points @ turn)[::way].copy()))
    assert (found.how, found.num_rings) == ("order", 64)
    assert (found.ring[::way] == ring).mean() > 0.99


def test_rings_of_a_shuffled_scan_are_fitted_and_those_stored_are_used():
    points, ring = simulated("hdl32e", 520)
    order = np.random.default_rng(0).permutation(len(points))
    fitted = rings_of(RecordedScan(points[order]))
    assert fitted.how == "inclination"
    assert (fitted.ring == ring[order]).all()
    assert fitted.sure > 0.99
    # nuScenes counts from the lowest.
    stored = rings_of(RecordedScan(points[order], ring=31 - ring[order]))
    assert stored.how == "stored"
    assert (stored.ring == ring[order]).all()


def test_a_shuffled_scan_of_lasers_at_different_heights_is_said_to_be_unsure():
    points, _ = simulated("hdl64e", 520)
    found = rings_of(RecordedScan(points[np.random.default_rng(0).permutation(len(points))]))
    assert found.how == "inclination"
    assert found.sure < 0.9


@pytest.mark.parametrize("model", ["hdl64e", "hdl32e"])
def test_stored_rings_are_sure_also_in_the_frame_of_the_vehicle(model):
    points, ring = simulated(model, 520)
    for shift in ([0, 0, 0], [0, 0, 1.8], [1.4, 0, 2.1]):
        moved = points + np.array(shift, dtype=np.float32)
        assert rings_of(RecordedScan(moved, ring=ring)).sure == 1


@pytest.mark.parametrize("most", [64, 256, 10**6])
def test_numbers_by_chance_are_no_rings(most):
    points, _ = simulated("hdl64e", 520)
    ring = np.random.default_rng(0).integers(-5, most, len(points))
    scan = RecordedScan(points, ring=ring)
    assert rings_of(scan).sure == 0
    with pytest.raises(ValueError, match=r"only 0% of the points are sure of one .* by stored"):
        Fault("missing_beams").apply(scan)


def test_more_than_256_rings_are_not_sure():
    points, ring = simulated("hdl64e", 520)
    split = 5 * ring + np.arange(len(ring)) % 5
    found = rings_of(RecordedScan(points, ring=split))
    assert (found.num_rings, found.sure) == (320, 0)


def test_one_point_has_a_ring():
    found = rings_of(RecordedScan(np.ones((1, 3), dtype=np.float32)))
    assert (found.num_rings, found.ring.tolist()) == (1, [0])


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize(("model", "beams"), [("hdl64e", 64), ("hdl32e", 32)])
def test_points_that_weather_adds_last_have_the_rings_of_the_scan(model, beams, way):
    points, ring = simulated(model, 520)
    scan = RecordedScan(points[::way].copy())
    foggy = Weather(visibility_m=40).apply(scan)
    added = foggy.index < 0
    assert added.sum() > 500
    found = rings_of(RecordedScan(foggy.points))
    assert (found.how, found.num_rings, found.num_shots) == ("order", beams, 520)
    assert (found.ring == ring[::way][foggy.shot])[~added].mean() > 0.99
    assert found.sure == pytest.approx((~added).mean(), abs=0.02)


def test_shots_without_a_return_do_not_hide_the_order_of_the_file():
    points = organised_turn(16).reshape(-1, 3)
    places = np.sort(np.random.default_rng(0).choice(len(points), 1000, replace=False))
    rings = rings_of(RecordedScan(np.insert(points, places, 0, axis=0)))
    assert (rings.num_rings, rings.how) == (16, "order")
    ring = np.delete(rings.ring, places + np.arange(len(places)))
    assert ring.tolist() == np.repeat(np.arange(16), 500).tolist()


def test_a_beam_may_look_straight_up():
    points = organised_turn(32, 400, 0.3, 89.9).reshape(-1, 3)
    assert rings_of(RecordedScan(points)).num_rings == 32
