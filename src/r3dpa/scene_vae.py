"""The VAE of a checkpoint alone: scans to latents and back."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from r3dpa.checkpoints import Checkpoint
from r3dpa.generation import SceneBatch, geometry_of, opened
from r3dpa.geometry import ScanGeometry, range_image
from r3dpa.io import usable_device
from r3dpa.nn import VAE


class SceneVAE:
    """Scans to raw latents and back, with the VAE and the geometry of a checkpoint of any stage.

    Args:
        vae: Encoder and decoder.
        geometry: Projection and range encoding of its training data.

    Example:
        >>> vae = SceneVAE.from_checkpoint("last.ckpt")  # doctest: +SKIP
        >>> latents = vae.encode(read_scan("scan.bin"))  # doctest: +SKIP
        >>> points = vae.decode(latents).points(0)  # doctest: +SKIP
    """

    def __init__(self, vae: VAE, geometry: ScanGeometry) -> None:
        self.vae, self.geometry = vae.eval(), geometry

    @classmethod
    def from_checkpoint(cls, checkpoint: str | Path | Checkpoint, device: str = "auto") -> Self:
        """Rebuilds the VAE of a checkpoint.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it cannot be read, or holds no range-image VAE or no scan geometry.
        """
        checkpoint = opened(checkpoint)
        vae = checkpoint.network("vae").build().to(usable_device(device))
        if not isinstance(vae, VAE):
            kind = type(vae).__name__
            raise ValueError(f"{checkpoint.path} holds a {kind} for a range-image VAE")
        return cls(vae, geometry_of(checkpoint))

    from_pretrained = from_checkpoint  # names of `r3dpa models`

    @torch.no_grad()
    def encode(self, points: Tensor | np.ndarray) -> Tensor:
        """Posterior means ``(1, C, h, w)`` of one scan ``(P, 3)`` or ``(P, 4)`` in metres."""
        xyz = torch.as_tensor(points)[:, :3].float()
        range_m = range_image(xyz, self.geometry.projection)[0]
        image = self.geometry.codec.to_image(range_m.to(next(self.vae.parameters()).device))
        return self.vae.encode(image[None]).mean

    @torch.no_grad()
    def decode(self, latents: Tensor) -> SceneBatch:
        """Scenes of raw latents ``(B, C, h, w)``."""
        projection = self.geometry.projection
        image = self.vae.decode(latents).float()
        range_m = self.geometry.codec.ranges_of(image, projection.sensor)
        return SceneBatch(range_m, latents, 0, projection)
