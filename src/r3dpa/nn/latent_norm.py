"""Statistics of the raw latents: normalise for the flow, denormalise for the decoder.

Letters: B batch, C latent channels, h x w latent size.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from r3dpa.nn.layers import at_least_float32, num_processes, sum_over_processes


class LatentNorm(nn.Module):
    """Per-channel normalisation of latents with running statistics and an exact inverse.

    A batch norm without weights: :meth:`update` uses batch statistics (training), :meth:`normalise`
    running statistics; the mode of the module plays no part. Latents are ``(B, C, h, w)``; results
    are in float32 or wider. State-dict keys follow ``torch.nn.BatchNorm2d``.

    Source: the batch norm inside SiT of REPA-E (Leng et al. 2025) and R3DPA (ICRA 2026).

    Args:
        channels: Latent channels C.
        eps: Added to the variance inside the root.
        momentum: Weight of the new batch in the running statistics.
        legacy_inverse: Leave ``eps`` out of :meth:`denormalise`, as the official code does: an
            error of 5e-5 at variance 1 and of 29 % at variance 1e-4.
        replace_non_finite: As the official code, replace NaN by 0 and infinities by the largest
            number. It hides the fault from the loss; the running statistics are safe either way.

    Example:
        >>> norm = LatentNorm(channels=4)
        >>> raw = 3 * torch.randn(16, 4, 8, 8) + 1
        >>> norm.update(raw).mean().abs() < 1e-5  # moves the running statistics
        tensor(True)
        >>> torch.allclose(norm.denormalise(norm.normalise(raw)), raw, atol=1e-5)
        True
    """

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor

    def __init__(
        self,
        channels: int,
        eps: float = 1e-4,
        momentum: float = 0.1,
        legacy_inverse: bool = False,
        replace_non_finite: bool = False,
    ) -> None:
        super().__init__()
        self.channels = channels
        self.eps = eps
        self.momentum = momentum
        self.legacy_inverse = legacy_inverse
        self.replace_non_finite = replace_non_finite
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))
        self.register_buffer("num_batches_tracked", torch.tensor(0, dtype=torch.long))

    @property
    def fitted(self) -> bool:
        """Whether the running statistics, loaded or not, have seen a batch.

        Generation must check it: fresh statistics (0, 1) denormalise to the wrong scale.
        """
        return bool(self.num_batches_tracked > 0)

    def normalise(self, latents: Tensor) -> Tensor:
        """Latents ``(x - mean) / sqrt(var + eps)`` of raw latents, with the running statistics."""
        latents = self._repair(at_least_float32(latents))
        # The root is a new tensor, so the graph holds no buffer that a later update overwrites
        # (an eval-mode BatchNorm2d reads its buffers again in backward).
        return (latents - _per_channel(self.running_mean, latents)) * _per_channel(
            torch.rsqrt(self.running_var + self.eps), latents
        )

    def update(self, latents: Tensor) -> Tensor:
        """Latents normalised with the statistics of this batch, which move the running ones.

        The batch covers all processes when ``torch.distributed`` is initialised; every process
        must then call it, as gradients flow through the shared statistics. The biased variance
        normalises, the unbiased one enters the running statistics. A batch with a non-finite
        latent, or whose variance overflows, leaves mean, variance and count unchanged.
        """
        latents = at_least_float32(latents)
        positions = latents.numel() // self.channels
        if positions * num_processes() < 2:
            raise ValueError(
                "batch statistics need at least two values per channel, got latents of shape "
                f"{tuple(latents.shape)}; use a larger batch, or normalise() with the running "
                "statistics"
            )
        num_broken = (~latents.isfinite()).sum(dtype=torch.float64)

        # Two passes in float64: the sum of squares minus the squared mean would cancel.
        wide = self._repair(latents).double()
        counts = torch.stack([num_broken.new_tensor(positions), num_broken])
        totals = sum_over_processes(torch.cat([counts, wide.sum(dim=(0, 2, 3))]))
        count, num_broken = totals[0].detach(), totals[1].detach()
        mean = totals[2:] / count
        squares = (wide - _per_channel(mean, wide)).square().sum(dim=(0, 2, 3))
        squares = sum_over_processes(squares)
        normalised = (wide - _per_channel(mean, wide)) * _per_channel(
            torch.rsqrt(squares / count + self.eps), wide
        )
        self._move_statistics(mean.detach(), squares.detach() / (count - 1), num_broken == 0)
        return normalised.to(latents.dtype)

    def denormalise(self, latents: Tensor) -> Tensor:
        """Raw latents ``x * sqrt(var + eps) + mean``, the exact inverse of :meth:`normalise`."""
        latents = at_least_float32(latents)
        variance = self.running_var if self.legacy_inverse else self.running_var + self.eps
        return latents * _per_channel(variance.sqrt(), latents) + _per_channel(
            self.running_mean, latents
        )

    def _repair(self, latents: Tensor) -> Tensor:
        return latents.nan_to_num() if self.replace_non_finite else latents

    @torch.no_grad()
    def _move_statistics(self, mean: Tensor, variance: Tensor, usable: Tensor) -> None:
        statistics = self.running_mean, self.running_var
        moved = [
            running.double().lerp(new, self.momentum).to(running.dtype)
            for running, new in zip(statistics, (mean, variance), strict=True)
        ]
        # After the rounding to float32: latents of 1e20 have a variance of 1e40, infinite there.
        usable = usable & torch.stack(moved).isfinite().all()
        for running, value in zip(statistics, moved, strict=True):
            running.copy_(torch.where(usable, value, running))
        self.num_batches_tracked += usable


def _per_channel(values: Tensor, latents: Tensor) -> Tensor:
    return values.to(latents.dtype)[None, :, None, None]
