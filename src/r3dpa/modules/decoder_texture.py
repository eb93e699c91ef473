"""Stage of the texture of a decoder: images that differ as the scans of equal latents do.

Letters: B batch, C channels, H x W image size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Self, cast

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from r3dpa.data.datasets import LidarBatch
from r3dpa.flow.noise import random_generator, scene_normal
from r3dpa.losses import energy_score
from r3dpa.modules.stage import PathDraws
from r3dpa.modules.vae_alignment import VAEAlignment
from r3dpa.nn import VAE, VelocityNetwork
from r3dpa.nn.layers import at_least_float32

# Encoded ranges from which on differences count by their logarithm: .005 is 1 % in log2.
_FROM_LIKELIER, _ALONG_RINGS, _ACROSS_RINGS, _BENDS = 0.01, 0.005, 0.005, 0.003
_PATCH, _PATTERN = (2, 8), (1, 4)  # rows and columns
_WEIGHTS = {
    "ranges": 1.0,
    "returns": 2.0,
    "intensity": 2.0,
    "along_rings_1": 0.25,
    "along_rings_2": 0.25,
    "along_rings_4": 0.25,
    "along_rings_8": 0.25,
    "across_rings_1": 0.5,
    "across_rings_2": 0.5,
    "bends": 1.0,
    "intensity_along_rings": 2.0,
    "intensity_across_rings": 2.0,
    "patches": 0.125,
    "patterns": 0.5,
    "near_means": 0.5,
    "far_means": 0.5,
    "near_returns": 2.0,
    "far_returns": 2.0,
}
_NEAR, _FAR = (4, 16), (8, 64)  # rows and columns of areas
_LEAST_RETURNS = 0.1  # share of an area whose ranges are compared


class DecoderTexture(VAEAlignment):
    """Training of the texture of a VAE; all other weights stay as they are.

    Two images are drawn from the decoded latents of each scan, and compared with the scan by the
    energy score of several views of them: single pixels, differences to neighbours along and
    across rings, patches, and means over areas. The score of each view is proper: it is smallest
    where images are spread as the scans with these latents are.

    Source: energy score: Gneiting and Raftery, "Strictly proper scoring rules, prediction, and
    estimation" (JASA 2007); networks trained by it with two draws: Shen and Meinshausen,
    "Engression" (JRSS B 2025).

    Args:
        vae: Range-image autoencoder with a texture.
        sit: Velocity network; takes no part.
        **kwargs: See :class:`GenerativeModule`. Of the loss weights ``texture`` counts.
    """

    stage = "decoder_texture"
    default_init: tuple[str, ...] = ("vae", "latent_norm")

    def __init__(self, vae: VAE, sit: VelocityNetwork, **kwargs: Any) -> None:
        if not vae.texture:
            raise ValueError(
                "there is no texture to train: set --model.init_args.vae.init_args.texture to its "
                "number of channels, such as 16"
            )
        super().__init__(vae, sit, train_encoder=False, **kwargs)
        self.vae.requires_grad_(False)
        self.texture.requires_grad_(True)

    @property
    def texture(self) -> nn.Module:
        """The network that is trained."""
        return cast(nn.Module, self.vae.decoder.further_texture)

    def train(self, mode: bool = True) -> Self:
        """Keep the VAE in evaluation mode: in training it decodes leaves otherwise."""
        super().train(mode)
        self.vae.eval()
        return self

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on range images ``(B, C, H, W)``."""
        image = batch["range_image"]
        draws = self.draw_path(len(image))
        with torch.no_grad():
            latents = self.vae.encode(image).sample(draws.posterior_noise)
            prediction = self.vae.predict(self.decoder_latents(latents, draws))
        scores = self.texture_scores(image, prediction, self._noise(image))
        self.log_dict({f"train/{name}": score.mean().detach() for name, score in scores.items()})
        return self.weigh_and_log({"texture": self.weights.texture * _total(scores).mean()})

    def held_out_errors(
        self, batch: LidarBatch, prediction: Tensor, latents: Tensor, draws: PathDraws
    ) -> dict[str, Tensor | tuple[Tensor, Tensor]]:
        """Energy score ``(B,)`` of two draws, on latents without noise."""
        image = batch["range_image"]
        size = self.vae.noise_size((image.shape[2], image.shape[3]))
        noise = [
            scene_normal((2, size), [number], self.seed).to(image)
            for number in batch["index"].tolist()
        ]
        scores = self.texture_scores(image, prediction, torch.cat(noise).unbind(dim=1))
        return {"texture": _total(scores)}

    def texture_scores(
        self, image: Tensor, prediction: Tensor, noises: Sequence[Tensor]
    ) -> dict[str, Tensor]:
        """Energy scores ``(B,)`` of each view of two draws, by its name.

        Args:
            image: ``(B, C, H, W)`` scans.
            prediction: ``(B, 22, H, W)`` outputs of the decoder for their latents.
            noises: Noise ``(B, n)`` of each draw.
        """
        prediction = at_least_float32(prediction)
        likelier = self.vae.image_of(prediction)[:, :1]
        returns = image[:, 1:2] > 0
        first, second = (
            views_of(self.texture(prediction, likelier, noise), likelier, returns)
            for noise in noises
        )
        certain = torch.where(returns, torch.inf, -torch.inf)
        scan = torch.cat([image[:, :1], certain, image[:, 2:3]], dim=1)
        target, masks = views_of(scan, likelier, returns), masks_of(returns)
        return {
            name: energy_score(first[name], second[name], target[name], masks[name])
            for name in _WEIGHTS
        }

    def _noise(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Noise ``(B, n)`` of both draws for this process's part of a batch of images."""
        world, rank = self.trainer.world_size, self.trainer.global_rank
        size = self.vae.noise_size((image.shape[2], image.shape[3]))
        generator = random_generator([self.seed, 2, self.batch_number], self.device, bits=32)
        shape = (2, len(image) * world, size)
        first, second = torch.randn(shape, generator=generator, device=self.device)
        return first[rank::world], second[rank::world]


def _total(scores: Mapping[str, Tensor]) -> Tensor:
    return torch.stack([_WEIGHTS[name] * score for name, score in scores.items()]).sum(dim=0)


def views_of(image: Tensor, likelier: Tensor, returns: Tensor) -> dict[str, Tensor]:
    """Views ``(B, ..., ..., ...)`` of an image that are compared, by their name.

    Args:
        image: ``(B, 3 or more, H, W)`` encoded range, logit of a return, encoded intensity.
        likelier: ``(B, 1, H, W)`` encoded ranges without noise.
        returns: ``(B, 1, H, W)`` where the scan has a return.
    """
    ranges, chance, intensity = image[:, :1], image[:, 1:2].sigmoid(), image[:, 2:3]
    moved = torch.asinh((ranges - likelier) / _FROM_LIKELIER)
    seen = torch.where(returns, moved, 0.0)
    views = {"ranges": moved, "returns": chance, "intensity": intensity}
    for columns in (1, 2, 4, 8):
        difference = ranges - ranges.roll(columns, -1)
        views[f"along_rings_{columns}"] = torch.asinh(difference / _ALONG_RINGS)
    for rows in (1, 2):
        difference = ranges - ranges.roll(rows, -2)
        views[f"across_rings_{rows}"] = torch.asinh(difference / _ACROSS_RINGS)
    bend = ranges.roll(1, -1) + ranges.roll(-1, -1) - 2 * ranges
    views["bends"] = torch.asinh(bend / _BENDS)
    views["intensity_along_rings"] = intensity - intensity.roll(1, -1)
    views["intensity_across_rings"] = intensity - intensity.roll(1, -2)
    views["patches"] = _folded(torch.cat([seen, 2 * chance], dim=1), _PATCH)
    views["patterns"] = _folded(chance, _PATTERN)
    for name, area in (("near", _NEAR), ("far", _FAR)):
        share = _pooled(returns.float(), area)
        views[f"{name}_means"] = _pooled(seen, area) / share.clamp(min=_LEAST_RETURNS)
        views[f"{name}_returns"] = _pooled(chance, area)
    return views


def masks_of(returns: Tensor) -> dict[str, Tensor]:
    """Where each view counts, bool, of returns ``(B, 1, H, W)`` of the scan."""
    masks = {"ranges": returns, "intensity": returns, "returns": torch.ones_like(returns)}
    for columns in (1, 2, 4, 8):
        masks[f"along_rings_{columns}"] = returns & returns.roll(columns, -1)
    for rows in (1, 2):
        above = returns.roll(rows, -2)
        above[:, :, :rows] = False
        masks[f"across_rings_{rows}"] = returns & above
    masks["bends"] = returns & returns.roll(1, -1) & returns.roll(-1, -1)
    masks["intensity_along_rings"] = masks["along_rings_1"]
    masks["intensity_across_rings"] = masks["across_rings_1"]
    masks["patches"] = _folded(torch.cat([returns, torch.ones_like(returns)], dim=1), _PATCH)
    masks["patterns"] = _folded(torch.ones_like(returns), _PATTERN)
    for name, area in (("near", _NEAR), ("far", _FAR)):
        share = _pooled(returns.float(), area)
        masks[f"{name}_means"] = share >= _LEAST_RETURNS
        masks[f"{name}_returns"] = torch.ones_like(masks[f"{name}_means"])
    return masks


def _pooled(image: Tensor, area: tuple[int, int]) -> Tensor:
    """Means over areas of an image ``(B, C, H, W)``, no larger than the image."""
    rows, columns = image.shape[-2:]
    return F.avg_pool2d(image, (min(area[0], rows), min(area[1], columns)))


def _folded(image: Tensor, patch: tuple[int, int]) -> Tensor:
    """Patches of an image ``(B, C, H, W)`` as vectors ``(B, C p q, H / p, W / q)``."""
    return rearrange(image, "B C (h p) (w q) -> B (C p q) h w", p=patch[0], q=patch[1])
