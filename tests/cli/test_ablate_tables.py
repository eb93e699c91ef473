"""``r3dpa ablate``: what is shared, what is run, what a failure costs, and what is written."""

from __future__ import annotations

import csv
import json
import shutil
import struct
import subprocess
import time
import zlib
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest
import wandb
import yaml
from scipy.stats import ttest_1samp

from r3dpa.ablation import make_plan, read_scale
from r3dpa.ablation import run as runner
from r3dpa.ablation.plan import Row, Table, merged, read_config
from r3dpa.ablation.tables import mean_of_seeds, order_results
from r3dpa.cli import main
from r3dpa.metrics.results import Evaluation, MetricResult

CONF = Path(__file__).resolve().parents[2] / "conf"
TABLES = CONF / "ablation"
SCALES = sorted(path.stem for path in (TABLES / "scale").glob("*.yaml"))
pytestmark = pytest.mark.filterwarnings(
    "ignore:LightningCLI's args parameter", "ignore:.*does not have many workers"
)


def plan_of(scale, seeds=(0,), tables=TABLES, rgb_weights=None):
    return make_plan(tables, read_scale(TABLES / "scale" / f"{scale}.yaml"), seeds, rgb_weights)


def rows_of(plan):
    return {(table.name, row.key): row for table in plan.tables for row in table.rows}


@pytest.mark.parametrize("scale", SCALES)
class TestShippedPlans:
    def test_all_rows_of_the_paper_are_there(self, scale):
        plan = plan_of(scale)
        assert [(table.name, len(table.rows)) for table in plan.tables] == [
            ("table_2", 3),
            ("table_3", 3),
            ("table_4", 2),
        ]
        assert all(len(row.published) == 6 for row in rows_of(plan).values())

    def test_what_rows_share_is_run_once(self, scale):
        """Two VAEs, four baselines, three joint trainings; table II ends as table III begins."""
        plan = plan_of(scale)
        kinds = [stage.experiment for stage in plan.stages if plan.on_scans(stage)]
        assert {kind: kinds.count(kind) for kind in kinds} == {
            "vae_alignment": 2,
            "flow_matching": 4,
            "joint": 2,
            "joint_unet": 1,
        }
        rows = rows_of(plan)
        same = rows["table_2", "3_aligned"], rows["table_3", "1_none"]
        assert same[0].tested(0).name == same[1].tested(0).name
        assert len(plan.tested) == 7

    def test_stages_come_after_what_they_start_from(self, scale):
        seen = set()
        for stage in plan_of(scale).stages:
            assert {before.name for before in stage.before} <= seen
            seen.add(stage.name)

    def test_a_second_seed_repeats_all_but_the_prior(self, scale):
        one, two = plan_of(scale), plan_of(scale, (0, 1))
        prior = [stage for stage in one.stages if not one.on_scans(stage)]
        assert len(two.stages) == 2 * len(one.stages) - len(prior)
        assert {stage.name for stage in one.stages} < {stage.name for stage in two.stages}


