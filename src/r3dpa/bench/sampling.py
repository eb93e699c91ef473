"""``r3dpa bench sampling``: what accuracy costs in time, by solver, steps and precision."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
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
from r3dpa.bench.report import pareto_front, write_report
from r3dpa.checkpoints import read_checkpoint
from r3dpa.flow.average_velocity import AVERAGE_STEPS
from r3dpa.flow.sampler import SamplerConfig, Solver
from r3dpa.flow.solvers import steps_for
from r3dpa.io import command, machine, save_tensors, usable_device, versions

#: Solvers with the shift of their grids.
_SOLVERS: tuple[tuple[Solver, float], ...] = (
    ("euler", 1.0),
    ("heun", 1.0),
    ("midpoint", 1.0),
    ("ab2", 1.0),
    ("ab2", 1.75),
    ("ab2", 2.0),
    ("ab3", 1.0),
    ("ab3", 1.5),
    ("ab3", 2.5),
    ("dpmpp_2m", 1.75),
    ("unipc", 1.0),
)
_EVALUATIONS = (2, 4, 8, 16, 32, 64, 128, 256)
_PRECISION_STEPS = 32
_MARGIN = 10  # the reference must be this many times more exact than what it judges
_RESAMPLES = 1000
_bar = partial(tqdm, disable=None)  # hidden without a terminal


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
                "the same command to continue it, or delete the folder"
            )

    def piece(self, name: str, make: Callable[[], Any]) -> Any:
        """Return the stored result of ``make``: tensors, numbers, strings, tuples, lists, dicts."""
        if self.folder is None:
            return make()
        path = self.folder / f"{name}.pt"
        if not path.exists():
            value = make()
            save_tensors(value, path)
        return torch.load(path, weights_only=True)


def sampling(
    out: Path,
    ckpt: Path | None = None,
    quick: bool = False,
    effort: Mapping[str, Any] | None = None,
    device: str = "auto",
) -> str:
    """Measure what accuracy costs in time, for an exact velocity and for a trained model.

    An interrupted run of a model continues with the same call.

    Args:
        out: Folder for ``sampling.json``, ``summary.md`` and ``pareto.png``: error against seconds.
        ckpt: Checkpoint of the model; default: the exact velocity alone.
        quick: Few scenes, steps and rounds.
        effort: Fields of :class:`Effort` for the model; defaults where missing or None.
        device: Device of the model.

    Returns:
        Tables, and where the files are.

    Raises:
        ValueError: If the folder holds unfinished work of another call.
    """
    device = usable_device(device)
    kind = device.partition(":")[0]
    batch = 64 if kind == "cuda" else 4
    usual = Effort(256, 1000, _EVALUATIONS, 20, batch)
    if quick:
        usual = Effort(8, 200, _EVALUATIONS[1:-3], 3, batch)
    chosen = replace(usual, **{k: v for k, v in (effort or {}).items() if v is not None})
    if chosen.reference_steps < 2:
        raise ValueError(
            f"reference_steps must be at least 2, got {chosen.reference_steps}: the solution in "
            "half the steps says how exact the reference is"
        )
    work, model, ways, about = Work(), None, [], {}
    if ckpt is not None:  # wrong files and options are refused before anything is measured
        checkpoint = read_checkpoint(ckpt)
        about = {"file": checkpoint.path.name, "stage": checkpoint.stage, "step": checkpoint.step}
        model = ModelProblem(checkpoint, device, chosen.batch)
        request = [about, checkpoint.path.stat().st_mtime_ns, str(chosen), device, quick]
        ways = settings_of(chosen, ("bf16", "fp32") if kind == "cuda" else ("fp32", "bf16"))
        if checkpoint.stage == "few_step":
            ways += few_step_settings(ways[0], "thin_decoder" in checkpoint.networks)
        work = Work(out / "work", request)
    toy = _TOY_QUICK if quick else _TOY
    mixture = MixtureProblem(toy_mixture(), toy.samples, toy.batch)
    problems = {"mixture": run_problem(mixture, settings_of(toy), toy)}
    if model is not None:
        problems["model"] = run_problem(model, ways, chosen, work)
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    facts = {
        "command": command(),
        "model": about or "none given: the mixture alone",
        "machine": machine() | {"threads": torch.get_num_threads(), "gpu": gpu},
        "versions": versions(torch, np),
    }
    text = write_report(out, problems, facts)
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
    if precisions:
        fixed = replace(usual, sampler=SamplerConfig("ab2", _PRECISION_STEPS, shift=2.0))
        ways += [replace(fixed, precision=precision) for precision in precisions]
        ways.append(replace(fixed, batch=1))
    samplers = [way.sampler for way in ways]
    return sorted(dict.fromkeys(ways), key=lambda way: samplers.index(way.sampler))


def few_step_settings(usual: Setting, thin: bool) -> list[Setting]:
    """Average velocities in all numbers of steps, by the decoder of the VAE and the thin one."""
    samplers = [SamplerConfig("average_velocity", steps) for steps in AVERAGE_STEPS]
    ways = [replace(usual, sampler=sampler) for sampler in samplers]
    if thin:
        ways += [replace(way, decoder="thin") for way in ways]
    return ways


def run_problem(
    problem: Problem, ways: Sequence[Setting], effort: Effort, work: Work | None = None
) -> dict[str, Any]:
    """Measure error and time of each way to sample, with progress bars.

    Returns:
        Plain values: ``rows`` with a dictionary for each way; ``front``, the labels of the Pareto
        front; how exact the ``reference`` and the ``timing`` are; FLOP of a network evaluation and
        of everything else.
    """
    work = work or Work()
    exact, self_error = reference(problem, effort.reference_steps, effort.samples, work)
    errors = errors_of(problem, ways, exact, work)
    labelled = _label(ways, effort.batch)
    cases = {name: problem.case(way) for name, way in labelled.items()}
    # Complete rounds are kept.
    timing = compare(cases, effort.rounds, lambda n, run: work.piece(f"round_{n}", run))
    flop = {decoder: problem.flop(decoder) for decoder in {way.decoder for way in ways}}
    rows = []
    for (label, way), error in zip(labelled.items(), errors, strict=True):
        evaluation, rest = flop[way.decoder]
        row = _row(label, way, error, timing.seconds[label], way.nfe * evaluation + rest)
        rows.append(row | {"converged": self_error < row["error"] / _MARGIN})
    return {
        "rows": rows,
        "front": pareto_front(rows),
        "reference": {
            "solver": "heun",
            "steps": effort.reference_steps,
            "samples": effort.samples,
            "self_error": self_error,
        },
        "timing": {"a_a": asdict(timing.repeat), "sound": timing.sound},
        "flop": dict(zip(("evaluation", "rest"), flop["full"], strict=True)),
    }


def _row(
    label: str, way: Setting, errors: dict[str, Any], rounds: list[float], flop: float
) -> dict[str, Any]:
    """Figures of a way to sample; times and FLOP are per scene."""
    squared, seconds = np.array(errors["squared"]), float(np.median(rounds))
    drawn = np.random.default_rng(0).choice(squared, (_RESAMPLES, len(squared)))
    return {
        "label": label,
        "name": way.name,
        "solver": way.sampler.solver,
        "steps": way.sampler.steps,
        "shift": way.sampler.shift,
        "nfe": way.nfe,
        "precision": way.precision,
        "batch": way.batch,
        "decoder": way.decoder,
        "error": float(np.sqrt(squared.mean())),
        "error_interval": np.quantile(np.sqrt(drawn.mean(axis=1)), [0.025, 0.975]).tolist(),
        "precision_error": None if way.precision == "fp32" else errors["precision"],
        "range_rmse_m": errors["range_rmse_m"],
        "mask_iou": errors["mask_iou"],
        "seconds": seconds,
        "flop": flop,
        "flop_s": flop / seconds,
        "rounds": rounds,
    }


def _batches(problem: Problem, num: int) -> list[range]:
    size = problem.batch
    return [range(first, min(first + size, num)) for first in range(0, num, size)]


def _concatenate(parts: Sequence[Solved]) -> Solved:
    ranges = [part.range_m for part in parts if part.range_m is not None]
    latents = torch.cat([part.latents for part in parts])
    return Solved(latents, torch.cat(ranges) if ranges else None)


def reference(problem: Problem, steps: int, num: int, work: Work) -> tuple[Solved, float]:
    """The converged solution, and the RMSE of its latents from a solution in half the steps."""

    def converged(count: int, indices: range) -> tuple[Tensor | None, ...]:
        return tuple(problem.converged(count, indices))

    def solve(count: int) -> Solved:
        parts = []
        for indices in _bar(_batches(problem, num), f"Heun-{count}"):
            run = partial(converged, count, indices)
            parts.append(Solved(*work.piece(f"reference_{count}_{indices.start}", run)))
        return _concatenate(parts)

    solved = solve(steps)
    return solved, _rmse(solved.latents, solve(steps // 2).latents)


def errors_of(
    problem: Problem, ways: Sequence[Setting], exact: Solved, work: Work
) -> list[dict[str, Any]]:
    """Errors of each setting against the converged solution of the same noise.

    ``squared`` is the mean squared error of the latents of each scene, ``precision`` the RMSE from
    the same sampler in fp32. ``range_rmse_m`` is of pixels with a return in both, ``mask_iou`` of
    returns; both None without a decoder.
    """
    batches = _batches(problem, len(exact.latents))

    @lru_cache(maxsize=2)  # settings of one sampler follow each other
    def solve(way: Setting) -> Solved:
        return _concatenate([problem.solve(way, part) for part in batches])

    def errors(way: Setting) -> dict[str, Any]:
        way = replace(way, batch=1)
        solved, plain = solve(way), solve(replace(way, precision="fp32"))
        range_rmse_m, mask_iou = _range_errors(solved.range_m, exact.range_m)
        return {
            "squared": _squared(solved.latents, exact.latents).tolist(),
            "precision": _rmse(solved.latents, plain.latents),
            "range_rmse_m": range_rmse_m,
            "mask_iou": mask_iou,
        }

    return [
        work.piece(f"errors_{index}", partial(errors, way))
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


def _label(ways: Sequence[Setting], batch: int) -> dict[str, Setting]:
    """Settings by name and NFE; precision and batch only where several share them."""
    labelled: dict[str, Setting] = {}
    for way in ways:
        label = f"{way.name} {way.nfe}"
        if label in labelled:
            label += f" {way.precision}"
            if way.batch != batch:
                label += f" batch {way.batch}"
        labelled[label] = way
    return labelled
