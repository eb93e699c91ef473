"""``r3dpa bench sampling``: what accuracy costs in time, by solver, steps and precision."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from r3dpa.bench.measure import compare
from r3dpa.bench.problems import (
    MixtureProblem,
    ModelProblem,
    Precision,
    Problem,
    Setting,
    Solved,
    toy_mixture,
)
from r3dpa.bench.report import Errors, Finding, Row, write_report
from r3dpa.checkpoints import read_checkpoint
from r3dpa.flow.average_velocity import AVERAGE_STEPS
from r3dpa.flow.sampler import SamplerConfig, Solver
from r3dpa.flow.solvers import steps_for
from r3dpa.io import atomic_path, command, machine, usable_device, versions

#: Solvers with the shift of their grids.
_SOLVERS: tuple[tuple[Solver, float], ...] = (
    *(("euler", 1.0), ("heun", 1.0), ("midpoint", 1.0), ("ab2", 1.0), ("ab2", 1.75), ("ab2", 2.0)),
    *(("ab3", 1.0), ("ab3", 1.5), ("ab3", 2.5), ("dpmpp_2m", 1.75), ("unipc", 1.0)),
)
_EVALUATIONS = (2, 4, 8, 16, 32, 64, 128, 256)
_PRECISION_STEPS = 32
_bar = partial(tqdm, disable=None)  # without a terminal there is none


@dataclass(frozen=True)
class Effort:
    """Samples of each row, Heun steps of the reference, NFE of the rows, timing rounds, batch."""

    samples: int
    reference_steps: int
    evaluations: tuple[int, ...]
    rounds: int
    batch: int


_TOY = Effort(1024, 1000, _EVALUATIONS, 20, 256)
_TOY_QUICK = Effort(256, 1000, _EVALUATIONS[:-2], 3, 256)


class Work:
    """Pieces of an interrupted run in a folder (if any), for the next run of the same request."""

    def __init__(self, folder: Path | None = None, request: Any = None) -> None:
        self.folder = folder
        text = json.dumps(request)
        if self.piece("request", lambda: text) != text:
            raise ValueError(
                f"{folder} holds unfinished work of other options or another checkpoint: repeat "
                "the same command to go on, or delete the folder"
            )

    def piece(self, name: str, make: Callable[[], Any]) -> Any:
        """Cached result of ``make``: tensors, numbers, strings, tuples, lists, dictionaries."""
        if self.folder is None:
            return make()
        path = self.folder / f"{name}.pt"
        if not path.exists():
            value = make()
            with atomic_path(path) as temporary:
                torch.save(value, temporary)
        return torch.load(path, weights_only=True)


def sampling(
    out: Path,
    ckpt: Path | None = None,
    quick: bool = False,
    effort: Mapping[str, Any] | None = None,
    device: str = "auto",
) -> str:
    """Measures what accuracy costs in time, for an exact velocity and for a trained model.

    The folder gets ``sampling.json``, ``summary.md``, ``pareto.png`` (error against seconds), and
    from a model ``quality.json``, as ``r3dpa sample --quality`` reads it. An interrupted run of a
    model goes on with the same call; ``ValueError`` if the folder holds unfinished work of another.
    ``effort`` has fields of :class:`Effort` for the model, the usual ones where missing or None.
    Returns tables, error per second along the front, and where the files are.
    """
    device = usable_device(device)
    kind = device.partition(":")[0]
    batch, toy = {"cuda": 64, "cpu": 4}[kind], _TOY_QUICK if quick else _TOY
    usual = Effort(256, 1000, _EVALUATIONS, 20, batch)
    if quick:
        usual = Effort(8, 200, _EVALUATIONS[1:-3], 3, batch)
    chosen = replace(usual, **{k: v for k, v in (effort or {}).items() if v is not None})
    about, work = {}, Work()
    problems: dict[str, Callable[[], Finding]] = {
        # Without a network precision does not apply.
        "mixture": lambda: run_problem(
            MixtureProblem(toy_mixture(), toy.samples, toy.batch), settings_of(toy), toy
        )
    }
    if ckpt is not None:
        checkpoint = read_checkpoint(ckpt)
        about = {"file": checkpoint.path.name, "stage": checkpoint.stage, "step": checkpoint.step}
        model = ModelProblem(checkpoint, device, chosen.batch)
        request = [about, checkpoint.path.stat().st_mtime_ns, str(chosen), device, quick]
        work = Work(out / "work", request)
        ways = settings_of(chosen, ("bf16", "fp32") if kind == "cuda" else ("fp32", "bf16"))
        if checkpoint.stage == "few_step":
            ways += few_step_settings(ways[0], "thin_decoder" in checkpoint.networks)
        problems["model"] = lambda: run_problem(model, ways, chosen, work)
    found = {name: run() for name, run in problems.items()}
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    facts = {
        "command": command(),
        "model": about or "none given: the mixture alone",
        "machine": machine() | {"threads": torch.get_num_threads(), "gpu": gpu},
        "versions": versions(torch, np),
    }
    text = write_report(out, found, facts)
    if work.folder is not None:
        shutil.rmtree(work.folder)
    return text


def settings_of(effort: Effort, precisions: Sequence[Precision] = ()) -> list[Setting]:
    """All ways to sample, in the first of the precisions.

    AB2 with 32 steps also runs in each precision, and with single scenes.
    """
    usual = Setting(SamplerConfig("euler", 1), [*precisions, "fp32"][0], effort.batch)
    ways = [
        replace(usual, sampler=SamplerConfig(solver, steps, shift=shift))
        for solver, shift in _SOLVERS
        for steps in dict.fromkeys(steps_for(solver, nfe) for nfe in effort.evaluations)
    ]
    fixed = replace(usual, sampler=SamplerConfig("ab2", _PRECISION_STEPS, shift=2.0))
    ways += [replace(fixed, precision=precision) for precision in precisions]
    ways += [replace(fixed, batch=1)] * bool(precisions)
    samplers = [way.sampler for way in ways]
    return sorted(dict.fromkeys(ways), key=lambda way: samplers.index(way.sampler))


def few_step_settings(usual: Setting, thin: bool) -> list[Setting]:
    """Average velocities in all numbers of steps, by the decoder of the VAE and the thin one."""
    samplers = [SamplerConfig("average_velocity", steps) for steps in AVERAGE_STEPS]
    ways = [replace(usual, sampler=sampler) for sampler in samplers]
    return ways + [replace(way, decoder="thin") for way in ways] * thin


def run_problem(
    problem: Problem, ways: Sequence[Setting], effort: Effort, work: Work | None = None
) -> Finding:
    """Error and time of each way to sample, with progress bars."""
    work, num, steps = work or Work(), effort.samples, effort.reference_steps
    exact, self_error = reference(problem, steps, num, work)
    errors = errors_of(problem, ways, exact, work)
    labelled = _labelled(ways, effort.batch)
    cases = {name: problem.case(way) for name, way in labelled.items()}
    # Complete rounds are kept.
    measured = compare(cases, effort.rounds, lambda n, run: work.piece(f"round_{n}", run))
    flop = {decoder: problem.flop(decoder) for decoder in {way.decoder for way in ways}}
    rows = []
    for (label, way), error in zip(labelled.items(), errors, strict=True):
        each, rest = flop[way.decoder]
        work_of = way.nfe * each + rest
        rows.append(Row(label, way, error, measured.seconds[label], work_of, self_error))
    return Finding(rows, steps, num, self_error, measured, flop["full"])


def _batches(problem: Problem, num: int) -> list[range]:
    size = problem.batch
    return [range(first, min(first + size, num)) for first in range(0, num, size)]


def _joined(parts: Sequence[Solved]) -> Solved:
    ranges = [part.range_m for part in parts if part.range_m is not None]
    return Solved(
        torch.cat([part.latents for part in parts]), torch.cat(ranges) if ranges else None
    )


def reference(problem: Problem, steps: int, num: int, work: Work) -> tuple[Solved, float]:
    """The converged solution, and the RMSE of its latents from those of half the steps."""

    def solve(count: int, indices: range) -> Solved:
        name = f"reference_{count}_{indices.start}"
        return Solved(*work.piece(name, lambda: tuple(problem.converged(count, indices))))

    solved, half = (
        _joined([solve(count, part) for part in _bar(_batches(problem, num), f"Heun-{count}")])
        for count in (steps, steps // 2)
    )
    return solved, _rmse(solved.latents, half.latents)


def errors_of(problem: Problem, ways: Sequence[Setting], exact: Solved, work: Work) -> list[Errors]:
    """Errors of each setting, and from the same sampler in fp32."""
    batches = _batches(problem, len(exact.latents))

    @lru_cache(maxsize=2)  # settings of one sampler follow each other
    def solve(way: Setting) -> Solved:
        return _joined([problem.solve(way, part) for part in batches])

    def errors(way: Setting) -> tuple[Any, ...]:
        way = replace(way, batch=1)
        solved, plain = solve(way), solve(replace(way, precision="fp32"))
        return (
            _squared(solved.latents, exact.latents).tolist(),
            _rmse(solved.latents, plain.latents),
            *_range_errors(solved.range_m, exact.range_m),
        )

    return [
        Errors(*work.piece(f"errors_{index}", partial(errors, way)))
        for index, way in enumerate(_bar(ways, "errors"))
    ]


def _squared(a: Tensor, b: Tensor) -> Tensor:
    return (a.double() - b.double()).flatten(1).square().mean(dim=1)


def _rmse(a: Tensor, b: Tensor) -> float:
    return float(np.sqrt(_squared(a, b).numpy().mean()))


def _range_errors(a: Tensor | None, b: Tensor | None) -> tuple[float | None, float | None]:
    """RMSE in metres over pixels valid in both, and intersection over union of the valid ones."""
    if a is None or b is None:
        return None, None
    both, either = (a > 0) & (b > 0), (a > 0) | (b > 0)
    if not both.any():
        return None, 0.0
    rmse = (a - b)[both].double().square().mean().sqrt().item()
    return rmse, (both.sum() / torch.clamp(either.sum(), min=1)).item()


def _labelled(ways: Sequence[Setting], batch: int) -> dict[str, Setting]:
    """Settings by name and NFE; precision and batch only where several share them."""
    found: dict[str, Setting] = {}
    for way in ways:
        label = f"{way.name} {way.nfe}"
        if label in found:
            label += f" {way.precision}"
            label += f" batch {way.batch}" if way.batch != batch else ""
        found[label] = way
    return found
