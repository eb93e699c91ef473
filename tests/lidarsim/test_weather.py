"""Weather on recorded scans; the published numbers are those of the sources named there."""

import math
import pickle
import random
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from lidarsim import Origin, Simulator, Street, load_sensor, simulate_scan
from lidarsim.clouds import PointCloud, read_cloud
from lidarsim.draws import Draws
from lidarsim.effects import EFFECTS, medium
from lidarsim.effects.medium import Rain, soft_waveform
from lidarsim.ground import ground_of
from lidarsim.recorded import Instrument, RecordedScan, RecordedSweep, scale_of
from lidarsim.scan import SECOND_RETURN_M, effect_name
from lidarsim.scene import Conditions, Scene
from lidarsim.sensors import hdl64e
from lidarsim.weather import ADDED_CLASS, REFUSED, Weather

CALLED = {
    "fog": {"visibility_m": 60.0},
    "rain": {"rain_mm_h": 30.0},
    "snow": {"snow_mm_h": 2.0},
    "wet_ground": {"water_film_mm": 1.0},
    "spray": {"water_film_mm": 1.0, "traffic_m_s": 25.0},
    "sun_glare": {"sun_elevation_deg": 3.0},
}
DETECTION = {"soft_raydrop", "detection_limit"}
TUNED = {"blooming": "on", "range_noise": "on"}
pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture(scope="module")
def scan():
    sensor = load_sensor("hdl64e", shots=520)
    scene = Street(5, 0, Conditions()).scene(52, sensor.mount_height_m)
    found = simulate_scan(scene, sensor, ("recorded",))
    return RecordedScan(found.points[:, :3].copy(), found.points[:, 3].copy(), labels=found.labels)


def same(one, other):
    return all(
        getattr(one, name).tobytes() == getattr(other, name).tobytes()
        for name in ("points", "intensity", "labels")
    )


def ran(result):
    return {record.name for record in result.effects if record.status == "ran"}


@pytest.mark.parametrize("switches", [{}, TUNED], ids=["default", "all"])
@pytest.mark.parametrize(
    "nothing",
    [
        {},
        {"visibility_m": math.inf},
        {"visibility_m": 1e12},
        {"rain_mm_h": 1e-30},
        {"snow_mm_h": 1e-30},
        {"water_film_mm": 1e-12, "traffic_m_s": 25.0},
    ],
)
def test_without_strength_the_scan_stays_bit_for_bit(scan, nothing, switches):
    result = Weather(**nothing).apply(scan, effects=switches if nothing else {})
    lost = np.setdiff1d(np.arange(len(scan)), result.index)
    if switches and nothing:  # halos replace echoes beside saturated ones
        kept = result.index >= 0
        assert (result.points[kept] == scan.points[result.index[kept]]).mean() > 0.999
        assert len(lost) < 0.01 * len(scan)
    else:
        assert same(result, scan)
        assert len(lost) == 0


@pytest.mark.parametrize("name", CALLED)
def test_each_effect_changes_the_scan_and_keeps_what_stays(scan, name):
    result = Weather(**CALLED[name]).apply(scan, seed=3)
    expected = {name, *DETECTION} | ({"wet_ground"} if name == "spray" else set())
    assert ran(result) == expected
    kept = result.index[result.index >= 0]
    assert (np.diff(kept) > 0).all()
    assert (result.index[: len(kept)] == kept).all()
    assert result.points[: len(kept)].tobytes() == scan.points[kept].tobytes()
    assert (result.labels[: len(kept)] == scan.labels[kept]).all()
    assert (result.intensity[: len(kept)] <= scan.intensity[kept]).all()
    made_by = result.origins[len(kept) :]
    assert (result.labels[len(kept) :] == ADDED_CLASS + made_by.astype(int)).all()
    report = result.report
    assert sum(report["lost"].values()) == len(scan) - len(kept)
    assert sum(report["added"].values()) == len(result.points) - len(kept)
    assert len(kept) < len(scan)
    if name in ("fog", "rain", "snow", "spray"):
        assert set(report["added"]) == {name}
        # Before the point that the shot had, and along its direction.
        shot = scan.points[result.shot[len(kept) :]]
        new = result.points[len(kept) :]
        start = np.array([0, 0, np.mean(hdl64e().lasers.height_m)])
        reach = np.linalg.norm(shot - start, axis=1)
        assert (np.linalg.norm(new - start, axis=1) <= reach + 1e-3).all()
        cosine = ((new - start) * (shot - start)).sum(axis=1)
        cosine /= np.linalg.norm(new - start, axis=1) * reach
        assert cosine.min() > 1 - 1e-5


