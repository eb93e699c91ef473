"""Cached posteriors are found again by whatever they depend on, and by nothing else."""

from __future__ import annotations

from contextlib import suppress
from types import SimpleNamespace

import pytest
import torch
from tiny_stages import TinyData, stage_module

from r3dpa.data.posterior_cache import cache_posteriors, fill_cache
from r3dpa.data.store import StoreError, tensor_cache
from r3dpa.modules import FlowMatching, flow_matching


class Images(list):
    """Items with an index and an image, as the loader reads them."""

    def __getitem__(self, index):
        item = super().__getitem__(index)
        image = torch.full((1, 8, 16), float(item.name))
        return {"index": index, "image": image}


def items(mtime_ns=7):
    return [SimpleNamespace(name=str(n), cache_key=(str(n), 160, mtime_ns)) for n in range(3)]


@pytest.fixture
def encode(tmp_path):
    """``encode(vae, settings, items)``: what the cache holds, and its number of folders."""
    loaders = SimpleNamespace(batch_size=2, num_workers=0, prepare_data_per_node=False)
    strategy = SimpleNamespace(barrier=lambda _: None)
    trainer = SimpleNamespace(
        datamodule=loaders, strategy=strategy, global_rank=0, world_size=1, num_devices=1
    )
    module = SimpleNamespace(
        trainer=trainer,
        device=torch.device("cpu"),
        latent_shape=(4, 4, 8),
        latents_dir=str(tmp_path),
    )

    def run(vae, settings, given):
        module.vae = vae
        cached = cache_posteriors(module, settings, given, Images, "image")
        rows = list(tmp_path.glob("*/*.rows"))
        return torch.stack([cached.read(item) for item in given]), len(rows)

    return run


def test_the_key_knows_weights_settings_and_files(encode):
    vae = stage_module("vae_alignment").vae
    first, rows = encode(vae, {"codec": "log2"}, items())
    image = torch.stack([sample["image"] for sample in (Images(items())[n] for n in range(3))])
    with torch.no_grad():
        posterior = vae.encode(image)
    expected = torch.cat([posterior.mean, posterior.logvar], dim=1)
    torch.testing.assert_close(first, expected, atol=1e-5, rtol=1e-5)
    assert encode(vae, {"codec": "log2"}, items())[1] == rows == 1
    assert encode(vae, {"codec": "linear"}, items())[1] == 2
    with torch.no_grad():
        vae.quant_conv.weight.mul_(2)
    second, rows = encode(vae, {"codec": "log2"}, items())
    assert rows == 3
    assert not torch.allclose(second, first)
    assert encode(vae, {"codec": "log2"}, items(mtime_ns=8))[1] == 4


def test_posteriors_of_scans_depend_on_projection_and_codec(monkeypatch, tmp_path):
    found = []
    monkeypatch.setattr(flow_matching, "cache_posteriors", lambda *args: found.append(args))
    module = stage_module("flow_matching", cache_latents=True)
    module.geometry = TinyData.geometry
    data = SimpleNamespace(train_set=SimpleNamespace(scans=[]), use_posteriors=lambda _: None)
    module._trainer = SimpleNamespace(
        datamodule=data, default_root_dir=tmp_path, fast_dev_run=False
    )
    FlowMatching.on_fit_start(module)
    ((_, settings, *_),) = found
    geometry = TinyData.geometry.to_dict()
    assert settings == {"projection": geometry["projection"], "codec": geometry["codec"]}


def test_processes_make_all_that_another_job_does_not(tmp_path):
    """It adds an item between the looks of two processes, which then see different ones missing."""
    cache, given = tensor_cache(tmp_path, "numbers", {}, (1,)), items()

    def rows(some):
        yield from (torch.tensor([[float(item.name)]]) for item in some)

    def fill(rank, at_barrier):
        loaders = SimpleNamespace(prepare_data_per_node=False)
        strategy = SimpleNamespace(barrier=lambda _: next(at_barrier, lambda: None)())
        trainer = SimpleNamespace(
            datamodule=loaders, strategy=strategy, global_rank=rank, world_size=2
        )
        return fill_cache(trainer, cache, given, rows)

    def second_process():
        with cache.writer(9) as writer:  # the other job
            writer.add([given[0].cache_key], torch.zeros(1, 1))
        with suppress(StoreError):  # where it is called before the first has written
            fill(1, iter(()))

    fill(0, iter([second_process]))
    assert not cache.missing(given)
