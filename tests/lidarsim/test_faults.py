"""Faults: their share, what they leave alone, and what they need."""

import numpy as np
import pytest

from lidarsim.faults import CROSSTALK_CLASS, STRENGTHS, Fault
from lidarsim.recorded import RecordedScan

random = np.random.default_rng(0)
BEAMS, SHOTS = 16, 120


def sweep(beams=BEAMS, shots=SHOTS, stored=True):
    """A room of 20 m with one beam after the other, and a car in front."""
    inclination = np.repeat(np.radians(np.linspace(2, -24, beams)), shots)
    azimuth = np.tile(np.arange(shots) / shots * 2 * np.pi, beams) + 0.01
    away = 20 * np.cos(inclination)
    points = [away * np.cos(azimuth), away * np.sin(azimuth), 20 * np.sin(inclination)]
    labels = np.where(np.abs(azimuth - 1) < 0.5, 26 | 1 << 16, 7).astype(np.uint32)
    return RecordedScan(
        np.stack(points, axis=1).astype(np.float32),
        random.random(beams * shots).astype(np.float32),
        np.repeat(np.arange(beams), shots) if stored else None,
        labels=labels,
    )


SCAN = sweep()
LOSING = ("missing_beams", "fewer_beams", "incomplete_echo", "dropped_sectors")


@pytest.mark.parametrize("kind", STRENGTHS)
@pytest.mark.parametrize("change", [{"severity": 0}, {"strength": 0.0}])
def test_without_strength_the_scan_is_the_same(kind, change):
    result = Fault(kind, **change).apply(SCAN)
    for name in ("points", "intensity", "labels"):
        np.testing.assert_array_equal(getattr(result, name), getattr(SCAN, name))
    assert result.index.tolist() == list(range(len(SCAN)))
    assert [(e.name, e.status) for e in result.effects] == [(kind, "not_called")]


@pytest.mark.parametrize("kind", STRENGTHS)
def test_points_keep_order_and_columns_and_depend_on_the_seed_alone(kind):
    fault = Fault(kind, severity=2)
    result, again, other = (fault.apply(SCAN, seed) for seed in (1, 1, (2, "a.bin")))
    np.testing.assert_array_equal(result.points, again.points)
    np.testing.assert_array_equal(result.index, again.index)
    if kind != "fewer_beams":
        different = len(other.points) != len(result.points) or (other.points != result.points).any()
        assert different
    assert (np.diff(result.index) > 0).all()
    np.testing.assert_array_equal(result.intensity, SCAN.intensity[result.index])
    moved = (result.points != SCAN.points[result.index]).any(axis=1)
    lost = len(SCAN) - len(result.points)
    assert (lost > 0, moved.any()) == (kind in LOSING, kind not in LOSING)
    assert result.report["lost"] == {kind: lost}
    assert result.report["moved"] == moved.sum()


