"""Cost of simulated scans: what is made of the times, and the command at the size of one laser."""

from __future__ import annotations

import json

import pytest

from r3dpa.bench import simulation as bench
from r3dpa.bench.simulation import ScanCost, Spread, case_cost
from r3dpa.cli import main
from r3dpa.simulation import hdl64e, load_sensor

# Two scans of 10 and 30 ms; only the second calls for fog.
PARTS = ({"rays": 1.0, "cast": 4.0, "points": 1.0}, {"rays": 3.0, "cast": 9.0, "points": 2.0})
SCANS = [
    ScanCost(200, 0.5, PARTS[0], {"range_noise": 3.0}, 0.5, 10.0, 11.0),
    ScanCost(301, 1.5, PARTS[1], {"fog": 10.0, "range_noise": 4.0}, 1.5, 30.0, 33.0),
]


@pytest.fixture
def small(monkeypatch, tmp_path):
    """One laser in place of the 64."""
    calibration = tmp_path / "laser.yaml"
    calibration.write_text("lasers: [{vert_correction: -0.1}]")
    monkeypatch.setattr(bench, "hdl64e", lambda: load_sensor(str(calibration)))


class TestCaseCost:
    def test_spread_is_over_the_scans_that_called(self):
        cost = case_cost(SCANS)
        assert cost.ms["cast"] == Spread(2, 6.5, 4.0, 9.0)
        assert cost.ms["fog"] == Spread(1, 10.0, 10.0, 10.0)
        assert cost.ms["not called"] == Spread(2, 1.0, 0.5, 1.5)
        assert cost.ms["total"] == Spread(2, 20.0, 10.0, 30.0)

    def test_parts_are_in_the_order_of_a_scan(self):
        order = ["scene", "rays", "cast", "fog", "range_noise", "points", "not called", "total"]
        assert list(case_cost(SCANS).ms) == order

    def test_shares_of_all_time(self):
        cost = case_cost(SCANS)
        assert cost.idle_share == pytest.approx(2.0 / 40)
        # 6 + 3 + 0.5 of the first scan and 14 + 14 + 1.5 of the second; the scene is no part.
        assert cost.accounted == pytest.approx(39.0 / 40)
        assert cost.repeat_ratio == pytest.approx(22 / 20)
        assert cost.primitives == (200, 250.5, 301)


class TestCommand:
    def test_prints_what_the_file_says(self, small, capsys, tmp_path):
        out = tmp_path / "new" / "cost.json"
        main(["bench", "simulation", "--quick", "--out", str(out)])
        content = json.loads(out.read_text())
        printed = capsys.readouterr().out
        rows = {line.split()[0]: line.split() for line in reversed(printed.splitlines()) if line}
        assert list(content["cases"]) == ["plain", "wet", "rain", "fog", "snow", "low sun"]
        plain = content["cases"]["plain"]
        cast, total = plain["ms"]["cast"], plain["ms"]["total"]
        cells = [f"{cast[name]:.2f}" for name in ("median", "min", "max")]
        assert rows["cast"][:5] == ["cast", "2", *cells]
        assert rows["fog"][3] == f"({plain['primitives'][0]}..{plain['primitives'][2]})"
        assert 0 < cast["min"] <= cast["median"] <= cast["max"] < total["max"]
        assert f"cast of a plain street: {cast['median']:.3g} ms, at most 60" in printed
        assert content["versions"]["numpy"] in printed

    def test_each_weather_calls_for_its_effects(self, small, tmp_path):
        out = tmp_path / "cost.json"
        bench.simulation(quick=True, out=out)
        cases = json.loads(out.read_text())["cases"]
        weathers = {"wet_ground", "rain", "fog", "snow", "sun_glare"}
        called = {name: weathers & set(case["ms"]) for name, case in cases.items()}
        assert called == {
            **{"plain": set(), "wet": {"wet_ground"}, "rain": {"wet_ground", "rain"}},
            **{"fog": {"fog"}, "snow": {"snow"}, "low sun": {"sun_glare"}},
        }
        for case in cases.values():
            assert 0 < case["idle_share"] < 0.5
            assert 0.5 < case["accounted"] < 1

    def test_says_what_is_over_budget(self, small, monkeypatch):
        monkeypatch.setattr(bench, "_CAST_BUDGET_MS", 0.0)
        monkeypatch.setattr(bench, "_SCAN_BUDGET_MS", 1e6)
        cast, scan, *_ = [
            line for line in bench.simulation(quick=True).splitlines() if ", at most " in line
        ]
        assert cast.endswith("ms, at most 0: MISSED")
        assert scan.endswith("ms, at most 1e+06: kept")

    def test_says_that_the_machine_was_busy(self, small, monkeypatch):
        monkeypatch.setattr(bench, "_UNDISTURBED", 1e9)
        assert "the times are too long" in bench.simulation(quick=True)
        monkeypatch.setattr(bench, "_UNDISTURBED", 0.0)
        assert "the times are too long" not in bench.simulation(quick=True)


def test_the_budget_is_for_the_whole_sensor():
    assert (hdl64e().num_beams, hdl64e().shots) == (64, 2083)


def test_bench_needs_to_know_what_to_measure(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["bench"])
    assert stop.value.code == 2
    assert "{training,sampling,control,speed," in capsys.readouterr().err