def test_blooming_puts_halos_around_saturated_points(scan):
    """Beside a bright sheet, and at its range, in place of the points of a dark wall behind it."""
    azimuth, height = (grid.ravel() for grid in np.meshgrid(np.arange(-40, 41), np.arange(9)))
    azimuth, inclination = np.radians(0.17 * azimuth), np.radians(0.4 * height - 1)
    is_sheet = np.abs(azimuth) < np.radians(1)
    away = np.where(is_sheet, 15.0, 30.0)
    towards = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(inclination)])
    points = (away * towards).T.astype(np.float32)
    wall = RecordedScan(points, np.where(is_sheet, 0.99, 0.05).astype(np.float32))
    off = Weather().apply(wall)
    on = Weather().apply(wall, effects={"blooming": "on"})
    assert "blooming" not in ran(off)
    assert "blooming" in ran(on)
    assert np.isin(np.flatnonzero(is_sheet), on.index).all()
    halo = on.origins == Origin.BLOOMING
    assert 0 < halo.sum() == on.report["lost"]["blooming"] < 9 * 8
    assert np.linalg.norm(on.points[halo, :2], axis=1) == pytest.approx(15, abs=0.2)
    assert (np.abs(azimuth[on.shot[halo]]) < np.radians(1 + 2.5 * 0.2 + 0.01)).all()


def test_saturated_points_may_be_sheeting():
    """At 15 m in fog of 15 m, only what is far brighter than a white surface is seen."""
    azimuth = np.linspace(0, 6.28, 2000)
    points = 15 * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    bright = RecordedScan(points.astype(np.float32), np.append(np.full(1999, 0.99), 0.5))
    seen = {
        response: Weather(visibility_m=15).apply(bright, 1, Instrument(response=response)).index
        for response in ("root", "linear")
    }
    assert 0.3 < (seen["root"] >= 0).sum() / 2000 < 0.6
    assert (seen["linear"] < 0).all()


def test_effects_that_are_not_called_for_do_nothing(scan, monkeypatch):
    for effect in EFFECTS:
        if effect_name(effect) not in {"fog", *DETECTION}:
            monkeypatch.setattr(type(effect), "apply", None)
            monkeypatch.setattr(type(effect), "rays", None)
    assert ran(Weather(visibility_m=60).apply(scan)) == {"fog", *DETECTION}
    monkeypatch.setattr("lidarsim.weather.RecordedSweep", None)
    result = Weather().apply(scan)
    assert result.points is scan.points
    assert not ran(result)


def test_one_effect_leaves_the_draws_of_another_alone(scan):
    """Fog takes the same points from a scan, but for the ground, on a wet and on a dry road."""
    dry = Weather(visibility_m=60).apply(scan, seed=3)
    wet = Weather(visibility_m=60, water_film_mm=0.5).apply(scan, seed=3)
    upright = np.flatnonzero(~ground_of(scan.points)[0])
    assert 1000 < len(np.intersect1d(dry.index, upright)) < len(upright)
    assert (np.intersect1d(dry.index, upright) == np.intersect1d(wet.index, upright)).all()


def test_a_seed_gives_the_same_weather(scan):
    one, again, other = (Weather(snow_mm_h=2).apply(scan, seed) for seed in (1, 1, (1, "other")))
    assert same(one, again)
    assert one.index.tobytes() != other.index.tobytes()


def test_unknown_powers_are_drawn_by_seed(scan):
    """Fog has no draws of its own: which hard echoes it loses follows from the powers alone."""
    off = {"soft_raydrop": "off"}
    kept = [Weather(visibility_m=60).apply(scan, seed, effects=off).index for seed in (1, 1, 2)]
    hard = [index[index >= 0].tobytes() for index in kept]
    assert hard[0] == hard[1] != hard[2]


