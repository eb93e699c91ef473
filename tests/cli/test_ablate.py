"""``r3dpa ablate``: what is run, what a failure costs, and what is left of an interrupt."""

import json
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
from tiny_evaluations import evaluation

from r3dpa.ablation import make_plan, run_plan
from r3dpa.ablation import runs as runner
from r3dpa.cli import main
from r3dpa.cli.bench import resolve_config

CONF = Path(__file__).resolve().parents[2] / "conf"
TABLES = CONF / "ablation"
pytestmark = pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")


def test_an_option_that_fit_refuses_is_named(capsys):
    with pytest.raises(ValueError, match="r3dpa fit joint --preset demo --colour 1"):
        resolve_config(["fit", "joint", "--preset", "demo", "--colour", "1"])
    assert "colour" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([str(TABLES / "table_9")], "table_9: no table or folder of tables"),
        ([str(TABLES), "--scale", "huge"], "unknown scale .*; choose from demo"),
        ([str(TABLES), "--seeds", "0", "0"], "different numbers"),
        ([str(TABLES), "--rgb_weights", "none.pt"], "none.pt does not exist"),
        ([str(TABLES / "table_4"), "--released.r2d2", "none.pt"], r"--released\.r2d2: unknown row"),
    ],
)
def test_a_wrong_argument_is_named(words, message, tmp_path, monkeypatch):
    monkeypatch.setattr("r3dpa.cli.bench.resolve_config", resolved)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        main(["ablate", *words, "--out", "out"])
    assert not (tmp_path / "out").exists()


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
        self.started, self.running, self.most = [], 0, 0
        self.run = leave_results

    def __call__(self, words, **_):
        self.started.append(words[3:])
        self.running += 1
        self.most = max(self.most, self.running)
        status = self.run(words[3:]) or 0
        looks = iter((None,))  # still running at the first look

        def poll():
            ended = next(looks, status)
            self.running -= ended is not None
            return ended

        return SimpleNamespace(poll=poll, returncode=status)

    def kinds(self):
        kinds = Counter(words[0] for words in self.started)
        self.started.clear()
        return kinds


@pytest.fixture
def processes(monkeypatch):
    processes = Processes()
    monkeypatch.setattr(runner, "Popen", processes)
    monkeypatch.setattr(runner, "_PAUSE_S", 0)
    return processes


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Words that run two rows at the size of conf/smoke.yaml: a VAE, without and with alignment.

    Their paths are relative, so that all tests have the same commands, which are resolved once.
    """
    monkeypatch.chdir(tmp_path)
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
    return ["ablate", "table_x", "--scale", "smoke.yaml", "--out", "out", "--wandb", "off"]


class TestRuns:
    def test_only_what_is_missing_is_run(self, command, tmp_path, processes, capsys):
        main([*command, "--jobs", "3"])
        assert processes.kinds() == {"features": 1, "reference": 1, "fit": 3, "test": 2}
        text = capsys.readouterr().out
        assert "A table. Scale smoke: Smoke. Seeds 0." in text
        assert (
            "Paper: row b better than row a. Here: JSD no difference above 14 %, +0 % [-14, +14]"
            in text
        )
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

    def test_as_many_processes_run_at_a_time_as_there_are_jobs(self, command, processes):
        main([*command, "--jobs", "2"])
        assert processes.most == 2
        kinds = [words[0] for words in processes.started]
        assert kinds[0] == "features"  # alone: all others need it
        assert kinds.index("test") > kinds.index("fit") + 1

    def test_a_failed_row_leaves_the_other_and_continues_at_the_next_call(
        self, command, tmp_path, processes, capsys
    ):
        def fail(words):
            leave_results(words)
            if words[0] == "fit" and "sit_alignment 0.5" in " ".join(words):
                run_dir = Path(words[words.index("--run_dir") + 1])
                (run_dir / "checkpoints" / "last.ckpt").write_text("half way")
                return 143
            return 0

        processes.run = fail
        with pytest.raises(SystemExit) as ended:
            main(command)
        assert ended.value.code == 1
        text = capsys.readouterr().out
        assert "ended with status 143" in text
        assert "not run, since flow_matching-" in text
        assert "row b, seed 0: no result" in text
        stored = json.loads((tmp_path / "out" / "table_x.json").read_text())
        assert [bool(row["values"]) for row in stored["rows"]] == [True, False]
        processes.started.clear()
        processes.run = leave_results
        main(command)
        fit, test = processes.started
        assert test[0] == "test"
        checkpoint = Path(fit[fit.index("--run_dir") + 1]) / "checkpoints" / "last.ckpt"
        assert fit[fit.index("--ckpt_path") + 1] == "last"
        assert checkpoint.read_text() == "half way"

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
        monkeypatch.setattr(runner, "Popen", sleep)
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
