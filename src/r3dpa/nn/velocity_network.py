"""What training and sampling ask of a network that predicts velocities and projected features.

Letters: B batch, C latent channels, h x w latent size, N tokens, F feature width, T times,
M numbers of a modulation.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.nn.layers import at_least_float32, no_autocast

__all__ = [
    "TIME_WIDTH",
    "AlignedPass",
    "VelocityNetwork",
    "VelocityOutput",
    "WideLinear",
    "time_frequencies",
]

TIME_WIDTH = 256
_MAX_PERIOD = 10_000.0


class VelocityOutput(NamedTuple):
    """What one evaluation of a :class:`VelocityNetwork` predicts.

    Attributes:
        velocity: ``(B, C, h, w)`` d x_t / d t of the normalised latents.
        features: ``(B, N, F)`` projected features, not of unit length.
    """

    velocity: Tensor
    features: Tensor


@dataclass(frozen=True)
class AlignedPass:
    """An evaluation that has come as far as the features, and may be finished.

    Args:
        features: ``(B, N, F)`` projected features, differentiable in latents and weights.
        velocity: Finishes the evaluation: ``(B, C, h, w)``, without a gradient.
    """

    features: Tensor
    velocity: Callable[[], Tensor]


class VelocityNetwork(nn.Module, ABC):
    """Network with two heads: velocity of the latents, and features at an inner depth (REPA).

    It only predicts: times, noise, targets and losses live outside. A subclass says how times
    become modulations, what is computed up to the depth where features are taken
    (:meth:`_begin`), the features from there (:meth:`_project`), and the rest (:meth:`_finish`).
    All evaluations are made of these, so that none computes what it does not need.

    Attributes:
        input_size: Latent rows and columns ``(h, w)``.
        in_channels: Latent channels C.
        grid_size: Rows and columns of the feature grid that it is aligned with, N = their product.
        feature_dim: Width F of the features.
        num_classes: Classes that labels may name.
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
        """Velocity and projected features from one pass through all layers.

        Args:
            latents: ``(B, C, h, w)`` noisy normalised latents.
            time: ``(B,)`` flow times, 0 data, 1 noise.
            labels: ``(B,)`` int64 classes; may be left out of a one-class model.

        Returns:
            Velocity ``(B, C, h, w)`` and features ``(B, N, F)``.

        Raises:
            ValueError: If a shape does not fit the network, or a model of several classes gets
                no labels.
        """
        self._check(latents, time)
        modulations = self.modulations(time, labels)
        activations = self._begin(latents, modulations)
        return VelocityOutput(self._finish(activations, modulations), self._project(activations[0]))

    def velocity(self, latents: Tensor, time: Tensor, labels: Tensor | None = None) -> Tensor:
        """Velocity alone; the projection head is not evaluated.

        Args:
            latents: ``(B, C, h, w)`` noisy normalised latents.
            time: ``(B,)`` flow times, 0 data, 1 noise.
            labels: ``(B,)`` int64 classes; may be left out of a one-class model.

        Returns:
            ``(B, C, h, w)`` d x_t / d t.

        Raises:
            ValueError: As :meth:`forward`.
        """
        self._check(latents, time)
        modulations = self.modulations(time, labels)
        return self._finish(self._begin(latents, modulations), modulations)

    def project_features(
        self, latents: Tensor, time: Tensor, labels: Tensor | None = None
    ) -> Tensor:
        """Projected features alone; nothing behind the depth of alignment is evaluated.

        Args:
            latents: ``(B, C, h, w)`` noisy normalised latents.
            time: ``(B,)`` flow times, 0 data, 1 noise.
            labels: ``(B,)`` int64 classes; may be left out of a one-class model.

        Returns:
            ``(B, N, F)``, not of unit length.

        Raises:
            ValueError: As :meth:`forward`.
        """
        self._check(latents, time)
        activations = self._begin(latents, self._first_modulations(time, labels))
        return self._project(activations[0])

    def aligned_pass(
        self, latents: Tensor, time: Tensor, labels: Tensor | None = None
    ) -> AlignedPass:
        """Features with a gradient, and the velocity without one, of a single evaluation.

        Feature guidance needs both: the layers before the alignment run forward and back, those
        behind it forward only.

        Args:
            latents: ``(B, C, h, w)`` noisy normalised latents.
            time: ``(B,)`` flow times, 0 data, 1 noise.
            labels: ``(B,)`` int64 classes; may be left out of a one-class model.

        Returns:
            Features, and what finishes the velocity; the same numbers as :meth:`forward`.

        Raises:
            ValueError: As :meth:`forward`.
        """
        self._check(latents, time)
        modulations = self.modulations(time, labels)
        activations = self._begin(latents, modulations)
        # Else the function would keep the graph alive, long after the gradient was taken.
        detached = tuple(values.detach() for values in activations)
        told = modulations.detach()

        def velocity() -> Tensor:
            with torch.no_grad():
                return self._finish(detached, told)

        return AlignedPass(self._project(activations[0]), velocity)

    def velocity_at(self, latents: Tensor, modulations: Tensor) -> Tensor:
        """Velocity at times whose modulations are known: all of :meth:`velocity` but those.

        A schedule meets the same times for every sample, and much of a network's weights may do
        nothing but turn times into modulations: the rows of a whole schedule are computed once.

        Args:
            latents: ``(B, C, h, w)`` noisy normalised latents.
            modulations: ``(B, M)`` rows of :meth:`modulations`, or ``(1, M)`` for all samples.

        Returns:
            ``(B, C, h, w)`` d x_t / d t; equal to :meth:`velocity` up to the rounding of another
            batch size.

        Raises:
            ValueError: If a shape does not fit the network.

        Example:
            >>> sit = SiT(hidden_size=32, depth=2, num_heads=2, alignment_depth=1)
            >>> table = sit.modulations(torch.linspace(1, 0, 9))
            >>> sit.velocity_at(torch.randn(4, 8, 16, 128), table[3:4]).shape
            torch.Size([4, 8, 16, 128])
        """
        self._check_latents(latents)
        if modulations.dim() != 2 or modulations.shape[1] != self.modulation_width:
            raise ValueError(
                f"modulations must be rows of {self.modulation_width} numbers, got "
                f"{tuple(modulations.shape)}; take them from {type(self).__name__}.modulations"
            )
        if len(modulations) not in (1, len(latents)):
            raise ValueError(
                f"modulations must hold 1 row or one for each of {len(latents)} samples, "
                f"got {len(modulations)}"
            )
        return self._finish(self._begin(latents, modulations), modulations)

    @property
    @abstractmethod
    def modulation_width(self) -> int:
        """Numbers M in a row of :meth:`modulations`."""

    @property
    @abstractmethod
    def input_layer(self) -> nn.Module:
        """The layer that takes the latents, which VAE alignment trains with the projector."""

    @property
    @abstractmethod
    def compiled_parts(self) -> list[nn.Module]:
        """Modules that make up nearly all of the work, to be compiled one by one."""

    @abstractmethod
    def modulations(self, time: Tensor, labels: Tensor | None = None) -> Tensor:
        """What the layers are told of some times and classes.

        Args:
            time: ``(T,)`` flow times, 0 data, 1 noise.
            labels: ``(T,)`` int64 classes; may be left out of a one-class model.

        Returns:
            ``(T, M)``, a row for each time.

        Raises:
            ValueError: If ``time`` or ``labels`` is not one number per row, or a model of several
                classes gets no labels.
        """

    @abstractmethod
    def halve_(self) -> Self:
        """Casts the weights that are nearly all of the work to bfloat16 in place.

        For sampling without autocast. The velocity is float32, and so is what makes the
        modulations, whose neighbouring times coincide in bfloat16.
        """

    @abstractmethod
    def _begin(self, latents: Tensor, modulations: Tensor) -> tuple[Tensor, ...]:
        """What later layers need: first the activations that features are taken from."""

    @abstractmethod
    def _project(self, activations: Tensor) -> Tensor:
        """Projected features ``(B, N, F)``."""

    @abstractmethod
    def _finish(self, activations: tuple[Tensor, ...], modulations: Tensor) -> Tensor:
        """Velocity ``(B, C, h, w)``."""

    def _first_modulations(self, time: Tensor, labels: Tensor | None) -> Tensor:
        """Modulations of the layers in :meth:`_begin`, where they can be had apart."""
        return self.modulations(time, labels)

    def _labels(self, time: Tensor, labels: Tensor | None) -> Tensor:
        """Checked classes ``(T,)`` of the times ``(T,)``."""
        if time.dim() != 1:
            raise ValueError(f"times must be given as (T,), got {tuple(time.shape)}")
        if labels is None:
            if self.num_classes > 1:
                raise ValueError(f"a model of {self.num_classes} classes needs labels")
            return torch.zeros(len(time), dtype=torch.long, device=time.device)
        if labels.shape != time.shape:
            raise ValueError(
                f"labels must hold one class per time, shape ({len(time)},), "
                f"got {tuple(labels.shape)}"
            )
        return labels

    def _check(self, latents: Tensor, time: Tensor) -> None:
        self._check_latents(latents)
        if time.shape != latents.shape[:1]:
            raise ValueError(
                f"time must hold one value per sample, shape ({len(latents)},), "
                f"got {tuple(time.shape)}"
            )

    def _check_latents(self, latents: Tensor) -> None:
        expected = (self.in_channels, *self.input_size)
        if latents.shape[1:] != expected:
            raise ValueError(
                f"{type(self).__name__} was built for latents of shape "
                f"(B, {', '.join(map(str, expected))}), got {tuple(latents.shape)}"
            )


def time_frequencies(time: Tensor, width: int = TIME_WIDTH) -> Tensor:
    """Sinusoidal features of the flow time, cosines before sines.

    The time enters unscaled, so that the features of t in [0, 1] stay those of the official
    weights. In bfloat16 neighbouring times would coincide: pass float32 or float64.

    Formula: ``cos(t f_k), sin(t f_k)`` with ``f_k = 10000^(-k / (width / 2))``.

    Args:
        time: ``(B,)`` flow times in [0, 1].
        width: Even number of features.

    Returns:
        ``(B, width)`` in [-1, 1], dtype of ``time``.
    """
    half = width // 2
    exponents = torch.arange(half, dtype=time.dtype, device=time.device) / half
    angles = time[:, None] * torch.exp(-math.log(_MAX_PERIOD) * exponents)
    return torch.cat([angles.cos(), angles.sin()], dim=1)


class WideLinear(nn.Linear):
    """Linear layer in at least float32, whatever the rest of the network runs in."""

    def forward(self, inputs: Tensor) -> Tensor:
        """Map ``(..., in_features)``."""
        weight, bias = at_least_float32(self.weight), at_least_float32(self.bias)
        with no_autocast(inputs.device):
            return F.linear(inputs.to(weight.dtype), weight, bias)
