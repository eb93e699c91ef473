"""``r3dpa ablate``: what is shared, what is run, what a failure costs, and what is written."""

import csv
import json
import math
import signal
import subprocess
import sys
import threading
from collections import Counter
from contextlib import nullcontext
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
from r3dpa.cli.bench import resolve_config
from r3dpa.metrics.results import Evaluation, MetricResult

CONF = Path(__file__).resolve().parents[2] / "conf"
TABLES = CONF / "ablation"
RECORDED = CONF.parent / "notebooks" / "results" / "ablation_demo"
SEEDS = ("seed_everything", "model.init_args.seed", "data.init_args.seed", "scorer.seed")
pytestmark = pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")


def plan_of(scale, seeds=(0,), tables=TABLES, **more):
    scale = TABLES / "scale" / f"{scale}.yaml" if isinstance(scale, str) else scale
    return make_plan(tables, scale, seeds, Path("out"), resolved, **more)


def rows_of(plan):
    return {(table.name, row.key): row for table in plan.tables for row in table.rows}


def names_of(stages):
    return [stage.name for stage in stages]


class TestPlan:
    def test_trainings_that_rows_share_are_planned_once(self):
        """Table II ends as table III begins; every stage comes after those that it starts from."""
        plan = plan_of("demo")
        rows = rows_of(plan)
        last, first = rows["table_2", "aligned"], rows["table_3", "none"]
        assert names_of(last.stages[0]) == names_of(first.stages[0])
        names = names_of(plan.stages)
        assert len(set(names)) == len(names) < sum(map(len, plan.chains))
        for place, stage in enumerate(plan.stages):
            assert set(stage.before) <= set(names[:place])
        assert all(len(row.published) == 6 for row in rows.values())

    def test_trainings_of_table_1_are_those_of_the_paper_and_the_others_its_ablations(self):
        plan = plan_of("paper")
        rows = rows_of(plan)
        steps = {
            key: {stage.words[0]: stage.config["trainer"]["max_steps"] for stage in row.stages[0]}
            for key, row in rows.items()
        }
        ours = {"rgb_pretraining": 1_000_000, "vae_alignment": 800_000, "joint": 1_000_000}
        assert steps["table_1", "r3dpa"] == ours
        assert steps["table_3", "joint"] == ours | {"vae_alignment": 400_000, "joint": 400_000}
        assert steps["table_1", "lidm_ape"] == {"lidm_first_stage": 40_000, "lidm": 200_000}
        assert "1 vae_alignment of 800000 steps" in budget_of(plan)
        sit, unet = (rows["table_4", key].stages[0][-1] for key in ("sit", "unet"))
        for stage, network in ((sit, "SiT"), (unet, "UNet")):
            assert stage.config["model"]["init_args"]["sit"]["class_path"] == f"r3dpa.nn.{network}"

    def test_a_second_seed_repeats_all_but_the_prior(self):
        one, two = plan_of("demo"), plan_of("demo", (0, 1))
        prior = [stage for stage in one.stages if not stage.on_scans]
        assert len(two.stages) == 2 * len(one.stages) - len(prior)
        assert set(names_of(one.stages)) < set(names_of(two.stages))
        for seed in (0, 1):
            vae, joint = rows_of(two)["table_3", "joint"].stages[seed][-2:]
            assert joint.words[-8::2] == [f"--{key}" for key in SEEDS]
            assert joint.words[-7::2] == [str(seed)] * 4
            assert str(vae.checkpoint) in joint.words

    def test_given_weights_replace_the_prior_and_are_part_of_the_name(self, tmp_path):
        names = []
        for content in ("one", "other"):
            weights = tmp_path / f"{content}.pt"
            weights.write_text(content)
            plan = plan_of("demo", tables=TABLES / "table_2", rgb_weights=weights)
            assert all(stage.on_scans for stage in plan.stages)
            assert str(weights) in rows_of(plan)["table_2", "rgb"].stages[0][-1].words
            names.append({key: set(names_of(r.stages[0])) for (_, key), r in rows_of(plan).items()})
        assert names[0]["scratch"] == names[1]["scratch"]
        assert not names[0]["aligned"] & names[1]["aligned"]

    def test_the_name_depends_on_what_is_trained_not_on_the_test_or_the_folder(self, tmp_path):
        scale = yaml.safe_load((TABLES / "scale" / "demo.yaml").read_text())
        names = []
        for section, key, out in (("scorer", "num_scenes", "a"), ("trainer", "max_steps", "b/c")):
            scale["config"][section][key] += 1
            path = tmp_path / "demo.yaml"
            path.write_text(yaml.safe_dump(scale))
            plan = make_plan(TABLES / "table_2.yaml", path, (0,), tmp_path / out, resolve_config)
            names.append(names_of(stage for stage in plan.stages if stage.on_scans))
        usual = names_of(s for s in plan_of("demo", tables=TABLES / "table_2").stages if s.on_scans)
        assert names[0] == usual
        assert not set(names[1]) & set(usual)

    def test_released_files_stand_for_trainings(self, tmp_path):
        weights, samples = tmp_path / "r2dm.pth", tmp_path / "samples"
        weights.write_bytes(b"weights")
        samples.mkdir()
        released = {"r2dm": weights, "ultralidar": samples}
        scale = TABLES / "scale" / "demo.yaml"
        plan = make_plan(TABLES / "table_1", scale, (0,), tmp_path, resolved, released=released)
        rows = rows_of(plan)
        assert next(key for _, key in rows) == "ultralidar"
        assert not any(stage.words[0] == "r2dm" for stage in plan.stages)
        jobs = {job.name: job for job in runner.plan_jobs(plan)}
        (stage,) = rows["table_1", "r2dm"].stages[0]
        sampled, test = jobs[stage.name], jobs[f"test of {stage.name}"]
        assert sampled.words[:3] == ["sample", "--ckpt", str(weights)]
        assert test.words[:3] == ["evaluate", "--samples", sampled.words[4]]
        assert (test.needs, test.makes) == ((stage.name, "reference"), stage.evaluation)
        (stage,) = rows["table_1", "ultralidar"].stages[0]
        assert jobs[f"test of {stage.name}"].words[2] == str(samples)
        assert stage.name not in jobs