def test_intensities_of_either_scale_give_the_same(scan):
    weather = Weather(visibility_m=80, water_film_mm=0.5)
    one = weather.apply(scan)
    for factor in (255.0, 4000.0):
        instrument = Instrument(full_intensity=4000.0 if factor > 255 else None)
        scaled = replace(scan, intensity=scan.intensity * np.float32(factor))
        other = weather.apply(scaled, instrument=instrument)
        assert (one.index == other.index).all()
        assert np.allclose(one.points, other.points, atol=1e-3)
        assert np.abs(one.intensity - other.intensity / factor).max() < 0.0051


@pytest.mark.parametrize(("full", "unit"), [(1, "0..1"), (255, "0..255"), (4000, "instrument")])
@pytest.mark.parametrize("factor", [1.001, 1.5, 200, 256, 1e6])
def test_a_single_intensity_does_not_set_the_scale(scan, full, unit, factor):
    """The others keep the share of a white surface that they have without it."""
    values = np.minimum(scan.intensity, np.float32(0.99)) * np.float32(full)
    plain = scale_of(values)
    values[7] = factor * full
    odd = scale_of(values)
    assert unit in odd.text
    assert odd.full == pytest.approx(
        plain.full, abs=0.03 * full
    )  # by three steps: few points are bright


@pytest.mark.parametrize("kind", ["u1", "i4"])
def test_integers_are_never_shares_of_1(scan, kind):
    dark = (scan.intensity > 0.5).astype(kind)
    assert scale_of(dark).full == 255
    assert scale_of(dark.astype("f4")).full == 1


@pytest.mark.parametrize("intensity", [None, 0.0, 1.0])
def test_unknown_intensities_are_said_and_stay(scan, intensity):
    values = None if intensity is None else np.full(len(scan), intensity, dtype=np.float32)
    result = Weather(visibility_m=60).apply(replace(scan, intensity=values))
    assert "assumed" in result.report["intensity"]
    assert 0 < (result.index < 0).sum() < len(scan) / 2
    if values is None:
        assert result.intensity is None
    else:
        assert (result.intensity == intensity).all()


def test_whole_numbers_stay_so(scan):
    whole = (scan.intensity * 255).round().astype(np.uint8)
    result = Weather(visibility_m=80).apply(replace(scan, intensity=whole))
    assert result.intensity.dtype == np.uint8
    assert result.report["intensity"].endswith("in steps of 1: 0..255, full scale 255")


def test_the_strongest_echo_is_the_first_of_two(scan):
    weather = Weather(visibility_m=40)
    strongest = weather.apply(scan)
    dual = weather.apply(scan, instrument=Instrument(returns="dual"))
    pairs = set(zip(strongest.shot.tolist(), strongest.index.tolist(), strict=True))
    assert pairs < set(zip(dual.shot.tolist(), dual.index.tolist(), strict=True))
    both = np.bincount(dual.shot)
    assert (both == 2).any()
    assert both.max() == 2


def test_spray_hangs_behind_a_given_box_alone(scan):
    box = np.array([[14.0, 3.0, -1.0, 4.5, 1.8, 1.5, 0.0, 25.0]])
    dry = Weather(water_film_mm=1.0).apply(scan)
    result = Weather(water_film_mm=1.0).apply(scan, boxes=box)
    new = result.points[result.index < 0]
    assert len(new) > 5
    assert (result.origins[result.index < 0] == Origin.SPRAY).all()
    x, y, z = new.T
    assert ((x > 14 - 2.25 - 12.5) & (x < 14 - 2.25 + 0.5)).all()
    assert ((np.abs(y - 3) < 1.5) & (z < 0.3)).all()
    behind = scan.points[:, 0] < -1
    assert np.isin(np.intersect1d(dry.index, np.flatnonzero(behind)), result.index).all()


