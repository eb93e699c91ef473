"""Feature guidance: a velocity function that pulls tokens towards given 3D features.

Letters: B batch, N tokens, F feature width, ``...`` axes of the latents.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from r3dpa.flow.sde import DriftChange
from r3dpa.flow.solvers import Velocity

__all__ = ["FeatureGuidance", "GuidanceRecord"]

_COSINE_EPS = 1e-6


class GuidanceRecord(NamedTuple):
    """What one guided evaluation did, one value per sample.

    Attributes:
        energy: ``(B,)`` minus the mean cosine over the selected tokens; with ``legacy`` the share
            of each sample in the mean over the whole batch (its sum is the official log).
        cosine: ``(B,)`` cosine between the direction of the sampler and the guidance term. With
            ``legacy`` the direction of an ODE step already contains the guidance.
    """

    energy: Tensor
    cosine: Tensor


class FeatureGuidance:
    """Velocity plus ``scale`` times the gradient of the alignment energy of given features.

    The energy of a sample is minus the mean cosine between its projected features and the target
    over the selected tokens, in float32 or wider. Solvers step backwards in time, so adding its
    gradient to the velocity raises the similarity. Samples do not influence each other. No token
    selected means no guidance, and a sample whose gradient is not finite goes unguided for that
    evaluation and is counted. The term of a sample is at most ``max_ratio`` times as long as its
    velocity, so that the steep gradients of tokens near pure noise cannot carry the state away.

    It is used as any velocity function. The same three calls serve the published sampler, which
    differs with ``legacy``::

        euler(guidance, x, times)
        heun(guidance, x, times, corrector_velocity=guidance.corrector_velocity)
        euler_maruyama(guidance.sde_velocity, x, times, noise, change_drift=guidance.change_drift)

    Works under ``torch.no_grad`` and ``torch.inference_mode``; gradients reach the latents only.

    Source: R3DPA (ICRA 2026), feature-conditioned sampling.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)`` without guidance.
        project_features: ``(x (B, ...), time (B,)) -> (B, N, F)`` projected features,
            differentiable in ``x``.
        target: ``(B, N, F)`` features to reach, any length per vector.
        token_mask: ``(B, N)`` bool, tokens to guide; all of them if left out.
        scale: Strength; the gradient is multiplied by it.
        max_ratio: Longest term of a sample, as a multiple of the length of its velocity; infinity
            for any length.
        legacy: Quirks of the official code. The energy is averaged over all selected tokens of
            the batch, so that the strength depends on batch and mask size; the term may be of any
            length; Heun's second slope is unguided; in the SDE the term is added to the drift,
            multiplied by t, and is absent in the last step.

    Attributes:
        velocity: The velocity function without guidance.
        history: One record per guided evaluation, on the device of the latents.

    Raises:
        ValueError: If ``target`` or ``token_mask`` has the wrong shape or dtype, or ``max_ratio``
            is negative or NaN.
    """

    def __init__(
        self,
        velocity: Velocity,
        project_features: Velocity,
        target: Tensor,
        token_mask: Tensor | None = None,
        *,
        scale: float,
        max_ratio: float = 1.0,
        legacy: bool = False,
    ) -> None:
        if target.dim() != 3:
            raise ValueError(f"target must have shape (B, N, F), got {tuple(target.shape)}")
        if token_mask is None:
            token_mask = torch.ones(target.shape[:2], dtype=torch.bool, device=target.device)
        if token_mask.shape != target.shape[:2] or token_mask.dtype != torch.bool:
            raise ValueError(
                f"token_mask must be bool of shape {tuple(target.shape[:2])}, got "
                f"{token_mask.dtype} of shape {tuple(token_mask.shape)}"
            )
        if not max_ratio >= 0:
            raise ValueError(f"max_ratio of the guidance must be 0 or above, got {max_ratio}")
        self.velocity = velocity
        self._project_features = project_features
        with torch.inference_mode(False):  # autograd cannot save tensors of inference mode
            self._target = _unit(_at_least_float32(target.detach().clone()))
            self._token_mask = token_mask.clone()
            self._num_dropped = torch.zeros((), dtype=torch.long, device=target.device)
        self._scale = scale
        self._max_ratio = math.inf if legacy else max_ratio
        self._legacy = legacy
        self.history: list[GuidanceRecord] = []

    def __call__(self, x: Tensor, time: Tensor) -> Tensor:
        """Guided velocity.

        Args:
            x: ``(B, ...)`` noisy latents.
            time: ``(B,)`` flow times.

        Returns:
            ``(B, ...)`` velocity plus guidance term.

        Raises:
            ValueError: If the projected features have another shape than the target.
        """
        velocity = self.velocity(x, time)
        energy, term = self._evaluate(x, time)
        term = self._limited(term, velocity)
        guided = velocity + term
        self._record(energy, guided if self._legacy else velocity, term)
        return guided

    def term(self, x: Tensor, time: Tensor) -> Tensor:
        """``scale`` times the gradient of the energy: what guidance adds, before it is limited.

        Args:
            x: ``(B, ...)`` latents.
            time: ``(B,)`` flow times.

        Returns:
            ``(B, ...)``, float32 or wider; zero for a sample without selected tokens.

        Raises:
            ValueError: If the projected features have another shape than the target.
        """
        return self._evaluate(x, time)[1]

    @property
    def corrector_velocity(self) -> Velocity:
        """Velocity of Heun's second slope: guided, but for ``legacy``."""
        return self.velocity if self._legacy else self

    @property
    def sde_velocity(self) -> Velocity:
        """Velocity that the SDE drift is made of: guided, but for ``legacy``."""
        return self.velocity if self._legacy else self

    @property
    def change_drift(self) -> DriftChange | None:
        """What the SDE solver does to its drift: nothing, but for ``legacy``."""
        return self._add_to_drift if self._legacy else None

    @property
    def num_dropped(self) -> int:
        """How often a sample went unguided because its gradient was not finite."""
        return int(self._num_dropped)

    def _add_to_drift(self, drift: Tensor, x: Tensor, time: Tensor) -> Tensor:
        energy, term = self._evaluate(x, time)
        self._record(energy, drift, term)
        return drift + time.reshape(-1, *[1] * (x.dim() - 1)) * term

    def _evaluate(self, x: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Energies ``(B,)`` and guidance term ``(B, ...)``."""
        with torch.inference_mode(False), torch.enable_grad():
            leaf = _at_least_float32(x.detach().clone()).requires_grad_()
            features = self._project_features(leaf, time.clone())
            if features.shape != self._target.shape:
                raise ValueError(
                    f"guidance towards features of shape {tuple(self._target.shape)}, but the "
                    f"network projects to {tuple(features.shape)}"
                )
            cosine = (_unit(_at_least_float32(features)) * self._target).sum(dim=-1)
            selected = torch.where(self._token_mask, cosine, 0.0).sum(dim=1)
            counts = self._token_mask.sum() if self._legacy else self._token_mask.sum(dim=1)
            energy = -selected / counts.clamp(min=1)
            (gradient,) = torch.autograd.grad(energy.sum(), leaf)
        finite = gradient.flatten(1).isfinite().all(dim=1)
        self._num_dropped += (~finite).sum()
        usable = finite.reshape(-1, *[1] * (x.dim() - 1))
        return energy.detach(), torch.where(usable, self._scale * gradient, 0.0)

    def _limited(self, term: Tensor, velocity: Tensor) -> Tensor:
        """The term of each sample, shortened to ``max_ratio`` times its velocity if longer."""
        if self._max_ratio == math.inf:
            return term
        # float64: the square of a long float32 gradient is infinite.
        length, allowed = (
            torch.linalg.vector_norm(values.flatten(1), dim=1, dtype=torch.float64)
            for values in (term, velocity)
        )
        allowed = self._max_ratio * allowed
        factor = torch.where(length > allowed, allowed / length, 1.0).to(term.dtype)
        return term * factor.reshape(-1, *[1] * (term.dim() - 1))

    def _record(self, energy: Tensor, direction: Tensor, term: Tensor) -> None:
        cosine = torch.cosine_similarity(direction.flatten(1), term.flatten(1), dim=1)
        self.history.append(GuidanceRecord(energy, cosine))


def _at_least_float32(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))


def _unit(vectors: Tensor) -> Tensor:
    """Unit vectors along the last axis; unlike ``normalize`` the gradient is finite at zero."""
    # Beyond 2^64 the squares are infinite and the cosine would be 0.
    scale = vectors.detach().abs().amax(dim=-1, keepdim=True).clamp(min=1)
    vectors = vectors / scale
    return vectors * torch.rsqrt(vectors.square().sum(dim=-1, keepdim=True) + _COSINE_EPS**2)
