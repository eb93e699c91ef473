"""``r3dpa ablate``: what is shared, what is run, what a failure costs, and what is written."""

import asyncio
import csv
import json
import math
import re
import shutil
import signal
import subprocess
import threading
from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import wandb
import yaml
from resolved_fits import resolved

from r3dpa.ablation import budget_of, make_plan, run_plan, write_table
from r3dpa.ablation import runs as runner
from r3dpa.ablation.plan import Plan, Row, Stage, Table
from r3dpa.ablation.tables import order_results
from r3dpa.cli import main
from r3dpa.cli.bench import _resolved
from r3dpa.metrics.results import Evaluation, MetricResult
from r3dpa.metrics.seeds import mean_of_seeds

CONF = Path(__file__).resolve().parents[2] / "conf"
TABLES = CONF / "ablation"
RECORDED = CONF.parent / "notebooks" / "results" / "ablation_demo"
pytestmark = pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")


def plan_of(scale, seeds=(0,), tables=TABLES, rgb_weights=None):
    path = TABLES / "scale" / f"{scale}.yaml"
    return make_plan(tables, path, seeds, Path("out"), resolved, rgb_weights)


def rows_of(plan):
    return {(table.name, row.key): row for table in plan.tables for row in table.rows}


def names_of(stages):
    return [stage.name for stage in stages]


def test_a_process_of_a_job_imports_nothing_of_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "r3dpa.py").write_text("open('run', 'w').close()")
    monkeypatch.chdir(tmp_path)
    job = runner.Job("version", ["--version"], tmp_path / "version", "")
    assert asyncio.run(runner._run(job, 1)) is None
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("scale", ["demo", pytest.param("small", marks=pytest.mark.slow), "paper"])
def test_a_training_of_several_rows_is_run_once(scale):
    """Table II ends as table III begins, whose last row is that of table I, but in the demo.

    There table I trains every row for fewer steps.
    """
    plan, own = plan_of(scale), scale == "demo"
    assert [len(table.rows) for table in plan.tables] == [5, 3, 3, 2]
    rows = rows_of(plan)
    assert all(len(row.published) == 6 for row in rows.values())
    assert Counter(stage.words[0] for stage in plan.stages if stage.on_scans) == {
        "vae_alignment": 2 + own,
        "flow_matching": 4,
        "joint": 3 + own,
        "lidm_first_stage": 1,
        "lidm": 2,
        "r2dm": 1,
        "r2flow": 1,
    }
    of_table_1, of_table_3 = rows["table_1", "5_r3dpa"].stages, rows["table_3", "3_joint"].stages
    assert (of_table_1 == of_table_3) != own
    steps = {stage.config["trainer"]["max_steps"] for stage in plan.tables[0].rows[0].stages[0]}
    assert not own or steps == {of_table_1[0][-1].config["trainer"]["max_steps"]} == {160}
    last = [rows[key].stages[0][-1] for key in (("table_2", "3_aligned"), ("table_3", "1_none"))]
    assert last[0].name == last[1].name
    seen = set()
    for stage in plan.stages:
        assert seen.issuperset(stage.before)
        seen.add(stage.name)


def test_a_second_seed_repeats_all_but_the_prior():
    one, two = plan_of("demo"), plan_of("demo", (0, 1))
    prior = [stage for stage in one.stages if not stage.on_scans]
    assert len(two.stages) == 2 * len(one.stages) - len(prior)
    assert set(names_of(one.stages)) < set(names_of(two.stages))
    for seed in (0, 1):
        words = rows_of(two)["table_3", "3_joint"].stages[seed][-1].words
        given = [words[i + 1] for i, word in enumerate(words) if "seed" in word]
        assert given == [str(seed)] * 4


def test_paper_scale_has_the_networks_of_the_paper():
    plan = plan_of("paper")
    models = [stage.config["model"]["init_args"] for stage in plan.stages if stage.on_features]
    networks = Counter(model["sit"]["class_path"] for model in models)
    assert networks == {"r3dpa.nn.SiT": 8, "r3dpa.nn.UNet": 1}
    for part in ("1 r2dm of 300000 steps", "1 rgb_pretraining of 1000000 steps", "3 joint of"):
        assert part in budget_of(plan)


