import pytest
import torch
from tiny_stages import QUIET, TinyData, stage_module

from r3dpa.flow import average_times
from r3dpa.modules.steps import PathDraws

pytestmark = QUIET


@pytest.mark.parametrize("time", [0.0, 0.5, 0.99])
def test_the_velocity_of_straight_paths_is_their_average(time):
    """Points t * noise move by noise between any two times: predicting it costs nothing."""
    module, logged = stage_module("few_step"), {}
    module.on_fit_start()
    noise = torch.randn(2, 4, 4, 8)
    points = noise[:, None] * average_times(8).to(noise)[:, None, None, None]
    draws = PathDraws(torch.zeros_like(noise), torch.full((2,), time), points)
    module.draw_path, module.log_dict = lambda *_: draws, logged.update
    module.sit.average_velocity = lambda x, start, end: noise
    module.training_step(TinyData().batches[0], 0)
    assert logged["train/denoising"] < 1e-9
    module.sit.average_velocity = lambda x, start, end: 0 * noise
    module.training_step(TinyData().batches[0], 0)
    torch.testing.assert_close(logged["train/denoising"], noise.square().mean())