def test_added_points_of_a_simulated_scan_lie_on_the_beams_of_its_sensor():
    scan = Simulator(sensor="vlp16").scan(3)
    result = Weather(visibility_m=40).apply(scan)
    new = result.index < 0
    assert new.sum() > 100
    seen, shot = result.points[new], scan.points[result.shot[new], :3]
    inclination = [np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (seen, shot)]
    np.testing.assert_allclose(*inclination, atol=1e-5)


@pytest.mark.parametrize("name", REFUSED)
def test_effects_that_need_a_scene_are_refused_by_name(scan, name):
    with pytest.raises(ValueError, match=f"effect {name} cannot act on a recorded scan: "):
        Weather(visibility_m=60).apply(scan, effects={name: "on"})


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda s: replace(s, points=s.points[:0]), "at least one point"),
        (lambda s: replace(s, points=s.points * np.nan), "points are NaN .*: drop these points"),
        (lambda s: replace(s, intensity=s.intensity * np.nan), "intensities are NaN or infinite"),
        (lambda s: replace(s, points=s.points * 100), "give metres"),
        (lambda s: replace(s, labels=s.labels[1:]), "labels must have one value for each"),
        (lambda s: Weather().apply(s, effects={"hail": "on"}), "unknown effect 'hail'"),
        (lambda s: Weather(visibility_m=0), "visibility_m must be 1 or greater"),
        (lambda s: Weather(visibility_m="60"), "visibility_m must be a number, got '60'"),
        (lambda s: Weather(traffic_m_s=None), "traffic_m_s must be a number, got None"),
        (lambda s: Weather(clear_sky="no"), "clear_sky must be True or False, got 'no'"),
        (lambda s: Weather(rain_mm_h=10_000), "rain_mm_h must be at most"),
        (lambda s: Weather(traffic_m_s=-1), "traffic_m_s must be 0 or greater"),
        (lambda s: Instrument(full_intensity=0), "full_intensity must be positive"),
        (lambda s: Instrument(response="log"), "response must be root or linear"),
        (
            lambda s: Weather(visibility_m=60).apply(replace(s, intensity=-1 - s.intensity)),
            "intensity must be 0 or greater",
        ),
        (lambda s: Weather(visibility_m=60).apply(s, seed=0.5), "seed must be .*, got 0.5"),
        (lambda s: Weather(visibility_m=60).apply(s, seed=-1), "seed must be .*, got -1"),
        (
            lambda s: Weather(visibility_m=60).apply(
                replace(s, intensity=s.intensity + (np.arange(len(s)) % 100 == 0))
            ),
            r"the scan: 0\.9% of the intensities exceed 1, up to .*: give their full scale",
        ),
        (lambda s: Weather().apply(s, boxes=np.zeros(3)), r"boxes must be \(N, 8\)"),
    ],
)
def test_bad_input_is_told_in_one_line(scan, make, told):
    with pytest.raises(ValueError, match=told) as caught:
        make(scan)
    assert "\n" not in str(caught.value)


def test_points_at_the_origin_and_single_points():
    points = np.zeros((3, 3), dtype=np.float32)
    points[2] = 10, 0, 0
    result = Weather(visibility_m=30).apply(RecordedScan(points))
    assert set(result.index.tolist()) >= {0, 1}
    for film in (0.0, 1.0):
        Weather(visibility_m=30, water_film_mm=film).apply(RecordedScan(points[2:]))


@pytest.mark.parametrize("name", ["visibility_m", "water_film_mm", "sun_elevation_deg"])
def test_a_scan_without_a_return_stays(name):
    recorded = RecordedScan(np.zeros((3, 3), np.float32), time_s=np.arange(3.0))
    result = Weather(**{name: 2.0}).apply(recorded)
    assert result.index.tolist() == [0, 1, 2]
    assert result.report["lost"] == result.report["added"] == {}


