"""Variational autoencoder of range images, and the posterior of its latents.

Letters: B batch, C latent channels, H x W image size, h x w latent size.
"""

from __future__ import annotations

import math
from typing import Any, Literal, Self, cast

import torch
from torch import Tensor, nn

from r3dpa.geometry import NUM_CLASSES, RangeCodec
from r3dpa.nn.encoder_decoder import LOGIT_GAIN, Decoder, Encoder
from r3dpa.nn.layers import Float32CircularConv2d, Size, at_least_float32
from r3dpa.nn.pixel_outputs import PixelOutputs, RangeMixture, clean_image
from r3dpa.nn.refinement import Refinement


class _StraightThroughClamp(torch.autograd.Function):
    """Clamp with the identity as gradient, so that a value outside can return."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, low: float, high: float) -> Tensor:
        return values.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return gradient, None, None


class Posterior:
    """Diagonal Gaussian over the raw latents of each image, in float32.

    The log-variance is clamped to [-30, 20] with a straight-through gradient: with the plain clamp
    of the official code a value outside would stay there for ever.

    Args:
        moments: ``(B, 2C, h, w)`` means, then log-variances.

    Attributes:
        mean: ``(B, C, h, w)``.
        logvar: ``(B, C, h, w)`` natural logarithm of the variance, in [-30, 20].
        std: ``(B, C, h, w)`` standard deviation.

    Example:
        >>> posterior = Posterior(torch.zeros(1, 16, 4, 8))  # means 0, variances 1
        >>> posterior.kl().item(), tuple(posterior.sample(torch.randn(1, 8, 4, 8)).shape)
        (0.0, (1, 8, 4, 8))
    """

    def __init__(self, moments: Tensor) -> None:
        self.mean, logvar = at_least_float32(moments).chunk(2, dim=1)
        self.logvar: Tensor = _StraightThroughClamp.apply(logvar, -30.0, 20.0)
        self.std = torch.exp(0.5 * self.logvar)

    def sample(self, noise: Tensor) -> Tensor:
        """Raw latents ``mean + std * noise`` for standard normal noise ``(B, C, h, w)``."""
        return self.mean + self.std * noise

    def kl(self) -> Tensor:
        """Kullback-Leibler divergence from N(0, 1), ``(B,)`` nats summed over C, h and w.

        Formula: ``0.5 * sum(mean^2 + exp(logvar) - 1 - logvar)``.
        """
        terms = self.mean.square() + self.logvar.exp() - 1.0 - self.logvar
        return 0.5 * terms.flatten(1).sum(dim=1)


class Autoencoder(nn.Module):
    """Encoder to a posterior, and decoder, with 1 x 1 convolutions on both sides of the latents.

    Attributes:
        in_channels: Channels of the image.
        latent_channels: Channels C of the latents.
        stride: Reduction of rows and columns.
    """

    def __init__(
        self,
        encoder: nn.Module,
        decoder: nn.Module,
        in_channels: int,
        latent_channels: int,
        stride: Size,
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.latent_channels = latent_channels
        self.stride = stride
        self.encoder, self.decoder = encoder, decoder
        self.quant_conv: nn.Module = nn.Conv2d(2 * latent_channels, 2 * latent_channels, 1)
        self.post_quant_conv = nn.Conv2d(latent_channels, latent_channels, 1)

    def latent_size(self, image_size: Size) -> Size:
        """Rows and columns ``(h, w)`` of the latents of an ``(H, W)`` image."""
        rows, columns = image_size
        if rows % self.stride[0] or columns % self.stride[1]:
            raise ValueError(
                f"image size (rows, columns) must be a multiple of {self.stride}, got {image_size}"
            )
        return rows // self.stride[0], columns // self.stride[1]

    def encode(self, image: Tensor) -> Posterior:
        """Posterior of the raw latents of images ``(B, in_channels, H, W)`` in [-1, 1]."""
        self.latent_size((image.shape[-2], image.shape[-1]))
        return Posterior(self.quant_conv(self.encoder(image)))

    def predict(self, latents: Tensor) -> Tensor:
        """Outputs of the decoder, from which the reconstruction loss is computed."""
        return self.decoder(self.post_quant_conv(latents))

    def image_of(self, prediction: Tensor) -> Tensor:
        """Images ``(B, in_channels, H, W)`` of outputs of the decoder."""
        return prediction

    def decode(self, latents: Tensor) -> Tensor:
        """Images ``(B, in_channels, H, W)`` of raw latents, not limited to [-1, 1]."""
        return self.image_of(self.predict(latents))


class VAE(Autoencoder):
    """Convolutional autoencoder whose columns wrap around, with the architecture of LiDM.

    Level i of the encoder has ``channels * channel_multipliers[i]`` channels and is followed by
    a strided convolution with ``strides[i]``; the decoder mirrors it. The encoder commutes with
    rotations of the scan by the product of the column strides, and so does the decoder unless
    ``legacy_upsample`` is set. Layouts with official weights (base 128, two blocks):

    ======== ================ ==================== ========= ============
    name     multipliers      strides              attention channels C
    ======== ================ ==================== ========= ============
    h2p4d8   1 2 2 4          1x2 2x2 2x2                    8
    h1p4d4   1 2 4            2x2 2x2                        4
    h16d4    1 1 2 2 4        1x2 four times       4         4
    h16p2d16 1 1 2 2 2 4      1x2 four times, 2x2  4         16
    ======== ================ ==================== ========= ============

    With a ``stem`` the encoder starts from blocks of pixels and the decoder ends with them: most of
    the time of the layouts above goes into layers of few channels at full resolution. All kernels
    are then 3 x 3.

    Images of two channels, see :class:`r3dpa.geometry.RangeCodec`, are range and return: the
    decoder predicts the logit of a return beside the range. With two ``modes`` it predicts a
    mixture of two Laplacians for the range, which keeps edges sharp where one value would lie
    between near and far (Tosi et al., "SMD-Nets", CVPR 2021).

    ``intensity`` and ``num_classes`` add channels to such images: the encoder takes the class as
    one channel for each, the decoder predicts their logits. They enter and leave through layers of
    their own, whose kernels are 1 x 1 to save time. The encoder layer starts at 0, so that weights
    of a VAE without these channels give the same latents. Without
    ``encode_further`` there is none, and the latents, which tell of range and return alone, are
    decoded to intensity and class as well. A ``refinement`` corrects ranges and returns pixel by
    pixel, see :class:`r3dpa.nn.refinement.Refinement`; leaves in training alone.

    Source: Ran et al., "Towards realistic scene generation with LiDAR diffusion models" (CVPR
    2024); R3DPA (ICRA 2026) uses h2p4d8. State-dict keys follow the official checkpoints.

    Args:
        in_channels: Channels of the range image, without intensity and class.
        latent_channels: Channels C of the latents.
        channels: Base width, a multiple of 32.
        channel_multipliers: Width of each level in units of the base width.
        strides: Reduction of (rows, columns) between two levels, each (1, 2), (1, 4), (2, 1) or
            (2, 2).
        num_res_blocks: Residual blocks per encoder level; decoder levels have one more.
        attention_levels: Levels with an attention block after each residual block.
        legacy_upsample: Interpolation of the official weights, see :class:`Upsample`.
        stem: Rows and columns of a block of pixels, which the strides come on top of.
        modes: 1 or, for images of two channels, 2.
        least_scale: Of two modes, see :class:`RangeMixture`; the default is 0.5 % of the range in
            a ``log2`` image.
        intensity: Images have a channel of intensity after range and return.
        num_classes: Classes of the returns, whose number is the last channel of the images; 0 where
            they have none.
        encode_further: The encoder sees intensity and class, not the decoder alone.
        refinement: Channels of the refinement, or 0 for none; needs two modes and classes.

    Example:
        >>> vae = VAE(channels=32, num_res_blocks=1)
        >>> posterior = vae.encode(torch.zeros(2, 1, 16, 64))
        >>> tuple(posterior.mean.shape), tuple(vae.decode(posterior.mean).shape)
        ((2, 8, 4, 8), (2, 1, 16, 64))
    """

    def __init__(
        self,
        in_channels: int = 1,
        latent_channels: int = 8,
        channels: int = 128,
        channel_multipliers: tuple[int, ...] = (1, 2, 2, 4),
        strides: tuple[tuple[int, int], ...] = ((1, 2), (2, 2), (2, 2)),
        num_res_blocks: int = 2,
        attention_levels: tuple[int, ...] = (),
        legacy_upsample: bool = False,
        stem: Size = (1, 1),
        modes: Literal[1, 2] = 1,
        least_scale: float = math.exp(-6),
        intensity: bool = False,
        num_classes: int = 0,
        encode_further: bool = True,
        refinement: int = 0,
    ) -> None:
        if least_scale <= 0:
            raise ValueError(f"least_scale must be above 0, got {least_scale}")
        if modes == 2 and in_channels != 2:
            raise ValueError(f"two modes need in_channels 2 (range and return), got {in_channels}")
        if (intensity or num_classes) and in_channels != 2:
            raise ValueError(
                "intensity and num_classes need in_channels 2 (range and return), got "
                f"{in_channels}"
            )
        if refinement and (modes != 2 or num_classes != NUM_CLASSES):
            raise ValueError(
                f"refinement needs modes 2 and num_classes {NUM_CLASSES}, got {modes} and "
                f"{num_classes}"
            )
        num_levels = len(channel_multipliers)
        if len(strides) != num_levels - 1:
            raise ValueError(
                f"{num_levels} channel_multipliers need {num_levels - 1} strides between their "
                f"levels, got {len(strides)}: {strides}"
            )
        if not set(attention_levels) <= set(range(num_levels)):
            raise ValueError(
                f"attention_levels must be among 0..{num_levels - 1}, got {attention_levels}"
            )
        widths = [channels * multiplier for multiplier in channel_multipliers]
        steps = [(rows, columns) for rows, columns in strides]
        attention = [level in attention_levels for level in range(num_levels)]
        shallower, deeper = [widths[0], *widths[:-1]], [*widths[1:], widths[-1]]
        down = list(zip(shallower, widths, attention, [*steps, None], strict=True))
        up = list(zip(deeper, widths, attention, [None, *steps], strict=True))
        outputs = in_channels if modes == 1 else RangeMixture.num_outputs + 1
        strides = (stem, *strides)
        further = intensity + num_classes
        seen = (intensity, num_classes) if encode_further else (False, 0)
        encoder = Encoder(in_channels, 2 * latent_channels, down, num_res_blocks, stem, *seen)
        decoder = Decoder(
            latent_channels, outputs, up, num_res_blocks + 1, legacy_upsample, stem, further
        )
        if refinement:
            decoder.further_refinement = Refinement(widths[0], refinement, stem, least_scale)
        super().__init__(
            encoder,
            decoder,
            in_channels,
            latent_channels,
            (math.prod(rows for rows, _ in strides), math.prod(columns for _, columns in strides)),
        )
        self.modes, self.least_scale = modes, least_scale
        self.intensity, self.num_classes = intensity, num_classes
        self.encode_further, self.refinement = encode_further, refinement

    @property
    def image_channels(self) -> int:
        """Channels of the images that it encodes and decodes."""
        return self.in_channels + self.intensity + (self.num_classes > 0)

    def codec_of_input(self, codec: RangeCodec) -> RangeCodec:
        """Codec of what the encoder reads: without intensity and class where it sees none."""
        return codec if self.encode_further else codec.without_further()

    def outputs_of(self, prediction: Tensor) -> PixelOutputs:
        """Parts of outputs ``(B, ..., H, W)`` of the decoder."""
        sizes = [
            1 if self.modes == 1 else RangeMixture.num_outputs,
            self.in_channels - 1,
            int(self.intensity),
            self.num_classes,
        ]
        ranges, returns, intensity, classes = prediction.split(sizes, dim=1)
        return PixelOutputs(
            ranges,
            returns if self.in_channels > 1 else None,
            intensity if self.intensity else None,
            LOGIT_GAIN * classes if self.num_classes else None,
        )

    def mixture_of(self, prediction: Tensor) -> RangeMixture:
        """Distribution of the encoded ranges, of outputs ``(B, 6 or more, H, W)`` for two modes."""
        return RangeMixture(prediction, self.least_scale)

    def image_of(self, prediction: Tensor) -> Tensor:
        """Images ``(B, image_channels, H, W)``, with the likeliest class.

        Of two modes, the one of the higher density. Choosing per pixel leaves flying pixels,
        which are moved to a surface, and ripples, which are smoothed; intensity and class stay.
        """
        outputs, image = self.outputs_of(prediction), prediction[:, : self.in_channels]
        if self.modes == 2:
            mode, returns = self.mixture_of(prediction).mode(), cast(Tensor, outputs.returns)
            image = clean_image(torch.cat([mode, returns], dim=1), outputs.classes)
        further = [] if outputs.intensity is None else [outputs.intensity]
        if outputs.classes is not None:
            further.append(outputs.classes.argmax(dim=1, keepdim=True).to(prediction.dtype))
        return torch.cat([image, *further], dim=1) if further else image

    def scan_of(self, prediction: Tensor) -> Tensor:
        """Images ``(B, in_channels, H, W)`` of outputs, as a discriminator sees scans.

        They are without intensity and class. Where the second channel is the logit of a return, it
        becomes 1 or -1, and the range -1 without one: the logit would give every reconstruction
        away. The threshold has the gradient of a sigmoid (straight-through, Bengio et al. 2013).
        """
        image = self.image_of(prediction)
        if self.in_channels == 1:
            return image
        logit = at_least_float32(image[:, 1:2])
        soft = torch.sigmoid(logit)
        seen = (logit > 0).to(soft) + soft - soft.detach()
        return torch.cat([seen * (image[:, :1] + 1) - 1, 2 * seen - 1], dim=1)

    def decoder_to_bfloat16_(self) -> Self:
        """Cast the convolutions of the decoder, but for the outputs, to bfloat16 for sampling.

        Statistics of the norms and the result of :meth:`decode` stay float32.
        """
        for layer in self.decoder.modules():
            if isinstance(layer, nn.Conv2d) and not isinstance(layer, Float32CircularConv2d):
                layer.bfloat16()
        return self


class ThinDecoder(VAE):
    """Decoder alone, for the latents of a VAE.

    With half its channels it has a quarter of the work, and less with fewer blocks.

    Args:
        **kwargs: See :class:`VAE`.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.encoder, self.quant_conv = nn.Identity(), nn.Identity()

    def encode(self, image: Tensor) -> Posterior:
        """Refused, as there is no encoder."""
        raise ValueError("a thin decoder has no encoder: encode with the VAE (decoder='full')")