def test_given_weights_replace_the_pretraining(tmp_path):
    names = {}
    for content in (b"one", b"other"):
        weights = tmp_path / f"{content.decode()}.pt"
        weights.write_bytes(content)
        plan = plan_of("demo", tables=TABLES / "table_2", rgb_weights=weights)
        assert all(stage.on_scans for stage in plan.stages)
        rows = rows_of(plan)
        stage = rows["table_2", "2_rgb"].stages[0][-1]
        assert stage.config["model"]["init_args"]["rgb_weights"] == str(weights)
        assert str(weights) in stage.words
        for key in ("1_scratch", "3_aligned"):
            names.setdefault(key, []).append(set(names_of(rows["table_2", key].stages[0])))
    assert names["1_scratch"][0] == names["1_scratch"][1]
    assert not names["3_aligned"][0] & names["3_aligned"][1]


def test_settings_of_the_test_do_not_count(tmp_path):
    names = []
    for new in ("", "--scorer.num_scenes 7", "--data.init_args.num_scans 145"):
        text = (TABLES / "scale" / "demo.yaml").read_text()
        text = text.replace("{here}", str(TABLES / "scale"))
        (tmp_path / "demo.yaml").write_text(text.replace("steps 400", f"steps 400 {new}"))
        table = TABLES / "table_4"
        plan = make_plan(table, tmp_path / "demo.yaml", (0,), tmp_path, resolved)
        names.append(names_of(plan.stages))
    assert names[0] == names[1]
    assert not set(names[0]) & set(names[2])


def test_released_files_stand_for_trainings(tmp_path):
    weights, samples = tmp_path / "r2dm.pth", tmp_path / "samples"
    weights.write_bytes(b"weights")
    samples.mkdir()
    path = TABLES / "scale" / "demo.yaml"
    released = {"r2dm": weights, "ultralidar": samples}
    plan = make_plan(TABLES / "table_1", path, (0,), tmp_path, resolved, None, released)
    rows = rows_of(plan)
    assert next(key for _, key in rows) == "0_ultralidar"
    assert not any(stage.words[0] == "r2dm" for stage in plan.stages)
    jobs = {job.name: job for job in runner._jobs(plan)}
    (stage,) = rows["table_1", "3_r2dm"].stages[0]
    sampled, test = jobs[stage.name], jobs[f"test of {stage.name}"]
    assert sampled.words[:3] == ["sample", "--ckpt", str(weights)]
    assert test.words[:3] == ["evaluate", "--samples", sampled.words[4]]
    assert test.needs == (stage.name, "reference")
    assert test.makes == stage.evaluation
    (stage,) = rows["table_1", "0_ultralidar"].stages[0]
    assert jobs[f"test of {stage.name}"].words[2] == str(samples)
    assert stage.name not in jobs
    assert "1 r2flow of 160 steps" in budget_of(plan)
    with pytest.raises(ValueError, match=r"--released\.r2d2: there is no such row"):
        make_plan(TABLES / "table_1", path, (0,), tmp_path, resolved, None, {"r2d2": weights})


ROW = {"label": "x", "commands": {"a": "fit joint --preset demo"}}


class TestWrongFiles:
    @pytest.mark.parametrize(
        ("row", "message"),
        [
            ({"label": "x"}, r"2_b.yaml: holds \['label'\]; needed are the keys"),
            ({"label": "x", "commands": {}, "colour": 1}, "holds .*'colour'"),
            ({"label": "y", "commands": {}}, "has no command"),
            (
                {"label": "y", "commands": {"a": "fit {fly}"}},
                r"commands\.a: {fly} is nothing known before it; give one of image_vae, prior, ",
            ),
            ({"label": "y", "commands": {"a": "sample x"}}, "is no command `fit EXPERIMENT"),
            (ROW | {"published": {"FID": 1.0}}, "published names none of FRID, FLD"),
        ],
    )
    def test_it_is_named(self, row, message, tmp_path):
        (tmp_path / "table.yaml").write_text("caption: c")
        (tmp_path / "1_a.yaml").write_text(yaml.safe_dump(ROW))
        (tmp_path / "2_b.yaml").write_text(yaml.safe_dump(row))
        with pytest.raises(ValueError, match=message):
            plan_of("demo", tables=tmp_path)

    def test_an_option_that_fit_refuses(self, capsys):
        with pytest.raises(ValueError, match="r3dpa fit joint --preset demo --colour 1"):
            _resolved("fit joint --preset demo --colour 1")
        assert "colour" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["nowhere"], "nowhere: is no folder"),
            (
                [str(CONF / "net"), "--scale", str(TABLES / "scale/demo.yaml")],
                r"holds no table\.yaml",
            ),
            ([str(TABLES), "--scale", "huge"], "no such scale; give one of demo"),
            ([str(TABLES), "--seeds", "0", "0"], "different numbers"),
            ([str(TABLES), "--seeds", "-1"], "from 0 on"),
            ([str(TABLES), "--rgb_weights", "none.pt"], "none.pt: there is no such file"),
        ],
    )
    def test_arguments(self, words, message, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ValueError, match=message):
            main(["ablate", *words, "--out", "out"])
        assert not (tmp_path / "out").exists()


