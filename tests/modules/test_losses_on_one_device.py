"""Losses of the stages never wait for a GPU and never mix devices.

``nn/test_one_device.py`` tests that :class:`OneDevice` finds both faults.
"""

from __future__ import annotations

import pytest
import torch
from one_device import OneDevice
from tiny_stages import QUIET, STAGES, stage_module

from r3dpa.modules.stage import PathDraws

pytestmark = QUIET


def step(module, **more):
    """Loss of a training step with draws and batch without values."""
    module.on_fit_start()

    def values(*shape):
        return torch.empty(shape, device="meta")

    latents = (2, 4, 4, 8)
    noise = (2, 9, 4, 4, 8) if module.stage == "few_step" else latents
    draws, logged = PathDraws(values(*latents), values(2), values(*noise)), {}
    module.draw_path, module.log_dict = lambda *_: draws, logged.update
    batch = {"range_image": values(2, 1, 8, 16), "feature_grid": values(2, 8, 6)}
    batch |= {name: values(*shape) for name, shape in more.items()}
    loss = module.training_step(batch, 0)
    assert {value.device.type for value in (loss, *logged.values())} == {"meta"}
    assert "train/loss" in logged
    return loss


@pytest.mark.parametrize("stage", [*STAGES, "cached"])
def test_losses_and_gradients_on_one_device(stage):
    module = stage_module("flow_matching" if stage == "cached" else stage).to("meta")
    more = {"posterior_moments": (2, 8, 4, 8)} if stage == "cached" else {}
    with OneDevice():
        step(module, **more).backward()
    trained = [p for n in module.trainable().values() for p in n.parameters() if p.requires_grad]
    assert all(parameter.grad is not None for parameter in trained)
