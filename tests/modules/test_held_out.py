"""What is logged of held-out scans does not depend on how they were put into batches."""

from __future__ import annotations

import lightning as L
import pytest
import torch
from tiny_stages import QUIET, TinyData, stage_module
from torch.utils.data import DataLoader

pytestmark = [
    *QUIET,
    pytest.mark.filterwarnings("ignore:The 'val_dataloader' does not have many workers"),
]


SILENT = {
    "enable_checkpointing": False,
    "enable_progress_bar": False,
    "enable_model_summary": False,
}


class HeldOut(TinyData):
    """Four scans with 128, 10, 1 and no returns, in batches of one size."""

    def __init__(self, batch_size):
        super().__init__([False, False])
        self.batch_size = batch_size
        both = {key: torch.cat([batch[key] for batch in self.batches]) for key in self.batches[0]}
        both["valid_mask"] = torch.zeros_like(both["range_image"], dtype=torch.bool)
        for scan, num_returns in enumerate((128, 10, 1, 0)):
            both["valid_mask"][scan].flatten()[:num_returns] = True
        self.whole = both
        self.scans = [{key: value[i] for key, value in both.items()} for i in range(4)]

    def val_dataloader(self):
        return DataLoader(self.scans, batch_size=self.batch_size)


@pytest.mark.parametrize("batch_size", [1, 2, 3, 4])
def test_the_error_in_metres_is_the_mean_over_pixels(batch_size, tmp_path):
    module, data = stage_module("vae_alignment"), HeldOut(batch_size)
    trainer = L.Trainer(accelerator="cpu", logger=False, default_root_dir=tmp_path, **SILENT)
    (logged,) = trainer.validate(module, datamodule=data, verbose=False)
    image, mask = data.whole["range_image"], data.whole["valid_mask"]
    codec = module.scan_geometry.codec
    with torch.no_grad():
        error_m = (codec.to_range(module.reconstruct(image)) - codec.to_range(image)).abs()
    assert mask.sum() == 139
    assert logged["val/range_error_m"] == pytest.approx(error_m[mask].mean().item(), rel=1e-5)


def test_the_average_is_evaluated_where_there_is_one(tmp_path):
    """By hand, with the draws of the first validation batch."""
    module, data = stage_module("joint"), HeldOut(4)
    with torch.no_grad():
        for weight in module.ema.parameters():
            weight.mul_(1.5)
    trainer = L.Trainer(accelerator="cpu", logger=False, default_root_dir=tmp_path, **SILENT)
    (logged,) = trainer.validate(module, datamodule=data, verbose=False)
    draws = module.draw_path(4, 0, stream=1)
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
