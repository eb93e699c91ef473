"""Problems for samplers: a mixture with an exact velocity, and the networks of a checkpoint.

Letters: N scenes or samples, D dimensions.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from r3dpa.bench.measure import Spent, flop_of, peak_bytes, synchronise, timed
from r3dpa.bench.mixture import GaussianMixture
from r3dpa.checkpoints import Checkpoint
from r3dpa.data import write_bin
from r3dpa.flow.solvers import ODE_SOLVERS, evaluations, heun
from r3dpa.flow.times import ode_times
from r3dpa.generation import SamplerConfig, SceneGenerator, scene_random
from r3dpa.geometry import points_of

_SEED = 0


@dataclass(frozen=True)
class Setting:
    """One way to sample.

    Args:
        sampler: ODE solver, steps and shift.
        precision: Of the networks.
        compiled: Whether they are compiled.
        batch: Scenes computed together.
    """

    sampler: SamplerConfig
    precision: Literal["fp32", "bf16"] = "fp32"
    compiled: bool = False
    batch: int = 1

    @property
    def name(self) -> str:
        """Solver with its shift, without the number of steps."""
        solver, shift = self.sampler.solver, self.sampler.shift
        return solver if shift == 1 else f"{solver} shift {shift:g}"

    @property
    def nfe(self) -> int:
        """Network evaluations per scene."""
        return evaluations(self.sampler.solver, self.sampler.steps)

    @property
    def plain(self) -> Setting:
        """The same solver in fp32, not compiled."""
        return replace(self, precision="fp32", compiled=False)


class Solved(NamedTuple):
    """Latents ``(N, ...)`` and range images ``(N, H, W)``, none without a decoder; on the CPU."""

    latents: Tensor
    range_m: Tensor | None


class MixtureProblem:
    """A mixture of Gaussians with its exact velocity; float64, whatever the precision of a setting.

    Args:
        mixture: Data.
        num: Samples that are solved together: one generator draws all noise.
        batch: Samples that are timed together.
    """

    def __init__(self, mixture: GaussianMixture, num: int, batch: int = 256) -> None:
        self.mixture, self.batch, self._timed_batch = mixture, num, batch
        self.device = mixture.means.device

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

    def case(self, setting: Setting, folder: Path) -> Callable[[], Spent]:
        """A batch as a case to be timed, times per sample; nothing is written."""
        run = timed(lambda: self.solve(setting, range(self._timed_batch)))
        return lambda: run().over(self._timed_batch)

    def flop(self) -> tuple[float, float]:
        """FLOP of a sample: of each evaluation, and of everything else."""
        x = self.mixture.means[:1]
        return flop_of(lambda: self.mixture.velocity(x, torch.ones(1))), 0.0

    def memory(self, setting: Setting) -> int | None:
        """Not measured."""
        return None


class ModelProblem:
    """The velocity network and the decoder of a checkpoint.

    Args:
        checkpoint: Of stage joint or flow_matching.
        device: Where it is computed.
        batch: Scenes that are solved together where nothing is timed.
    """

    def __init__(self, checkpoint: Checkpoint, device: str, batch: int) -> None:
        self.batch, self._path = batch, checkpoint.interpolant
        self._plain = SceneGenerator.from_checkpoint(checkpoint, SamplerConfig(), device=device)
        self._made = {Setting(SamplerConfig()): self._plain}
        self.device = self._plain.device

    def _generator(self, setting: Setting) -> SceneGenerator:
        """Generator of its own that shares networks, and what was compiled, with others."""
        batch = setting.batch if setting.compiled else 1
        kind, plain = replace(setting, sampler=SamplerConfig(), batch=batch), self._plain
        if kind not in self._made:
            self._made[kind] = SceneGenerator(
                plain.vae,
                plain.sit,
                plain.latent_norm,
                plain.geometry,
                setting.sampler,
                self._path,
                setting.precision,
                batch_size=batch if setting.compiled else None,
                compile=setting.compiled,
            )
        return self._made[kind].with_sampler(setting.sampler)

    def solve(self, setting: Setting, indices: range) -> Solved:
        """Scenes of these indices as the generator draws them."""
        with _exact_products():
            found = self._generator(setting).generate(indices, _SEED)
        return Solved(found.latents.cpu(), found.range_m.cpu())

    @torch.inference_mode()
    def converged(self, steps: int, indices: range) -> Solved:
        """The same scenes by Heun's method: network in float32 without TF32, state in float64."""
        generator, sit = self._plain, self._plain.sit
        shape = (sit.in_channels, *sit.input_size)
        draws = [torch.randn(shape, generator=scene_random(_SEED, i)) for i in indices]
        noise = torch.stack(draws).to(self.device)

        def velocity(x: Tensor, moment: Tensor) -> Tensor:
            return sit.velocity(x.float(), moment.float()).double()

        with _exact_products():
            found = heun(velocity, noise.double(), ode_times(steps))
            image = generator.vae.decode(generator.latent_norm.denormalise(found.float()))
        geometry = generator.geometry
        range_m = geometry.codec.decode(image[:, 0].float(), geometry.projection.sensor)
        return Solved(found.cpu(), range_m.cpu())

    def case(self, setting: Setting, folder: Path) -> Callable[[], Spent]:
        """A batch of scenes: sampling and decoder; then copying, points and ``.bin`` files."""
        generator, scenes = self._generator(setting), list[Tensor]()
        indices = range(setting.batch)
        sampling = timed(
            lambda: scenes.append(generator.generate(indices, _SEED).range_m), self.device
        )

        def run() -> Spent:
            scenes.clear()
            start = time.perf_counter()
            spent = sampling()
            for index, range_m in enumerate(scenes[0].cpu()):
                points = points_of(range_m, generator.geometry.projection)
                write_bin(folder / f"{index:06d}.bin", points)
            return spent._replace(end_to_end=time.perf_counter() - start).over(setting.batch)

        return run

    def flop(self) -> tuple[float, float]:
        """Counted with one and with two Euler steps of one scene."""
        counts = []
        for steps in (1, 2):
            generator = self._generator(Setting(SamplerConfig("euler", steps)))
            generator.generate([0], _SEED)  # what is computed once for a schedule does not count
            counts.append(flop_of(partial(generator.generate, [0], _SEED)))
        each = float(counts[1] - counts[0])
        return each, counts[0] - each

    def memory(self, setting: Setting) -> int | None:
        """Peak memory of one batch on a GPU, bytes; None on a CPU."""
        if self.device.type != "cuda":
            return None
        generator = self._generator(setting)
        torch.cuda.reset_peak_memory_stats(self.device)
        generator.generate(range(setting.batch), _SEED)
        synchronise(self.device)
        return peak_bytes(self.device)


Problem = MixtureProblem | ModelProblem


def _exact_products() -> AbstractContextManager[None]:
    """Convolutions in float32, as matrix products are by default."""
    return torch.backends.cudnn.flags(enabled=True, allow_tf32=False)
