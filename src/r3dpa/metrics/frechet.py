"""Fréchet distance as a streaming metric, for the features of any extractor."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import Metric

from r3dpa.metrics.functional import Moments, frechet_distance, merge_packed


class FrechetDistance(Metric):
    """Fréchet distance between real and generated features: FRID, FLD, FSVD, FPVD.

    The metric knows no network: give it the features of one extractor. It keeps the moments of
    each set in float64, so memory does not grow with the samples, and processes with unequal
    batches give what one process would.

    Args:
        num_features: Feature width F.
        allow_few_samples: Accept fewer than F + 1 samples, where the covariance is singular and
            the distance mostly tells how many samples there were.
        reference: Mean ``(F,)`` and covariance ``(F, F)`` of the real features, where only these
            are known, as in the official statistics file; real features are then refused.

    Raises:
        ValueError: On features that hold NaN or have another width; by ``compute``, if there are
            fewer than F + 1 samples.

    Example:
        >>> metric = FrechetDistance(num_features=2)
        >>> square = torch.tensor([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
        >>> metric.update(square, real=True)
        >>> metric.update(square + 3, real=False)
        >>> round(metric.compute().item(), 6)
        18.0
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

    real_moments: Tensor
    generated_moments: Tensor
    reference_mean: Tensor | None
    reference_covariance: Tensor | None

    def __init__(
        self,
        num_features: int,
        allow_few_samples: bool = False,
        reference: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.num_features = num_features
        self.allow_few_samples = allow_few_samples
        empty = torch.zeros(1 + num_features + num_features**2, dtype=torch.float64)
        for name in ("real_moments", "generated_moments"):
            self.add_state(name, default=empty.clone(), dist_reduce_fx=merge_packed)
        mean, covariance = reference if reference is not None else (None, None)
        self.register_buffer("reference_mean", mean, persistent=False)
        self.register_buffer("reference_covariance", covariance, persistent=False)

    def update(self, features: Tensor, real: bool) -> None:
        """Add ``(N, F)`` features of real or of generated scans."""
        name = f"{'real' if real else 'generated'} features"
        if features.ndim != 2 or features.shape[1] != self.num_features:
            raise ValueError(
                f"{name}: expected (N, {self.num_features}), got {tuple(features.shape)}; "
                "num_features must be the width of the extractor"
            )
        if real and self.reference_mean is not None:
            raise ValueError("real features given beside a reference; build the metric without it")
        state = "real_moments" if real else "generated_moments"
        merged = Moments.unpack(getattr(self, state)).merge(Moments.of(features.detach(), name))
        setattr(self, state, merged.pack())

    def compute(self) -> Tensor:
        """Distance ``()`` float64 of everything seen so far, by all processes."""
        generated = self._gaussian(Moments.unpack(self.generated_moments), "generated")
        if self.reference_mean is not None and self.reference_covariance is not None:
            real = (self.reference_mean, self.reference_covariance)
        else:
            real = self._gaussian(Moments.unpack(self.real_moments), "real")
        return frechet_distance(*real, *generated)

    def _gaussian(self, moments: Moments, which: str) -> tuple[Tensor, Tensor]:
        needed = 2 if self.allow_few_samples else self.num_features + 1
        if moments.count < needed:
            raise ValueError(
                f"{which}: {int(moments.count)} samples for {self.num_features} features, at least "
                f"{needed} are needed; give more, or allow_few_samples=True for a smoke test"
            )
        return moments.mean, moments.covariance(f"{which} features")
