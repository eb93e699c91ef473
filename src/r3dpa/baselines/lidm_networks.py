"""Networks of LiDM: vector-quantised autoencoder, U-Net without alignment.

Encoder, decoder and U-Net are the same as in R3DPA, which took them from LiDM. Letters: B batch,
C latent channels, H x W image size, h x w latent size.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from r3dpa.nn.layers import CircularConv2d, Float32CircularConv2d, at_least_float32, no_autocast
from r3dpa.nn.unet import UNet
from r3dpa.nn.vae import VAE, Posterior
from r3dpa.nn.velocity_network import time_frequencies

_COMMITMENT = 0.25
_LEAST_LOGVAR = -30.0


class Quantised(NamedTuple):
    """Nearest codes ``(B, C, h, w)``, their numbers ``(B, h, w)`` and the codebook loss."""

    latents: Tensor
    indices: Tensor
    loss: Tensor


class Codebook(nn.Module):
    """Vectors of which each latent pixel takes the nearest.

    Source: van den Oord et al. 2017, as in VQGAN (Esser et al. 2021).

    Args:
        num_codes: Vectors.
        channels: Their width C.
        legacy: Weigh the codes by 0.25 and the encoder by 1, as in the released training; the
            papers weigh the encoder by 0.25.
    """

    def __init__(self, num_codes: int, channels: int, legacy: bool = True) -> None:
        super().__init__()
        self.embedding = nn.Embedding(num_codes, channels)
        nn.init.uniform_(self.embedding.weight, -1 / num_codes, 1 / num_codes)
        self.legacy = legacy

    def forward(self, latents: Tensor) -> Quantised:
        """Nearest codes of ``(B, C, h, w)``; gradients pass through as if nothing had changed."""
        latents = at_least_float32(latents)
        codes = self.embedding.weight
        pixels = latents.movedim(1, -1)
        with no_autocast(latents.device):
            products = pixels @ codes.T
        distance = pixels.square().sum(-1, keepdim=True) + codes.square().sum(1) - 2 * products
        indices = distance.argmin(dim=-1)
        nearest = self.embedding(indices).movedim(-1, 1)
        to_codes = (nearest - latents.detach()).square().mean()
        to_latents = (nearest.detach() - latents).square().mean()
        weights = (_COMMITMENT, 1.0) if self.legacy else (1.0, _COMMITMENT)
        loss = weights[0] * to_codes + weights[1] * to_latents
        return Quantised(latents + (nearest - latents).detach(), indices, loss)


class VQAutoencoder(VAE):
    """First stage of LiDM, whose latents are quantised when they are decoded.

    The diffusion model works on latents before quantisation. With ``mask`` the decoder has a
    second output, below 0 where a pixel is empty.

    Source: Ran et al. (CVPR 2024). State-dict keys as in the released checkpoints.

    Args:
        num_codes: Vectors of the codebook.
        mask: Predict which pixels are empty.
        channels: Base width.
        legacy_upsample: Interpolation of the released weights, see :class:`r3dpa.nn.VAE`.
        legacy_codebook: See :class:`Codebook`.
        z_channels: Channels of the encoder's output and the decoder's input, as LiDM names them;
            None for as many as the latents and codes have.
        **sizes: Further arguments of :class:`r3dpa.nn.VAE`.
    """

    def __init__(
        self,
        num_codes: int = 16384,
        mask: bool = False,
        channels: int = 64,
        legacy_upsample: bool = True,
        legacy_codebook: bool = True,
        z_channels: int | None = None,
        **sizes: Any,
    ) -> None:
        super().__init__(channels=channels, legacy_upsample=legacy_upsample, **sizes)
        width = self.latent_channels
        outside = z_channels or width
        deepest = self.encoder.get_parameter("conv_out.weight").shape[1]
        self.encoder.conv_out = CircularConv2d(deepest, outside, (3, 3))
        self.quant_conv = nn.Conv2d(outside, width, 1)
        if outside != width:
            self.post_quant_conv = nn.Conv2d(width, outside, 1)
            deepest = len(self.decoder.get_parameter("conv_in.weight"))
            self.decoder.conv_in = CircularConv2d(outside, deepest, (3, 3))
        self.quantize = Codebook(num_codes, width, legacy_codebook)
        self.mask = mask
        if mask:
            self.decoder.conv_out = Float32CircularConv2d(channels, 2, (1, 4))

    def encode(self, image: Tensor) -> Posterior:
        """Latents ``(B, C, h, w)`` of images ``(B, 1, H, W)`` in [-1, 1], with next to no variance.

        They are not quantised: that is part of :meth:`decode`.
        """
        self.latent_size((image.shape[-2], image.shape[-1]))
        latents = self.quant_conv(self.encoder(image))
        return Posterior(torch.cat([latents, torch.full_like(latents, _LEAST_LOGVAR)], dim=1))

    def image_of(self, prediction: Tensor) -> Tensor:
        """Images ``(B, 1, H, W)``, -1 where the second channel, if there is one, is below 0."""
        image, *masks = prediction.split(1, dim=1)
        return torch.where(masks[0] < 0, -1.0, image) if masks else image

    def decode(self, latents: Tensor) -> Tensor:
        """Images ``(B, 1, H, W)`` of latents ``(B, C, h, w)``, which are quantised first."""
        return self.image_of(self.predict(self.quantize(latents).latents))


class LiDMUNet(UNet):
    """U-Net of LiDM, which predicts noise: :class:`r3dpa.nn.UNet` without classes and alignment.

    Args:
        position_bias: Learned bias on every latent pixel (APE); the released network has none.
        **sizes: Arguments of :class:`r3dpa.nn.UNet`.
    """

    def __init__(self, position_bias: bool = False, **sizes: Any) -> None:
        super().__init__(feature_dim=1, projector_dim=1, **sizes)
        del self.projector, self.label_emb
        if not position_bias:
            self.ape = nn.Identity()

    def modulations(self, time: Tensor, labels: Tensor | None = None) -> Tensor:
        """Embeddings ``(T, E)`` of steps ``(T,)``, 0 to 999 and unscaled."""
        return self.time_embed(time_frequencies(at_least_float32(time), self.channels))

    def forward(  # type: ignore[override]
        self, latents: Tensor, time: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        """Noise ``(B, C, h, w)`` in latents of that shape at steps ``(B,)``."""
        return self.velocity(latents, time)