class TestContentOfAStage:
    def test_given_weights_replace_the_pretraining(self, tmp_path):
        weights = tmp_path / "rgb.pt"
        weights.write_bytes(b"one")
        first = plan_of("demo", rgb_weights=weights)
        assert all(first.on_scans(stage) for stage in first.stages)
        start = rows_of(first)["table_2", "2_rgb"].tested(0).starts
        assert start["model.init_args.rgb_weights"] == weights
        weights.write_bytes(b"two")
        second = plan_of("demo", rgb_weights=weights)
        scratch = rows_of(first)["table_2", "1_scratch"].tested(0).name
        assert rows_of(second)["table_2", "1_scratch"].tested(0).name == scratch
        aligned = [rows_of(p)["table_2", "3_aligned"].stages[0] for p in (first, second)]
        for before, after in zip(*aligned, strict=True):
            assert before.name != after.name

    def test_how_it_is_tested_does_not_count(self):
        scale = read_scale(TABLES / "scale" / "demo.yaml")
        scorer = {"scorer": {"num_scenes": 7}}
        other = replace(scale, overrides=merged(scale.overrides, scorer))
        longer = replace(scale, overrides=merged(scale.overrides, {"trainer": {"max_epochs": 9}}))
        names = [
            [stage.name for stage in make_plan(TABLES, s, (0,)).stages]
            for s in (scale, other, longer)
        ]
        assert names[0] == names[1]
        assert names[0] != names[2]

    def test_another_class_takes_no_argument_of_the_one_before(self):
        before = {"sit": {"class_path": "a", "init_args": {"depth": 3, "width": 1}}, "x": 1}
        deeper = {"sit": {"class_path": "a", "init_args": {"depth": 4}}}
        other = {"sit": {"class_path": "b", "init_args": {"depth": 4}}}
        assert merged(before, deeper)["sit"]["init_args"] == {"depth": 4, "width": 1}
        assert merged(before, other)["sit"]["init_args"] == {"depth": 4}

    def test_merged_files_are_what_the_command_line_makes_of_them(self, capsys, tmp_path):
        files = ["trainer", "trainer_demo", "data/demo", "experiment/joint"]
        files = [CONF / f"{name}.yaml" for name in (*files, "experiment/joint_demo")]
        both = [word for path in files for word in ("--config", str(path))]
        single = tmp_path / "one.yaml"
        config = {}
        for path in files:
            config = merged(config, read_config(path))
        single.write_text(yaml.safe_dump(config))
        printed = []
        for words in (both, ["--config", str(single)]):
            with pytest.raises(SystemExit):
                main(["fit", *words, "--print_config"])
            printed.append(yaml.safe_load(capsys.readouterr().out))
        assert printed[0] == printed[1]


class TestWrongFiles:
    @pytest.mark.parametrize(
        ("row", "message"),
        [
            ({"label": "x"}, r"1_a.yaml: lacks the keys \['stages'\]"),
            ({"label": "x", "stages": [], "colour": 1}, r"unknown keys \['colour'\]"),
            ({"label": "x", "stages": []}, "has no stage to train"),
            (
                {"label": "x", "stages": [{"name": "a", "experiment": "fly"}]},
                r"stages\[0\]: the scale demo has no experiment 'fly'; give one of image_vae",
            ),
            (
                {
                    "label": "x",
                    "stages": [{"name": "a", "experiment": "joint", "start": {"k": "b"}}],
                },
                "no stage before it is called 'b'",
            ),
        ],
    )
    def test_it_is_named(self, row, message, tmp_path):
        (tmp_path / "table.yaml").write_text("caption: c")
        (tmp_path / "1_a.yaml").write_text(yaml.safe_dump(row))
        with pytest.raises(ValueError, match=message):
            plan_of("demo", tables=tmp_path)

    def test_folder_scale_and_seeds(self, tmp_path):
        with pytest.raises(ValueError, match=r"holds no table\.yaml"):
            plan_of("demo", tables=tmp_path)
        with pytest.raises(ValueError, match="no such scale; give one of demo"):
            plan_of("huge")
        with pytest.raises(ValueError, match="different numbers"):
            plan_of("demo", (1, 1))
        with pytest.raises(ValueError, match="from 0 on"):
            plan_of("demo", (-1,))

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({}, "2 rows have the label 'x'; tell them apart"),
            ({"published": {"FID": 1.0}}, "2_b.yaml: published: 'FID' is no metric of the paper"),
        ],
    )
    def test_rows_that_no_table_could_show(self, changes, message, tmp_path):
        (tmp_path / "table.yaml").write_text("caption: c")
        row = {"label": "x", "stages": [{"name": "a", "experiment": "joint"}]}
        (tmp_path / "1_a.yaml").write_text(yaml.safe_dump(row))
        (tmp_path / "2_b.yaml").write_text(yaml.safe_dump(row | changes))
        with pytest.raises(ValueError, match=message):
            plan_of("demo", tables=tmp_path)

    def test_weights_that_are_not_there(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ValueError, match="needs files that are not there: data/weights/dino"):
            main(["ablate", str(TABLES), "--scale", "paper", "--out", "out"])
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize(
        ("words", "message"),
        [(["nowhere"], "nowhere: is no folder"), ([str(TABLES), "--seeds", "0", "0"], "different")],
    )
    def test_arguments(self, words, message):
        with pytest.raises(ValueError, match=message):
            main(["ablate", *words])


