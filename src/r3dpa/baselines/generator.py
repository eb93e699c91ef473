"""From noise to scenes with a baseline, with the interface of :class:`r3dpa.SceneGenerator`."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.flow.noise import scene_noise
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.generation import check_precision, pad_batch, scene_indices
from r3dpa.geometry import ScanGeometry
from r3dpa.scenes import SceneBatch

FULL_SCALE = 1 - 1e-6  # of images: a saturated pixel is a return just below the largest range


class BaselineGenerator:
    """Draws scenes from a baseline.

    The random numbers of a scene are a function of (seed, index) alone and are drawn on the CPU,
    as in :class:`r3dpa.SceneGenerator`.

    Args:
        baseline: Module that knows path, velocity and decoder, see
            :class:`r3dpa.baselines.base.Baseline`.
        network: Its network with the weights to sample from, averaged ones as a rule.
        geometry: Projection and range encoding of the training data.
        sampler: Solver and steps.
        precision: ``bf16`` runs the network under autocast; state and solver stay float32.
        batch_size: Pad smaller batches with zeros, so that the network sees a single shape.
        compile: Compile the network. Needs ``batch_size``.
    """

    def __init__(
        self,
        baseline: Any,
        network: nn.Module,
        geometry: ScanGeometry,
        sampler: SamplerConfig,
        precision: Literal["fp32", "bf16"] = "fp32",
        *,
        batch_size: int | None = None,
        compile: bool = False,
    ) -> None:
        check_precision(precision)
        if compile and batch_size is None:
            raise ValueError("compiled networks have one shape: give the generator a batch_size")
        self.baseline, self.network = baseline, network.eval()
        self.geometry, self.sampler, self.precision = geometry, sampler, precision
        self.batch_size, self.calls = batch_size, 0
        self._called: Any = torch.compile(network, dynamic=False) if compile else network

    @property
    def device(self) -> torch.device:
        """Device of the network."""
        return next(self.network.parameters()).device

    def with_sampler(self, sampler: SamplerConfig) -> BaselineGenerator:
        """Return a generator of the same network with another solver."""
        other = copy.copy(self)
        other.sampler = sampler
        return other

    def prepare(self) -> None:
        """Do nothing: the first scene takes as long as the others."""

    def velocity(self, x: Tensor, time: Tensor) -> Tensor:
        """Velocity ``(B, C, h, w)`` at times ``(B,)``, in the dtype of ``x``."""
        self.calls += 1
        half = self.precision == "bf16"
        with torch.autocast(x.device.type, torch.bfloat16, enabled=half):
            velocity = self.baseline.velocity(self._called, x.float(), time.float())
        return velocity.to(x.dtype)

    @torch.no_grad()
    def generate(self, indices: int | Sequence[int], seed: int = 0) -> SceneBatch:
        """Draw one scene per index; arguments as of :meth:`r3dpa.SceneGenerator.generate`."""
        indices = scene_indices(indices)
        size = self.batch_size or len(indices)
        if len(indices) > size:
            raise ValueError(f"batch_size is {size}, but {len(indices)} scenes are requested")
        self.calls = 0
        noises = scene_noise(self.baseline.latent_shape, indices, seed)
        draws = (pad_batch(noise, size).to(self.device) for noise in noises)
        path = self.baseline.interpolant
        latents = self.sampler.solve(self.velocity, next(draws), draws, path)[: len(indices)]
        return self._scenes(latents)

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Range images ``(B, H, W)``, metres, as in :class:`r3dpa.SceneBatch`, of samples."""
        return self._scenes(latents).range_m

    def _scenes(self, latents: Tensor) -> SceneBatch:
        image = self.baseline.decode(latents).float()
        finite = image.flatten(1).isfinite().all(dim=1)[:, None, None]
        image = image.clamp(-1, FULL_SCALE)
        projection, codec = self.geometry.projection, self.geometry.codec
        range_m = torch.where(finite, codec.ranges_of(image, projection.sensor), torch.nan)
        intensity = (image[:, 1] + 1) / 2 if codec.reflectance else None
        return SceneBatch(range_m, latents, self.calls, projection, intensity)

    @torch.no_grad()
    def complete(
        self,
        image: Tensor,
        known: Tensor,
        indices: int | Sequence[int] = 1,
        seed: int = 0,
        *,
        resamplings: int = 10,
    ) -> SceneBatch:
        """Complete an encoded range image ``(C, H, W)``, once per index.

        Pixels that are True in ``known`` ``(H, W)`` are kept. ``resamplings`` goes to
        :func:`~r3dpa.baselines.diffusion_paths.repaint`, with the steps of the sampler. Latents
        are completed without resampling, see :func:`~r3dpa.baselines.diffusion_paths.inpaint`.
        ``ValueError`` as of :meth:`known_latents`.
        """
        self.calls = 0
        baseline, mask = self.baseline, self.known_latents(known).to(self.device)
        indices = scene_indices(indices)
        noises = scene_noise(baseline.latent_shape, indices, seed)
        draws = (noise.to(self.device) for noise in noises)
        data = baseline.encode(image.to(self.device)[None]).expand(len(indices), -1, -1, -1)
        samples = baseline.complete(self.velocity, data, mask, draws, self.sampler, resamplings)
        return self._scenes(samples)

    def known_latents(self, known: Tensor) -> Tensor:
        """Mask ``(1, 1, h, w)`` float32, 1 where all pixels of a latent are known ``(H, W)``.

        Raises:
            ValueError: If pixels are known, but no latent.
        """
        size = self.baseline.latent_shape[1:]
        mask = -F.adaptive_max_pool2d(-known[None, None].float(), size)
        if known.any() and not mask.any():
            rows, columns = known.shape[0] // size[0], known.shape[1] // size[1]
            raise ValueError(
                f"stage {self.baseline.stage} would read nothing of the scan: it knows blocks of "
                f"{rows} x {columns} pixels, and in each of them some are missing; leave whole "
                "blocks, as a sector does, or complete with weights of another stage"
            )
        return mask

    def noise(self, indices: Sequence[int], seed: int = 0) -> Tensor:
        """First noise ``(B, C, h, w)`` of scenes, on the device of the network."""
        return next(scene_noise(self.baseline.latent_shape, indices, seed)).to(self.device)
