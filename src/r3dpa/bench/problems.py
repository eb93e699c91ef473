"""What samplers are judged on: a mixture whose velocity is exact, and the SiT of a checkpoint.

Letters: N scenes or samples, D dimensions, B batch.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from r3dpa.bench.front import plain_name
from r3dpa.bench.hardware import flop_of, peak_memory, synchronise
from r3dpa.bench.mixture import GaussianMixture
from r3dpa.bench.timing import Spent
from r3dpa.data import write_bin
from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.solvers import CountingVelocity, heun
from r3dpa.flow.times import ode_times
from r3dpa.generation import SamplerConfig, SceneGenerator, scene_random
from r3dpa.geometry import points_of

__all__ = ["Make", "MixtureProblem", "ModelProblem", "Problem", "Setting", "Solved"]

_SEED = 0


@dataclass(frozen=True)
class Setting:
    """One way to sample.

    Args:
        sampler: Solver and steps.
        precision: Of the networks.
        compiled: Whether they are compiled.
        batch: Scenes computed together.
        autoguided: Whether a weak snapshot guides.
        tag: What solver and shift do not tell, such as ``mean``; part of the name.
    """

    sampler: SamplerConfig
    precision: Literal["fp32", "bf16"] = "fp32"
    compiled: bool = False
    batch: int = 1
    autoguided: bool = False
    tag: str = ""

    @property
    def name(self) -> str:
        """Solver with its settings, without the number of steps."""
        name = plain_name(self.sampler.solver, self.sampler.shift)
        return " ".join(filter(None, [name, self.tag, "autoguided" if self.autoguided else ""]))

    @property
    def deterministic(self) -> bool:
        """Whether noise alone decides the result, so that it can be compared scene by scene."""
        return self.sampler.solver != "euler_maruyama"

    @property
    def plain(self) -> Setting:
        """The same solver without anything that makes it faster."""
        return replace(self, precision="fp32", compiled=False)


class Solved(NamedTuple):
    """Results of a setting.

    Attributes:
        latents: ``(N, ...)`` on the CPU.
        range_m: ``(N, H, W)`` on the CPU; None where there is no decoder.
        nfe: Evaluations per sample, counted.
    """

    latents: Tensor
    range_m: Tensor | None
    nfe: int


#: A generator of scenes in the precision of a setting, compiled and guided as it says; compiled
#: ones for its batch. The sampler does not matter. Generators may share their networks.
Make = Callable[[Setting], SceneGenerator]


class Problem(Protocol):
    """What a benchmark needs to know of a problem."""

    name: str
    device: torch.device

    def solve(self, setting: Setting, num: int) -> Solved:
        """Samples 0 to ``num`` - 1, each from its own noise."""
        ...

    def converged(self, steps: int, num: int) -> Solved:
        """The same samples by Heun steps with a float64 state."""
        ...

    def case(self, setting: Setting, folder: Path) -> Callable[[], Spent]:
        """One batch as a case to be timed; times are per sample."""
        ...

    def flop(self) -> tuple[float, float]:
        """FLOP of a sample: of each evaluation, and of everything else."""
        ...

    def memory(self, setting: Setting) -> int | None:
        """Peak memory of one batch on a GPU, bytes."""
        ...


class MixtureProblem:
    """A mixture of Gaussians, whose velocity has no error.

    Args:
        mixture: Data.
        batch: Samples that are timed together.
    """

    name = "mixture"

    def __init__(self, mixture: GaussianMixture, batch: int = 256) -> None:
        self.mixture, self.batch = mixture, batch
        self.device = mixture.means.device

    def solve(self, setting: Setting, num: int) -> Solved:
        """Samples in float64 throughout; precision and compilation do not apply."""
        generator = torch.Generator().manual_seed(_SEED)
        noise = self._draw(num, generator)
        velocity = CountingVelocity(self.mixture.velocity)
        latents = setting.sampler.solve(velocity, noise, generator, Interpolant())
        return Solved(latents, None, velocity.nfe)

    def _draw(self, num: int, generator: torch.Generator) -> Tensor:
        shape = (num, self.mixture.means.shape[1])
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    def converged(self, steps: int, num: int) -> Solved:
        """Heun's method with the exact velocity."""
        noise = self._draw(num, torch.Generator().manual_seed(_SEED))
        velocity = CountingVelocity(self.mixture.velocity)
        return Solved(heun(velocity, noise, ode_times(steps)), None, velocity.nfe)

    def case(self, setting: Setting, folder: Path) -> Callable[[], Spent]:
        """A batch of samples; nothing is written."""

        def run() -> Spent:
            start, core = time.perf_counter(), time.process_time()
            self.solve(setting, self.batch)
            wall, spent = time.perf_counter() - start, time.process_time() - core
            return Spent(wall / self.batch, wall / self.batch, spent / self.batch)

        return run

    def flop(self) -> tuple[float, float]:
        """Two matrix products for each evaluation."""
        x = self.mixture.means[:1]
        return flop_of(lambda: self.mixture.velocity(x, torch.ones(1))), 0.0

    def memory(self, setting: Setting) -> int | None:
        """Not known."""
        return None