@pytest.mark.parametrize("severity", [1, 2, 3])
def test_severities_have_the_published_shares(severity):
    def of(kind):
        return Fault(kind, severity).apply(SCAN)

    share = {1: 0.25, 2: 0.5, 3: 0.75}[severity]
    stay = np.unique(SCAN.ring[of("missing_beams").index])
    assert len(stay) == BEAMS * (1 - share)
    fewer = of("fewer_beams").index
    rings, counts = np.unique(SCAN.ring[fewer], return_counts=True)
    assert len(rings) == BEAMS * (1 - share)
    assert np.diff(rings).max() <= np.ceil(1 / (1 - share))
    assert set(counts) == {SHOTS // 2}

    crosstalk = of("crosstalk")
    hit = crosstalk.labels == CROSSTALK_CLASS
    expected = {1: 0.006, 2: 0.008, 3: 0.01}[severity]
    assert hit.sum() == round(expected * len(SCAN))
    assert (hit == (crosstalk.points != SCAN.points).any(axis=1)).all()

    car = SCAN.labels & 0xFFFF == 26
    left = of("incomplete_echo").index
    expected = {1: 0.75, 2: 0.85, 3: 0.95}[severity]
    assert car[left].sum() == car.sum() - int(expected * car.sum())
    assert (~car[left]).sum() == (~car).sum()


@pytest.mark.parametrize("strength", [0.25, 0.5, 0.75])
def test_a_strength_of_fewer_beams_is_the_share_of_points_that_go(strength):
    """A severity is that of Robo3D, which keeps every second shot alone."""
    result = Fault("fewer_beams", strength=strength).apply(SCAN)
    assert len(result.index) == len(SCAN) * (1 - strength)
    assert "shot" not in result.effects[0].reason
    assert "every second shot" in Fault("fewer_beams", 2).apply(SCAN).effects[0].reason


def test_faults_take_arrays_too():
    rows = np.column_stack([SCAN.points, SCAN.intensity])
    found = Fault("crosstalk", 2).apply(rows, 1)
    np.testing.assert_array_equal(found[:, :3], Fault("crosstalk", 2).apply(SCAN, 1).points)


def test_crosstalk_blur_and_shift_move_by_their_measure():
    scan = sweep(64, 500)
    moved = Fault("crosstalk", strength=0.5).apply(scan)
    hit = moved.labels == CROSSTALK_CLASS
    away = (moved.points - scan.points)[hit]
    assert np.abs(away.std() - 3) < 5 * 3 / np.sqrt(2 * away.size)

    shifts = []
    for seed in range(200):
        blurred = Fault("motion_blur", severity=3).apply(SCAN, seed)
        away = (blurred.points - SCAN.points).astype(float)
        shifts.append(away.mean(axis=0))
        np.testing.assert_allclose(away.std(axis=0), [0.03, 0.03, 0.015], rtol=0.1)
    assert np.abs(np.std(shifts) - 0.3) < 5 * 0.3 / np.sqrt(2 * 600)

    turned = Fault("shifted_extrinsics", strength=2).apply(SCAN).points.astype(float)
    before = SCAN.points.astype(float)
    turn, *_ = np.linalg.lstsq(np.column_stack([before, np.ones(len(before))]), turned, rcond=None)
    np.testing.assert_allclose(turn[:3] @ turn[:3].T, np.eye(3), atol=1e-4)
    angle = np.degrees(np.arccos((np.trace(turn[:3]) - 1) / 2))
    np.testing.assert_allclose([angle, np.linalg.norm(turn[3])], [2, 0.2], rtol=1e-3)


@pytest.mark.parametrize("degrees", [9, 30, 120, 360])
def test_three_sectors_are_dropped(degrees):
    scan = sweep(2, 3600)
    result = Fault("dropped_sectors", strength=degrees).apply(scan, 4)
    lost = np.ones(3600, dtype=bool)
    lost[result.index[result.index < 3600]] = False
    assert lost.sum() == pytest.approx(10 * degrees, abs=3)
    begins = lost & ~np.roll(lost, 1)
    assert begins.sum() == (3 if degrees < 360 else 0)


def test_semantic_kitti_classes_are_told_by_those_that_only_it_has():
    labels = np.where(SCAN.labels & 0xFFFF == 26, 10, 70).astype(np.uint32)
    scan = RecordedScan(SCAN.points, labels=labels)
    result = Fault("incomplete_echo", severity=2).apply(scan)
    cars = (labels == 10).sum()
    assert len(scan) - len(result.points) == int(0.85 * cars)


def test_what_is_missing_or_out_of_range_is_named():
    with pytest.raises(ValueError, match="unknown fault 'fog'; choose from missing_beams, fewer"):
        Fault("fog")
    with pytest.raises(ValueError, match="severity must be 0, 1, 2 or 3, got 4"):
        Fault("crosstalk", 4)
    with pytest.raises(ValueError, match=r"severity must be 0, 1, 2 or 3, got 1\.0"):
        Fault("crosstalk", 1.0)
    with pytest.raises(ValueError, match=r"strength must lie in 0\.\.1 \(of the points\), got 1.5"):
        Fault("crosstalk", strength=1.5)
    with pytest.raises(ValueError, match="strength must lie in"):
        Fault("motion_blur", strength=float("nan"))
    unlabelled = RecordedScan(SCAN.points)
    with pytest.raises(ValueError, match="needs labels beside the scan"):
        Fault("incomplete_echo").apply(unlabelled)
    shuffled = random.normal(0, 10, (500, 3)).astype(np.float32)
    with pytest.raises(ValueError, match="keep the order of the sensor, or store the column ring"):
        Fault("missing_beams").apply(RecordedScan(shuffled))


@pytest.mark.parametrize("kind", ["crosstalk", "motion_blur", "shifted_extrinsics"])
def test_shots_without_a_return_stay_at_the_origin(kind):
    points = SCAN.points.copy()
    points[::2] = 0
    result = Fault(kind, severity=3).apply(RecordedScan(points))
    assert not result.points[::2].any()
    assert 0 < result.report["moved"] <= len(points) // 2


def test_shots_without_a_return_have_no_say_in_the_beams():
    points = SCAN.points.copy()
    points[:100] = 0  # most of the first beam
    is_return = points.any(axis=1)
    fault = Fault("fewer_beams", strength=0.5)
    whole = fault.apply(RecordedScan(points, ring=SCAN.ring)).points
    returns = fault.apply(RecordedScan(points[is_return], ring=SCAN.ring[is_return])).points
    np.testing.assert_array_equal(whole[whole.any(axis=1)], returns)
    assert (~whole.any(axis=1)).sum() == 100
