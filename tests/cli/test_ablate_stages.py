"""Shipped scales and rows: each stage is built at its full size, and started at the demo's."""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from test_ablate_tables import CONF, SCALES, TABLES, InThisProcess, plan_of

from r3dpa.ablation import RunSettings, flop_per_sample, make_plan, read_scale, run_plan
from r3dpa.ablation import run as runner
from r3dpa.ablation.plan import merged
from r3dpa.cli import main

pytestmark = pytest.mark.filterwarnings(
    "ignore:LightningCLI's args parameter",
    "ignore:.*does not have many workers",
    "ignore:.*LeafSpec.*is deprecated",
    "ignore:Attribute '.*' is an instance of `nn.Module`",
)


@pytest.mark.parametrize(
    "scale",
    [scale if scale == "demo" else pytest.param(scale, marks=pytest.mark.slow) for scale in SCALES],
)
def test_every_stage_steps_at_its_full_size_without_memory(scale):
    """Losses and gradients of the whole networks, on the meta device."""
    kinds = {stage.experiment: stage for stage in plan_of(scale).stages}
    assert all(flop_per_sample(stage.config) > 0 for stage in kinds.values())


def test_paper_scale_has_the_networks_of_the_paper():
    kinds = {}
    for stage in plan_of("paper").stages:
        init_args = stage.config["model"]["init_args"]
        kinds[stage.experiment] = init_args["sit"]["class_path"], stage.config["trainer"]
    assert kinds["joint_unet"][0] == "r3dpa.nn.UNet"
    assert kinds["joint"][0] == "r3dpa.nn.SiT"
    prior = kinds.pop("rgb_pretraining")
    assert prior[1]["max_steps"] == 1_000_000
    assert {trainer["max_steps"] for _, trainer in kinds.values()} == {400_000}


@pytest.mark.parametrize("scale", SCALES)
def test_the_command_line_accepts_every_stage(scale, tmp_path, capsys):
    plan = plan_of(scale)
    kinds = {stage.experiment: stage for stage in plan.stages}  # rows set known keys of them
    for stage in kinds.values():
        path = tmp_path / f"{stage.experiment}.yaml"
        config = runner.settled(stage, RunSettings(tmp_path))
        path.write_text(yaml.safe_dump(config))
        with pytest.raises(SystemExit) as ended:
            main(["fit", "--config", str(path), "--print_config"])
        assert ended.value.code == 0
        assert yaml.safe_load(capsys.readouterr().out)["model"]["class_path"]


def told_commands():
    """Commands in the comments on top of the files of ``conf``."""
    for path in sorted(CONF.rglob("*.yaml")):
        head = "".join(
            line.lstrip("# ") for line in path.open() if re.match(r"#\s{2,}(r3dpa|--)", line)
        )
        for line in head.replace("\\\n", " ").splitlines():
            if line.startswith("r3dpa "):
                yield pytest.param(shlex.split(line)[1:], id=str(path.relative_to(CONF)))


@pytest.mark.parametrize("words", told_commands())
def test_commands_in_comments_are_accepted(words, monkeypatch):
    monkeypatch.chdir(CONF.parent)
    if words[0] == "ablate":
        words = [*words, "--budget_only"]
        main(words)
        return
    assert words[0] == "fit"
    with pytest.raises(SystemExit) as ended:
        main([*words, "--print_config"])
    assert ended.value.code == 0


def in_miniature(scale):
    """One step of each training at the sizes of the demo, on few images and scans."""
    train = {
        "trainer": {"max_steps": 1, "val_check_interval": 1, "limit_val_batches": 1},
        "checkpoint": {"every_n_train_steps": 1},
    }
    images = {"source": {"init_args": {"num_images": 40}}, "val_every": 2, "num_workers": 0}
    experiments = {}
    for name, given in scale.experiments.items():
        change = (
            train if given.get("scans", True) else merged(train, {"data": {"init_args": images}})
        )
        experiments[name] = {**given, "set": merged(given.get("set", {}), change)}
    few = {
        "data": {"init_args": {"num_scans": 12}},
        "scorer": {"num_scenes": 4, "batch_size": 4, "spaces": ["fgeo"]},
    }
    few["scorer"]["sampler"] = {"solver": "euler", "steps": 1, "shift": 1.0}
    overrides = merged(scale.overrides, few)
    return replace(scale, overrides=overrides, experiments=experiments)


@pytest.mark.slow
def test_all_rows_of_the_demo_run_in_miniature(tmp_path, monkeypatch):
    monkeypatch.setattr(InThisProcess, "started", [])
    monkeypatch.setattr(runner, "Popen", InThisProcess)
    scale = in_miniature(read_scale(TABLES / "scale" / "demo.yaml"))
    plan = make_plan(TABLES, scale, (0,))
    assert not run_plan(plan, RunSettings(tmp_path), lambda _: None)
    counts = Counter(words[0] for words in InThisProcess.started)
    assert counts == {"features": 1, "reference": 1, "fit": 11, "test": 7}
    for stage in plan.tested:
        numbers = json.loads(Path(runner.evaluation_of(tmp_path, stage)).read_text())
        assert numbers