def evaluation(label="x", **values):
    about = {
        "backbones": {}, "protocol": {"name": "default"}, "reference": "r", "solver": None,
        "steps": None, "seed": 0, "precision": None, "commit": None, "feature_source": None,
        "published": False, "source": "s", "extra": {},
    }  # fmt: skip
    rows = tuple(
        MetricResult(name, value, (value - 0.1, value + 0.1), scale=-2)
        for name, value in values.items()
    )
    return Evaluation(label, rows, about)


class TestSeeds:
    def test_mean_and_students_interval(self):
        values = (1.0, 2.0, 4.0)
        row = mean_of_seeds("row", [evaluation(JSD=v) for v in values]).row("JSD")
        expected = ttest_1samp(values, 0).confidence_interval()
        assert row.value == pytest.approx(7 / 3)
        assert row.interval == pytest.approx((expected.low, expected.high))

    def test_a_single_seed_keeps_the_interval_of_its_scenes(self):
        assert mean_of_seeds("row", [evaluation(JSD=1.0)]).row("JSD").interval == (0.9, 1.1)

    def test_a_metric_that_one_seed_lacks_has_no_mean(self):
        mean = mean_of_seeds("row", [evaluation(JSD=1.0, MMD=2.0), evaluation(JSD=1.0)])
        assert mean.row("MMD") is None

    def test_a_row_with_fewer_seeds_keeps_what_must_be_known_of_each(self):
        one, other = evaluation(JSD=1.0), evaluation(JSD=2.0)
        few = replace(other.rows[0], note="few scenes")
        bad = {**other.about, "extra": {"bad_samples": ["7"]}}
        mean = mean_of_seeds("row", [one, replace(other, rows=(few,), about=bad)])
        assert mean.row("JSD").note == "few scenes"
        assert mean.bad_samples == ["7"]


class TestOrders:
    def holds(self, ours, theirs, published=({}, {})):
        rows = tuple(Row(key, key, found, {}) for key, found in zip("ab", published, strict=True))
        table = Table("t", "", rows, (("a", "b"),), (("a", "b"),))
        results = {
            key: {seed: evaluation(JSD=value) for seed, value in enumerate(values)}
            for key, values in (("a", ours), ("b", theirs))
        }
        return {order.claim: order for order in order_results(table, results, ["JSD"])}

    @pytest.mark.parametrize(
        ("ours", "theirs", "better", "alike"),
        [
            ((1.0,), (2.0,), "yes", "no"),
            ((2.0,), (1.0,), "no", "no"),
            ((1.0,), (1.1,), "unclear", "unclear"),  # half widths of 0.1 each
            ((20.0,), (20.1,), "unclear", "yes"),
            ((1.0, 1.01), (2.0, 2.0), "yes", "no"),
            ((1.0, 1.9), (2.0, 2.0), "unclear", "unclear"),  # both better, by very unlike amounts
            ((1.0, 2.0), (2.0, 1.0), "unclear", "unclear"),
            ((3.0, 5.0), (3.01, 5.01), "unclear", "yes"),  # in pairs: seeds differ more than rows
        ],
    )
    def test_an_order_is_told_by_the_interval_of_the_difference(self, ours, theirs, better, alike):
        found = self.holds(ours, theirs)
        assert (found["better"].holds, found["alike"].holds) == (better, alike)

    def test_intervals(self):
        single = self.holds((1.0,), (2.0,))["better"]
        assert single.change == -0.5
        assert single.interval == pytest.approx((-0.5 - 0.02**0.5 / 2, -0.5 + 0.02**0.5 / 2))
        expected = ttest_1samp((-0.5, -0.6, -0.4), 0).confidence_interval()
        several = self.holds((1.0, 0.8, 1.2), (2.0, 2.0, 2.0))["better"]
        assert several.interval == pytest.approx((expected.low, expected.high))

    def test_what_the_paper_printed_goes_before_its_claim(self):
        reverse = ({"JSD": 3.0}, {"JSD": 2.0})
        assert self.holds((1.0,), (2.0,), reverse)["worse"].holds == "no"
        assert self.holds((2.0,), (1.0,), reverse)["worse"].holds == "yes"


