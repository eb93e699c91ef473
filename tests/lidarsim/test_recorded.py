"""Turns made from recorded scans: where the ground is, and where vehicles are."""

from dataclasses import replace

import numpy as np
import pytest

from lidarsim import Semantic, Simulator, Street, load_sensor, simulate_scan
from lidarsim.draws import Draws
from lidarsim.ground import ground_of
from lidarsim.raycast import surface_distance
from lidarsim.recorded import Instrument, RecordedScan, RecordedSweep
from lidarsim.scene import Conditions, Pose, Primitive, Scene, Shape
from lidarsim.sensors.files import read_sensor, write_sensor
from lidarsim.solids import solids_of


def test_the_ground_is_found():
    sensor = load_sensor("hdl64e", shots=520)
    scene = Street(5, 1, Conditions()).scene(3, sensor.mount_height_m)
    scan = simulate_scan(scene, sensor, ("recorded",))
    is_ground, normal = ground_of(scan.points[:, :3])
    code, range_m = scan.labels & 0xFFFF, np.linalg.norm(scan.points[:, :3], axis=1)
    road = np.isin(code, [Semantic.ROAD, Semantic.SIDEWALK]) & (range_m < 40)
    assert is_ground[road].mean() > 0.95
    assert is_ground[np.isin(code, [Semantic.BUILDING, Semantic.CAR])].mean() < 0.05
    assert normal[:, 2].min() > 0.95


def test_a_sloping_ground_has_its_normal():
    generator = np.random.default_rng(0)
    points = generator.uniform(-20, 20, (4000, 3))
    points[:3000, 2] = 0.08 * points[:3000, 0] - 1.7 + generator.normal(0, 0.02, 3000)
    points[3000:, 2] += 22
    is_ground, normal = ground_of(points.astype(np.float32))
    assert is_ground[:3000].mean() > 0.99
    assert is_ground[3000:].mean() < 0.01
    assert np.allclose(normal[0] / normal[0, 2], [-0.08, 0, 1], atol=0.01)


def test_the_feet_of_a_wall_are_no_ground():
    across, away, height = np.arange(-15, 15, 0.05), np.arange(3, 10, 0.25), np.arange(0, 2, 0.05)
    ground = np.stack([*map(np.ravel, np.meshgrid(away, across)), np.full(600 * 28, -1.7)], 1)
    wall = np.stack(np.meshgrid([10.1], across, height - 1.7), 3).reshape(-1, 3)
    is_ground, _ = ground_of(np.concatenate([ground, wall]).astype(np.float32))
    assert is_ground[: len(ground)].mean() > 0.95
    assert not is_ground[len(ground) :].any()


def test_a_moving_box_is_shown_where_its_shots_were_taken():
    # To the left, a quarter of a turn after the middle of it: 25 ms at 10 turns a second.
    azimuth = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    points = 20 * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1)
    ring = RecordedScan(points.astype(np.float32), np.full(400, 0.5, np.float32))
    box = Primitive(
        Shape.BOX, (0.0, 10.0, 0.0), (2.0, 1.0, 1.0), Semantic.CAR, 0.5, velocity_m_s=(8.0, -4.0)
    )
    instrument = Instrument()
    sensor = replace(instrument.sensor_for(ring), spin_hz=10.0)
    sweep = RecordedSweep(Scene((box,)), ring, instrument, sensor, Draws(400, 0))
    assert sweep.scene.primitives[0].centre == pytest.approx((-0.2, 10.1, 0.0), abs=1e-3)


def test_rays_near_a_solid_are_those_that_can_meet_it():
    generator = np.random.default_rng(0)
    points = generator.normal(0, 15, (20_000, 3)).astype(np.float32)
    scan, instrument = RecordedScan(points), Instrument()
    sensor = instrument.sensor_for(scan)
    sweep = RecordedSweep(Scene(), scan, instrument, sensor, Draws(len(points), 0))
    car = Primitive(Shape.BOX, (0, 0, 0), (2, 1, 1), Semantic.CAR, 0.5, velocity_m_s=(9, 0))
    ahead = replace(car, centre=(12, 5, 0), yaw_rad=0.4)
    behind = replace(car, centre=(-30, 2, 1), yaw_rad=2.0)
    solids = solids_of([ahead, behind, car], Pose(z_m=0.0), 0.0)
    near = sweep.rays_near(solids)
    for index, rays in enumerate(near):
        start = sweep.start.copy()
        start[:2] -= solids.velocity[index][:, None] * sweep.time_s
        every = np.full(sweep.num_rays, index)
        enter, leave = surface_distance(solids, every, start, sweep.direction)
        met = np.flatnonzero(leave > np.maximum(enter, 0))
        assert np.isin(met, rays).all()
    assert [len(rays) < 1000 for rays in near] == [True, True, False]


@pytest.mark.parametrize("kind", ["preset", "path", "sensor"])
def test_the_instrument_takes_all_that_a_simulator_takes(tmp_path, kind):
    path = tmp_path / "mine.yaml"
    write_sensor(path, read_sensor("vlp16"))
    sensor = {"preset": "vlp16", "path": path, "sensor": load_sensor("vlp16")}[kind]
    scan = RecordedScan(np.ones((5, 3), np.float32))
    assert Instrument(sensor).sensor_for(scan).divergence_rad == load_sensor("vlp16").divergence_rad
    assert Simulator(sensor=sensor).sensor.num_beams == 16
