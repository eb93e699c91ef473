import csv
import io
import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from r3dpa.metrics import results as results_module
from r3dpa.metrics.result_table import EvaluationTable, Mark, _latex
from r3dpa.metrics.results import Evaluation, MetricResult, published_evaluations

ABOUT = {
    "backbones": {"FRID": {"backbone": "RangeViT", "layer": "decoder", "weights": "0f3a"}},
    "protocol": {"name": "published", "voxel_m": 0.05},
    "reference": "KITTI-360 val, 1000 scans",
    "solver": "Euler-Maruyama",
    "steps": 256,
    "seed": 0,
    "precision": "bf16",
    "commit": "abc123",
    "feature_source": "scalr",
    "published": False,
    "source": "samples/",
    "extra": {"ema": 0.9999},
}


def evaluation(label, *rows, **about):
    return Evaluation(label, rows, ABOUT | about)


def one_metric(values, **fields):
    """Table of evaluations a, b, c, ... with one metric."""
    rows = [value if isinstance(value, dict) else {"value": value} for value in values]
    return EvaluationTable(
        [
            evaluation(label, MetricResult("M", **(fields | row)))
            for label, row in zip("abcdef", rows, strict=False)
        ]
    )


def places(table, metric="M"):
    return {label: mark.place for label, mark in table.marks(metric).items()}


# One result


@pytest.mark.parametrize(
    ("key", "bad"),
    [
        ("name", ""),
        ("value", float("nan")),
        ("value", float("inf")),
        ("interval", (2.0, 1.0)),
        ("interval", (1.0,)),
        ("floor", -1.0),
        ("direction", "up"),
    ],
)
def test_a_wrong_field_is_named(key, bad):
    with pytest.raises(ValueError, match=rf"metric '.*': {key} is"):
        MetricResult(**({"name": "FRID", "value": 1.0} | {key: bad}))


def test_a_value_that_is_none_needs_a_reason():
    with pytest.raises(ValueError, match="reason in the note"):
        MetricResult("FRID", None)
    assert MetricResult("FRID", None, note="fewer samples than features").value is None
    assert MetricResult("FRID", 1.0, interval=(0.2, 0.8)).half_width == pytest.approx(0.3)


def test_half_widths_add_in_squares():
    # half widths 3 and 4: values tie up to a difference of 5
    a = MetricResult("M", 20.0, interval=(17.0, 23.0))
    assert a.ties_with(MetricResult("M", 25.0, interval=(21.0, 29.0)))
    assert not a.ties_with(MetricResult("M", 25.01, interval=(21.01, 29.01)))


def test_a_difference_below_the_larger_floor_is_a_tie():
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


def stored():
    return json.loads(json.dumps(asdict(evaluation("ours", MetricResult("FRID", 1.0)))))


def without(mapping, key):
    return {name: value for name, value in mapping.items() if name != key}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: without(s, "label"), r"evaluation lacks the keys \['label'\]"),
        (lambda s: s | {"rows": [without(s["rows"][0], "floor")]}, r"row 0 lacks.*'floor'"),
        (lambda s: s | {"rows": [s["rows"][0] | {"std": 1}]}, r"row 0 .*unknown keys \['std'\]"),
        (lambda s: s | {"rows": s["rows"] * 2}, r"more than one row for \['FRID'\]"),
        (lambda s: s | {"rows": [3]}, "row 0 is 3"),
        (lambda s: s | {"about": without(s["about"], "seed")}, r"about lacks the keys \['seed'\]"),
        (lambda s: s | {"label": " "}, "label"),
        (lambda s: [s], "evaluation is"),
    ],
)
def test_a_file_with_a_wrong_key_is_refused_by_name(tmp_path, change, message):
    path = tmp_path / "wrong.json"
    path.write_text(json.dumps(change(stored())))
    with pytest.raises(ValueError, match=rf"wrong\.json holds no evaluation: .*{message}"):
        Evaluation.load(path)
    path.write_text(json.dumps(stored())[:-20])
    with pytest.raises(ValueError, match=r"wrong\.json holds no evaluation"):
        Evaluation.load(path)


@pytest.mark.parametrize("bad", [Path("x"), float("nan")])
def test_what_json_cannot_hold_is_refused_at_once(bad):
    with pytest.raises(ValueError, match="ours: about is not for JSON"):
        evaluation("ours", extra={"value": bad})