@pytest.fixture
def scale_file(tmp_path):
    """The three LiDAR stages at smoke size."""
    smoke = read_config(CONF / "smoke.yaml")
    data = merged(smoke["data"], {"init_args": {"root": "{out}/data"}})
    trainer = smoke["trainer"] | {"callbacks": [], "limit_val_batches": 0}
    scorer = smoke["scorer"] | {"spaces": ["fgeo"]}
    experiment = {
        name: {"configs": [str(CONF / "experiment" / f"{name}.yaml")], "set": networks(smoke)}
        for name in ("vae_alignment", "flow_matching", "joint")
    }
    scale = {
        "about": "Smoke.",
        "common": [str(CONF / "trainer.yaml")],
        "data": {"data": data},
        "set": {"trainer": trainer, "scorer": scorer, "checkpoint": smoke["checkpoint"]},
        "experiments": experiment,
    }
    path = tmp_path / "smoke.yaml"
    path.write_text(yaml.safe_dump(scale))
    return path


def networks(smoke):
    return {"model": smoke["model"]}


@pytest.fixture
def table(tmp_path):
    """Two rows: of a plain VAE, without and with alignment of the SiT."""
    folder = tmp_path / "table_x"
    folder.mkdir()
    (folder / "table.yaml").write_text("caption: A table.\nbetter: [[2_b, 1_a]]\n")
    vae = {"name": "vae", "experiment": "vae_alignment"}
    for key, weight in (("1_a", 0.0), ("2_b", 0.5)):
        flow = {
            "name": "flow",
            "experiment": "flow_matching",
            "start": {"model.init_args.init_from": "vae"},
            "set": {"model": {"init_args": {"weights": {"sit_alignment": weight}}}},
        }
        row = {"label": f"row {key}", "published": {"JSD": 5.0}, "stages": [vae, flow]}
        (folder / f"{key}.yaml").write_text(yaml.safe_dump(row))
    return folder


class InThisProcess:
    """Stands in for a process: the imports of each would take ten seconds."""

    started: ClassVar[list[list[str]]] = []
    run = staticmethod(main)
    broken = ""

    def __init__(self, words, stdout, stderr, env):
        self.words, self.log = words[3:], stdout

    def terminate(self):
        """It runs in the thread that has started it, which is waited for."""

    def wait(self, timeout=None):
        InThisProcess.started.append(self.words)
        if InThisProcess.broken and InThisProcess.broken in " ".join(self.words):
            self.log.write(b"it broke\n")
            self.log.flush()
            return 3
        InThisProcess.run(self.words)
        return 0


@pytest.fixture
def started(monkeypatch):
    monkeypatch.setattr(InThisProcess, "started", [])
    monkeypatch.setattr(runner, "Popen", InThisProcess)
    yield InThisProcess.started
    wandb.teardown()  # else it keeps its settings of now for all tests after this one


def wandb_records(path):
    """Records of an offline run: a log in blocks of 32 KiB, as LevelDB writes it."""
    from wandb.proto import wandb_internal_pb2

    data = path.read_bytes()
    assert data[:4] == b":W&B"
    place, parts = 7, []
    while place + 7 <= len(data):
        left = 32768 - place % 32768
        if left < 7:
            place += left
            continue
        checksum, size, kind = struct.unpack("<IHB", data[place : place + 7])
        part = data[place + 7 : place + 7 + size]
        assert checksum == zlib.crc32(part, zlib.crc32(bytes([kind])))
        parts.append(part)
        place += 7 + size
        if kind in (1, 4):  # whole, or the last of several
            record = wandb_internal_pb2.Record()
            record.ParseFromString(b"".join(parts))
            parts = []
            yield record


