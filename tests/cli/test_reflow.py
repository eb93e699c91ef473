"""Straightening and distillation of R2Flow, from its shipped configurations."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier
from types import SimpleNamespace

import pytest
import torch
from tiny_baselines import fit_words

from r3dpa.baselines import ReflowPairs
from r3dpa.baselines.reflow import clamp_to_sensor
from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli import main
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.flow.solvers import euler
from r3dpa.flow.times import ode_times
from r3dpa.stages import scene_generator

CONF = Path(__file__).resolve().parents[2] / "conf"
SAMPLER = SamplerConfig("euler", 3)


@pytest.fixture(scope="module")
def flow(baseline_once):
    """Checkpoint of a 1-rectified flow."""
    return baseline_once("r2flow")


@pytest.fixture(scope="module")
def pairs_root(tmp_path_factory):
    return tmp_path_factory.mktemp("pairs")


def pairs_of(flow, root, num_pairs=7, rank=0, barrier=lambda: None, processes=1):
    pairs = ReflowPairs(str(root), str(flow), num_pairs, SAMPLER, 2, 3, "cpu")
    assert not pairs.prepare_data_per_node  # all nodes share the work
    strategy = SimpleNamespace(barrier=lambda _: barrier())
    pairs.trainer = SimpleNamespace(
        strategy=strategy,
        datamodule=pairs,
        global_rank=rank,
        local_rank=rank,
        world_size=processes,
        num_devices=processes,
    )
    return pairs


def test_processes_share_the_generation(flow, tmp_path):
    """Threads for processes."""
    barrier = Barrier(2, timeout=60).wait
    both = [pairs_of(flow, tmp_path, 7, rank, barrier, 2) for rank in (0, 1)]
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda pairs: pairs.setup("fit"), both))
    assert [len(pairs.train_set) for pairs in both] == [5, 5]
    journals = sorted(tmp_path.rglob("*.jsonl"))
    assert [len(path.read_text().splitlines()) for path in journals] == [4, 3]


def test_a_pair_is_noise_and_what_the_flow_makes_of_it(flow, pairs_root, monkeypatch):
    pairs_of(flow, pairs_root, 5).setup("fit")
    generator = scene_generator(flow, SAMPLER, device="cpu")
    made = []
    generate = type(generator).generate
    monkeypatch.setattr(
        type(generator),
        "generate",
        lambda self, indices, seed=0: made.extend(indices) or generate(self, indices, seed),
    )
    pairs = pairs_of(flow, pairs_root)
    pairs.setup("fit")
    assert made == [5, 6]  # only those that were missing
    assert (len(pairs.train_set), len(pairs.val_set)) == (5, 2)
    for index in (0, 4):
        pair = pairs.train_set[index]
        with torch.no_grad():
            scene = euler(generator.velocity, pair["noise"][None], ode_times(3))
        expected = clamp_to_sensor(scene, generator.geometry)[0]
        torch.testing.assert_close(pair["range_image"], expected, atol=1e-4, rtol=0)
    assert not torch.equal(pairs.train_set[0]["noise"], pairs.train_set[1]["noise"])


def test_reflow_and_distillation_start_from_the_averaged_flow(flow, pairs_root, tmp_path):
    words = ["fit"]
    for name in ("trainer", "data/simulated", "baseline/r2flow", "baseline/r2flow_reflow"):
        words += ["--config", str(CONF / f"{name}.yaml")]
    words += ["--config", str(CONF / "baseline/r2flow_distilled.yaml")]
    reused = {
        word.split("=")[0][2:]: word.split("=", 1)[1]
        for word in fit_words("fit", "r2flow", "", tmp_path)
        if word.startswith(("--model", "--trainer", "--run_dir"))
    }
    settings = reused | {
        "model.init_args.init_from": flow,
        "model.init_args.num_steps": 2,
        "model.init_args.optimizer.lr": 0.0,
        "data.init_args.checkpoint": flow,
        "data.init_args.root": pairs_root,
        "data.init_args.num_pairs": 7,
        "data.init_args.num_held_out": 2,
        "data.init_args.sampler": '{"solver": "euler", "steps": 3}',
        "data.init_args.batch_size": 2,
        "data.init_args.num_workers": 0,
        "data.init_args.device": "cpu",
        "trainer.max_steps": 2,
        "trainer.val_check_interval": 2,
    }
    main([*words, *(f"--{key}={value}" for key, value in settings.items())])
    before = read_checkpoint(flow)
    after = read_checkpoint(tmp_path / "checkpoints" / "last.ckpt")
    assert after.settings == {"num_steps": 2}
    generator = scene_generator(after, device="cpu")
    assert generator.sampler == SamplerConfig("euler", 2)
    assert generator.generate(1).nfe == 2
    started = before.network("ema_network").state_dict
    for key, value in after.network("network").state_dict.items():
        assert torch.equal(value, started[key]), key  # with a learning rate of 0