@pytest.mark.parametrize(
    ("extinction", "peak_m", "value"),
    [(0.005, 4.70, 4.568e-9), (0.06, 4.60, 3.816e-9), (0.2, 4.50, 2.476e-9)],
)
def test_soft_echo_of_a_published_pulse(extinction, peak_m, value, monkeypatch):
    """Hahner et al., ICCV 2021: pulse sin^2 of 20 ns at half height, overlap from 0.9 to 1.0 m.

    The pulse is a mixture of box pulses of half length h in [0, 3 m] and of the density
    sin(pi h / 3 m) pi / 6 m; its echo is reported 3 m behind its middle. The unit is that of an
    integral over time, per backscatter.
    """
    light_m_s = 299_792_458.0
    half_m = light_m_s * 20e-9 / 2

    def overlap(range_m, sensor):
        return ((range_m - 0.9) / 0.1).clip(0, 1) / np.maximum(range_m, 0.1) ** 2

    monkeypatch.setattr(medium, "overlap_by_square", overlap)
    monkeypatch.setattr(medium, "_FOG_STEP_M", 0.01)
    sensor = replace(hdl64e(), min_range_m=0.0, max_range_m=10.0)
    total = 0.0
    halves = (np.arange(200) + 0.5) * half_m / 200
    for half in halves:
        pulse = replace(sensor, pulse_s=4 * half / light_m_s)
        edges, waveform = soft_waveform(math.log(20) / extinction, pulse)
        weight = math.sin(math.pi * half / half_m) * math.pi / (2 * half_m) * half_m / 200
        total = total + weight * waveform
    echo = total / (medium._BACKSCATTER * extinction) / (light_m_s / 2)
    assert edges[echo.argmax()] + half_m == pytest.approx(peak_m, abs=0.051)
    assert echo.max() == pytest.approx(value, rel=0.005)


@pytest.mark.parametrize(("rate", "published"), [(5, 0.94e-3), (10, 1.46e-3), (30, 2.94e-3)])
def test_extinction_of_rain_beside_a_measured_law(rate, published):
    """Ulbrich and Atlas 1985: 1.45 R^0.64 dB/km.

    Ours follows from the sizes of Marshall and Palmer, with which the echoes of single drops
    agree; it is 6 to 9 % higher.
    """
    assert 1.45 * rate**0.64 * math.log(10) / 1e4 == pytest.approx(published, rel=0.01)
    assert 1.03 < Rain().extinction_per_m(rate) / published < 1.11


def test_attenuation_of_calibrated_reflectivities(scan):
    """LiDAR simulators of fog (Hahner et al. 2021) store ``round(I exp(-2 alpha R))``."""
    whole = (scan.intensity * 255).round()
    result = Weather(visibility_m=200).apply(
        replace(scan, intensity=whole), instrument=Instrument("hdl32e", response="linear")
    )
    kept = result.index[result.index >= 0]
    range_m = np.linalg.norm(scan.points[kept].astype(float), axis=1)
    expected = whole[kept] * np.exp(-2 * math.log(20) / 200 * range_m)
    clear = (whole[kept] > 0) & (np.abs(expected % 1 - 0.5) > 1e-3)
    assert clear.sum() > 1000
    assert (result.intensity[: len(kept)][clear] == np.round(expected[clear])).all()


@pytest.fixture(scope="module")
def rows(scan):
    """Points and intensities ``(P, 4)``."""
    return np.column_stack([scan.points, scan.intensity])


@pytest.fixture(scope="module")
def expected(scan):
    """The same in fog."""
    result = Weather(visibility_m=60).apply(replace(scan, labels=None), 3)
    return np.column_stack([result.points, result.intensity])


