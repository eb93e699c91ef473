"""Problems for samplers: a mixture with an exact velocity, and the networks of a checkpoint.

Letters: N scenes or samples, D dimensions, B batch, K Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import torch
from torch import Tensor

from r3dpa.bench.measure import flop_of, timed
from r3dpa.checkpoints import Checkpoint
from r3dpa.flow.solvers import ODE_SOLVERS, heun
from r3dpa.flow.times import ode_times
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.stages import scene_generator

if TYPE_CHECKING:
    from r3dpa.baselines import BaselineGenerator

Precision = Literal["fp32", "bf16"]
Decoder = Literal["full", "thin"]
_SEED = 0
#: Convolutions in float32, as matrix products are by default.
_EXACT_PRODUCTS = partial(torch.backends.cudnn.flags, enabled=True, allow_tf32=False)


@dataclass(frozen=True)
class GaussianMixture:
    """Data distribution ``sum_k weight_k N(mean_k, std^2 I)`` and its velocity on the linear path.

    ``means`` are ``(K, D)``, all Gaussians have the same ``std`` in every direction, and the
    ``weights`` ``(K,)`` need not sum to 1.
    """

    means: Tensor
    std: float
    weights: Tensor

    def velocity(self, x: Tensor, time: Tensor) -> Tensor:
        """Exact velocity ``E[noise - data | x_t = x]`` on the path ``(1 - t) data + t noise``.

        Given the Gaussian k, ``x_t`` is Gaussian about ``(1 - t) mean_k`` with variance
        ``V = (1 - t)^2 std^2 + t^2``, so that with ``m = sum_k p(k | x) mean_k``::

            v = -m + (t - (1 - t) std^2) / V (x - (1 - t) m)

        ``|x|^2`` is common to all ``log p(k | x)`` and left out: nothing large cancels. Finite for
        all t in [0, 1]: ``-x`` at t = 0 and ``x`` minus the mean of the data at t = 1. Samples are
        ``(B, D)``, times ``(B,)``; computed in float64, returned in the dtype of ``x``.
        """
        state, t = x.double(), time.double()[:, None]
        means, weights = self.means.to(state), self.weights.to(state)
        variance = (1 - t).square() * self.std**2 + t.square()
        nearness = (1 - t) * (state @ means.T) - (1 - t).square() * means.square().sum(1) / 2
        mean = torch.softmax(weights.log() + nearness / variance, dim=1) @ means
        slope = (t - (1 - t) * self.std**2) / variance
        return (slope * (state - (1 - t) * mean) - mean).to(x.dtype)


def toy_mixture(seed: int = 0) -> GaussianMixture:
    """Return 128 equally likely Gaussians in 64 dimensions, float64, standard deviation 0.2.

    The means are standard Gaussian in a random subspace of 4 dimensions, as data lie near few
    dimensions of their space. There they are close together, so that a path decides between
    neighbours late, which is where solvers err. Means in all 64 dimensions would be far apart, and
    decided between at once near the noise.
    """
    generator = torch.Generator().manual_seed(seed)
    places = torch.randn(128, 4, generator=generator, dtype=torch.float64)
    plane = torch.randn(4, 64, generator=generator, dtype=torch.float64) / 2
    return GaussianMixture(places @ plane, std=0.2, weights=torch.full((128,), 1 / 128).double())


@dataclass(frozen=True)
class Setting:
    """One way to sample: solver, steps and shift, precision, scenes computed together, decoder."""

    sampler: SamplerConfig
    precision: Precision = "fp32"
    batch: int = 1
    decoder: Decoder = "full"

    @property
    def name(self) -> str:
        """Solver with its shift and a thin decoder, without the number of steps."""
        solver, shift = self.sampler.solver, self.sampler.shift
        name: str = solver if shift == 1 else f"{solver} shift {shift:g}"
        return name if self.decoder == "full" else f"{name} thin"

    @property
    def nfe(self) -> int:
        """Network evaluations per scene."""
        return self.sampler.nfe


class Solved(NamedTuple):
    """Latents ``(N, ...)`` and range images ``(N, H, W)``, none without a decoder; on the CPU."""

    latents: Tensor
    range_m: Tensor | None


class MixtureProblem:
    """A mixture of Gaussians with its exact velocity, in float64 at every setting.

    ``num`` samples are solved together, since one generator draws all noise; ``batch`` are timed.
    """

    def __init__(self, mixture: GaussianMixture, num: int, batch: int = 256) -> None:
        self.mixture, self.batch, self._timed_batch = mixture, num, batch

    def solve(self, setting: Setting, indices: range) -> Solved:
        """Samples of these indices, each from its own noise."""
        shape = (len(indices), self.mixture.means.shape[1])
        generator = torch.Generator().manual_seed(_SEED)
        noise = torch.randn(shape, generator=generator, dtype=torch.float64)
        times = ode_times(setting.sampler.steps, shift=setting.sampler.shift)
        solver = ODE_SOLVERS[setting.sampler.solver]
        return Solved(solver(self.mixture.velocity, noise, times), None)

    def converged(self, steps: int, indices: range) -> Solved:
        """The same samples by Heun's method."""
        return self.solve(Setting(SamplerConfig("heun", steps)), indices)

    def case(self, setting: Setting) -> Callable[[], float]:
        """A batch as a case to be timed, times per sample."""
        run = timed(lambda: self.solve(setting, range(self._timed_batch)))
        return lambda: run() / self._timed_batch

    def flop(self, decoder: Decoder = "full") -> tuple[float, float]:
        """FLOP of a sample: of each evaluation, and of everything else."""
        x = self.mixture.means[:1]
        return flop_of(lambda: self.mixture.velocity(x, torch.ones(1))), 0.0


