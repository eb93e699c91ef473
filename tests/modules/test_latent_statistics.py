"""Statistics of the latents in a training step."""

from __future__ import annotations

import pytest
import torch
from tiny_stages import QUIET, TinyData, stage_module, train
from torch import nn

pytestmark = QUIET


@pytest.mark.parametrize("stage", ["joint", "vae_alignment"])
@pytest.mark.numerics("statistics updated twice in a step")
def test_a_step_updates_the_latent_statistics_once(stage):
    """Both passes see the latents; after two steps the count is 2, the momentum applied twice."""
    module, seen = stage_module(stage), []
    update = module.latent_norm.update
    module.latent_norm.update = lambda latents: (seen.append(latents.clone()), update(latents))[1]
    train(module, TinyData([False] * 2))
    assert module.latent_norm.num_batches_tracked == len(seen) == 2
    once, twice = nn.BatchNorm2d(4), nn.BatchNorm2d(4)
    for latents in seen:
        once(latents)
        twice(latents)
        twice(latents)
    torch.testing.assert_close(module.latent_norm.running_var, once.running_var)
    assert ((twice.running_var - once.running_var) / once.running_var).abs().max() > 0.03


@pytest.mark.numerics("batch of one")
def test_a_batch_of_one_scan_trains():
    data = TinyData()
    data.batches = [{key: value[:1] for key, value in data.batches[0].items()}]
    module = train(stage_module("joint"), data)
    assert module.latent_norm.num_batches_tracked == 1
    assert all(value.isfinite().all() for value in module.state_dict().values())