class ModelProblem:
    """The SiT and the decoder of a checkpoint.

    Args:
        make: Generator of scenes for a setting.
        batch: Scenes that are solved together where nothing is timed.
    """

    name = "model"

    def __init__(self, make: Make, batch: int) -> None:
        self._make, self._batch = make, batch
        self._made: dict[Setting, SceneGenerator] = {}
        self._plain = self._generator(Setting(SamplerConfig("euler", 1)))
        self.device = self._plain.device
        self.sensor = self._plain.geometry.projection.sensor

    def _generator(self, setting: Setting) -> SceneGenerator:
        """A generator of its own that shares networks, and what was compiled, with others."""
        kind = replace(
            setting,
            sampler=SamplerConfig(),
            tag="",
            batch=setting.batch if setting.compiled else 1,
        )
        if kind not in self._made:
            self._made[kind] = self._make(setting)
        return self._made[kind].with_sampler(setting.sampler)

    def solve(self, setting: Setting, num: int) -> Solved:
        """Scenes as :class:`SceneGenerator` makes them."""
        generator = self._generator(setting)
        size = setting.batch if setting.compiled else self._batch
        with _exact_products():
            parts = [generator.generate(part, _SEED) for part in _batches(num, size)]
        return Solved(
            torch.cat([part.latents.cpu() for part in parts]),
            torch.cat([part.range_m.cpu() for part in parts]),
            parts[0].nfe,
        )

    @torch.inference_mode()
    def converged(self, steps: int, num: int) -> Solved:
        """The network in float32 without TF32; state in float64."""
        generator, latents, images = self._plain, [], []

        def velocity(x: Tensor, moment: Tensor) -> Tensor:
            return generator.sit.velocity(x.float(), moment.float()).double()

        counted = CountingVelocity(velocity)
        with _exact_products():
            for part in _batches(num, self._batch):
                counted.nfe = 0
                noise = self._noise(part).double()
                found = heun(counted, noise, ode_times(steps))
                latents.append(found.cpu())
                raw = generator.latent_norm.denormalise(found.float())
                image = generator.vae.decode(raw)[:, 0].float()
                images.append(generator.geometry.codec.decode(image, self.sensor).cpu())
        return Solved(torch.cat(latents), torch.cat(images), counted.nfe)

    def _noise(self, indices: Sequence[int]) -> Tensor:
        sit = self._plain.sit
        shape = (sit.in_channels, *sit.input_size)
        draws = [torch.randn(shape, generator=scene_random(_SEED, i)) for i in indices]
        return torch.stack(draws).to(self.device)

    def case(self, setting: Setting, folder: Path) -> Callable[[], Spent]:
        """A batch of scenes: sampling and decoder; then copying, points, and ``.bin`` files."""
        generator, indices, device = self._generator(setting), range(setting.batch), self.device

        def run() -> Spent:
            clock = _device_clock(device)
            start, core = time.perf_counter(), time.process_time()
            scenes = generator.generate(indices, _SEED)
            device_seconds, core = clock(), time.process_time() - core
            for index, range_m in enumerate(scenes.range_m.cpu()):
                points = points_of(range_m, generator.geometry.projection)
                write_bin(folder / f"{index:06d}.bin", points)
            end = time.perf_counter() - start
            per = setting.batch
            on_cpu = device.type == "cpu"
            return Spent(device_seconds / per, end / per, core / per if on_cpu else None)

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
        """Peak of the tensors while one batch is generated."""
        if self.device.type != "cuda":
            return None
        generator = self._generator(setting)
        return peak_memory(lambda: generator.generate(range(setting.batch), _SEED), self.device)


def _batches(num: int, size: int) -> list[range]:
    return [range(first, min(first + size, num)) for first in range(0, num, size)]


def _exact_products() -> AbstractContextManager[None]:
    """Float32 convolutions in float32, as matrix products are unless told otherwise."""
    return torch.backends.cudnn.flags(enabled=True, allow_tf32=False)


def _device_clock(device: torch.device) -> Callable[[], float]:
    """Starts now; tells the seconds until all work given to the device since then is done."""
    if device.type != "cuda":
        start = time.perf_counter()
        return lambda: time.perf_counter() - start
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    synchronise(device)
    begin.record()

    def stop() -> float:
        end.record()
        synchronise(device)
        return begin.elapsed_time(end) / 1000

    return stop