def evaluation(extra=None, **values):
    about = {"protocol": {"name": "default"}, "reference": "r", "seed": 0, "published": False}
    about |= dict.fromkeys(("solver", "steps", "precision", "commit", "feature_source"))
    about |= {"backbones": {}, "source": "s", "extra": extra or {}}
    rows = tuple(
        MetricResult(name, value, (value - 0.1, value + 0.1), scale=-2)
        for name, value in values.items()
    )
    return Evaluation("x", rows, about)


def test_a_row_with_fewer_seeds_keeps_what_must_be_known_of_each():
    few = evaluation({"bad_samples": ["7"]}, JSD=2.0)
    few = replace(few, rows=(replace(few.rows[0], note="few scenes"),))
    mean = mean_of_seeds("row", [evaluation(JSD=1.0, MMD=2.0), few])
    assert mean.row("JSD").note == "few scenes"
    assert mean.row("MMD") is None
    assert mean.bad_samples == ["7"]
    assert mean_of_seeds("row", [evaluation(JSD=1.0)]).row("JSD").interval == (0.9, 1.1)


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
def test_an_order_is_told_by_the_interval_of_the_difference(ours, theirs, better, alike):
    rows = [Row(key, key, {}, {}) for key in "ab"]
    table = Table("t", "", rows, [("better", "a", "b"), ("alike", "a", "b")])
    results = {
        key: {seed: evaluation(JSD=value) for seed, value in enumerate(values)}
        for key, values in (("a", ours), ("b", theirs))
    }
    found = [order.holds for order in order_results(table, results, {"JSD": True})]
    assert found == [better, alike]


def recorded(name, out):
    """The plan of a recorded table, with its evaluations in their folders."""
    stored = json.loads((RECORDED / f"{name}.json").read_text())
    with (RECORDED / f"{name}.csv").open(newline="") as file:
        lines = {(line["label"], line["metric"]): line for line in csv.DictReader(file)}
    rows, about = [], evaluation().about
    for row in stored["rows"]:
        chains = {}
        for seed, names in row["stages"].items():
            chain = [Stage(stage, out / stage, [], {}, ()) for stage in names]
            results = []
            for metric, value in row["values"][seed].items():
                line, ends = lines[row["label"], metric], row["intervals"][seed][metric]
                counts = [int(line[key]) for key in ("num_samples", "num_references")]
                floor, note = float(line["floor"] or "nan"), line["note"] or "unknown"
                form = (line["direction"], line["unit"], int(line["scale"]), *counts)
                floor = None if math.isnan(floor) else floor
                results.append(MetricResult(metric, value, ends, floor, *form, note))
            Evaluation(row["label"], results, about).save(chain[-1].evaluation)
            chains[int(seed)] = chain
        rows.append(Row(row["key"], row["label"], row["published"], chains))
    orders = {
        (order["claim"].replace("worse", "better"), order["first"], order["second"]): None
        for order in stored["orders"]
    }
    table = Table(name, stored["caption"], rows, list(orders))
    return Plan(out, stored["scale"], stored["about"], [], (0, 1, 2), [table]), stored


@pytest.mark.parametrize("name", ["table_2", "table_3", "table_4"])
def test_recorded_tables_are_computed_again(name, tmp_path):
    """From the numbers of each seed: means, intervals, paired differences and what they say."""
    plan, stored = recorded(name, tmp_path)
    write_table(plan, plan.tables[0], {})
    found = json.loads((tmp_path / f"{name}.json").read_text())
    for key in ("caption", "scale", "about", "rows", "orders"):
        assert found[key] == stored[key], key
    old, new = (folder / f"{name}.md" for folder in (RECORDED, tmp_path))
    lines = [line for line in old.read_text().splitlines() if "Paper: " in line or "Scale" in line]
    assert [line for line in lines if line not in new.read_text()] == []
    means = []
    for folder in (RECORDED, tmp_path):
        with (folder / f"{name}.csv").open(newline="") as file:
            keys = ("label", "metric", "value", "low", "high", "floor")
            means.append([[line[key] for key in keys] for line in csv.DictReader(file)])
    assert means[0] == means[1]


