"""The bench of training steps at smoke size: counts, memory, work, table, and killed processes."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from r3dpa.bench import training as bench
from r3dpa.bench.measure import flop_of
from r3dpa.bench.training import STAGES, StepSettings, training
from r3dpa.nn import SiT

CONF = Path(__file__).resolve().parents[2] / "conf"
SETTINGS = StepSettings(batch_size=2, steps=2, device="cpu")


@pytest.fixture(scope="module")
def small_conf(tmp_path_factory):
    """The shipped experiments with the networks of conf/smoke.yaml."""
    conf = tmp_path_factory.mktemp("conf")
    smoke = yaml.safe_load((CONF / "smoke.yaml").read_text())["model"]["init_args"]
    smoke["sit"]["class_path"] = "r3dpa.nn.SiT"
    (conf / "experiment").mkdir()
    (conf / "demo").mkdir()
    for stage in STAGES:
        config = yaml.safe_load((CONF / "experiment" / f"{stage}.yaml").read_text())
        arguments = config["model"]["init_args"] | smoke
        if "discriminator" in arguments:
            arguments["discriminator"] = {
                "class_path": "r3dpa.nn.PatchDiscriminator",
                "init_args": {"channels": 16},
            }
        config["model"]["init_args"] = arguments
        (conf / "experiment" / f"{stage}.yaml").write_text(yaml.safe_dump(config))
        smaller = {"model": {"init_args": {"sit": {"init_args": {"hidden_size": 16}}}}}
        (conf / "demo" / f"{stage}.yaml").write_text(yaml.safe_dump(smaller))
    return conf


@pytest.fixture(scope="module")
def figures(small_conf, tmp_path_factory):
    """Table and file of two stages, in this process."""
    out = tmp_path_factory.mktemp("bench") / "figures.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "_in_new_process", bench._measure)
        table = training(small_conf, ("vae_alignment", "flow_matching"), SETTINGS, out)
    return table, json.loads(out.read_text())


def test_every_step_of_every_stage_is_run(figures):
    _, content = figures
    assert [stage["stage"] for stage in content["stages"]] == ["vae_alignment", "flow_matching"]
    for stage in content["stages"]:
        assert len(stage["step_seconds"]) == 2
        assert 0 < stage["loss"] < 100
        assert 2**27 < stage["peak_host_bytes"] < 2**33
        assert stage["peak_gpu_bytes"] is None
        assert stage["images_per_second"] == pytest.approx(2 / stage["step_seconds"][1])


def test_work_is_that_of_a_step(figures, small_conf):
    """Flow matching reads cached latents: the SiT alone, far less than the VAE of the other."""
    vae, flow = (stage["flop"] for stage in figures[1]["stages"])
    # Forward and backward of two scans: 3 times the forward pass, a little less at the input.
    config = yaml.safe_load((small_conf / "experiment" / "flow_matching.yaml").read_text())
    sit = SiT(**config["model"]["init_args"]["sit"]["init_args"])
    latents = torch.randn(2, sit.in_channels, *sit.input_size)
    forward = flop_of(lambda: sit.velocity(latents, torch.rand(2)))
    assert 2.5 * forward < flow <= 3.5 * forward
    assert vae > 5 * flow


def test_the_table_quotes_the_file(figures):
    table, content = figures
    rows = [line.split() for line in table.splitlines()]
    for stage, cells in zip(content["stages"], rows[2:4], strict=True):
        assert cells[0] == stage["stage"]
        assert cells[1] == f"{stage['step_seconds'][0]:.3g}"
        assert cells[3] == f"{stage['peak_host_bytes'] / 2**30:.2f}"
        assert cells[7] == f"{stage['flop'] / 1e9:.4g}"
    assert f"torch {torch.__version__}" in table


@pytest.mark.slow
def test_quick_measures_the_small_networks_in_a_process_of_their_own(small_conf, tmp_path):
    out = tmp_path / "quick.json"
    training(small_conf, ("joint",), replace(SETTINGS, quick=True, steps=1), out)
    (stage,) = json.loads(out.read_text())["stages"]
    assert stage["flop"] < 9.7e8  # 9.71e8 at hidden size 32, here 16


def test_a_missing_experiment_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"experiment/joint\.yaml does not exist; choose"):
        training(tmp_path, ("joint",))


def killed(*args):
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_the_stage_whose_process_was_killed_is_named(small_conf, monkeypatch):
    monkeypatch.setattr(bench, "_measure", killed)
    with pytest.raises(RuntimeError, match=r"joint was killed.*batch_size 1"):
        training(small_conf, ("joint",))
