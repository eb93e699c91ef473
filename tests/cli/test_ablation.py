"""``r3dpa simulate --ablate``: what changes, what is compared, and what is written."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from math import isnan

import pytest

from r3dpa.cli import main
from r3dpa.cli.ablation import _ablate_scene, _places, ablate
from r3dpa.cli.ablation_report import NOTHING, EffectAblation
from r3dpa.metrics import MEASURES, scan_statistics
from r3dpa.simulation import (
    EFFECTS,
    Street,
    Weather,
    effect_name,
    load_sensor,
    simulate_scan,
)

CALIBRATION = "lasers: [{vert_correction: -0.02}, {vert_correction: -0.1}]"
NAMES = [effect_name(effect) for effect in EFFECTS]
WET = Weather(water_film_mm=1.0)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    path = tmp_path_factory.mktemp("sensor") / "two_lasers.yaml"
    path.write_text(CALIBRATION)
    return path


@pytest.fixture(scope="module")
def sensor(calibration):
    return load_sensor(str(calibration))


@pytest.fixture(scope="module")
def wet(sensor, tmp_path_factory):
    """A single wet scan, with itself as the reference."""
    folder = tmp_path_factory.mktemp("ablation")
    scan = scan_of_wet(sensor)
    (folder / "real").mkdir()
    (folder / "real" / "0.bin").write_bytes(scan.points.tobytes())
    out = folder / "out"
    return ablate(out, sensor, 1, weather=WET, reference=folder / "real"), out


def scan_of_wet(sensor, **switches):
    """The first scan of the first drive, as the data set of seed 0 has it."""
    return simulate_scan(Street(0, 0, WET).scene(0), sensor, (0, "effects", 0, 0), switches)


def by_measure(effect, reference=None):
    return {change.measure: change for change in effect.changes(reference)}


class TestOneScan:
    def test_nothing_switched_off_changes_nothing(self, wet):
        table, _ = wet
        changes = table.effects[NOTHING].changes(table.reference)
        assert {change.distance for change in changes} == {0.0, None}
        assert {change.gain for change in changes} == {0.0}

    @pytest.mark.parametrize("name", ["range_noise", "detection_limit", "wet_ground"])
    def test_changes_are_those_of_the_scan_without(self, wet, sensor, name):
        whole = scan_statistics(scan_of_wet(sensor).points)
        without = scan_statistics(scan_of_wet(sensor, **{name: "off"}).points)
        changes = by_measure(wet[0].effects[name])
        for measure in MEASURES:
            if "beams" in measure.needs:  # which take all 64
                assert changes[measure.name].distance is None
            else:
                expected = measure.between(whole, without)
                assert changes[measure.name].distance == (None if isnan(expected) else expected)
        returns = changes["returns per scan"]
        assert (returns.with_all, returns.without) == (whole.num_returns, without.num_returns)
        assert returns.difference == without.num_returns - whole.num_returns

    def test_distance_to_a_reference_that_is_the_scan_itself(self, wet):
        table, _ = wet
        for effect in (effect for effect in table.effects.values() if effect.scans):
            for change in effect.changes(table.reference):
                assert change.reference_with_all in (0.0, None)
                assert change.reference_without == change.distance
                assert change.gain == (1.0 if change.distance else 0.0)

    def test_every_effect_is_called_or_named_as_not_called(self, wet, sensor):
        table, _ = wet
        ran = {part.name for part in scan_of_wet(sensor).effects if part.status == "ran"}
        assert list(table.effects) == [NOTHING, *NAMES]
        assert {name for name, effect in table.effects.items() if effect.scans} == {NOTHING} | ran
        (line,) = (line for line in str(table).splitlines() if line.startswith("Not called"))
        idle = line.removesuffix(".").partition(": ")[2].split(", ")
        assert idle == [name for name in NAMES if name not in ran]

    def test_times_are_paired(self, wet):
        table, _ = wet
        for name, effect in table.effects.items():
            num_pairs = 3 * effect.scans
            assert len(effect.saved_ms) == len(effect.own_ms) == num_pairs
            assert all((ms == 0) == (name == NOTHING) for ms in effect.own_ms)


class TestFiles:
    def test_the_table_is_markdown(self, wet):
        table, out = wet
        text = (out / "ablation.md").read_text()
        assert text == f"{table}\n"
        rows = [line for line in text.splitlines() if line.startswith("| range_noise")]
        changes, approach = ([cell.strip() for cell in row.split("|")[1:-1]] for row in rows)
        returns = by_measure(table.effects["range_noise"])["returns per scan"]
        assert changes[4] == f"{returns.difference:+.3g}"
        # The scan without noise lies farther from the scan itself in all that changes.
        num_changed, total = approach[1].split(" of ")
        assert num_changed == total != "0"

    def test_csv_and_json_hold_every_measure(self, wet):
        table, out = wet
        content = json.loads((out / "ablation.json").read_text())
        with (out / "ablation.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        called = [name for name, effect in table.effects.items() if effect.scans]
        expected = [(name, measure.name) for name in called for measure in MEASURES]
        assert [(row["effect"], row["measure"]) for row in rows] == expected
        for row in rows:
            effect = content["effects"][row["effect"]]
            (change,) = (c for c in effect["measures"] if c["measure"] == row["measure"])
            assert row["distance"] == (
                "" if change["distance"] is None else str(change["distance"])
            )
            assert int(row["scans"]) == effect["scans"] == 1
            assert sorted(effect["saved_ms"])[1] == float(row["saved_ms"])
        assert content["strata"] == {"as given": 1}
        assert content["settings"]["water_film_mm"] == 1.0
        assert content["machine"]["cpu"]


def test_twelve_scans_show_every_weather_and_two_returns(sensor):
    places = list(_places(12, 0, None))
    names = [name for name, _, _ in places]
    assert names.count("dry") == 6
    assert set(names) == {"dry", "wet", "rain", "fog", "snow", "low sun", "dual return"}
    assert len({(street.drive, number) for _, street, number in places}) == 12
    weathers = ("wet_ground", "rain", "fog", "snow", "sun_glare")
    for name, street, number in places:
        scene = street.scene(number)
        called = {effect_name(e) for e in EFFECTS if e.called_by(scene, sensor)}
        expected = {"wet": {"wet_ground"}, "rain": {"rain", "wet_ground"}, "low sun": {"sun_glare"}}
        if name not in ("dry", "dual return"):  # whose sun may stand low
            assert called & set(weathers) == expected.get(name, {name})


def test_a_given_weather_takes_the_place_of_all_but_two_returns():
    places = [(name, street.weather) for name, street, _ in _places(24, 0, WET)]
    assert places == ([("as given", WET)] * 11 + [("dual return", WET)]) * 2


def test_two_returns_are_compared_alone(sensor):
    effects = {name: EffectAblation() for name in (NOTHING, *NAMES)}
    dual = replace(sensor, return_mode="dual")
    _ablate_scene(effects, Street(0, 0, WET), 0, dual, ("dual_return",))
    assert [name for name, effect in effects.items() if effect.scans] == ["dual_return"]
    assert by_measure(effects["dual_return"])["returns per scan"].difference < 0


class TestCommand:
    def test_flag(self, calibration, tmp_path, capsys):
        out = tmp_path / "out"
        words = ["--out", str(out), "--scans", "1", "--sensor", str(calibration)]
        main(["simulate", *words, "--ablate"])
        assert capsys.readouterr().out == (out / "ablation.md").read_text()
        assert {path.name for path in out.iterdir()} == {
            f"ablation.{suffix}" for suffix in ("md", "csv", "json")
        }

    def test_no_scan(self, sensor, tmp_path):
        with pytest.raises(ValueError, match="scans must be 1 or greater, got 0"):
            ablate(tmp_path, sensor, 0)

    def test_a_reference_without_scans(self, sensor, tmp_path):
        with pytest.raises(ValueError, match="No scan found"):
            ablate(tmp_path / "out", sensor, 1, reference=tmp_path)
        assert not (tmp_path / "out").exists()

    def test_a_reference_of_the_wrong_intensity_is_named(self, sensor, tmp_path):
        points = scan_of_wet(sensor).points
        points[:, 3] *= 255
        (tmp_path / "real.bin").write_bytes(points.tobytes())
        with pytest.raises(ValueError, match=r"real\.bin: intensity must lie in \[0, 1\]"):
            ablate(tmp_path / "out", sensor, 1, reference=tmp_path)