class ModelProblem:
    """Networks of a checkpoint, without guidance: solvers are judged by the plain flow.

    Where nothing is timed, ``batch`` scenes are solved together.
    """

    def __init__(self, checkpoint: Checkpoint, device: str, batch: int) -> None:
        read = partial(
            scene_generator, checkpoint, SamplerConfig(), device=device, guidance_scale=1.0
        )
        self.batch = batch
        has_thin = "thin_decoder" in checkpoint.networks
        decoders: tuple[Decoder, ...] = ("full", "thin") if has_thin else ("full",)
        self._generators = {
            (precision, decoder): read(precision=precision, decoder=decoder)
            for precision in ("fp32", "bf16")
            for decoder in decoders
        }
        self.device = self._generators["fp32", "full"].device

    def _generator(self, setting: Setting) -> SceneGenerator | BaselineGenerator:
        return self._generators[setting.precision, setting.decoder].with_sampler(setting.sampler)

    def solve(self, setting: Setting, indices: range) -> Solved:
        """Scenes of these indices as the generator draws them."""
        with _EXACT_PRODUCTS():
            scenes = self._generator(setting).generate(indices, _SEED)
        return Solved(scenes.latents.cpu(), scenes.range_m.cpu())

    @torch.inference_mode()
    def converged(self, steps: int, indices: range) -> Solved:
        """The same scenes by Heun's method: network in float32 without TF32, state in float64."""
        generator = self._generators["fp32", "full"]
        noise = generator.noise(indices, _SEED)
        with _EXACT_PRODUCTS():
            latents = heun(generator.velocity, noise.double(), ode_times(steps))
            range_m = generator.decode(latents.float())
        return Solved(latents.cpu(), range_m.cpu())

    def case(self, setting: Setting) -> Callable[[], float]:
        """Sampling and decoding a batch as a case to be timed, times per scene."""
        generator, indices = self._generator(setting), range(setting.batch)
        run = timed(lambda: generator.generate(indices, _SEED), self.device)
        return lambda: run() / setting.batch

    def flop(self, decoder: Decoder = "full") -> tuple[float, float]:
        """Counted with one and with two Euler steps of one scene."""
        counts = []
        for steps in (1, 2):
            generator = self._generator(Setting(SamplerConfig("euler", steps), decoder=decoder))
            generator.generate(
                [0], _SEED
            )  # computes what a schedule needs once, which is not counted
            counts.append(flop_of(partial(generator.generate, [0], _SEED)))
        each = float(counts[1] - counts[0])
        return each, counts[0] - each


Problem = MixtureProblem | ModelProblem