@pytest.mark.slow  # 20 s; its parts are tested below, with processes that take no time
def test_two_rows_from_nothing_to_the_tables(table, scale_file, tmp_path, started, capsys):
    out = tmp_path / "out"
    words = ["ablate", str(table), "--scale", str(scale_file), "--out", str(out)]
    main(words)
    kinds = [words[0] for words in started]
    assert kinds.count("fit") == 3  # the VAE of both rows, and two baselines
    assert {kind: kinds.count(kind) for kind in ("features", "reference", "test")} == {
        "features": 1,
        "reference": 1,
        "test": 2,
    }
    printed = capsys.readouterr().out
    assert printed.startswith("budget: 3 trainings, ")
    for text in (printed, (out / "table_x.md").read_text()):
        assert "A table." in text
        assert "Paper: row 2_b better than row 1_a. Here:" in text
        for label in ("row 1_a (published)", "row 1_a", "row 2_b"):
            assert label in text.replace("\\_", "_")
    assert r"\bottomrule" in (out / "table_x.tex").read_text()
    with (out / "table_x.csv").open(newline="") as file:
        lines = {(line["label"], line["metric"]): line for line in csv.DictReader(file)}
    stored = json.loads((out / "table_x.json").read_text())
    values = {row["label"]: row["values"]["0"] for row in stored["rows"]}
    for row in stored["rows"]:
        vae, flow = (stored["curves"][name] for name in row["stages"]["0"])
        assert len(vae["train/loss"][0]) == len(vae["train/loss"][1]) == 3
        assert "train/denoising" in flow
    for (label, metric), line in lines.items():
        if line["value"]:
            assert float(line["value"]) == values[label][metric]

    runs = sorted(out.glob("wandb/offline-run-*/*.wandb"))
    assert len(runs) == 2
    for path in runs:
        group, name, config, summary, curves = None, None, {}, {}, set()
        for record in wandb_records(path):
            if record.HasField("run"):
                group, name = record.run.run_group, record.run.display_name
                config = {c.key: json.loads(c.value_json) for c in record.run.config.update}
            for item in record.summary.update:
                summary[item.key or "/".join(item.nested_key)] = json.loads(item.value_json)
            for item in record.history.item:
                curves.add(item.key or "/".join(item.nested_key))
        assert group == "table_x smoke"
        label = config["label"]
        assert name == f"{label}, seed 0"
        weight = config["stages"]["flow_matching"]["model"]["init_args"]["weights"]
        assert weight["sit_alignment"] == {"row 1_a": 0.0, "row 2_b": 0.5}[label]
        for metric, value in values[label].items():
            if value is not None:
                assert summary[metric.replace(" ", "_")] == pytest.approx(value), metric
        assert {"vae_alignment/train/loss", "flow_matching/train/denoising"} <= curves

    started.clear()
    main(words)
    assert not started  # nothing is run again
    assert sorted(out.glob("wandb/offline-run-*/*.wandb")) == runs
    assert "7 of 7 are done already" in capsys.readouterr().out


def without_training(words):
    """Leaves behind what others need."""
    run_dir = Path(words[words.index("--run_dir") + 1]) if "--run_dir" in words else None
    if words[0] == "fit":
        (run_dir / "checkpoints").mkdir(exist_ok=True)
        (run_dir / "checkpoints" / "last.ckpt").touch()
    if words[0] == "test":
        evaluation(JSD=1.0).save(run_dir / "evaluation" / "evaluation.json")
    if words[0] == "reference":
        Path(words[words.index("--out") + 1]).touch()


@pytest.fixture
def command(table, scale_file, tmp_path, started, monkeypatch):
    """Words of an ablation whose processes take no time."""
    monkeypatch.setattr(InThisProcess, "run", staticmethod(without_training))
    out = tmp_path / "out"
    words = ["ablate", str(table), "--scale", str(scale_file), "--out", str(out)]
    return [*words, "--wandb", "off"]


def kinds_of(started):
    found = [words[0] for words in started]
    started.clear()
    return found


def test_what_starts_from_a_stage_is_trained_anew_with_it(command, tmp_path, started):
    main(command)
    assert sorted(kinds_of(started)) == ["features", *3 * ["fit"], "reference", *2 * ["test"]]
    main(command)
    assert kinds_of(started) == []
    stages = tmp_path / "out" / "stages"
    old = sorted(stages.glob("flow_matching-*/checkpoints/last.ckpt"))
    for path in old:
        path.write_text("of the VAE before")
    (vae,) = stages.glob("vae_alignment-*")
    shutil.rmtree(vae)
    main(command)
    assert sorted(kinds_of(started)) == [*3 * ["fit"], *2 * ["test"]]
    assert [path.read_text() for path in old] == ["", ""]


