import csv
import json
import math
import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from r3dpa.feature_names import SPACES
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import (
    Evaluation,
    EvaluationTable,
    MetricResult,
    published_evaluations,
    report,
    save_csv,
)

ABOUT = {
    "backbones": {"FRID": {"backbone": "RangeViT", "layer": "decoder", "weights": "0f3a"}},
    "protocol": {"name": "published", "voxel_m": 0.05},
    "reference": "KITTI-360 val, 1000 scans",
    "steps": 256,
}


def evaluation(label, *rows, **about):
    return Evaluation(label, rows, ABOUT | about)


def marks(values, **fields):
    """Marks of evaluations with one metric."""
    rows = [value if isinstance(value, dict) else {"value": value} for value in values]
    table = EvaluationTable([evaluation("x", MetricResult("M", **(fields | row))) for row in rows])
    return table.marks("M")


# Intervals


def test_interval_of_a_mean_is_students():
    values = torch.tensor([2.0, 4.0, 4.0, 6.0])  # deviation sqrt(8 / 3), t of 3 degrees 3.1824
    half = 3.1824 * math.sqrt(8 / 3) / 2
    ends = pytest.approx((4 - half, 4 + half), abs=1e-4)
    assert Resampling().of_mean(values) == ends
    assert Resampling().interval(lambda kept: values[kept].mean().item(), 4) == ends