def without_training(words, step=None):
    """Leaves behind what others need."""
    run_dir = Path(words[words.index("--run_dir") + 1]) if "--run_dir" in words else None
    if words[0] == "fit":
        for folder in ("checkpoints", "version_0"):
            (run_dir / folder).mkdir(exist_ok=True)
        (run_dir / "checkpoints" / "last.ckpt").touch()
        (run_dir / "version_0" / "metrics.csv").write_text("step,train/loss\n0,2.0\n1,1.0\n")
    if words[0] == "test":
        found = evaluation({} if step is None else {"step": step}, JSD=1.0)
        found.save(run_dir / "evaluation" / "evaluation.json")
    if words[0] == "reference":
        Path(words[words.index("--out") + 1]).touch()


class Processes:
    """Stands in for processes, since the imports of each would take ten seconds."""

    def __init__(self):
        self.started = []
        self.run = without_training

    async def __call__(self, *words, **_):
        self.started.append(list(words[3:]))
        status = self.run(self.started[-1]) or 0
        return SimpleNamespace(wait=lambda: asyncio.sleep(0, status))

    def kinds(self):
        found = Counter(words[0] for words in self.started)
        self.started.clear()
        return found


@pytest.fixture
def processes(monkeypatch):
    found = Processes()
    monkeypatch.setattr(asyncio, "create_subprocess_exec", found)
    return found


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """An ablation of two rows at smoke size: a VAE, without and with aligned SiT."""
    tmp_path = tmp_path_factory.mktemp("plan")
    smoke = yaml.safe_load((CONF / "smoke.yaml").read_text())
    smoke["data"]["init_args"]["root"] = "{out}/data"
    smoke["trainer"] |= {"callbacks": [], "limit_val_batches": 0}
    smoke["scorer"]["spaces"] = ["fgeo"]
    smoke["model"]["init_args"].pop("discriminator", None)
    (tmp_path / "smoke").mkdir()
    (tmp_path / "smoke" / "smoke.yaml").write_text(yaml.safe_dump(smoke))
    common = "--preset demo --config {here}/smoke/smoke.yaml --seed_everything {seed}"
    words = {name: f"{name} {{common}}" for name in ("vae_alignment", "flow_matching")}
    scale = {"about": "Smoke.", "words": {"common": common} | words, "reference": "--spaces fgeo"}
    (tmp_path / "smoke.yaml").write_text(yaml.safe_dump(scale))
    folder = tmp_path / "table_x"
    folder.mkdir()
    (folder / "table.yaml").write_text("caption: A table.\nbetter: [[2_b, 1_a]]\n")
    for key, weight in (("1_a", 0.0), ("2_b", 0.5)):
        commands = {
            "vae": "fit {vae_alignment}",
            "flow": "fit {flow_matching} --model.init_args.init_from {vae} "
            f"--model.init_args.weights.sit_alignment {weight}",
        }
        row = {"label": f"row {key}", "published": {"JSD": 5.0}, "commands": commands}
        (folder / f"{key}.yaml").write_text(yaml.safe_dump(row, sort_keys=False))
    return tmp_path


@pytest.fixture
def command(files, tmp_path, monkeypatch):
    """Words that run it."""
    monkeypatch.setattr("r3dpa.cli.bench._resolved", resolved)
    words = ["ablate", str(files / "table_x"), "--scale", str(files / "smoke.yaml")]
    return [*words, "--out", str(tmp_path / "out"), "--wandb", "off"]


ALL = {"features": 1, "reference": 1, "fit": 3, "test": 2}


def test_only_what_is_missing_is_run(command, tmp_path, processes, capsys):
    main([*command, "--jobs", "3"])
    assert processes.kinds() == ALL  # the VAE of both rows is trained once
    main(command)
    assert not processes.started
    assert "7 of 7 are done already" in capsys.readouterr().out
    out = tmp_path / "out"
    (flow, _) = out.glob("stages/flow_matching-*")
    shutil.rmtree(flow)
    main(command)
    assert processes.kinds() == {"fit": 1, "test": 1}
    (out / "reference.safetensors").unlink()
    main(command)
    assert processes.kinds() == {"reference": 1}


