"""What accuracy costs in time: solvers, steps, precision and compilation, from noise to files."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np
import torch

from r3dpa.bench.distributions import Distances, SceneDistances, SlicedDistance, verdicts
from r3dpa.bench.error_budget import Errors, Reference, budget, certified_reference
from r3dpa.bench.front import (
    Row,
    pareto_front,
    resampled_errors,
    resampled_seconds,
    sentences,
    steps_along,
)
from r3dpa.bench.hardware import Peak, control_kernel, peak_of
from r3dpa.bench.mixture import toy_mixture
from r3dpa.bench.problems import Make, MixtureProblem, ModelProblem, Problem, Setting, Solved
from r3dpa.bench.sampling_report import EVALUATIONS, Found, write_report
from r3dpa.bench.timing import Controlled, Series, measure
from r3dpa.flow.solvers import steps_for
from r3dpa.generation import SamplerConfig, Solver
from r3dpa.io import command, machine, versions

__all__ = ["Effort", "run_problem", "sampling", "settings_of"]

#: Solvers of the picture, with the shift of their grids.
_SOLVERS: tuple[tuple[Solver, float], ...] = (
    *(("euler", 1.0), ("heun", 1.0), ("midpoint", 1.0), ("ab2", 1.0), ("ab2", 1.75), ("ab2", 2.0)),
    *(("ab3", 1.0), ("ab3", 1.5), ("ab3", 2.5), ("dpmpp_2m", 1.75), ("unipc", 1.0)),
)
_PRECISION_STEPS = 32
_BATCH = {"cuda": 64, "cpu": 4}
_LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Effort:
    """How much is measured of a problem.

    Args:
        samples: Solved by each row.
        reference_steps: Of Heun's method.
        evaluations: NFE of the rows.
        rounds: Of the timing.
        batch: Scenes timed together.
        resamples: Of the intervals of distances between distributions, at least 40.
    """

    samples: int
    reference_steps: int
    evaluations: tuple[int, ...]
    rounds: int
    batch: int
    resamples: int = 200


def sampling(
    out: Path,
    make: Make | None = None,
    data: Path | None = None,
    quick: bool = False,
    scenes: int | None = None,
    batch_size: int | None = None,
    rounds: int | None = None,
    nfe: Sequence[int] | None = None,
    reference_steps: int | None = None,
    autoguided: bool = False,
    about: Mapping[str, Any] | None = None,
    published: Mapping[str, float] | None = None,
) -> str:
    """Measure what accuracy costs in time, for an exact velocity and for a trained model.

    The folder gets ``sampling.json`` and ``sampling.csv`` (all rows), ``pareto.png`` and
    ``pareto.html`` (error against seconds), ``pareto_<distance>.png`` where data tell a distance,
    ``discretisation.png`` (error against NFE), ``summary.md``, and from a model ``quality.json``,
    as ``r3dpa sample --quality`` reads it.

    Args:
        out: Folder to write.
        make: Generators of a checkpoint, see :data:`r3dpa.bench.problems.Make`; without one only
            the mixture of Gaussians is measured, and the summary says so.
        data: Real scans, a folder or a file of ``r3dpa reference``: distances between
            distributions are computed, too.
        quick: Few scenes, steps and rounds: minutes on a CPU.
        scenes: Of the model, solved by each row; 256, or 8 with ``quick``.
        batch_size: Scenes computed together; 64 on a GPU, 4 on a CPU.
        rounds: Of the timing; 20, or 3 with ``quick``.
        nfe: Evaluations of the model's rows; 2 to 256, or 4 to 32 with ``quick``.
        reference_steps: Heun steps of the model's converged solution, an even number; 1000, or 200
            with ``quick``.
        autoguided: Whether ``make`` can guide: one more solver in the picture.
        about: What a reader must know of the model, such as its name, stage and step.
        published: Values of other work by the name of the distance.

    Returns:
        Tables, what each further second buys, and where the files are.

    Raises:
        ValueError: If a number is below 1, or the data cannot be used.
    """
    if min(scenes or 2, rounds or 2, batch_size or 2) < 1 or scenes == 1:
        raise ValueError(
            f"scenes must be at least 2, rounds and batch_size at least 1, got {scenes}, {rounds} "
            f"and {batch_size}"
        )
    if nfe is not None and (not nfe or min(nfe) < 1):
        raise ValueError(f"nfe must be numbers of evaluations, got {list(nfe)}")
    if reference_steps is not None and (reference_steps < 2 or reference_steps % 2):
        raise ValueError(f"reference_steps must be even and at least 2, got {reference_steps}")
    if data is not None and make is None:
        raise ValueError(f"data {data} tell nothing without a checkpoint to compare with them")
    found = {}
    mixture = toy_mixture()
    effort = _effort("mixture", quick)
    # A mixture has no network: what changes its speed does not apply.
    ways = settings_of(effort, "cpu", False, ())
    distances = SlicedDistance(mixture, effort.samples)
    found["mixture"] = run_problem(MixtureProblem(mixture, effort.batch), ways, effort, distances)
    if make is not None:
        device = make(Setting(SamplerConfig("euler", 1))).device
        effort = _effort("model", quick, scenes, batch_size or _BATCH[device.type], rounds)
        if nfe is not None:
            effort = replace(effort, evaluations=tuple(sorted(set(nfe))))
        if reference_steps is not None:
            effort = replace(effort, reference_steps=reference_steps)
        problem = ModelProblem(make, effort.batch)
        real = None
        if data is not None:
            real = SceneDistances(data, problem.sensor, effort.samples, str(device))
        kinds = (False,) if quick else (False, True)  # compiling takes minutes
        ways = settings_of(effort, device.type, autoguided, kinds)
        found["model"] = run_problem(problem, ways, effort, real)
    facts = _facts(about, make is not None)
    return write_report(out, found, facts, dict(published or {}))


def _effort(
    problem: Literal["mixture", "model"],
    quick: bool,
    scenes: int | None = None,
    batch: int = 256,
    rounds: int | None = None,
) -> Effort:
    nfes: tuple[int, ...]
    if problem == "mixture":
        samples, steps = (256, 1000) if quick else (1024, 1000)
        nfes = EVALUATIONS[:-2] if quick else EVALUATIONS
    else:
        samples, steps = (8, 200) if quick else (256, 1000)
        nfes = EVALUATIONS[1:-3] if quick else EVALUATIONS
    rounds = rounds or (3 if quick else 20)
    return Effort(scenes or samples, steps, nfes, rounds, batch, 40 if quick else 200)


def settings_of(
    effort: Effort,
    device: str,
    autoguided: bool,
    compiled: Sequence[bool],
) -> list[Setting]:
    """All ways to sample that are measured.

    On a GPU they run in bf16 and compiled where that is wanted, on a CPU in fp32 as written. AB2
    with 32 steps also runs in each precision, compiled and not, and with single scenes.

    Args:
        effort: Gives NFE and batch.
        device: ``cuda`` or ``cpu``.
        autoguided: Whether guided rows are wanted.
        compiled: Whether to compile that, or each; none where only the solver matters.
    """
    usual = Setting(SamplerConfig("euler", 1), batch=effort.batch)
    if device == "cuda" and True in compiled:
        usual = replace(usual, precision="bf16", compiled=True)
    ways = []
    for solver, shift in _SOLVERS:
        for count in dict.fromkeys(steps_for(solver, nfe) for nfe in effort.evaluations):
            sampler = SamplerConfig(solver, count, shift=shift)
            ways.append(replace(usual, sampler=sampler))
    for nfe in effort.evaluations:
        for last in ("mean", "denoise"):
            sampler = SamplerConfig("euler_maruyama", nfe, sde_last=last)
            ways.append(replace(usual, sampler=sampler, tag=last))
    usual = replace(usual, sampler=SamplerConfig("ab2", _PRECISION_STEPS, shift=2.0))
    if autoguided:
        for steps in (8, _PRECISION_STEPS):
            sampler = SamplerConfig("ab2", steps, shift=2.0)
            ways.append(replace(usual, sampler=sampler, autoguided=True))
    if compiled:
        precisions: tuple[Literal["fp32", "bf16"], ...] = ("fp32", "bf16")
        kinds = [(p, c, effort.batch) for p in precisions for c in compiled]
        kinds.append((usual.precision, usual.compiled, 1))
        for precision, is_compiled, batch in kinds:
            way = replace(usual, precision=precision, compiled=is_compiled, batch=batch)
            if way not in ways:
                ways.append(way)
    return ways


def run_problem(
    problem: Problem,
    ways: Sequence[Setting],
    effort: Effort,
    distances: Distances | None = None,
) -> Found:
    """Error, time and distance of each way to sample.

    Args:
        problem: What is sampled.
        ways: How.
        effort: How much.
        distances: From data, where there are any.
    """
    reference = certified_reference(problem, effort.reference_steps, effort.samples)
    prepared: list[Any] = []

    def look(setting: Setting, solved: Solved) -> None:
        if distances is not None:
            prepared.append(distances.prepare(solved))

    errors = budget(problem, ways, reference, look)
    labels = _labels(ways, errors, effort.batch)
    with tempfile.TemporaryDirectory(prefix="r3dpa_bench_") as folder:
        cases = {
            label: problem.case(way, Path(folder)) for label, way in zip(labels, ways, strict=True)
        }
        control = control_kernel(problem.device)
        timing = measure(cases, effort.rounds, control, torch.get_num_threads())
    flop = problem.flop()
    peaks: dict[str, Peak] = {}
    for way in ways:
        if way.precision not in peaks:
            peaks[way.precision] = peak_of(problem.device, way.precision)
    metrics = [distances.values(item) for item in prepared] if distances else [{}] * len(ways)
    rows = tuple(
        _row(label, way, error, reference, timing.series[label], flop, peaks, values,
             problem.memory(way))
        for label, way, error, values in zip(labels, ways, errors, metrics, strict=True)
    )  # fmt: skip
    front = _front(rows, errors, timing)
    told = sentences(
        [rows[index] for index in front],
        [rows[index].error or 0.0 for index in front],
        "the error of the latents",
    )
    floors, model, against = {}, {}, {}
    if distances is not None:
        floors = distances.floors
        converged = distances.prepare(reference.solved)
        model = distances.values(converged)
        against = {
            label: verdicts(distances.difference(item, converged, effort.resamples), floors)
            for label, item in zip(labels, prepared, strict=True)
        }
    unsure = tuple(row.label for row in rows if row.converged is False)
    fastest = max(peaks.values(), key=lambda peak: peak.flop_s)
    main = distances.main if distances else None
    return Found(
        rows, reference, unsure, tuple(front), tuple(told), timing, fastest, flop, floors, model,
        against, main,
    )  # fmt: skip


def _labels(ways: Sequence[Setting], errors: Sequence[Errors], batch: int) -> list[str]:
    """Name and NFE; speed only where several rows share them."""
    plain = [f"{way.name} {error.nfe}" for way, error in zip(ways, errors, strict=True)]
    labels: list[str] = []
    for label, way in zip(plain, ways, strict=True):
        extra = ""
        if plain.count(label) > 1 and label in labels:
            extra = f" {way.precision}{' compiled' if way.compiled else ''}"
            extra += f" batch {way.batch}" if way.batch != batch else ""
        labels.append(label + extra)
    return labels


def _row(
    label: str,
    way: Setting,
    error: Errors,
    reference: Reference,
    series: Series,
    flop: tuple[float, float],
    peaks: Mapping[str, Peak],
    metrics: dict[str, float],
    memory: int | None,
) -> Row:
    taken = series.of_kept(series.device)
    seconds = median(taken)
    interval = None
    if error.squared is not None:
        low, high = np.quantile(resampled_errors(error.squared[None])[0], [0.025, 0.975]).tolist()
        interval = (low, high)
    work = error.nfe * flop[0] + flop[1]
    rate = work / seconds
    share = rate / peaks[way.precision].flop_s
    lower, upper = np.quantile(taken, [0.25, 0.75]).tolist()
    return Row(
        label,
        way.name,
        way.sampler.solver,
        way.sampler.steps,
        way.sampler.shift,
        error.nfe,
        way.precision,
        way.compiled,
        way.batch,
        error.rmse,
        interval,
        error.discretisation,
        error.precision if way != way.plain else None,
        error.range_rmse_m,
        error.mask_iou,
        None if error.rmse is None else reference.certifies(error.rmse),
        seconds,
        (lower, upper),
        median(series.of_kept(series.end_to_end)),
        series.enough,
        work,
        rate,
        share,
        _suspicion(share),
        memory,
        metrics,
    )


def _suspicion(share: float) -> str:
    if share > 1:
        return "above the peak: time or FLOP is wrong"
    return "below 1 % of the peak: bound by something else" if share < _LEAST_SHARE else ""


def _front(rows: Sequence[Row], errors: Sequence[Errors], timing: Controlled) -> list[int]:
    """Indices of the rows with an error that buy something for their time."""
    known = [
        (index, error.squared) for index, error in enumerate(errors) if error.squared is not None
    ]
    spread = resampled_errors(np.stack([squared for _, squared in known]))
    series = [timing.series[rows[index].label] for index, _ in known]
    seconds = resampled_seconds([taken.of_kept(taken.device) for taken in series])
    front = pareto_front(seconds, spread, timing.tolerance)
    return [known[place][0] for place in steps_along(seconds, spread, front)]


def _facts(about: Mapping[str, Any] | None, has_model: bool) -> dict[str, Any]:
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "command": command(),
        "model": dict(about or {}) if has_model else "none given: the mixture alone",
        "machine": machine() | {"threads": torch.get_num_threads(), "gpu": gpu},
        "versions": versions(torch, np),
    }