def test_interval_leaves_out_groups_of_equal_size():
    """Of 35 values, 3 are over: the sums of 16 pairs tell how much the mean varies."""
    values = torch.randn(35, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    left_out = []

    def mean(kept):
        left_out.append(sorted(set(range(35)) - set(kept.tolist())))
        return values[kept].mean().item()

    low, high = Resampling().interval(mean, 35)
    assert left_out == [*([i, i + 16] for i in range(16)), []]
    pairs = values[:16] + values[16:32]
    mean_of_all = values.mean().item()
    half = 2.1314 * math.sqrt(pairs.var().item() / (2 * 35))  # t of 15 degrees
    assert (low, high) == pytest.approx((mean_of_all - half, mean_of_all + half), rel=1e-4)


@pytest.mark.parametrize(("num_hits", "ends"), [(0, (0, 0.1611)), (20, (0.8389, 1))])
def test_interval_of_a_share_is_wilsons(num_hits, ends):
    """Without any hit a share ends at z^2 / (n + z^2), where all resamples would be 0."""
    hits = torch.arange(20) < num_hits
    assert Resampling().of_share(hits.double()) == pytest.approx(ends, abs=1e-4)


def test_interval_of_few_scenes_is_not_much_wider_than_they_spread():
    """Samples that are drawn twice would make distances of 16 scenes spread three times as far."""
    generator = torch.Generator().manual_seed(0)
    values, halves = [], []
    for _ in range(60):
        scenes = (torch.rand(16, 300, generator=generator) < 0.2).double()

        def distance(kept, scenes=scenes):
            counts = scenes[kept].sum(dim=0)
            return (counts / counts.sum() - 1 / 300).abs().sum().item() / 2

        low, high = Resampling().interval(distance, 16)
        values.append(distance(torch.arange(16)))
        halves.append((high - low) / 2)
    ratio = torch.tensor(halves).mean() / (1.96 * torch.tensor(values).std())
    assert 0.9 < ratio < 2


def test_intervals_need_samples_and_resamples():
    assert Resampling().of_mean(torch.ones(1)) is None
    assert Resampling().interval(len, 2) is None
    for interval in (Resampling(num_resamples=0).of_mean, Resampling(num_resamples=0).of_share):
        assert interval(torch.ones(9)) is None
    assert Resampling(num_resamples=0).interval(len, 9) is None


# One result


@pytest.mark.parametrize(
    "fields",
    [
        {"value": float("nan")},
        {"value": 1.0, "floor": float("inf")},
        {"value": 1.0, "interval": (2.0, 1.0)},
        {"value": 1.0, "interval": (0.0, float("inf"))},
    ],
)
def test_a_number_that_is_none_is_refused(fields):
    with pytest.raises(ValueError, match=r"'FRID'.*give (finite numbers|the lower end)"):
        MetricResult("FRID", **fields)


@pytest.mark.numerics("floor of the Jensen-Shannon distance")
def test_a_difference_below_the_larger_floor_or_the_half_widths_is_a_tie():
    # half widths 3 and 4, in squares: values tie up to a difference of 5
    a = MetricResult("M", 20.0, interval=(17.0, 23.0))
    assert a.ties_with(MetricResult("M", 25.0, interval=(21.0, 29.0)))
    assert not a.ties_with(MetricResult("M", 25.01, interval=(21.01, 29.01)))
    a = MetricResult("M", 1.0, floor=0.5)
    assert a.ties_with(MetricResult("M", 3.0, floor=2.0))
    assert MetricResult("M", 3.0, floor=2.0).ties_with(a)
    assert not a.ties_with(MetricResult("M", 3.0, floor=1.9))
    without = MetricResult("M", 1.0)
    assert without.ties_with(without)
    assert not without.ties_with(MetricResult("M", 1.0 + 1e-12))


# JSON


def test_saved_evaluation_is_read_back(tmp_path):
    before = evaluation(
        "ours",
        MetricResult("JSD", 0.0567, (0.05, 0.06), 0.028, scale=-2, num_samples=10_000, note="é"),
        MetricResult("FRID", None, note="skipped"),
        extra={"pair": (1, 2)},
    )
    before.save(tmp_path / "new" / "ours.json")
    after = Evaluation.load(tmp_path / "new" / "ours.json")
    assert after == before
    assert after.rows[0].interval == (0.05, 0.06)
    assert after.about["extra"] == {"pair": [1, 2]}
    assert (after.published, after.about["solver"]) == (False, None)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.pop("label"), "missing .* 'label'"),
        (lambda s: s["rows"][0].pop("value"), "missing .* 'value'"),
        (lambda s: s["rows"][0].update(std=1), "unexpected keyword argument 'std'"),
        (lambda s: s.update(rows=[3]), "must be a mapping"),
    ],
)
def test_a_file_with_a_wrong_key_is_refused_by_name(tmp_path, change, message):
    path, stored = tmp_path / "wrong.json", asdict(evaluation("ours", MetricResult("FRID", 1.0)))
    change(stored := json.loads(json.dumps(stored)))
    path.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=rf"wrong\.json holds no evaluation: .*{message}"):
        Evaluation.load(path)
    for text in (path.read_text()[:-20], "[]"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"wrong\.json holds no evaluation"):
            Evaluation.load(path)


@pytest.mark.parametrize("bad", [Path("x"), float("nan")])
def test_what_json_cannot_hold_is_refused_at_once(bad):
    with pytest.raises((TypeError, ValueError), match="JSON"):
        evaluation("ours", extra={"value": bad})


def test_printed_evaluation_shows_how_sure_it_is():
    row = MetricResult("JSD", 0.0567, (0.0551, 0.0572), 0.028, scale=-2, num_samples=10_000)
    text = str(evaluation("ours", row))
    cells = text.splitlines()[4].split("  ")
    assert list(filter(None, map(str.strip, cells))) == [
        "JSD x1e-2", "5.67", "[5.51, 5.72]", "2.80", "lower", "10,000", "-",
    ]  # fmt: skip
    assert "steps: 256" in text
    assert (row.printed(0.00123), row.printed(0.0), row.printed(None)) == ("0.12", "0.00", "-")
    assert "feature_source" not in text


# Marks


def test_first_and_second_in_both_directions():
    values = [3.0, 1.0, 2.0, 4.0]
    assert marks(values) == ["", "best", "second", ""]
    assert marks(values, direction="higher") == ["second", "", "", "best"]


