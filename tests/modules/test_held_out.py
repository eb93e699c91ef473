"""What is logged of held-out scans does not depend on how they were put into batches."""

from __future__ import annotations

import json
import math
import os
import socket
from types import SimpleNamespace
from unittest.mock import Mock

import lightning as L
import pytest
import torch
import torch.multiprocessing as mp
from tiny_stages import QUIET, SILENT, TinyData, stage_module
from torch.utils.data import DataLoader

from r3dpa.data.loader_module import LoaderModule

pytestmark = [
    *QUIET,
    pytest.mark.filterwarnings("ignore:The 'val_dataloader' does not have many workers"),
]


def validated(module, data, folder):
    trainer = L.Trainer(default_root_dir=folder, **SILENT)
    return trainer.validate(module, datamodule=data, verbose=False)[0]


class HeldOut(TinyData):
    """Four scans with 128, 10, 1 and no returns, in batches of one size."""

    def __init__(self, batch_size):
        super().__init__([False, False])
        self.batch_size = batch_size
        both = {key: torch.cat([batch[key] for batch in self.batches]) for key in self.batches[0]}
        both["valid_mask"] = torch.zeros_like(both["range_image"], dtype=torch.bool)
        for scan, num_returns in enumerate((128, 10, 1, 0)):
            both["valid_mask"][scan].flatten()[:num_returns] = True
        both["index"] = torch.arange(4)
        self.whole = both
        self.scans = [{key: value[i] for key, value in both.items()} for i in range(4)]

    def val_dataloader(self):
        return DataLoader(self.scans, batch_size=self.batch_size)


@pytest.mark.parametrize("batch_size", [1, 2, 3, 4])
def test_the_error_in_metres_is_the_mean_over_pixels(batch_size, tmp_path):
    module, data = stage_module("vae_alignment"), HeldOut(batch_size)
    logged = validated(module, data, tmp_path)
    image, mask = data.whole["range_image"], data.whole["valid_mask"]
    codec = module.scan_geometry.codec
    with torch.no_grad():
        error_m = (codec.to_range(module.reconstruct(image)) - codec.to_range(image)).abs()
    assert mask.sum() == 139
    assert logged["val/range_error_m"] == pytest.approx(error_m[mask].mean().item(), rel=1e-5)


def test_a_pixel_at_infinity_does_not_count(tmp_path):
    """Decoders say anything where there is no return, and 2 to its power may overflow."""
    module, data = stage_module("vae_alignment"), HeldOut(4)
    mask = data.whole["valid_mask"]
    module.vae.image_of = lambda prediction: torch.where(mask, 0.0, torch.inf)
    assert math.isfinite(validated(module, data, tmp_path)["val/range_error_m"])


def test_the_average_is_evaluated_where_there_is_one(tmp_path):
    """By hand, with the draws of the scans."""
    module, data = stage_module("joint"), HeldOut(4)
    with torch.no_grad():
        for weight in module.ema.parameters():
            weight.mul_(1.5)
    logged = validated(module, data, tmp_path)
    draws = module.draw_held_out(torch.arange(4))
    losses = {}
    for name, networks in (("average", module.ema), ("last", module)):
        with torch.no_grad():
            raw = module.vae.encode(data.whole["range_image"]).sample(draws.posterior_noise)
            latents = networks.latent_norm.normalise(raw)
            noisy = (1 - draws.time[:, None, None, None]) * latents
            noisy = noisy + draws.time[:, None, None, None] * draws.noise
            velocity = networks.sit.velocity(noisy, draws.time)
        losses[name] = (velocity - (draws.noise - latents)).square().mean().item()
    assert logged["val/denoising"] == pytest.approx(losses["average"], rel=1e-4)
    assert losses["last"] != pytest.approx(losses["average"], rel=1e-2)


class Dealt(LoaderModule):
    """The first scans of two sets of four, dealt out to the processes."""

    geometry = TinyData.geometry

    def __init__(self, num_scans):
        super().__init__(batch_size=2, num_workers=0, seed=0)
        scans = [*HeldOut(4).scans, *reversed(HeldOut(4).scans)][:num_scans]
        self.scans = [scan | {"index": index} for index, scan in enumerate(scans)]

    def val_dataloader(self):
        return self.loader(self.scans, train=False)

    test_dataloader = val_dataloader


def evaluate(rank, num_processes, port, counts, folder):
    """Losses of ``validate`` and ``test``, in a process as Lightning's launchers start it."""
    if num_processes > 1:
        os.environ |= {"LOCAL_RANK": str(rank), "NODE_RANK": "0", "GROUP_RANK": "0"}
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    found = {}
    for count in counts:
        module = stage_module("joint")
        settings = SILENT | {"strategy": "ddp" if num_processes > 1 else "auto"}
        trainer = L.Trainer(devices=num_processes, default_root_dir=folder, **settings)
        (held_out,) = trainer.validate(module, datamodule=Dealt(count), verbose=False)
        (tested,) = trainer.test(module, datamodule=Dealt(count), verbose=False)
        found[count] = held_out | tested
    (folder / f"{num_processes}_{rank}.json").write_text(json.dumps(found))


@pytest.mark.ddp
@pytest.mark.parametrize(
    ("num_processes", "counts"),
    [
        (2, [1, 3]),  # three scans on two processes: one of them gets a scan twice
        pytest.param(2, range(1, 8), marks=pytest.mark.slow),
        pytest.param(3, range(1, 8), marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork")
@pytest.mark.numerics("uneven last batch")
def test_losses_do_not_depend_on_the_number_of_processes(
    num_processes, counts, tmp_path, one_thread
):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    evaluate(0, 1, 0, counts, tmp_path)
    arguments = (num_processes, port, counts, tmp_path)
    mp.start_processes(evaluate, arguments, nprocs=num_processes, start_method="fork")
    alone = json.loads((tmp_path / "1_0.json").read_text())
    for rank in range(num_processes):
        shared = json.loads((tmp_path / f"{num_processes}_{rank}.json").read_text())
        for count in map(str, counts):
            assert len(alone[count]) == 8
            assert shared[count] == pytest.approx(alone[count], rel=1e-6, abs=1e-6), count


def test_draws_for_held_out_scans_are_not_those_of_training():
    """Batch 3 of one sample and held-out scan 3 have the same seed and number."""
    module = stage_module("joint")
    module._trainer = SimpleNamespace(world_size=1, global_rank=0)
    held_out, training = module.draw_held_out(torch.tensor([3])), module.draw_path(1, 3)
    for name, values in held_out._asdict().items():
        assert values.shape == getattr(training, name).shape
        assert not torch.equal(values, getattr(training, name)), name


@pytest.mark.parametrize("run", ["validate", "test"])
@pytest.mark.numerics("batch norm on real and fake batches")
def test_held_out_scans_are_not_shown_to_the_discriminator(run, tmp_path):
    """Its running statistics mix scans with reconstructions, and describe neither."""
    module, data = stage_module("joint"), HeldOut(4)
    module.discriminator.forward = Mock(side_effect=AssertionError("the discriminator was called"))
    data.test_dataloader = data.val_dataloader
    trainer = L.Trainer(default_root_dir=tmp_path, **SILENT)
    assert getattr(trainer, run)(module, datamodule=data, verbose=False)
