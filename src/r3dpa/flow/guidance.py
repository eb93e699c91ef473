"""Feature guidance: a velocity function that pulls tokens towards given 3D features.

Letters: B batch, N tokens, F feature width, S sources, ``...`` axes of the latents.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch
from torch import Tensor

from r3dpa.flow.sde import DriftChange
from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import check_interval, per_sample
from r3dpa.losses import unit_vectors

Finish = Callable[[], Tensor]
AlignedVelocity = Callable[[Tensor, Tensor], tuple[Tensor, Finish]]


@dataclass(frozen=True, eq=False)
class FeatureTarget:
    """Features that some tokens are to reach.

    Args:
        features: ``(B, N, F)``, any length per vector; a zero vector is a cell without points.
        token_mask: ``(B, N)`` bool, tokens to guide. Default: all.
    """

    features: Tensor
    token_mask: Tensor | None = None

    def __post_init__(self) -> None:
        features, mask = self.features, self.token_mask
        if features.dim() != 3:
            raise ValueError(f"target must have shape (B, N, F), got {tuple(features.shape)}")
        if mask is not None and (mask.shape != features.shape[:2] or mask.dtype != torch.bool):
            raise ValueError(
                f"token_mask must be bool of shape {tuple(features.shape[:2])}, got "
                f"{mask.dtype} of shape {tuple(mask.shape)}"
            )

    @classmethod
    def stitched(cls, sources: Sequence[Tensor], token_weights: Tensor) -> Self:
        """One target from the features of several scenes: weighted means of unit vectors.

        A source without points in a cell does not count there.

        Args:
            sources: S features ``(B, N, F)``.
            token_weights: ``(S, N)`` of 0 or above: share of each source in each token.
        """
        shapes = {tuple(source.shape) for source in sources}
        tokens = next(iter(shapes))[1:2] if len(shapes) == 1 else ()
        if token_weights.shape != (len(sources), *tokens):
            raise ValueError(
                "stitching needs features (B, N, F) of one shape and weights (S, N), got features "
                f"{sorted(shapes)} and weights {tuple(token_weights.shape)}"
            )
        if not (token_weights.isfinite() & (token_weights >= 0)).all():
            raise ValueError("the weights of stitched features must be finite and 0 or above")
        mixed = torch.zeros_like(_at_least_float32(sources[0]))
        for source, weights in zip(sources, token_weights.to(mixed), strict=True):
            mixed += weights[:, None] * unit_vectors(_at_least_float32(source))
        return cls(mixed)


class GuidanceRecord(NamedTuple):
    """One guided evaluation: energy ``(B,)``, and cosine ``(B,)`` between velocity and term.

    With ``legacy`` the energy is the share of each sample in the mean over the whole batch (its sum
    is the official log), and the velocity of an ODE step already contains the guidance.
    """

    energy: Tensor
    cosine: Tensor


class FeatureGuidance:
    """Velocity plus a multiple of the gradient of the alignment energy of given features.

    The energy of a sample is minus the mean cosine between its projected features and a target
    over the selected tokens, in float32 or wider. Cells of a target without points are not
    selected. Solvers step backwards in time, so adding the gradient g to the velocity v raises the
    similarity::

        v + scale g                     as published
        v + scale |v| sqrt(q) g / |g|   relative

    q is the share of the tokens that are selected, so that the term has ``scale`` times the
    length of the velocity of these tokens. No term is longer than ``max_ratio |v| sqrt(q)``:
    neither the steep gradients of tokens near pure noise nor few tokens that get all of the term
    can carry the state away. Samples do not influence each other. Where nothing is guided (a scale
    of 0, no token selected, times outside the interval) the velocity equals ``velocity`` bit for
    bit, and no gradient is computed unless another sample needs one. A sample whose gradient is not
    finite goes unguided for that evaluation and is counted.

    It is used as any velocity function, by every solver. ``legacy`` differs in these calls, which
    serve both::

        euler(guidance, x, times)
        heun(guidance, x, times, corrector_velocity=guidance.corrector_velocity)
        euler_maruyama(guidance.sde_velocity, x, times, noise, change_drift=guidance.change_drift)

    An evaluation runs the first blocks forward and back and the others forward: with linear
    layers alone ``(depth + alignment_depth) / depth`` times the FLOP of a plain one, plus twice
    the projection head: 1.52 times for SiT-B/2, of two calls 1.86 times. Works under
    ``torch.no_grad`` and ``torch.inference_mode``; gradients reach the latents only.

    Source: R3DPA (ICRA 2026), feature-conditioned sampling.

    Args:
        velocity: ``(x (B, ...), time (B,)) -> (B, ...)`` without guidance.
        aligned: The same arguments to projected features ``(B, N, F)``, differentiable in the
            latents, and a function that finishes the evaluation and returns the velocity
            ``(B, ...)`` without a gradient: the ``aligned_pass`` of a network.
        target: What to reach.
        scale: Strength, 0 or above.
        relative: Measure the strength in velocities rather than in gradients; then ``scale`` is at
            most ``max_ratio``. Not with ``legacy``.
        interval: First and last time that is guided, in [0, 1]. Shorter ones read the times, which
            waits for a GPU.
        max_ratio: Longest term, see above; infinity for any length.
        legacy: Quirks of the official code. The energy is averaged over all selected tokens of
            the batch, cells without points included, so that the strength depends on batch and
            mask size; the term may be of any length; Heun's second slope is unguided; in the SDE
            the term is added to the drift, multiplied by t, and is absent in the last step.

    Attributes:
        velocity: The velocity function without guidance.
        history: One record per guided evaluation, on the device of the latents.
    """

    def __init__(
        self,
        velocity: Velocity,
        aligned: AlignedVelocity,
        target: FeatureTarget,
        *,
        scale: float,
        relative: bool = False,
        interval: tuple[float, float] = (0.0, 1.0),
        max_ratio: float = 1.0,
        legacy: bool = False,
    ) -> None:
        if not 0 <= scale < math.inf:
            raise ValueError(f"scale of the guidance must be 0 or above, got {scale}")
        if not max_ratio >= 0:
            raise ValueError(f"max_ratio of the guidance must be 0 or above, got {max_ratio}")
        check_interval(interval, "the interval of guidance")
        if relative and (legacy or scale > max_ratio):
            raise ValueError(
                f"relative guidance is not legacy, and its scale at most max_ratio ({max_ratio}), "
                f"got legacy={legacy} and scale {scale}; 0.5 is strong"
            )
        self.velocity = velocity
        self._aligned = aligned
        self._scale = scale
        self._relative = relative
        self._interval = interval
        self._max_ratio = math.inf if legacy else max_ratio
        self._legacy = legacy
        self.history: list[GuidanceRecord] = []
        with torch.inference_mode(False):  # autograd cannot save tensors of inference mode
            features = _at_least_float32(target.features.detach().clone())
            selected = torch.ones(features.shape[:2], dtype=torch.bool, device=features.device)
            if target.token_mask is not None:
                selected &= target.token_mask
            if not legacy:
                selected &= features.abs().amax(dim=-1) > 0
            self._target, self._selected = unit_vectors(features), selected
            self._num_dropped = torch.zeros((), dtype=torch.long, device=features.device)
        self._spread = selected.double().mean(dim=1).sqrt()  # float64: see _limited
        self._idle = scale == 0 or max_ratio == 0 or not bool(selected.any())

    def __call__(self, x: Tensor, time: Tensor) -> Tensor:
        """Guided velocity ``(B, ...)`` at noisy latents ``(B, ...)`` and flow times ``(B,)``."""
        everywhere = self._interval == (0, 1)
        inside = self._inside(time)
        if self._idle or not (everywhere or inside.any()):
            return self.velocity(x, time)
        finish, energy, gradient = self._evaluate(x, time)
        velocity = finish()
        term = self._limited(gradient, velocity)
        if not everywhere:
            term = torch.where(per_sample(inside, x), term, 0.0)
        guided = velocity + term
        self._record(energy, guided if self._legacy else velocity, term)
        return guided

    def term(self, x: Tensor, time: Tensor) -> Tensor:
        """``scale`` times the gradient ``(B, ...)`` of the energy: the term before its limits."""
        if self._relative:
            raise ValueError("relative guidance has no term without a velocity")
        return self._scale * self._evaluate(x, time)[2]

    def energy(self, x: Tensor, time: Tensor) -> Tensor:
        """Energy ``(B,)`` of samples, guided or not; not recorded."""
        with torch.no_grad():
            return self._energy(self._aligned(_at_least_float32(x), time)[0])

    @property
    def corrector_velocity(self) -> Velocity:
        """Velocity of Heun's second slope and of the SDE drift: guided, but for ``legacy``."""
        return self.velocity if self._legacy else self

    sde_velocity = corrector_velocity

    @property
    def change_drift(self) -> DriftChange | None:
        """Change of the SDE drift: none, but for ``legacy``."""
        return self._add_to_drift if self._legacy else None

    @property
    def num_dropped(self) -> int:
        """Number of times that a sample went unguided because its gradient was not finite."""
        return int(self._num_dropped)

    def _inside(self, time: Tensor) -> Tensor:
        """Whether each time ``(B,)`` is guided."""
        first, last = self._interval
        return (time >= first) & (time <= last)

    def _add_to_drift(self, drift: Tensor, x: Tensor, time: Tensor) -> Tensor:
        inside = self._inside(time)
        if self._idle or not inside.any():
            return drift
        _, energy, gradient = self._evaluate(x, time)
        term = torch.where(per_sample(inside, x), self._scale * gradient, 0.0)
        self._record(energy, drift, term)
        return drift + per_sample(time, x) * term

    def _evaluate(self, x: Tensor, time: Tensor) -> tuple[Finish, Tensor, Tensor]:
        """Rest of the evaluation, energies ``(B,)`` and their gradient ``(B, ...)``."""
        with torch.inference_mode(False), torch.enable_grad():
            leaf = _at_least_float32(x.detach().clone()).requires_grad_()
            # A view: module hooks, such as torch's FLOP counter, take no leaf.
            features, finish = self._aligned(leaf.view_as(leaf), time.clone())
            energy = self._energy(features)
            (gradient,) = torch.autograd.grad(energy.sum(), leaf)
        finite = gradient.flatten(1).isfinite().all(dim=1)
        self._num_dropped += (~finite).sum()
        return finish, energy.detach(), torch.where(per_sample(finite, x), gradient, 0.0)

    def _energy(self, features: Tensor) -> Tensor:
        if features.shape != self._target.shape:
            raise ValueError(
                f"guidance towards features of shape {tuple(self._target.shape)}, but the "
                f"network projects to {tuple(features.shape)}"
            )
        cosine = (unit_vectors(_at_least_float32(features)) * self._target).sum(dim=-1)
        counts = self._selected.sum() if self._legacy else self._selected.sum(dim=1)
        return -torch.where(self._selected, cosine, 0.0).sum(dim=1) / counts.clamp(min=1)

    def _limited(self, gradient: Tensor, velocity: Tensor) -> Tensor:
        """Gradient of each sample, scaled to the length of its term."""
        if not self._relative and self._max_ratio == math.inf:
            return self._scale * gradient
        # float64: the square of a long float32 gradient is infinite.
        length, reach = (
            torch.linalg.vector_norm(values.flatten(1), dim=1, dtype=torch.float64)
            for values in (gradient, velocity)
        )
        reach = reach * self._spread
        if self._relative:
            wanted = self._scale * reach
        else:
            wanted = torch.minimum(self._scale * length, self._max_ratio * reach)
        factor = torch.where(length > 0, wanted / length, 0.0)
        return (gradient.double() * per_sample(factor, gradient)).to(gradient.dtype)

    def _record(self, energy: Tensor, direction: Tensor, term: Tensor) -> None:
        cosine = torch.cosine_similarity(direction.flatten(1), term.flatten(1), dim=1)
        self.history.append(GuidanceRecord(energy, cosine))


def _at_least_float32(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))