def test_values_that_tie_for_a_place_do_not_get_it():
    # tolerance 0.1 * sqrt(2)
    assert marks([1.0, 1.1, 2.0, 9.0], interval=(0.0, 0.2)) == ["tie", "tie", "", ""]
    assert marks([1.0, 2.0, 2.1, 9.0], interval=(0.0, 0.2)) == ["best", "tie", "tie", ""]
    assert marks([1.0, {"value": None, "note": "no returns"}]) == ["", ""]


def as_published(evaluation, published=True):
    return replace(evaluation, about=evaluation.about | {"published": published})


# Tables


@pytest.fixture
def table():
    """FRID tells a and b apart, FLD does not; c has no FLD; the paper's row is better than all."""
    paper = evaluation("LiDM w/ APE", MetricResult("FLD", 0.1, scale=-1))
    a = [MetricResult("FRID", 4.0, (3.5, 4.5), 1.0), MetricResult("FLD", 0.25, scale=-1)]
    b = [MetricResult("FRID", 8.0, (7.5, 8.5), 1.5), MetricResult("FLD", 0.25, scale=-1)]
    return EvaluationTable(
        [
            evaluation("a_1 & co", *a),
            evaluation("b|\nb", *b),
            evaluation("c", MetricResult("FRID", 12.345), MetricResult("FLD", None, note="no net")),
            as_published(paper),
        ]
    )


def test_a_table_as_text(table):
    lines = [re.sub(" +", " ", line) for line in str(table).splitlines()]
    assert re.fullmatch(r"\|:-+\|-+:\|-+:\|", lines.pop(1))
    assert lines == [
        "| | FRID (lower) | FLD (1e-1, lower) |",
        "| LiDM w/ APE (published) | - | 1.00 |",
        "| a_1 & co | **4.00** [3.50, 4.50] | = 2.50 |",
        "| b/ b | _8.00_ [7.50, 8.50] | = 2.50 |",
        "| c | 12.35 | - |",
        "| real vs. real (floor) | 1.00 to 1.50 | - |",
        "",
        "- **best**, _second_, = tie: no further apart than the floor or the intervals",
        "- [low, high]: 95 % interval (measured to hold in 90 to 99 %) over draws of as many "
        "generated scenes against the same real scans; of a mean over trainings, over these (MMD: "
        "real scans drawn, generated scenes fixed)",
        "- published: against KITTI-360 val, 1000 scans, not ranked",
        "- c, FLD: no net",
    ]


def test_a_table_as_latex(table):
    lines = [line for line in table.latex().splitlines() if not line.startswith("%")]
    assert [re.sub(" +", " ", line).strip() for line in lines] == [
        r"\begin{tabular}{lrr}",
        r"\toprule",
        r"Method & FRID $\downarrow$ & FLD $\downarrow$ $\times 10^{-1}$ \\",
        r"\midrule",
        r"LiDM w/ APE (published) & - & 1.00 \\",
        r"a\_1 \& co & \textbf{4.00} & 2.50$^{=}$ \\",
        r"b/ b & \underline{8.00} & 2.50$^{=}$ \\",
        r"c & 12.35 & - \\",
        r"real vs. real (floor) & 1.00 to 1.50 & - \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_csv_holds_every_row_as_computed(table, tmp_path):
    save_csv(table.evaluations, tmp_path / "table.csv")
    with (tmp_path / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["label"], row["metric"], row["value"]) for row in rows] == [
        ("LiDM w/ APE", "FLD", "0.1"),
        ("a_1 & co", "FRID", "4.0"),
        ("a_1 & co", "FLD", "0.25"),
        ("b|\nb", "FRID", "8.0"),
        ("b|\nb", "FLD", "0.25"),
        ("c", "FRID", "12.345"),
        ("c", "FLD", ""),
    ]
    assert (rows[1]["low"], rows[1]["high"], rows[1]["floor"]) == ("3.5", "4.5", "1.0")
    assert (rows[0]["published"], rows[6]["note"]) == ("True", "no net")