def test_printed_evaluation_shows_how_sure_it_is():
    row = MetricResult("JSD", 0.0567, (0.0551, 0.0572), 0.028, scale=-2, num_samples=10_000)
    text = str(evaluation("ours", row, feature_source=None))
    cells = text.splitlines()[4].split("  ")
    assert list(filter(None, map(str.strip, cells))) == [
        "JSD x1e-2", "5.67", "[5.51, 5.72]", "2.80", "lower", "10,000", "-",
    ]  # fmt: skip
    assert "steps: 256" in text
    assert "feature_source" not in text


# Places


def test_first_and_second_in_both_directions():
    values = [3.0, 1.0, 2.0, 4.0]
    assert places(one_metric(values)) == {"a": 0, "b": 1, "c": 2, "d": 0}
    assert places(one_metric(values, direction="higher")) == {"a": 2, "b": 0, "c": 0, "d": 1}


def test_values_that_tie_for_a_place_do_not_get_it():
    marks = one_metric([1.0, 1.1, 2.0, 9.0], interval=(0.0, 0.2)).marks("M")
    # tolerance 0.1 * sqrt(2)
    assert marks == {"a": Mark(0, True), "b": Mark(0, True), "c": Mark(), "d": Mark()}
    marks = one_metric([1.0, 2.0, 2.1, 9.0], interval=(0.0, 0.2)).marks("M")
    assert marks == {"a": Mark(1), "b": Mark(0, True), "c": Mark(0, True), "d": Mark()}


def test_a_column_with_one_value_has_no_best():
    table = one_metric([1.0, {"value": None, "note": "no returns"}])
    assert table.marks("M") == {"a": Mark()}
    assert "b, M: no returns" in str(table)


def as_published(evaluation):
    return replace(evaluation, about=evaluation.about | {"published": True})


def test_published_numbers_are_ranked_only_if_asked_for():
    paper = as_published(evaluation("a", MetricResult("M", 0.5)))
    own = [evaluation("a", MetricResult("M", 1.0)), evaluation("b", MetricResult("M", 2.0))]
    assert places(EvaluationTable([paper, *own])) == {"a": 1, "b": 2}
    ranked = EvaluationTable([paper, *own], rank_published=True)
    assert places(ranked) == {"a (published)": 1, "a": 2, "b": 0}


# Tables


@pytest.fixture
def table():
    """FRID tells a and b apart, FLD does not; c has no FLD; the paper's row is better than all."""
    paper = evaluation("LiDM w/ APE", MetricResult("FLD", 0.1, scale=-1))
    a = [MetricResult("FRID", 4.0, (3.5, 4.5), 1.0), MetricResult("FLD", 0.25, scale=-1)]
    b = [MetricResult("FRID", 8.0, (7.5, 8.5), 1.5), MetricResult("FLD", 0.25, scale=-1)]
    return EvaluationTable(
        [
            as_published(paper),
            evaluation("a_1 & co", *a),
            evaluation("b", *b),
            evaluation("c", MetricResult("FRID", 12.345)),
        ]
    )


def test_text(table):
    assert str(table) == "\n".join(
        [
            "                                        FRID            FLD",
            "                                       lower    x1e-1 lower",
            "-----------------------  -------------------  -------------",
            "LiDM w/ APE (published)                    -           1.00",
            "a_1 & co                 * 4.00 [3.50, 4.50]         = 2.50",
            "b                        + 8.00 [7.50, 8.50]         = 2.50",
            "c                                      12.35              -",
            "real vs. real (floor)           1.00 to 1.50              -",
            "",
            "* best, + second, in each column",
            "= tie for the next place: they differ by no more than the floor or their intervals",
            "[low, high]: 95 % interval of the value at this number of scenes",
            "published: against KITTI-360 val, 1000 scans, not ranked",
            "",
        ]
    )


