"""The VAE of a checkpoint alone: scans to latents and back."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from r3dpa.checkpoints import Checkpoint
from r3dpa.generation import geometry_of, open_checkpoint
from r3dpa.geometry import ScanGeometry
from r3dpa.io import usable_device
from r3dpa.nn import VAE
from r3dpa.scenes import (
    ScanLike,
    SceneBatch,
    clamp_intensities,
    scan_pixels,
    with_unknown_intensity,
)


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
        self.vae = vae.eval()
        self.geometry = geometry

    def __repr__(self) -> str:
        sensor = self.geometry.projection.sensor
        rows, columns = self.vae.latent_size((sensor.beams, sensor.columns))
        return (
            f"SceneVAE({sensor.beams} x {sensor.columns} pixels, latents "
            f"{self.vae.latent_channels} x {rows} x {columns}, {self.device})"
        )

    @property
    def device(self) -> torch.device:
        """Device of the VAE."""
        return next(self.vae.parameters()).device

    def to(self, device: str | torch.device) -> Self:
        """Move the VAE, and return the object itself."""
        self.vae.to(usable_device(str(device)))
        return self

    @classmethod
    def from_checkpoint(cls, checkpoint: str | Path | Checkpoint, device: str = "auto") -> Self:
        """Rebuild the VAE of a checkpoint.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it cannot be read, or holds no range-image VAE or no scan geometry.
        """
        checkpoint = open_checkpoint(checkpoint)
        vae = checkpoint.network("vae").build().to(usable_device(device))
        if not isinstance(vae, VAE):
            kind = type(vae).__name__
            raise ValueError(f"{checkpoint.path} holds a {kind} for a range-image VAE")
        return cls(vae, geometry_of(checkpoint))

    from_pretrained = from_checkpoint  # names of `r3dpa models`

    @torch.no_grad()
    def encode(self, scan: ScanLike, labels: ArrayLike | None = None) -> Tensor:
        """Posterior means ``(1, C, h, w)`` of one scan.

        Args:
            scan: Points ``(P, 3)`` in metres, or ``(P, 4)`` with the intensity, or another
                :data:`r3dpa.scenes.ScanLike`.
            labels: ``(P,)`` KITTI-360 class in the lower 16 bits, for a VAE of classes, unless the
                scan has them. A VAE that encodes intensity or class sees 0 and no class where a
                scan has none, which it knows if it was trained with ``further_dropout``.

        Raises:
            ValueError: As :func:`r3dpa.scenes.scan_pixels`, and if the VAE encodes intensities and
                more than 0.1 % of them are above 1.
        """
        pixels = scan_pixels(scan, self.geometry.projection, labels)
        codec = self.vae.codec_of_input(self.geometry.codec)
        pixels = with_unknown_intensity(clamp_intensities(pixels, codec), codec)
        image = codec.to_image(*pixels).to(self.device)
        return self.vae.encode(image[None]).mean

    @torch.no_grad()
    def decode(self, latents: Tensor | np.ndarray) -> SceneBatch:
        """Scenes of raw latents ``(B, C, h, w)``, with what the VAE has of intensity and labels.

        Raises:
            ValueError: If the latents do not have the shape of the VAE's latents.
        """
        projection = self.geometry.projection
        sensor = projection.sensor
        size = self.vae.latent_channels, *self.vae.latent_size((sensor.beams, sensor.columns))
        weight = next(self.vae.parameters())
        latents = torch.as_tensor(latents, dtype=weight.dtype, device=weight.device)
        if latents.ndim != 4 or latents.shape[1:] != size:
            sizes = ", ".join(map(str, size))
            raise ValueError(f"latents must have shape (B, {sizes}), got {tuple(latents.shape)}")
        image = self.vae.decode(latents).float()
        pixels = self.geometry.codec.pixels_of(image, projection.sensor)
        finite = image.flatten(1).isfinite().all(dim=1)[:, None, None]
        pixels = pixels._replace(range_m=torch.where(finite, pixels.range_m, torch.nan))
        return SceneBatch.of(pixels, latents, 0, projection)