def test_an_interrupted_training_goes_on(command, tmp_path, started, monkeypatch):
    def stopped(words):
        without_training(words)
        if words[0] == "fit":
            raise RuntimeError("stopped")

    monkeypatch.setattr(InThisProcess, "run", staticmethod(stopped))
    with pytest.raises(SystemExit):
        main(command)
    (checkpoint,) = (tmp_path / "out").glob("stages/vae_alignment-*/checkpoints/last.ckpt")
    checkpoint.write_text("half way")
    monkeypatch.setattr(InThisProcess, "run", staticmethod(lambda words: None))
    with pytest.raises(SystemExit):
        main(command)
    assert checkpoint.read_text() == "half way"


def test_a_test_without_numbers_is_a_failure_and_old_ones_are_gone(
    command, tmp_path, started, monkeypatch, capsys
):
    """As `r3dpa test` ends where scenes are too few to compare."""
    main(command)
    assert (tmp_path / "out" / "table_x.md").is_file()
    scale = Path(command[command.index("--scale") + 1])
    scale.write_text(scale.read_text().replace("num_scenes: 4", "num_scenes: 5"))
    monkeypatch.setattr(InThisProcess, "run", staticmethod(lambda words: None))
    for _ in range(2):
        started.clear()
        capsys.readouterr()
        with pytest.raises(SystemExit):
            main(command)
        assert kinds_of(started) == 2 * ["test"]
        printed = capsys.readouterr().out
        assert "left no evaluation.json" in printed
        assert "no row has a result" in printed
        assert printed.endswith("tables: none\n")
    assert not list((tmp_path / "out").glob("table_x.*"))


def test_wandb_shows_the_newest_numbers_of_each_row(command, tmp_path, started, monkeypatch):
    def summaries():
        return sorted(
            json.loads(item.value_json)
            for path in (tmp_path / "out").glob("wandb/offline-run-*/*.wandb")
            for record in wandb_records(path)
            for item in record.summary.update
            if item.key == "JSD" or list(item.nested_key) == ["JSD"]
        )

    command = command[:-2]
    main(command)
    assert summaries() == [1.0, 1.0]
    (one, _) = sorted((tmp_path / "out").glob("stages/flow_matching-*/evaluation/evaluation.json"))
    evaluation(JSD=2.0).save(one)
    main(command)
    assert summaries() == [1.0, 2.0]


def test_a_row_that_fails_leaves_the_other(
    table, scale_file, command, tmp_path, started, monkeypatch, capsys
):
    out = tmp_path / "out"
    scale = read_scale(scale_file)
    broken = make_plan(table, scale, (0,)).tables[0].rows[1].tested(0).name
    monkeypatch.setattr(InThisProcess, "broken", f"fit --config {out}/stages/{broken}")
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 1
    printed = capsys.readouterr().out
    assert f"! {broken} ended with status 3" in printed
    assert "it broke" in printed
    assert f"test of {broken}: not run, since {broken} failed" in printed
    assert "row 2_b, seed 0: no result" in printed
    stored = json.loads((out / "table_x.json").read_text())
    assert [bool(row["values"]) for row in stored["rows"]] == [True, False]
    monkeypatch.setattr(InThisProcess, "broken", "")
    started.clear()
    main(command)
    assert kinds_of(started) == ["fit", "test"]


def test_processes_are_real(monkeypatch, tmp_path):
    """What is started is this package; a failure shows the end of what it wrote."""
    words = ["check", str(tmp_path / "none")]
    job = runner.Job("check", words, tmp_path / "check", "")
    with (
        runner._processes() as start,
        pytest.raises(RuntimeError, match=r"status 1; .*(\n.*)*none"),
    ):
        start(job, {}, runner.RunSettings(tmp_path))
    assert job.state().ending is None


def test_a_stopped_ablation_stops_what_it_started(tmp_path):
    """As by Ctrl-C between two lines."""
    sleeping = []

    class Sleeping(subprocess.Popen):
        def __init__(self, words, **options):
            super().__init__(["sleep", "60"], **options)
            sleeping.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "Popen", Sleeping)
        job = runner.Job("sleep", [], tmp_path / "sleep", "")

        def interrupted():
            with runner.ThreadPoolExecutor(1) as pool, runner._processes() as start:
                pool.submit(start, job, {}, runner.RunSettings(tmp_path))
                while not sleeping:
                    time.sleep(0.01)
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            interrupted()
    assert sleeping[0].wait(5) < 0