ROW = {"label": "x", "commands": {"a": "r3dpa fit joint"}}


class TestErrors:
    @pytest.mark.parametrize(
        ("row", "message"),
        [
            ({"commands": {}}, r"t\.yaml: b: .*'label'"),
            ({"label": "x", "colour": 1}, r"t\.yaml: b: .*'colour'"),
            (
                ROW | {"commands": {"a": "r3dpa fit x {fly}"}},
                "unknown {fly}; choose from image_vae, prior",
            ),
            (ROW | {"commands": {"a": "sample x"}}, "is no command `r3dpa fit STAGE"),
            (ROW | {"published": {"FID": 1.0}}, "unknown 'FID'; choose from FRID"),
        ],
    )
    def test_a_wrong_row_is_named(self, row, message, tmp_path):
        content = {"caption": "c", "rows": {"a": ROW, "b": row}}
        (tmp_path / "t.yaml").write_text(yaml.safe_dump(content))
        with pytest.raises(ValueError, match=message):
            plan_of("demo", tables=tmp_path / "t.yaml")

    def test_an_option_that_fit_refuses_is_named(self, capsys):
        with pytest.raises(ValueError, match="r3dpa fit joint --preset demo --colour 1"):
            resolve_config(["fit", "joint", "--preset", "demo", "--colour", "1"])
        assert "colour" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            ([str(TABLES / "table_9")], "table_9.yaml is no table"),
            ([str(TABLES), "--scale", "huge"], "unknown scale .*; choose from demo"),
            ([str(TABLES), "--seeds", "0", "0"], "different numbers"),
            ([str(TABLES), "--rgb_weights", "none.pt"], "none.pt does not exist"),
            ([str(TABLES), "--released.r2d2", "none.pt"], r"--released\.r2d2: unknown row"),
        ],
    )
    def test_a_wrong_argument_is_named(self, words, message, tmp_path, monkeypatch):
        monkeypatch.setattr("r3dpa.cli.bench.resolve_config", resolved)
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ValueError, match=message):
            main(["ablate", *words, "--out", "out"])
        assert not (tmp_path / "out").exists()


def evaluation(step=None, **values):
    about = {"protocol": {"name": "default"}, "reference": "r", "seed": 0, "published": False}
    about |= dict.fromkeys(("solver", "steps", "precision", "commit", "feature_source"))
    about |= {"backbones": {}, "source": "s", "extra": {} if step is None else {"step": step}}
    rows = tuple(
        MetricResult(name, value, (value - 0.1, value + 0.1), scale=-2)
        for name, value in values.items()
    )
    return Evaluation("x", rows, about)


