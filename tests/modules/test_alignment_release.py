"""The alignment ends once its residual has stopped falling, alike on all processes."""

import json
import math
import os
import socket
from dataclasses import asdict

import lightning as L
import pytest
import torch
import torch.multiprocessing as mp
from tiny_stages import QUIET, SILENT, TinyData, stage_module, train
from torch.utils.data import DataLoader

from r3dpa.callbacks import RunCheckpoint
from r3dpa.checkpoints.networks import FACTS
from r3dpa.modules import LossWeights, OptimizerConfig
from r3dpa.modules.alignment_release import ResidualAverages

pytestmark = QUIET
WEIGHTS = LossWeights(alignment_release=0.05, alignment_decays=(0.2, 0.6))


def same_batch(num):
    data = TinyData([False] * num)
    data.batches = data.batches[:1] * num
    return data


def released_at(residuals, decays, within=0.02):
    averages = ResidualAverages()
    for step, residual in enumerate(residuals, 1):
        averages.update(residual, decays, within)
        if averages.released:
            return step
    return None


def test_a_residual_that_does_not_fall_ends_the_alignment_at_the_first_look():
    """The slow average reaches over 1 / (1 - 0.96) = 25 steps."""
    assert released_at([0.7] * 100, (0.5, 0.96)) == 25
    assert released_at([0.7 + 0.01 * step for step in range(100)], (0.5, 0.96)) == 25


def test_the_fall_by_hand():
    """0.8, then 0.4: the means weigh them 0.5 to 1 (fast) and 0.999 to 1 (slow)."""
    averages, decays = ResidualAverages(), (0.5, 0.999)
    assert averages.update(0.8, decays, 0.02) == pytest.approx(0)
    fast, slow = (0.5 * 0.8 + 0.4) / 1.5, (0.999 * 0.8 + 0.4) / 1.999
    assert averages.update(0.4, decays, 0.02) == pytest.approx(1 - fast / slow)


def test_at_the_budget_of_r3dpa_s_it_ends_between_a_fifth_and_a_half():
    """A residual that falls from 1 to 0.5, as fast as in trials, with the noise of a batch."""
    generator = torch.Generator().manual_seed(0)
    noise = 0.03 * torch.randn(12000, generator=generator)
    for constant in (200, 400, 800):
        fall = [0.5 + 0.5 * math.exp(-step / constant) for step in range(12000)]
        noisy = [value * (1 + float(e)) for value, e in zip(fall, noise, strict=True)]
        assert 2400 < released_at(noisy, LossWeights().alignment_decays) < 6000


@pytest.mark.parametrize("stage", ["joint", "flow_matching"])
def test_a_stage_ends_its_alignment_by_the_rule(stage):
    """A learning rate of 0 leaves the residual as it is: three steps are seen, the rest is not."""
    module = stage_module(stage, weights=WEIGHTS, optimizer=OptimizerConfig(lr=0.0))
    module.draw_path = lambda num, number=None, draw=module.draw_path: draw(num, 0)
    train(module, same_batch(6))
    aligned = [parts["sit_alignment"].item() != 0 for parts in module.parts]
    assert aligned == [True] * 3 + [False] * 3
    assert module.alignment_ended
    assert module.residuals.steps == 3


def test_the_residual_of_a_step_is_the_mean_of_its_batches():
    """Two batches a step: the average is of both, as two processes would have it."""
    module = stage_module("flow_matching", weights=WEIGHTS, optimizer=OptimizerConfig(lr=0.0))
    train(module, TinyData([False] * 4), max_steps=1, accumulate_grad_batches=2)
    residuals = [1 + parts["sit_alignment"].item() / 0.5 for parts in module.parts]
    assert abs(residuals[0] - residuals[1]) > 1e-3
    first = module.residuals.fast / (1 - WEIGHTS.alignment_decays[0])
    assert first == pytest.approx(sum(residuals) / 2, rel=1e-5)


def test_a_skipped_step_is_not_averaged():
    module = train(stage_module("flow_matching", weights=WEIGHTS), TinyData([False, True]))
    assert module.guard.skipped == 1
    assert module.residuals.steps == 1
    assert math.isfinite(module.residuals.slow)


def fit(folder, steps, ckpt=None):
    module = stage_module("flow_matching", weights=WEIGHTS)
    saver = RunCheckpoint(folder, save_last=True, every_n_train_steps=100)
    more = {"max_steps": steps, "enable_checkpointing": True, "max_epochs": -1}
    train(module, same_batch(8), callbacks=[saver], ckpt_path=ckpt, **more)
    return module.residuals, torch.load(folder / "last.ckpt", weights_only=False)


def test_a_resumed_run_ends_it_at_the_same_step(tmp_path):
    expected, whole = fit(tmp_path / "whole", 5)
    assert expected.released
    assert whole["r3dpa"].keys() <= {*FACTS}  # all that readers of checkpoints know
    for stop in (1, expected.steps):
        folder = tmp_path / str(stop)
        fit(folder, stop)
        found, resumed = fit(folder, 5, folder / "last.ckpt")
        assert found == expected
        for key, value in whole["state_dict"].items():
            assert torch.equal(resumed["state_dict"][key], value), key


class Dealt(TinyData):
    """Scans of each step dealt to the processes; with one process, all of them."""

    def __init__(self, rank, num_processes):
        super().__init__([False] * 8)
        for batch in self.batches:
            batch.update({key: value[rank::num_processes] for key, value in batch.items()})

    def train_dataloader(self):
        return DataLoader(self.batches, batch_size=None)


def fit_in_process(rank, num_processes, port, folder):
    """Trains in a process as Lightning's launchers start it."""
    if num_processes > 1:
        os.environ |= {"LOCAL_RANK": str(rank), "NODE_RANK": "0", "GROUP_RANK": "0"}
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    settings = SILENT | {"strategy": "ddp" if num_processes > 1 else "auto", "max_steps": 8}
    settings |= {"devices": num_processes, "use_distributed_sampler": False}
    trainer = L.Trainer(default_root_dir=folder, **settings)
    module = stage_module("flow_matching", weights=WEIGHTS)
    trainer.fit(module, datamodule=Dealt(rank, num_processes))
    (folder / f"{num_processes}_{rank}.json").write_text(json.dumps(asdict(module.residuals)))


@pytest.mark.ddp
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork")
@pytest.mark.filterwarnings("ignore:The 'train_dataloader' does not have many workers")
def test_processes_decide_alike(tmp_path, one_thread):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    fit_in_process(0, 1, 0, tmp_path)
    mp.start_processes(fit_in_process, (2, port, tmp_path), nprocs=2, start_method="fork")
    alone, first, second = (
        json.loads((tmp_path / f"{name}.json").read_text()) for name in ("1_0", "2_0", "2_1")
    )
    assert first == second
    assert alone["released"]
    assert first == pytest.approx(alone, rel=1e-5)


@pytest.mark.parametrize("decays", [(0.999, 0.99), (0.9, 1.0), (-0.1, 0.5)])
def test_averages_that_reach_over_no_number_of_steps_are_refused(decays):
    with pytest.raises(ValueError, match="alignment_decays must be 0 or more and below 1"):
        LossWeights(alignment_decays=decays)
