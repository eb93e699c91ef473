"""Every shipped YAML is accepted by the real parser, in the order that README gives."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from r3dpa.cli import main

CONF = Path(__file__).resolve().parents[2] / "conf"
STAGES = ("vae_alignment", "joint", "flow_matching")
# Started by tests/cli/test_rgb_stages.py.
RGB_DATA = ("dead_leaves", "images")
RGB_STAGES = ("image_vae", "rgb_pretraining", "rgb_pretraining_demo")


def parsed(capsys, *configs):
    words = [word for config in configs for word in ("--config", str(CONF / f"{config}.yaml"))]
    with pytest.raises(SystemExit) as ended:
        main(["fit", *words, "--print_config"])
    assert ended.value.code == 0
    return yaml.safe_load(capsys.readouterr().out)


@pytest.mark.parametrize(
    "data", sorted({path.stem for path in (CONF / "data").iterdir()} - {"points", *RGB_DATA})
)
def test_data_config(data, capsys):
    config = parsed(capsys, "trainer", f"data/{data}", "experiment/joint")
    assert config["data"]["init_args"]["extractor"]["class_path"].endswith("WaffleIronS")
    assert config["trainer"]["max_steps"] == 1000000


@pytest.mark.parametrize("stage", STAGES)
def test_demo_of_a_stage(stage, capsys):
    experiments = (f"experiment/{stage}", f"experiment/{stage}_demo")
    config = parsed(capsys, "trainer", "trainer_demo", "data/demo", *experiments)
    sit = config["model"]["init_args"]["sit"]["init_args"]
    grid = [size // sit["patch_size"] for size in sit["input_size"]]
    assert config["data"]["init_args"]["grid_size"] == grid
    assert config["trainer"]["max_steps"] == 400


def test_no_experiment_is_left_out():
    names = {path.stem for path in (CONF / "experiment").iterdir()}
    assert names == {*STAGES, *(f"{stage}_demo" for stage in STAGES), "waffleiron_s", *RGB_STAGES}


def test_teacher_config(capsys):
    config = parsed(capsys, "trainer", "data/points", "experiment/waffleiron_s")
    network = config["model"]["init_args"]["network"]["init_args"]
    grid = config["data"]["init_args"]["prepare"]["init_args"]["grid"]
    extent = [hi - lo for lo, hi in zip(grid["minimum_m"], grid["maximum_m"], strict=True)]
    assert network["cells"] == [round(length / grid["cell_m"]) for length in extent]