def test_unlike_evaluations_are_noted():
    a = evaluation("a", MetricResult("FRID", 1.0, num_samples=500))
    b = evaluation("b", MetricResult("FRID", 2.0, num_samples=10_000), protocol={"name": "other"})
    assert EvaluationTable([a, b]).notes == [
        "not the same protocol: a, b",
        "not the same number of scenes: 500 of a; 10,000 of b",
    ]
    assert EvaluationTable([a, b]).marks("FRID") == ["", ""]
    assert EvaluationTable([a, replace(a, label="b")]).notes == []


# The paper's table

PAPER = {  # place of each method in each column, as the paper marks them
    "train-val": {
        "FRID": ("R2Flow", "R3DPA"),
        "FLD": ("R3DPA", "R2Flow"),
        "FSVD": ("R3DPA", "R2DM"),
        "FPVD": ("R3DPA", "R2DM"),
        "JSD": ("R3DPA", "R2DM"),
    },
    "val-only": {
        "FRID": ("R3DPA", "R2Flow"),
        "FLD": ("R3DPA", "R2DM"),
        "FSVD": ("R3DPA", "R2DM"),
        "FPVD": ("R3DPA", "R2DM"),
        "JSD": ("R3DPA", "R2DM"),
        "MMD": ("R2Flow", "R2DM"),
    },
}


@pytest.mark.parametrize("split", PAPER)
def test_published_numbers_are_marked_as_in_the_paper(split):
    table = EvaluationTable([as_published(e, False) for e in published_evaluations(split)])
    found = {}
    for metric in sorted(table.columns, key=list(PAPER[split]).index):
        placed = table.marks(metric)
        indices = [placed.index(place) for place in ("best", "second")]
        found[metric] = tuple(table.evaluations[index].label for index in indices)
    assert found == PAPER[split]


def test_published_values_are_unscaled_and_print_as_in_the_paper():
    evaluations = published_evaluations("val-only")
    mmd = evaluations[1].row("MMD")
    assert (mmd.num_samples, mmd.num_references) == (2000, 1000)
    assert [row.name for row in evaluations[0].rows] == ["FSVD", "FPVD", "JSD", "MMD"]
    ours = evaluations[-1]
    assert (ours.label, ours.published, ours.about["steps"]) == ("R3DPA", True, 256)
    assert [row.value for row in ours.rows] == [8.46, 0.634, 9.83, 11.0, 0.0567, 8.72e-5]
    last = EvaluationTable(evaluations).latex().splitlines()[-3]
    numbers = r"8.46 & 6.34 & 9.83 & 11.00 & 5.67 & 8.72 \\"
    assert re.sub(" +", " ", last) == f" R3DPA (published) & {numbers}"


def test_references_without_a_data_set_say_why_published_numbers_are_left_out():
    text = report(Evaluation("ours", (MetricResult("FRID", 5.0),)), {"split": "all"})
    assert "(published)" not in text
    assert text.splitlines()[-1].startswith("- published numbers left out: the reference does not")


@pytest.mark.parametrize(("dataset", "shown"), [("KITTI-360", True), (None, False)])
def test_published_numbers_stand_beside_references_of_their_data_set(dataset, shown):
    evaluation = Evaluation("ours", (MetricResult("FRID", 5.0),))
    text = report(evaluation, {"split": "all", "dataset": dataset})
    assert ("R3DPA (published)" in text) == shown
    assert "| ours" in text


def test_tables_beside_others_have_every_distance_and_no_other_metric():
    rows = [MetricResult(space.upper(), 1.0) for space in SPACES]
    earlier = Evaluation("before", (*rows, MetricResult("W1 range", 1.0)))
    text = report(Evaluation("ours", tuple(rows)), {}, [earlier])
    table = [line for line in text.splitlines() if line.startswith("| ours")]
    heads = text[: text.index(table[0])]
    assert all(f" {space.upper()} " in heads for space in SPACES)
    assert "W1" not in heads
