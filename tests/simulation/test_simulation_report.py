"""Facts of the report that can be counted by hand, and the file of the times."""

import json

import pytest

from r3dpa.simulation import EFFECTS, effect_name, hdl64e, simulate
from r3dpa.simulation.report import PARTS, make_report

NAMES = [effect_name(effect) for effect in EFFECTS]
COLUMNS = [*PARTS, *NAMES, "total"]


def summary(drive, status="ran", reason="base", rays=10):
    record = {"status": status, "reason": reason, "rays": rays}
    return {"drive": drive, "points": 5, "effects": {"range_noise": record}}


def timing(**ms):
    return dict.fromkeys(COLUMNS, 0.0) | {"total": 10.0} | ms


class TestEffects:
    def test_counts_and_rays(self):
        summaries = [
            summary("0003", "not_called", "nothing", 0),
            summary("0003", "ran", "first", 30),
            summary("0003", "ran", "second", 50),
            summary("0000", "off", "switched off", 0),
        ]
        total = make_report(summaries, []).effects["range_noise"]
        assert (total.ran, total.not_called, total.off) == (2, 1, 1)
        assert total.rays_per_scan == 20
        assert total.why == "first"

    def test_without_a_run_the_reason_is_that_of_the_first_scan(self):
        summaries = [summary("0003", "not_called", "nothing"), summary("0003", "off", "off")]
        assert make_report(summaries, []).effects["range_noise"].why == "nothing"

    def test_scans_by_drive(self):
        summaries = [summary("0003"), summary("0000"), summary("0003")]
        assert make_report(summaries, []).scans_per_drive == {"0003": 2, "0000": 1}


class TestCosts:
    def test_mean_median_and_share(self):
        """Casts of 1, 2 and 9 ms in totals of 10, 10 and 20 ms: 12 of 40."""
        timings = [timing(cast=1.0), timing(cast=2.0), timing(cast=9.0, total=20.0)]
        result = make_report([summary("0003")] * 3, timings)
        assert result.costs["cast"] == pytest.approx((4.0, 2.0, 0.3))
        assert result.costs["total"] == pytest.approx((40 / 3, 10.0, 1.0))
        assert result.num_timed == 3

    def test_accounted_is_the_sum_of_all_but_the_total(self):
        timings = [timing(cast=4.0, range_noise=3.0, write=2.0)]
        assert make_report([summary("0003")], timings).accounted == pytest.approx(0.9)

    def test_without_times_there_are_none(self):
        result = make_report([summary("0003")], [])
        assert (result.costs, result.num_timed, result.accounted) == ({}, 0, 0)
        assert "- " in str(result)


class TestTable:
    def test_has_a_line_for_every_effect_part_and_the_total(self):
        timings = [timing(cast=2.5, range_noise=5.0)]
        result = make_report([summary("0003", "ran", "sigma 1 cm", 1234)], timings)
        lines = {line.split()[0]: line.split() for line in str(result).splitlines() if line}
        assert lines["range_noise"][1:] == (
            ["1", "0", "0", "1234", "5.00", "5.00", "50.0%", "sigma", "1", "cm"]
        )
        assert lines["cast"][1:] == ["2.50", "2.50", "25.0%"]
        assert lines["total"][1:] == ["10.00", "10.00", "100.0%"]
        assert set(PARTS) < set(lines)
        assert str(result).splitlines()[-1] == "effects and parts add up to 75.0% of the total"


@pytest.fixture(scope="module")
def data_set(tmp_path_factory):
    root = tmp_path_factory.mktemp("reported")
    effects = {"range_noise": "off"}
    return root, simulate(root, 6, drives=["0003"], sensor=hdl64e(32), effects=effects)


class TestOfADataSet:
    def test_report_on_disk_is_the_one_returned(self, data_set):
        root, result = data_set
        stored = json.loads((root / "report.json").read_text())
        assert stored == json.loads(json.dumps(result.to_dict()))
        assert stored["scans_per_drive"] == {"0003": 6}
        assert "num_written" not in stored

    def test_totals_are_those_of_the_single_scans(self, data_set):
        root, result = data_set
        scans = [json.loads(path.read_text()) for path in sorted(root.rglob("sim/*.json"))]
        assert len(scans) == 6
        assert list(result.effects) == NAMES
        for name, total in result.effects.items():
            records = [scan["effects"][name] for scan in scans]
            for status in ("ran", "not_called", "off"):
                count = sum(record["status"] == status for record in records)
                assert getattr(total, status) == count
            assert total.rays_per_scan == pytest.approx(sum(r["rays"] for r in records) / 6)
            assert total.why in [record["reason"] for record in records]
        assert result.effects["range_noise"].off == 6
        assert result.effects["detection_limit"].ran == 6