def test_files_and_text_of_a_table(command, tmp_path, processes, capsys):
    main(command)
    out = tmp_path / "out"
    for text in (capsys.readouterr().out, (out / "table_x.md").read_text()):
        assert "A table. Scale smoke: Smoke. Seeds 0." in text
        assert "Paper: row 2_b better than row 1_a. Here: JSD unclear, +0 % [-14, +14]" in text
        assert "row 1_a (published)" in text.replace("\\_", "_")
    assert r"\bottomrule" in (out / "table_x.tex").read_text()
    stored = json.loads((out / "table_x.json").read_text())
    assert [row["values"] for row in stored["rows"]] == [{"0": {"JSD": 1.0}}] * 2


def test_an_interrupted_training_continues(command, tmp_path, processes):
    processes.run = lambda words: without_training(words) or (words[0] == "fit") * 143
    with pytest.raises(SystemExit):
        main(command)
    (checkpoint,) = (tmp_path / "out").glob("stages/vae_alignment-*/checkpoints/last.ckpt")
    checkpoint.write_text("half way")
    processes.run = lambda words: None
    with pytest.raises(SystemExit):
        main(command)
    assert checkpoint.read_text() == "half way"
    for words in processes.started:
        if words[0] == "fit":
            assert words[words.index("--ckpt_path") + 1] == "last"


def test_a_test_without_numbers_is_a_failure_and_old_ones_are_gone(
    command, files, tmp_path, processes, capsys
):
    """As `r3dpa test` ends where scenes are too few to compare."""
    main(command)
    assert (tmp_path / "out" / "table_x.md").is_file()
    text = (files / "smoke.yaml").read_text().replace("{here}", str(files))
    command[3] = str(tmp_path / "smoke.yaml")
    (tmp_path / "smoke.yaml").write_text(text.replace("--seed", "--scorer.num_scenes 5 --seed"))
    processes.run = lambda words: None
    processes.kinds()
    for _ in range(2):
        with pytest.raises(SystemExit):
            main(command)
        assert processes.kinds() == {"test": 2}
        printed = capsys.readouterr().out
        assert "left no evaluation.json" in printed
        assert "no row has a result" in printed
        assert printed.endswith("tables: none\n")
    assert not list((tmp_path / "out").glob("table_x.*"))


def test_a_row_that_fails_leaves_the_other(command, files, tmp_path, processes, capsys):
    plan = make_plan(files / "table_x", files / "smoke.yaml", (0,), tmp_path, resolved)
    broken = plan.tables[0].rows[1].stages[0][-1].name
    run_dir = f"{tmp_path}/out/stages/{broken}"
    processes.run = lambda words: 3 if run_dir in words else without_training(words)
    with pytest.raises(SystemExit) as ended:
        main(command)
    assert ended.value.code == 1
    printed = capsys.readouterr().out
    assert f"! {broken} ended with status 3" in printed
    assert f"test of {broken}: not run, since {broken} failed" in printed
    assert "row 2_b, seed 0: no result" in printed
    stored = json.loads((tmp_path / "out" / "table_x.json").read_text())
    assert [bool(row["values"]) for row in stored["rows"]] == [True, False]
    processes.run = without_training
    processes.kinds()
    main(command)
    assert processes.kinds() == {"fit": 1, "test": 1}


def test_wandb_gets_the_newest_numbers_of_each_row(command, tmp_path, processes, monkeypatch):
    logged = []

    def init(**options):
        (options["dir"] / "wandb" / f"offline-run-x-{options['id']}").mkdir(parents=True)
        run = SimpleNamespace(**options, summary={}, lines=[], define_metric=lambda *_, **__: None)
        run.log = run.lines.append
        logged.append(run)
        return nullcontext(run)

    monkeypatch.setattr(wandb, "init", init)
    main(command[:-2])
    for run, key, weight in zip(logged, ("1_a", "2_b"), (0.0, 0.5), strict=True):
        assert (run.group, run.job_type, run.mode) == ("table_x smoke", "row", "offline")
        assert run.name == f"row {key}, seed 0"
        assert f"sit_alignment {weight}" in list(run.config["commands"].values())[-1]
        model = list(run.config["stages"].values())[-1]["model"]["init_args"]
        assert model["weights"]["sit_alignment"] == weight
        assert run.summary == {"JSD": 1.0}
        assert {"vae_alignment/step": 1, "vae_alignment/train/loss": 1.0} in run.lines
    main(command[:-2])
    assert len(logged) == 2  # nothing new
    (one, _) = sorted((tmp_path / "out").glob("stages/flow_matching-*/evaluation/evaluation.json"))
    evaluation(JSD=2.0).save(one)
    main(command[:-2])
    assert len(logged) == 3
    assert logged[-1].summary == {"JSD": 2.0}


