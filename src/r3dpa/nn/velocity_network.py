"""Interface of the networks that predict velocities and features, and the average of one.

Letters: B batch, C latent channels, h x w latent size, N tokens, F feature width, T times,
M width of a modulation row.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.nn.layers import at_least_float32, no_autocast

TIME_WIDTH = 256
MAX_PERIOD = 10_000.0


class VelocityOutput(NamedTuple):
    """Velocity ``(B, C, h, w)`` and projected features ``(B, N, F)``, not of unit length."""

    velocity: Tensor
    features: Tensor


class VelocityNetwork(nn.Module, ABC):
    """Network with two heads: velocity of the latents, and features at an inner depth (REPA).

    It only predicts: times, noise, targets and losses live outside. A subclass implements
    :meth:`modulations`, the layers up to the aligned depth (:meth:`_begin`), the features from
    there (:meth:`_project`) and the remaining layers (:meth:`_finish`). Every evaluation is
    composed of these and computes nothing that it does not return.

    Arguments of all evaluations: ``latents`` ``(B, C, h, w)`` noisy normalised latents, ``time``
    ``(B,)`` flow times (0 data, 1 noise), ``labels`` ``(B,)`` int64 classes, which a one-class
    model does not need. Wrong latents or times, or missing labels, raise a ValueError.

    Attributes:
        input_size: Latent rows and columns ``(h, w)``.
        in_channels: Latent channels C.
        grid_size: Rows and columns of the aligned feature grid; N is their product.
        feature_dim: Width F of the features.
        num_classes: Number of classes.
        projector: Head of the features.
    """

    input_size: tuple[int, int]
    in_channels: int
    grid_size: tuple[int, int]
    feature_dim: int
    num_classes: int
    projector: nn.Sequential

    def forward(
        self, latents: Tensor, time: Tensor, labels: Tensor | None = None
    ) -> VelocityOutput:
        """Velocity and projected features, from one pass."""
        self._check(latents, time)
        modulations = self.modulations(time, labels)
        activations = self._begin(latents, modulations)
        return VelocityOutput(self._finish(activations, modulations), self._project(activations[0]))

    def velocity(self, latents: Tensor, time: Tensor, labels: Tensor | None = None) -> Tensor:
        """Velocity ``(B, C, h, w)`` alone; the projection head is not evaluated."""
        self._check(latents, time)
        modulations = self.modulations(time, labels)
        return self._finish(self._begin(latents, modulations), modulations)

    def project_features(
        self, latents: Tensor, time: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        """Projected features ``(B, N, F)`` alone; layers behind the aligned depth are not run."""
        self._check(latents, time)
        return self._project(self._begin(latents, self._first_modulations(time, labels))[0])

    def aligned_pass(
        self, latents: Tensor, time: Tensor, labels: Tensor | None = None
    ) -> tuple[Tensor, Callable[[], Tensor]]:
        """Features ``(B, N, F)``, and a function that returns the velocity ``(B, C, h, w)``.

        Feature guidance needs both, the velocity without a gradient: layers up to the aligned depth
        run forward and backward, the others forward only.
        """
        self._check(latents, time)
        modulations = self.modulations(time, labels)
        activations = self._begin(latents, modulations)
        # Detached, or the closure would keep the graph alive after the gradient was taken.
        detached, constant = tuple(values.detach() for values in activations), modulations.detach()

        def velocity() -> Tensor:
            with torch.no_grad():
                return self._finish(detached, constant)

        return self._project(activations[0]), velocity

    def velocity_at(self, latents: Tensor, modulations: Tensor) -> Tensor:
        """Velocity ``(B, C, h, w)`` from precomputed modulations.

        All samples of a schedule share their times, and much of a network's weights may only turn
        times into modulations, so the rows ``(B, M)`` or ``(1, M)`` of :meth:`modulations` of a
        whole schedule are computed once.
        """
        return self._finish(self._begin(latents, modulations), modulations)

    @property
    @abstractmethod
    def input_layer(self) -> nn.Module:
        """First layer, which VAE alignment trains with the projector."""

    @property
    @abstractmethod
    def compiled_parts(self) -> list[nn.Module]:
        """Modules with nearly all of the computation, to be compiled one by one."""

    @abstractmethod
    def modulations(self, time: Tensor, labels: Tensor | None = None) -> Tensor:
        """Modulation vectors ``(T, M)`` of times ``(T,)`` and classes ``(T,)``."""

    @abstractmethod
    def to_bfloat16_(self) -> Self:
        """Cast the weights of nearly all of the computation to bfloat16 in place.

        For sampling without autocast. The velocity stays float32, and so does the time embedding:
        neighbouring times coincide in bfloat16.
        """

    @abstractmethod
    def _begin(self, latents: Tensor, modulations: Tensor) -> tuple[Tensor, ...]:
        """Activations at the aligned depth first, then others that :meth:`_finish` needs."""

    @abstractmethod
    def _project(self, activations: Tensor) -> Tensor:
        """Projected features ``(B, N, F)``."""

    @abstractmethod
    def _finish(self, activations: tuple[Tensor, ...], modulations: Tensor) -> Tensor:
        """Velocity ``(B, C, h, w)``."""

    def _first_modulations(self, time: Tensor, labels: Tensor | None) -> Tensor:
        """Modulations of the layers in :meth:`_begin`, if they can be computed separately."""
        return self.modulations(time, labels)

    def _labels(self, time: Tensor, labels: Tensor | None) -> Tensor:
        """Classes ``(T,)`` of the times ``(T,)``."""
        if labels is not None:
            return labels
        if self.num_classes > 1:
            raise ValueError(f"a model of {self.num_classes} classes needs labels")
        return torch.zeros(len(time), dtype=torch.long, device=time.device)

    def _check(self, latents: Tensor, time: Tensor) -> None:
        expected = (time.numel(), self.in_channels, *self.input_size)
        if latents.shape != expected or time.dim() != 1:
            raise ValueError(
                f"{type(self).__name__} takes latents {expected} for {time.numel()} times, got "
                f"{tuple(latents.shape)} and times {tuple(time.shape)}"
            )


def time_frequencies(time: Tensor, width: int = TIME_WIDTH) -> Tensor:
    """Sinusoidal features ``(B, width)`` of flow times ``(B,)``, cosines before sines.

    The time in [0, 1] enters unscaled, as the official weights expect. Pass float32 or float64:
    neighbouring times coincide in bfloat16.

    Formula: ``cos(t f_k), sin(t f_k)`` with ``f_k = 10000^(-k / (width / 2))``.
    """
    half = width // 2
    exponents = torch.arange(half, dtype=time.dtype, device=time.device) / half
    angles = time[:, None] * torch.exp(-math.log(MAX_PERIOD) * exponents)
    return torch.cat([angles.cos(), angles.sin()], dim=1)


class Float32Linear(nn.Linear):
    """Linear layer in at least float32, also under autocast."""

    def forward(self, inputs: Tensor) -> Tensor:
        """``(..., in_features)`` to ``(..., out_features)``."""
        weight, bias = at_least_float32(self.weight), at_least_float32(self.bias)
        with no_autocast(inputs.device):
            return F.linear(inputs.to(weight.dtype), weight, bias)