class TestTables:
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
    def test_an_order_holds_if_the_interval_lies_inside_the_claim(
        self, ours, theirs, better, alike
    ):
        rows = [Row(key, key, {}, {}) for key in "ab"]
        table = Table("t", "", rows, [("better", "a", "b"), ("alike", "a", "b")])
        results = {
            key: {seed: evaluation(JSD=value) for seed, value in enumerate(values)}
            for key, values in (("a", ours), ("b", theirs))
        }
        orders = order_results(table, results, {"JSD": True})
        assert [order.holds for order in orders] == [better, alike]

    @pytest.mark.parametrize("name", ["table_2", "table_3", "table_4"])
    def test_recorded_tables_are_computed_again(self, name, tmp_path):
        """From the numbers of each seed: means, intervals, paired differences and what they say."""
        plan, stored = recorded(name, tmp_path)
        write_table(plan, plan.tables[0], {})
        content = json.loads((tmp_path / f"{name}.json").read_text())
        for key in ("caption", "scale", "about", "rows", "orders"):
            assert content[key] == stored[key], key
        old, new = ((folder / f"{name}.md").read_text() for folder in (RECORDED, tmp_path))
        lines = [line for line in old.splitlines() if "Paper: " in line or "Scale" in line]
        assert [line for line in lines if line not in new] == []
        assert "against KITTI-360, train-val (MMD: val-only)" in new
        assert r"\bottomrule" in (tmp_path / f"{name}.tex").read_text()
        keys = ("label", "metric", "value", "low", "high", "floor")
        means = []
        for folder in (RECORDED, tmp_path):
            with (folder / f"{name}.csv").open(newline="") as file:
                means.append([[line[key] for key in keys] for line in csv.DictReader(file)])
        assert means[0] == means[1]


def recorded(name, out):
    """Plan of a recorded table, with its evaluations in their folders."""
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


def leave_results(words, step=None):
    """Write what the command of a job would leave for others."""
    run_dir = Path(words[words.index("--run_dir") + 1]) if "--run_dir" in words else None
    if words[0] == "fit":
        for folder in ("checkpoints", "version_0"):
            (run_dir / folder).mkdir(exist_ok=True)
        (run_dir / "checkpoints" / "last.ckpt").touch()
        (run_dir / "version_0" / "metrics.csv").write_text("step,train/loss\n0,2.0\n1,1.0\n")
    if words[0] == "test":
        evaluation(step, JSD=1.0).save(run_dir / "evaluation" / "evaluation.json")
    if words[0] == "reference":
        Path(words[words.index("--out") + 1]).touch()


class Processes:
    """Stands in for processes, whose imports would take ten seconds each."""

    def __init__(self):
        self.started = []
        self.run = leave_results

    def __call__(self, words, **_):
        self.started.append(words[3:])
        status = self.run(words[3:]) or 0
        return SimpleNamespace(poll=lambda: status, returncode=status)

    def kinds(self):
        kinds = Counter(words[0] for words in self.started)
        self.started.clear()
        return kinds