def test_processes_are_real(tmp_path):
    """What is started is this package; a failure shows the end of what it wrote."""
    job = runner.Job("check", ["check", "--colour"], tmp_path / "check", "")
    assert "ended with status 2" in (failure := asyncio.run(runner._run(job, 1)))
    assert "colour" in failure
    assert not job.done


def test_a_stopped_ablation_stops_what_it_started(tmp_path, monkeypatch):
    real, sleeping = asyncio.create_subprocess_exec, []

    async def sleep(*_, **options):
        sleeping.append(await real("sleep", "60", **options))
        return sleeping[-1]

    monkeypatch.setattr(asyncio, "create_subprocess_exec", sleep)
    job = runner.Job("x", ["sleep"], tmp_path / "sleep", "")

    async def stopped():
        task = asyncio.create_task(runner._run(job, 1))
        while not sleeping:
            await asyncio.sleep(0.01)
        assert not task.done()
        raise KeyboardInterrupt  # as by Ctrl-C between two lines

    with pytest.raises(KeyboardInterrupt):
        asyncio.run(stopped())
    assert sleeping[0].returncode == -signal.SIGTERM


def test_a_table_refuses_numbers_of_another_step(command, tmp_path, processes):
    """As of a stale checkpoint in a folder that was moved."""

    steps = iter((3, 2))
    processes.run = lambda words: without_training(
        words, next(steps) if words[0] == "test" else None
    )
    main(command)
    stored = json.loads((tmp_path / "out" / "table_x.json").read_text())
    assert [len(row["values"]) for row in stored["rows"]] == [1, 0]
    table = (tmp_path / "out" / "table_x.md").read_text()
    assert "evaluation.json is of step 2, not the last" in table


def test_a_killed_ablation_leaves_no_process():
    """Linux signals a child when the thread that has started it ends."""
    started = []

    def start():
        started.append(subprocess.Popen(["sleep", "60"], preexec_fn=runner._end_with_parent))

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    assert started[0].wait(5) == -signal.SIGTERM


@pytest.mark.slow
def test_two_rows_from_nothing_to_the_tables(command, tmp_path, processes):
    processes.run = main
    main(command[:-2])
    assert processes.kinds() == ALL
    assert len(list((tmp_path / "out").glob("wandb/offline-run-*/*.wandb"))) == 2
    wandb.teardown()  # else it keeps its settings of now for all tests after this one


@pytest.mark.slow
def test_all_rows_of_the_demo_run_in_miniature(tmp_path, processes):
    """One step of each training at the sizes of the demo, on few images and scans."""
    processes.run = main
    text = (TABLES / "scale" / "demo.yaml").read_text().replace("{here}", str(TABLES / "scale"))
    step = "--trainer.max_steps 1 --trainer.val_check_interval 1 --trainer.limit_val_batches 1 "
    step += "--checkpoint.every_n_train_steps 1"
    sampled = "--scorer.num_scenes 4 --scorer.batch_size 4 --scorer.spaces '[fgeo]' "
    sampled += "--scorer.sampler.solver euler --scorer.sampler.steps 1 --scorer.sampler.shift 1"
    images = f"{step} --data.init_args.source.init_args.num_images 40 "
    images += "--data.init_args.val_every 2 --data.init_args.num_workers 0"
    text = text.replace(
        "--trainer.max_steps 400", f"{step} {sampled} --data.init_args.num_scans 12"
    )
    text = re.sub("(fit (?:image_vae|rgb_pretraining) --preset demo)", rf"\1 {images}", text)
    (tmp_path / "tiny.yaml").write_text(text.replace("fwid,fgeo", "fgeo"))
    plan = make_plan(TABLES, tmp_path / "tiny.yaml", (0,), tmp_path, resolved)
    assert not run_plan(plan, lambda _: None)
    assert processes.kinds() == {"features": 1, "reference": 1, "fit": 11, "test": 7}
    for chain in plan.chains:
        assert json.loads(chain[-1].evaluation.read_text())