class TestKinds:
    """What is given comes back as its kind, with the same numbers."""

    @pytest.mark.parametrize("kind", ["f4", "f8"])
    def test_arrays(self, rows, expected, kind):
        found = Weather(visibility_m=60).apply(rows.astype(kind), 3)
        assert found.dtype == kind
        np.testing.assert_array_equal(found.astype("f4"), expected)
        without = Weather(visibility_m=60).apply(rows[:, :3].astype(kind), 3)
        assert without.shape[1] == 3

    def test_tensors(self, rows, expected):
        found = Weather(visibility_m=60).apply(torch.from_numpy(rows), 3)
        assert torch.equal(found, torch.from_numpy(expected))

    def test_clouds_and_paths(self, scan, rows, expected, tmp_path):
        (tmp_path / "a.bin").write_bytes(rows.tobytes())
        (tmp_path / "a.label").write_bytes(scan.labels.tobytes())
        found = Weather(visibility_m=60).apply(read_cloud(tmp_path / "a.bin"), 3)
        assert isinstance(found, PointCloud)
        np.testing.assert_array_equal(found.rows(), expected)
        for path in (tmp_path / "a.bin", str(tmp_path / "a.bin")):
            result = Weather(visibility_m=60).apply(path, 3)
            assert result.points.tobytes() == found.points.tobytes()
            np.testing.assert_array_equal(result.labels, found.labels)

    @pytest.mark.parametrize("shape", [(10,), (10, 2), (10, 5), (2, 10, 3)])
    def test_other_shapes_are_refused(self, shape):
        with pytest.raises(ValueError, match=r"points must be \(P, 3\) or \(P, 4\), got"):
            Weather(visibility_m=60).apply(np.ones(shape))

    def test_a_transform_draws_anew_and_by_the_seed_of_random(self, rows):
        weather = pickle.loads(pickle.dumps(Weather(visibility_m=60)))  # noqa: S301
        assert weather == Weather(visibility_m=60)
        random.seed(0)
        one, other = (weather(rows) for _ in range(2))
        random.seed(0)
        np.testing.assert_array_equal(weather(rows), one)
        assert one.tobytes() != other.tobytes()


class Drive(Dataset):
    """The same points twice, through a transform."""

    def __init__(self, points, transform):
        self.points, self.transform = points, transform

    def __len__(self):
        return 2

    def __getitem__(self, index):
        return self.transform(self.points)


def test_a_loader_applies_weather_in_its_processes(scan):
    points = torch.from_numpy(np.column_stack([scan.points, scan.intensity])[:2000])
    drive = Drive(points, Weather(visibility_m=60))
    loaders = [
        DataLoader(drive, None, num_workers=1, generator=torch.Generator().manual_seed(0))
        for _ in range(2)
    ]
    first, again = (list(loader) for loader in loaders)
    assert all(torch.equal(one, other) for one, other in zip(first, again, strict=True))
    assert first[0].numpy().tobytes() != first[1].numpy().tobytes()


def test_recorded_powers_could_be_detected():
    """The darkest points are as strong as the weakest echo that the sensor can report."""
    points = np.zeros((2000, 3), dtype=np.float32)
    points[:, 0] = np.linspace(1, 110, 2000)
    points[:, 1] = np.linspace(-1, 1, 2000)
    intensity = np.where(np.arange(2000) % 2, 0.0, 1e-3).astype(np.float32)
    intensity[0] = 1
    scan, instrument = RecordedScan(points, intensity), Instrument(response="linear")
    sensor = instrument.sensor_for(scan)
    sweep = RecordedSweep(Scene(), scan, instrument, sensor, Draws(2000, 0))
    least = sensor.min_power * math.exp(-3 * sensor.threshold_spread)
    assert sweep.recorded_power.min() == pytest.approx(least, rel=1e-5)


def test_second_returns_are_apart_from_the_first(scan):
    """Closer ones are one echo to the sensor."""
    instrument = Instrument(returns="dual")
    nearest_m = []
    for weather in (Weather(visibility_m=40), Weather(snow_mm_h=3), Weather(rain_mm_h=100)):
        result = weather.apply(scan, 1, instrument)
        order = np.argsort(result.shot, kind="stable")
        range_m = np.linalg.norm(result.points[order].astype(float), axis=1)
        is_pair = np.diff(result.shot[order]) == 0
        nearest_m.append(np.abs(np.diff(range_m)[is_pair]).min())
    # From the optical centre and from the origin, distances differ by some centimetres.
    assert min(nearest_m) > SECOND_RETURN_M - 0.05


def test_a_simulated_scan_is_changed_as_a_recorded_one():
    scan = Simulator(seed=0, sensor="vlp16").scan(0)
    assert len(repr(scan)) < 1000
    found = Weather(visibility_m=60).apply(scan)
    points, intensity = scan.points[:, :3], scan.points[:, 3]
    recorded = RecordedScan(points, intensity, labels=scan.labels)
    expected = Weather(visibility_m=60).apply(recorded, instrument=Instrument("vlp16"))
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.labels, expected.labels)