@pytest.fixture
def processes(monkeypatch):
    processes = Processes()
    monkeypatch.setattr(runner.subprocess, "Popen", processes)
    return processes


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Words that run two rows at the size of conf/smoke.yaml: a VAE, without and with alignment."""
    monkeypatch.setattr("r3dpa.cli.bench.resolve_config", resolved)
    smoke = yaml.safe_load((CONF / "smoke.yaml").read_text())
    smoke["trainer"] |= {"callbacks": [], "limit_val_batches": 0}
    smoke["scorer"]["spaces"] = ["fgeo"]
    smoke["data"]["init_args"].pop("root")
    options = "--preset demo --data.init_args.root {out}/data"
    scale = {"about": "Smoke.", "options": options, "config": smoke, "reference": "--spaces fgeo"}
    (tmp_path / "smoke.yaml").write_text(yaml.safe_dump(scale))
    flow = "r3dpa fit flow_matching --model.init_args.init_from {vae}"
    rows = {}
    for key, weight in (("a", 0.0), ("b", 0.5)):
        aligned = f"{flow} --model.init_args.weights.sit_alignment {weight}"
        commands = {"vae": "r3dpa fit vae_alignment", "flow": aligned}
        rows[key] = {"label": f"row {key}", "published": {"JSD": 5.0}, "commands": commands}
    table = {"caption": "A table.", "rows": rows, "better": [["b", "a"]]}
    (tmp_path / "table_x.yaml").write_text(yaml.safe_dump(table, sort_keys=False))
    words = ["ablate", str(tmp_path / "table_x"), "--scale", str(tmp_path / "smoke.yaml")]
    return [*words, "--out", str(tmp_path / "out"), "--wandb", "off"]


ALL = {"features": 1, "reference": 1, "fit": 3, "test": 2}


class TestRuns:
    def test_only_what_is_missing_is_run(self, command, tmp_path, processes, capsys):
        main([*command, "--jobs", "3"])
        assert processes.kinds() == ALL  # the VAE of both rows is trained once
        text = capsys.readouterr().out
        assert "A table. Scale smoke: Smoke. Seeds 0." in text
        assert "Paper: row b better than row a. Here: JSD unclear, +0 % [-14, +14]" in text
        main(command)
        assert not processes.started
        assert "7 of 7 are done already" in capsys.readouterr().out
        (flow, _) = (tmp_path / "out").glob("stages/flow_matching-*")
        (flow / "fit.done").unlink()
        main(command)
        assert processes.kinds() == {"fit": 1}
        (tmp_path / "out" / "reference.safetensors").unlink()
        main(command)
        assert processes.kinds() == {"reference": 1}

    def test_jobs_are_started_together_but_after_those_that_they_need(
        self, command, tmp_path, processes
    ):
        ended = []

        def start(words, **_):
            processes.started.append(words[3:])
            leave_results(words[3:])
            process = SimpleNamespace(returncode=0, words=words[3:])
            looks = iter((None, None, 0))
            process.poll = lambda: next(looks, 0)
            ended.append(process)
            return process

        runner.subprocess.Popen = start  # restored by the fixture
        main([*command, "--jobs", "2"])
        kinds = [words[0] for words in processes.started]
        assert kinds[0] == "features"
        assert set(kinds[1:3]) == {"reference", "fit"}
        assert kinds.index("test") > kinds.index("fit") + 1

    def test_an_interrupted_training_continues(self, command, tmp_path, processes):
        processes.run = lambda words: leave_results(words) or (words[0] == "fit") * 143
        with pytest.raises(SystemExit):
            main(command)
        (checkpoint,) = (tmp_path / "out").glob("stages/vae_alignment-*/checkpoints/last.ckpt")
        checkpoint.write_text("half way")
        processes.started.clear()
        processes.run = lambda words: None
        with pytest.raises(SystemExit):
            main(command)
        assert checkpoint.read_text() == "half way"
        (first, *_) = [words for words in processes.started if words[0] == "fit"]
        assert first[first.index("--ckpt_path") + 1] == "last"

    def test_a_row_that_fails_leaves_the_other(self, command, tmp_path, processes, capsys):
        def fail(words):
            aligned = "--model.init_args.weights.sit_alignment 0.5" in " ".join(words)
            return 3 if words[0] == "fit" and aligned else leave_results(words)

        processes.run = fail
        with pytest.raises(SystemExit) as ended:
            main(command)
        assert ended.value.code == 1
        text = capsys.readouterr().out
        assert "ended with status 3" in text
        assert "not run, since flow_matching-" in text
        assert "row b, seed 0: no result" in text
        stored = json.loads((tmp_path / "out" / "table_x.json").read_text())
        assert [bool(row["values"]) for row in stored["rows"]] == [True, False]
        processes.run = leave_results
        processes.kinds()
        main(command)
        assert processes.kinds() == {"fit": 1, "test": 1}

    def test_a_test_without_numbers_fails_and_removes_old_tables(
        self, command, tmp_path, processes, capsys
    ):
        """As `r3dpa test` ends where scenes are too few to compare."""
        main([*command, "--jobs", "2"])
        scale = yaml.safe_load((tmp_path / "smoke.yaml").read_text())
        scale["config"]["scorer"]["num_scenes"] = 5
        (tmp_path / "smoke.yaml").write_text(yaml.safe_dump(scale))
        processes.run = lambda words: None
        processes.kinds()
        with pytest.raises(SystemExit):
            main(command)
        assert processes.kinds() == {"test": 2}
        text = capsys.readouterr().out
        assert "left no evaluation.json" in text
        assert text.endswith("tables: none\n")
        assert not list((tmp_path / "out").glob("table_x.*"))

    def test_a_table_refuses_numbers_of_another_step(self, command, tmp_path, processes):
        """As of a stale checkpoint in a folder that was moved."""
        steps = iter((3, 2))
        processes.run = lambda words: leave_results(
            words, next(steps) if words[0] == "test" else None
        )
        main(command)
        stored = json.loads((tmp_path / "out" / "table_x.json").read_text())
        assert [len(row["values"]) for row in stored["rows"]] == [1, 0]
        text = (tmp_path / "out" / "table_x.md").read_text()
        assert "evaluation.json is of step 2, not the last" in text

    def test_wandb_gets_the_newest_numbers_of_each_row(
        self, command, tmp_path, processes, monkeypatch
    ):
        logged = []

        def init(**options):
            (options["dir"] / "wandb" / f"offline-run-x-{options['id']}").mkdir(parents=True)
            run = SimpleNamespace(**options, summary={}, lines=[])
            run.define_metric, run.log = lambda *_, **__: None, run.lines.append
            logged.append(run)
            return nullcontext(run)

        monkeypatch.setattr(wandb, "init", init)
        main(command[:-2])
        for run, key, weight in zip(logged, "ab", (0.0, 0.5), strict=True):
            assert (run.group, run.job_type, run.mode) == ("table_x smoke", "row", "offline")
            assert run.name == f"row {key}, seed 0"
            assert f"sit_alignment {weight}" in list(run.config["commands"].values())[-1]
            assert run.summary == {"JSD": 1.0}
            assert {"vae_alignment/step": 1, "vae_alignment/train/loss": 1.0} in run.lines
        main(command[:-2])
        assert len(logged) == 2  # nothing new
        (first, _) = sorted((tmp_path / "out").glob("stages/flow_matching-*/evaluation/*.json"))
        evaluation(JSD=2.0).save(first)
        main(command[:-2])
        assert len(logged) == 3
        assert logged[-1].summary == {"JSD": 2.0}


class TestProcesses:
    def test_imports_nothing_of_the_current_folder(self, tmp_path, monkeypatch):
        (tmp_path / "r3dpa.py").write_text("open('run', 'w').close()")
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("PYTHONSAFEPATH", "")
        job = runner.Job("version", ["--version"], tmp_path / "a", "")
        assert runner.finish(job, runner.start(job, 1).wait()) is None
        assert not (tmp_path / "run").exists()

    def test_a_failure_shows_the_end_of_the_log(self, tmp_path):
        job = runner.Job("check", ["check", "--colour"], tmp_path / "check", "")
        reason = runner.finish(job, runner.start(job, 1).wait())
        assert "ended with status 2" in reason
        assert "colour" in reason
        assert not job.done

    def test_an_interrupt_stops_what_was_started(self, tmp_path, monkeypatch):
        started, popen = [], subprocess.Popen

        def sleep(*_, **options):
            started.append(popen(["sleep", "60"], **options))
            return started[-1]

        def interrupt(_):
            raise KeyboardInterrupt

        jobs = [runner.Job(name, ["sleep"], tmp_path / name, "") for name in "ab"]
        monkeypatch.setattr(runner.subprocess, "Popen", sleep)
        monkeypatch.setattr(runner, "plan_jobs", lambda _: jobs)
        monkeypatch.setattr(runner.time, "sleep", interrupt)
        with pytest.raises(KeyboardInterrupt):
            run_plan(None, print, jobs=2)
        assert [process.returncode for process in started] == [-signal.SIGTERM] * 2

    @pytest.mark.skipif(sys.platform != "linux", reason="a signal of Linux")
    def test_a_killed_ablation_leaves_no_process(self):
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
    scale = yaml.safe_load((TABLES / "scale" / "demo.yaml").read_text())
    step = {"max_steps": 1, "val_check_interval": 1, "limit_val_batches": 1}
    scale["config"]["data"]["init_args"]["num_scans"] = 12
    scale["config"]["trainer"] |= step
    scale["config"]["checkpoint"] = {"every_n_train_steps": 1}
    scale["config"]["scorer"] |= {"num_scenes": 4, "batch_size": 4, "spaces": ["fgeo"]}
    sampler = {"solver": "euler", "steps": 1, "shift": 1}
    scale["tables"] = {name: {"stages": {}} for name in ("table_1",)}
    for settings in (scale["config"], *scale["stages"].values()):
        settings["scorer"]["sampler"] = sampler
    images = {"trainer": step, "checkpoint": {"every_n_train_steps": 1}}
    images["data"] = {"init_args": {"val_every": 2, "num_workers": 0}}
    images["data"]["init_args"]["source"] = {"init_args": {"num_images": 40}}
    for name, text in scale["commands"].items():
        scale["commands"][name] = f"{text} --config '{json.dumps(images)}'"
    scale["reference"] = "--spaces fgeo"
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(scale))
    plan = make_plan(TABLES, tmp_path / "tiny.yaml", (0,), tmp_path, resolved)
    assert not run_plan(plan, lambda _: None)
    kinds = processes.kinds()
    assert (kinds["features"], kinds["reference"]) == (1, 1)
    assert kinds["fit"] == len(plan.stages)
    for chain in plan.chains:
        assert json.loads(chain[-1].evaluation.read_text())
