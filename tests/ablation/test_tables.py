"""Tables of ablations: means over seeds, orders of the paper, and the recorded tables again."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_evaluations import evaluation

from r3dpa.ablation import write_table
from r3dpa.ablation.plan import Plan, PlannedStage, Row, Table
from r3dpa.ablation.tables import mean_of_seeds, order_results, relative_change
from r3dpa.metrics.results import Evaluation, EvaluationTable, MetricResult

RECORDED = Path(__file__).resolve().parents[2] / "notebooks" / "results" / "ablation_demo"


def test_a_mean_over_seeds_keeps_notes_and_bad_samples():
    few = evaluation(JSD=2.0)
    few = replace(few, rows=(replace(few.rows[0], note="few scenes"),))
    few.about["extra"]["bad_samples"] = ["7"]
    mean = mean_of_seeds("row", [evaluation(JSD=1.0, MMD=2.0), few])
    assert mean.row("JSD").note == "few scenes"
    assert mean.row("MMD") is None
    assert mean.bad_samples == ["7"]
    assert mean_of_seeds("row", [evaluation(JSD=1.0)]).row("JSD").interval == (0.9, 1.1)


def test_a_table_says_that_the_interval_of_a_mean_is_over_its_trainings():
    seeds = [evaluation(JSD=1.0), evaluation(JSD=2.0)]
    seeds[0].about["extra"]["verdict"] = "of the scenes of this seed"
    mean = mean_of_seeds("row", seeds)
    table = str(EvaluationTable([mean]))
    assert "of a mean over trainings, over these" in table
    assert "verdict" not in mean.about["extra"]


def test_released_weights_keep_their_interval_over_scenes(tmp_path):
    """With every seed they are the same: three seeds say no more than one."""
    stage = PlannedStage("weights", tmp_path / "weights", [], {}, ())
    evaluation(JSD=0.5).save(stage.evaluation)
    row = Row("r", "released", {}, {seed: [stage] for seed in (0, 1, 2)})
    table = Table("t", "", [row], [])
    write_table(Plan(tmp_path, "demo", "", [], (0, 1, 2), [table]), table, {})
    (line,) = csv.DictReader((tmp_path / "t.csv").read_text().splitlines())
    assert (float(line["low"]), float(line["high"])) == pytest.approx((0.4, 0.6))


def test_a_side_that_is_one_run_has_the_interval_of_its_scenes():
    released = {seed: evaluation(JSD=5.0) for seed in (0, 1, 2)}
    other = {seed: evaluation(JSD=4.9) for seed in (0, 1, 2)}
    one = relative_change({0: other[0]}, {0: released[0]}, "JSD")
    assert relative_change(other, released, "JSD") == one
    assert one[1][1] - one[0] == pytest.approx(math.hypot(0.1, 0.1) / 5)
    trained = {seed: evaluation(JSD=4.9 + seed / 100) for seed in (0, 1, 2)}
    mean, (low, high) = relative_change(trained, released, "JSD")
    seeds = 4.3027 * 0.01 / 5 / 3**0.5  # Student's t of two degrees of freedom
    assert (high - low) / 2 == pytest.approx(math.hypot(seeds, 0.1 / 5), rel=1e-3)
    assert mean == pytest.approx(-0.09 / 5)


@pytest.mark.parametrize(
    ("ours", "theirs", "better", "alike"),
    [
        ((1.0,), (2.0,), "yes", "no"),
        ((2.0,), (1.0,), "no", "no"),
        ((1.0,), (1.1,), "unclear", "unclear"),  # half widths of 0.1 each
        ((20.0,), (20.1,), "unclear", "yes"),
        ((1.0, 1.01), (2.0, 2.0), "yes", "no"),
        ((1.0, 1.9), (2.0, 2.0), "unclear", "unclear"),  # both better, by unlike amounts
        ((3.0, 5.0), (3.01, 5.01), "unclear", "yes"),  # in pairs: seeds differ more than rows
    ],
)
def test_an_order_holds_if_the_interval_lies_inside_the_claim(ours, theirs, better, alike):
    rows = [Row(key, key, {}, {}) for key in "ab"]
    table = Table("t", "", rows, [("better", "a", "b"), ("alike", "a", "b")])
    results = {
        key: {seed: evaluation(JSD=value) for seed, value in enumerate(values)}
        for key, values in (("a", ours), ("b", theirs))
    }
    orders = order_results(table, results, {"JSD": True})
    assert [order.holds for order in orders] == [better, alike]


@pytest.mark.parametrize("name", ["table_2", "table_3", "table_4"])
def test_recorded_tables_are_computed_again(name, tmp_path):
    """From the numbers of each seed: means, intervals, paired differences and what they say."""
    plan, stored = recorded(name, tmp_path)
    write_table(plan, plan.tables[0], {})
    content = json.loads((tmp_path / f"{name}.json").read_text())
    for key in ("caption", "scale", "about", "rows", "orders"):
        assert six_digits(content[key]) == six_digits(stored[key]), key
    old, new = ((folder / f"{name}.md").read_text() for folder in (RECORDED, tmp_path))
    lines = [line for line in old.splitlines() if "Paper: " in line or "Scale" in line]
    assert [line for line in lines if line not in new] == []
    assert "against KITTI-360, train-val (MMD: val-only)" in new
    assert r"\bottomrule" in (tmp_path / f"{name}.tex").read_text()
    means = []
    for folder in (RECORDED, tmp_path):
        with (folder / f"{name}.csv").open(newline="") as file:
            means.append(
                [
                    [line["label"], line["metric"]]
                    + [float(line[key]) for key in ("value", "low", "high") if line[key]]
                    for line in csv.DictReader(file)
                ]
            )
    assert six_digits(means[0]) == six_digits(means[1])


def six_digits(value):
    """Value of a JSON file with its numbers as text: the last digits depend on SciPy's version."""
    return json.loads(json.dumps(value), parse_float=lambda number: f"{float(number):.6g}")


def recorded(name, out):
    """Plan of a recorded table, with its evaluations in their folders."""
    stored = json.loads((RECORDED / f"{name}.json").read_text())
    rows = []
    for row in stored["rows"]:
        chains = {}
        for seed, names in row["stages"].items():
            chain = [PlannedStage(stage, out / stage, [], {}, ()) for stage in names]
            results = [
                MetricResult(metric, value, row["intervals"][seed][metric])
                for metric, value in row["values"][seed].items()
            ]
            Evaluation(row["label"], results, evaluation().about).save(chain[-1].evaluation)
            chains[int(seed)] = chain
        rows.append(Row(row["key"], row["label"], row["published"], chains))
    orders = {
        (order["claim"].replace("worse", "better"), order["first"], order["second"]): None
        for order in stored["orders"]
    }
    table = Table(name, stored["caption"], rows, list(orders))
    return Plan(out, stored["scale"], stored["about"], [], (0, 1, 2), [table]), stored
