import copy
import json
import math
import re

import numpy as np
import pytest

from lidarsim.divergences import curve_rmse, jensen_shannon, wasserstein_1
from lidarsim.realism import measures, realism_table
from lidarsim.scan_statistics import ScanStatistics, scan_statistics


def street(seed: int, lost: float = 0.02, wall_m: float = 25.0, gray: float = 0.3) -> np.ndarray:
    """A scan of a road between two walls, with noise and random losses."""
    generator = np.random.default_rng(seed)
    inclination = np.radians(np.linspace(2.0, -24.8, 64))[:, None]
    azimuth = (np.arange(1500) + 0.5)[None] * 2 * np.pi / 1500
    direction = np.stack(
        np.broadcast_arrays(
            np.cos(inclination) * np.cos(azimuth),
            np.cos(inclination) * np.sin(azimuth),
            np.sin(inclination),
        ),
        axis=-1,
    )
    wall_m = wall_m + 2 * generator.random()
    to_road = 1.73 / np.maximum(-direction[..., 2], 1e-3)
    to_wall = wall_m / np.maximum(np.abs(direction[..., 1]), 1e-3)
    range_m = np.minimum(to_road, to_wall)
    kept = (range_m < 79) & (generator.random(range_m.shape) > lost)
    range_m = range_m + generator.normal(0, 0.01, range_m.shape)
    points = (range_m[..., None] * direction)[kept]
    intensity = generator.normal(gray, 0.1, len(points)).clip(0, 0.99)
    return np.column_stack([points, intensity]).astype(np.float32)


NAMES = list(measures(ScanStatistics()))


@pytest.fixture(scope="module")
def drives() -> dict[str, ScanStatistics]:
    return {f"drive {seed}": scan_statistics(street(seed)) for seed in range(3)}


def test_distances_of_nothing_are_unknown():
    nothing, something = np.zeros(4), np.ones(4)
    assert math.isnan(wasserstein_1(nothing, something, 1.0))
    assert math.isnan(jensen_shannon(something, nothing))
    assert math.isnan(curve_rmse(np.full(4, np.nan), something))
    assert curve_rmse(np.array([1, np.nan, 3]), np.array([2, 5, 0.0])) == pytest.approx(
        math.sqrt(5)
    )


def test_identical_data_have_distance_0_everywhere(drives):
    one = {"only": drives["drive 0"]}
    table = realism_table(one, one)
    assert [row.name for row in table.rows] == NAMES
    assert all(row.distance == row.pooled == 0 for row in table.rows)
    # One drive of the reference: distances, but no floor.
    assert all(math.isnan(row.ratio) and "no floor" in row.reason for row in table.rows)
    lines = str(table).splitlines()
    assert [line for line in lines if line.startswith("n/a")] == [
        "n/a: all measures: B is a single drive, so there is no floor; give two drives or more"
    ]
    assert "A: 1 scan of 1 drive" in lines
    twice = {"first": drives["drive 0"], "second": drives["drive 0"]}  # a floor of 0
    assert {row.ratio for row in realism_table(one, twice).rows} == {0}
    other = realism_table({"other": drives["drive 1"]}, twice)
    assert {row.ratio for row in other.rows} <= {0, math.inf}
    assert len(other.misses) > len(NAMES) / 2


def test_scans_like_the_reference_are_within_its_floor(drives):
    others = {f"other {seed}": scan_statistics(street(seed)) for seed in range(10, 14)}
    table = realism_table(others, drives)
    judged = [row for row in table.rows if not math.isnan(row.ratio)]
    assert len(judged) == len(NAMES) == 36
    assert np.median([row.ratio for row in judged]) == pytest.approx(1, abs=0.5)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"lost": 0.2}, {"dropout by beam", "keep rate by range, ground", "dropout run length"}),
        ({"gray": 0.6}, {"intensity JSD", "median intensity by range"}),
        ({"wall_m": 10.0}, {"range W1", "range W1, upper block", "height map W1"}),
    ],
)
def test_a_change_is_found_where_it_belongs(drives, change, found):
    changed = {"changed": scan_statistics(street(20, **change))}
    table = realism_table(changed, drives)
    misses = [row.name for row in table.misses]
    assert found <= set(misses)
    assert [row.ratio for row in table.misses] == sorted(
        (row.ratio for row in table.misses), reverse=True
    )
    assert f"{misses[0]} (" in str(table).split("beyond 3 x the floor: ")[1]


def test_distance_and_floor_are_medians_over_pairs_of_drives(drives):
    row = next(r for r in realism_table(drives, drives).rows if r.name == "range W1")
    counts = [s.range_counts.sum(axis=0) for s in drives.values()]
    pairs = np.array([[wasserstein_1(a, b, 1.0) for a in counts] for b in counts])
    assert row.distance == pytest.approx(np.median(pairs))
    assert row.floor == pytest.approx(np.median(pairs[np.triu_indices(3, 1)]))
    assert row.floor_max == pytest.approx(pairs.max())
    assert row.pooled == 0


def test_measures_that_scans_cannot_give_are_named(drives):
    points = street(30)
    points[:, 3] = 0
    shuffled = np.random.default_rng(0).permutation(points)
    table = realism_table({"generated": scan_statistics(shuffled)}, drives, ["a note"])
    by_name = {row.name: row for row in table.rows}
    assert math.isfinite(by_name["range W1"].ratio)
    assert by_name["mixed pixels"].reason == "A: no scan is stored ring after ring"
    assert by_name["intensity JSD"].reason == "A: the intensity is zero everywhere"
    assert math.isfinite(by_name["mixed pixels"].value_b)
    text = str(table)
    assert re.search("^n/a: .*mixed pixels.*: A: no scan is stored ring after ring$", text, re.M)
    assert "1 not in ring order" in text
    assert all(name in text for name in NAMES)
    read = json.loads(json.dumps(table.to_dict(), allow_nan=False))
    assert [row["name"] for row in read["rows"]] == NAMES
    assert read["notes"][-1] == "a note"
    mixed = read["rows"][NAMES.index("mixed pixels")]
    assert mixed["ratio"] is mixed["value_a"] is None


def test_no_drive_is_refused(drives):
    with pytest.raises(ValueError, match="at least one drive"):
        realism_table({}, drives)


def test_a_row_of_pixels_more_or_less_is_no_difference(drives):
    """Drives with equally many rows have no spread; any other number would be infinitely far."""
    reference = {name: drives[name] for name in ("drive 0", "drive 1")}
    other = copy.deepcopy(drives["drive 2"])
    hit = np.flatnonzero(other.row_returns)
    other.row_returns[hit[-1]] = 0
    rows = {row.name: row for row in realism_table({"a": other}, reference).rows}
    row = rows["image rows > 2 % valid"]
    assert (row.distance, row.floor, row.ratio) == (1, 1, 1)


def test_a_scan_of_many_returns_differs_from_one_of_more():
    points = np.random.default_rng(0).normal(0, 15, (520_000, 3)).astype(np.float32)
    sets = [np.column_stack([p, np.ones(len(p), np.float32)]) for p in (points[:260_000], points)]
    few, many = (scan_statistics(each).points_per_scan.argmax() for each in sets)
    assert many > 1.9 * few


def test_single_intensities_that_are_no_numbers_do_not_matter():
    points = street(0)
    points[7, 3] = np.nan
    assert scan_statistics(points).num_intensity_scans == 1