def test_markdown(table):
    lines = [re.sub(" +", " ", line) for line in table.markdown().splitlines()]
    assert lines[0] == "| | FRID (lower) | FLD &times;10<sup>-1</sup> (lower) |"
    assert re.fullmatch(r"\|:-+\|-+:\|-+:\|", lines[1])
    assert lines[2:7] == [
        "| LiDM w/ APE (published) | - | 1.00 |",
        r"| a\_1 & co | **4.00** [3.50, 4.50] | 2.50<sup>=</sup> |",
        "| b | <u>8.00</u> [7.50, 8.50] | 2.50<sup>=</sup> |",
        "| c | 12.35 | - |",
        "| real vs. real (floor) | 1.00 to 1.50 | - |",
    ]


def test_latex(table):
    lines = [line for line in table.latex().splitlines() if not line.startswith("%")]
    assert lines == [
        r"\begin{tabular}{lcc}",
        r"\toprule",
        r"Method & FRID $\downarrow$ & FLD $\downarrow$ \\",
        r" & {\footnotesize $\times 10^{0}$} & {\footnotesize $\times 10^{-1}$} \\",
        r"\midrule",
        r"LiDM w/ APE (published) & - & 1.00 \\",
        r"a\_1 \& co & \textbf{4.00} & 2.50$^{=}$ \\",
        r"b & \underline{8.00} & 2.50$^{=}$ \\",
        r"c & 12.35 & - \\",
        r"real vs. real (floor) & 1.00 to 1.50 & - \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


NASTY = "50% of $x_1$ & {a}^b ~ #2 \\ <c>\n"


def check_tabular(source):
    """Braces and environments are balanced, and every line has as many cells as columns."""
    code = "\n".join(line for line in source.splitlines() if not line.startswith("%"))
    bare = re.sub(r"\\[&%$#_{}]", "", code)
    depth = 0
    for character in bare:
        depth += (character == "{") - (character == "}")
        assert depth >= 0
    assert depth == 0
    assert bare.count("$") % 2 == 0
    assert not set("#~<>_%") & set(bare)
    assert re.findall(r"\\(begin|end)\{tabular\}", bare) == ["begin", "end"]
    (columns,) = re.findall(r"\\begin\{tabular\}\{(\w+)\}", bare)
    rows = [line for line in bare.splitlines() if line.endswith(r"\\")]
    assert {line.count("&") + 1 for line in rows} == {len(columns)}
    assert len(bare.splitlines()) == len(rows) + bare.count("rule") + 2
    return len(columns), len(rows)


def test_latex_of_texts_that_are_commands_is_well_formed():
    rows = [MetricResult(NASTY, 1.0, unit="m_0", note=NASTY), MetricResult("b", 2.0, floor=1.0)]
    table = EvaluationTable([evaluation(NASTY, *rows), evaluation("b", rows[0])])
    assert check_tabular(table.latex()) == (3, 5)


def test_a_label_is_no_option_of_the_line_break_before_it():
    rows = [evaluation(label, MetricResult("M", 1.0)) for label in ("a", "[2]", "*")]
    lines = EvaluationTable(rows).latex().splitlines()
    assert not [line for line in lines if line.startswith(("[", "*"))]
    assert _latex(r"a\b~^<>") == (
        r"a\textbackslash{}b\textasciitilde{}\textasciicircum{}\textless{}\textgreater{}"
    )
    assert _latex("&%$#_{}") == r"\&\%\$\#\_\{\}"
    assert _latex("[*|") == r"{[}{*}\textbar{}"


def test_markdown_cells_stay_in_their_column():
    rows = MetricResult("a|b", 1.0)
    lines = EvaluationTable([evaluation("x|y\nz", rows)]).markdown().splitlines()
    assert re.sub(" +", " ", lines[0]) == r"| | a\|b (lower) |"
    assert re.sub(" +", " ", lines[2]) == r"| x\|y z | 1.00 |"


def test_csv_holds_every_row_as_computed(table):
    rows = list(csv.DictReader(io.StringIO(table.csv())))
    assert [(row["label"], row["metric"]) for row in rows] == [
        ("LiDM w/ APE", "FLD"),
        *((label, metric) for label in ("a_1 & co", "b") for metric in ("FRID", "FLD")),
        ("c", "FRID"),
    ]
    assert [row["place"] for row in rows] == ["", "1", "", "2", "", ""]
    assert [row["tie"] for row in rows] == ["False", "False", "True", "False", "True", "False"]
    assert [row["value"] for row in rows] == ["0.1", "4.0", "0.25", "8.0", "0.25", "12.345"]
    assert (rows[1]["low"], rows[1]["high"], rows[1]["floor"]) == ("3.5", "4.5", "1.0")
    assert rows[0]["published"] == "True"


def test_the_suffix_gives_the_format(table, tmp_path):
    wanted = {"txt": str(table), "md": table.markdown(), "tex": table.latex(), "csv": table.csv()}
    for suffix, text in wanted.items():
        table.save(tmp_path / f"table.{suffix}")
        assert (tmp_path / f"table.{suffix}").read_text(encoding="utf-8") == text
    with pytest.raises(ValueError, match=r"table\.html.*\.txt, \.md, \.tex, \.csv"):
        table.save(tmp_path / "table.html")
    assert "0.0012" in str(one_metric([0.00123]))
    assert "0.00 " not in str(one_metric([0.00123]))


def test_columns_that_mix_things_are_refused():
    for key, other in (("direction", "higher"), ("unit", "m"), ("scale", -2)):
        with pytest.raises(ValueError, match=f"M: {key} differs"):
            one_metric([1.0, {"value": 2.0, key: other}])
    with pytest.raises(ValueError, match=r"called \['a'\]"):
        EvaluationTable([evaluation("a"), evaluation("a")])
    with pytest.raises(ValueError, match="no evaluation"):
        EvaluationTable([])


def test_unlike_evaluations_are_noted():
    a = evaluation("a", MetricResult("FRID", 1.0, num_samples=500))
    b = evaluation("b", MetricResult("FRID", 2.0, num_samples=10_000), protocol={"name": "other"})
    assert EvaluationTable([a, b]).notes == (
        "not the same protocol: a, b",
        "FRID: not the same number of samples: 500 of a; 10,000 of b",
    )
    assert EvaluationTable([a, replace(a, label="b")]).notes == ()


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
    table = EvaluationTable(published_evaluations(split), rank_published=True)
    found = {}
    for metric in sorted(table.metrics, key=list(PAPER[split]).index):
        by_place = {mark.place: name for name, mark in table.marks(metric).items()}
        found[metric] = tuple(by_place[place].removesuffix(" (published)") for place in (1, 2))
    assert found == PAPER[split]


def test_published_values_are_unscaled_and_print_as_in_the_paper():
    evaluations = published_evaluations("val-only")
    ours = evaluations[-1]
    assert (ours.label, ours.published, ours.about["steps"]) == ("R3DPA", True, 256)
    assert [row.value for row in ours.rows] == [8.46, 0.634, 9.83, 11.0, 0.0567, 8.72e-5]
    last = EvaluationTable(evaluations).latex().splitlines()[-3]
    assert last == r"R3DPA (published) & 8.46 & 6.34 & 9.83 & 11.00 & 5.67 & 8.72 \\"
    assert check_tabular(EvaluationTable(evaluations).latex()) == (7, 8)


def test_what_the_paper_leaves_open_is_none():
    ultralidar = published_evaluations("train-val")[0]
    assert [row.name for row in ultralidar.rows] == ["FSVD", "FPVD", "JSD"]
    assert ultralidar.row("FRID") is None
    mmd = published_evaluations("val-only")[1].row("MMD")
    assert (mmd.num_samples, mmd.num_references) == (2000, 1000)
    with pytest.raises(ValueError, match="train-val, val-only"):
        published_evaluations("test")


def test_published_numbers_are_the_lines_of_the_paper():
    paper = Path(__file__).resolve().parents[3] / "shared" / "paper" / "r3dpa.tex"
    if not paper.exists():
        pytest.skip(f"no {paper.name} beside the repository")
    lines = paper.read_text().splitlines()
    table = json.loads(Path(results_module.__file__).with_name("published.json").read_text())
    for method in table["methods"]:
        cells = lines[method["line"] - 1].rstrip("\\ ").split("&")[2:]
        found = [re.sub(r"[^\d.]", "", cell) for cell in cells]
        names = ["FRID", "FLD", "FSVD", "FPVD", "JSD"]
        wanted = [method["train-val"].get(name) for name in names]
        wanted += [method["val-only"].get(name) for name in (*names, "MMD")]
        assert [float(cell) if cell else None for cell in found] == wanted, method["label"]
