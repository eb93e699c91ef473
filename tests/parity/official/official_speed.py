"""``r3dpa bench official``: the official code beside ours, with the same weights, in turn."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from official_imports import COMMIT, OfficialCode, Overlay, load_official
from official_networks import (
    at_times,
    equal_error,
    noise_of,
    random_networks,
    relative,
    sits,
    trained_networks,
    vaes,
)
from official_runs import (
    PATCHES,
    replaced,
    save_for_official,
    train_official,
    write_official_scenes,
)
from official_step import train_ours
from torch import Tensor, nn

from r3dpa.bench.measure import Comparison, compare
from r3dpa.checkpoints import Checkpoint, save_checkpoint, to_official
from r3dpa.checkpoints.networks import format_table
from r3dpa.data.scans import read_scan
from r3dpa.flow import Interpolant, euler, euler_maruyama, ode_times, sde_times
from r3dpa.generation import SamplerConfig
from r3dpa.geometry import ScanGeometry, range_image
from r3dpa.io import atomic_path, command, machine, one_line, versions
from r3dpa.nn import VAE, SiT

__all__ = ["PARTS", "OfficialSettings", "official"]

Part = Literal["sampler", "decode", "scenes", "joint"]
PARTS: tuple[Part, ...] = ("sampler", "decode", "scenes", "joint")

SampleScenes = Callable[[Path, Path, int, int, int, SamplerConfig, Literal["fp32", "bf16"]], object]
"""Checkpoint, folder, number, seed, batch size, sampler, precision: writes as ``r3dpa sample``."""

_SEED = 0

Clock = Literal["wall", "processor"]
_CLOCKS: dict[Clock, Callable[[], float]] = {
    "wall": time.perf_counter,
    "processor": time.process_time,
}

_OFFICIAL, _OURS = "official", "r3dpa"
_SMALL_SIT = {"hidden_size": 128, "depth": 4, "num_heads": 4, "alignment_depth": 2}
_SMALL_VAE = {"channels": 32}
_SAME_LATENTS, _SAME_IMAGE, _SAME_RANGE_M, _SAME_STEP = 1e-4, 1e-4, 5e-3, 1e-2


@dataclass(frozen=True)
class OfficialSettings:
    """What is run, how large and how often.

    Args:
        parts: ``sampler`` (latents of a batch), ``decode`` (one range image), ``scenes`` (files of
            scenes, from weights to the last byte), ``joint`` (a training step of stage 2).
        size: Networks of ``joint``: ``small`` (SiT of width 128 with 4 blocks, VAE of a quarter of
            the width; ``sampler`` and ``scenes`` have these too) or ``full`` (SiT-B/2, h2p4d8:
            minutes per step).
        steps: Network evaluations of the official sampler.
        scenes: Scenes written, a multiple of 2.
        rounds: Measurements of each case that count.
        clock: ``wall``, or ``processor`` for the processor time of this process, which others on
            the machine disturb less; it leaves waiting for the disk out.
        quick: Two rounds, 10 steps, 2 scenes and a small decoder: a trial.

    Raises:
        ValueError: If a number is below what is needed or a part is unknown.
    """

    parts: tuple[Part, ...] = PARTS
    size: Literal["small", "full"] = "small"
    steps: int = 50
    scenes: int = 10
    rounds: int = 5
    clock: Clock = "wall"
    quick: bool = False

    @property
    def now(self) -> Callable[[], float]:
        """The clock: seconds since some time."""
        return _CLOCKS[self.clock]

    def timed(self, function: Callable[[], object]) -> Callable[[], float]:
        """The function as a case of :func:`r3dpa.bench.measure.compare` on this clock."""

        def run() -> float:
            start = self.now()
            function()
            return self.now() - start

        return run

    def __post_init__(self) -> None:
        """Check the numbers; ``quick`` sets them."""
        unknown = set(self.parts) - set(PARTS)
        if unknown or not self.parts:
            raise ValueError(f"parts must be some of {', '.join(PARTS)}, got {self.parts}")
        if self.steps < 2 or self.rounds < 1 or self.scenes < 2 or self.scenes % 2:
            raise ValueError(
                "steps >= 2, rounds >= 1 and an even number of scenes are needed, got "
                f"{self.steps}, {self.rounds} and {self.scenes}"
            )
        if self.quick:
            for name, value in {"steps": 10, "scenes": 2, "rounds": 2}.items():
                object.__setattr__(self, name, value)


@dataclass(frozen=True)
class PartResult:
    """Times of one part, after both sides have given the same.

    Args:
        part: Name and size.
        difference: What ``differs`` counts.
        tolerance: What counts as the same.
        differs: Of each case of ours from the official result.
        times: Of all cases; the first is the official one.
        seconds_by_part: Where the time of one run went, by case.
        remarks: What else a reader should know.
    """

    part: str
    difference: str
    tolerance: float
    differs: dict[str, float]
    times: Comparison
    seconds_by_part: dict[str, dict[str, float]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)

    def rows(self) -> list[list[str]]:
        """Cells of the printed table."""
        rows = []
        for case, ms in self.times.ms.items():
            ratio, name = "1", self.part if case == _OFFICIAL else ""
            if case != _OFFICIAL:
                over = self.times.over_first[case]
                ratio = f"{1 / over.value:.2f} ({1 / over.high:.2f} to {1 / over.low:.2f})"
            differs = f"{self.differs[case]:.1e}" if case in self.differs else ""
            rows.append([name, case, f"{ms.median / 1000:.3g}", f"{ms.min / 1000:.3g}"])
            rows[-1] += [ratio, differs]
        again = self.times.repeat
        verdict = "" if self.times.sound else " NOT SOUND: no claim"
        rows.append(
            ["", "official again", "", "", f"({again.low:.2f} to {again.high:.2f}){verdict}", ""]
        )
        return rows

    def lines(self) -> list[str]:
        """What stands below the table."""
        lines = [f"{self.part}: differs by {self.difference}; same up to {self.tolerance:g}"]
        lines += [f"  {remark}" for remark in self.remarks]
        for case, parts in self.seconds_by_part.items():
            spent = ", ".join(f"{name} {value:.3g}" for name, value in parts.items())
            lines.append(f"  seconds of one run, {case}: {spent}")
        return lines


def official(
    repo: Path,
    sample: SampleScenes,
    settings: OfficialSettings = OfficialSettings(),
    ckpt: Path | None = None,
    out: Path | None = None,
) -> str:
    """Runs the official code of a local checkout beside ours and prints how much faster ours is.

    Both have the same weights and inputs and must first give the same result. Then they take turns,
    the official one twice a round. A ratio is official time over ours, with its 95 % interval.
    Nothing of the checkout is changed; packages it needs that are absent are replaced, as printed.

    Args:
        repo: Checkout of valeoai/R3DPA at commit aa08e6d.
        sample: Writes scenes as ``r3dpa sample`` does.
        settings: Parts, sizes and rounds.
        ckpt: Trained networks for ``sampler`` and ``scenes``: equal error means little for random
            weights, which are taken where None. Its decoder then interpolates as the official one.
        out: JSON file for the same figures, without rounding.

    Returns:
        A table with a row per case, and what was replaced.

    Raises:
        ValueError: If the checkout is not that of the commit, or the checkpoint has another layout.
        RuntimeError: If both sides do not give the same result.
    """
    code = load_official(repo)
    results: list[PartResult] = []
    torch.manual_seed(0)
    small = random_networks(_SMALL_SIT, _SMALL_VAE) if ckpt is None else trained_networks(ckpt)
    runs: dict[Part, Callable[[], list[PartResult]]] = {
        "sampler": lambda: _sampler(code, small, settings),
        "decode": lambda: [_decode(code, settings)],
        "scenes": lambda: [_scenes(code, small, settings, sample)],
        "joint": lambda: [_joint(code, settings)],
    }
    for part in settings.parts:
        results += runs[part]()
    about: dict[str, Any] = {
        "reference": {"repository": "valeoai/R3DPA", "commit": COMMIT},
        "stand-ins": dict(code.stand_ins),
        "patches": "; ".join(PATCHES),
        "weights": "random" if ckpt is None else ckpt.name,
        "settings": asdict(settings),
        "machine": machine() | {"threads": torch.get_num_threads()},
        "versions": versions(torch),
    }
    if out is not None:
        content = {"command": command(), **about, "parts": [asdict(result) for result in results]}
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n")
    header = ["part", "case", "median s", "min s", "official / ours (95 %)", "differs"]
    lines = [format_table(header, (row for result in results for row in result.rows()))]
    lines += [line for result in results for line in result.lines()]
    lines += [f"{name}: {one_line(values)}" for name, values in about.items()]
    return "\n".join(lines)


# The parts


def _sampler(
    code: OfficialCode, networks: Checkpoint, settings: OfficialSettings
) -> list[PartResult]:
    batch, steps = (2 if settings.quick else 4), settings.steps
    nets, samplers = sits(code, networks), code["samplers"]
    half = networks.network("ema").build().eval()
    assert isinstance(half, SiT)
    half.halve_()
    noise = torch.randn(batch, nets.ours.in_channels, *nets.ours.input_size)
    draws = torch.randn(steps - 1, *noise.shape, dtype=torch.float64)
    labels = torch.zeros(batch, dtype=torch.long)

    def theirs(sampler: Callable[..., Tensor]) -> Tensor:
        return sampler(nets.theirs, noise, labels, num_steps=steps, path_type=networks.interpolant)

    def their_sde() -> Tensor:
        with replaced(samplers, torch=Overlay(torch, randn_like=_in_order(draws))):
            return theirs(samplers.euler_maruyama_sampler)

    def sde(sit: SiT) -> Tensor:
        times = sde_times(steps)
        path = Interpolant(networks.interpolant)
        velocity = at_times(sit, times[:-1])
        return euler_maruyama(velocity, noise, times, draws, interpolant=path, last="mean")

    def ode(sit: SiT) -> Tensor:
        times = ode_times(steps)
        return euler(at_times(sit, times[:-1]), noise, times)

    results = []
    for name, reference, ours in (
        ("Euler", lambda: theirs(samplers.euler_sampler), ode),
        ("Euler-Maruyama", their_sde, sde),
    ):
        exact = reference()
        cases = {_OURS: partial(ours, nets.ours), f"{_OURS} bf16": partial(ours, half)}
        differs = {case: relative(run(), exact) for case, run in cases.items()}
        _check("sampler", differs, (_OURS,), _SAME_LATENTS)
        timed = {case: settings.timed(run) for case, run in cases.items()}
        result = PartResult(
            f"sampler, {name}, batch {batch}, {steps} steps",
            "RMS of the latents over their RMS",
            _SAME_LATENTS,
            differs,
            compare({_OFFICIAL: settings.timed(reference), **timed}, settings.rounds),
        )
        results.append(result)
    return results


def _decode(code: OfficialCode, settings: OfficialSettings) -> PartResult:
    networks = random_networks(_SMALL_SIT, _SMALL_VAE if settings.quick else {})
    nets = vaes(code, networks)
    half = networks.network("vae").build().eval()
    assert isinstance(half, VAE)
    half.halve_decoder_()
    sit = networks.network("sit").arguments
    latents = torch.randn(1, sit["in_channels"], *sit["input_size"])
    with torch.inference_mode():
        image = nets.theirs.decode(latents).sample
        differs = {
            name: relative(vae.decode(latents), image)
            for name, vae in {_OURS: nets.ours, f"{_OURS} bf16": half}.items()
        }
        _check("decode", differs, (_OURS,), _SAME_IMAGE)
        cases = {
            _OFFICIAL: settings.timed(lambda: nets.theirs.decode(latents)),
            _OURS: settings.timed(lambda: nets.ours.decode(latents)),
            f"{_OURS} bf16": settings.timed(lambda: half.decode(latents)),
        }
        times = compare(cases, settings.rounds)
    size = "quarter width" if settings.quick else "full size"
    return PartResult(
        f"decode, 1 scene, {size}", "RMS of the image over its RMS", _SAME_IMAGE, differs, times
    )


def _scenes(
    code: OfficialCode, networks: Checkpoint, settings: OfficialSettings, sample: SampleScenes
) -> PartResult:
    num, batch, steps = settings.scenes, settings.scenes // 2, settings.steps
    nets = sits(code, networks)
    equal, remarks = equal_error(
        lambda noise, steps: code["samplers"].euler_sampler(
            nets.theirs, noise, torch.zeros(len(noise), dtype=torch.long), num_steps=steps
        ),
        nets.ours,
        steps,
    )
    cases: dict[str, tuple[SamplerConfig, Literal["fp32", "bf16"]]] = {
        f"{_OURS}, equal NFE": (SamplerConfig("euler", steps), "fp32"),
        f"{_OURS}, equal NFE, bf16": (SamplerConfig("euler", steps), "bf16"),
        f"{_OURS}, equal error": (equal, "fp32"),
        f"{_OURS}, equal error, bf16": (equal, "bf16"),
    }
    with tempfile.TemporaryDirectory(prefix="r3dpa_bench_") as name:
        folder = Path(name)
        experiment, file = folder / "experiment", folder / "ours.safetensors"
        save_for_official(code, networks, experiment)
        save_checkpoint(networks, file)

        def theirs(noise: Tensor | None = None, parts: dict[str, float] | None = None) -> Any:
            with tempfile.TemporaryDirectory(dir=folder) as out:
                start = settings.now()
                range_m = write_official_scenes(
                    code,
                    networks,
                    experiment,
                    Path(out),
                    num,
                    batch,
                    steps,
                    noise,
                    parts,
                    settings.now,
                )
                return range_m, settings.now() - start

        def ours(case: str) -> tuple[Tensor, float]:
            sampler, precision = cases[case]
            with tempfile.TemporaryDirectory(dir=folder) as out:
                with contextlib.redirect_stderr(io.StringIO()):  # progress bars
                    start = settings.now()
                    sample(file, Path(out), num, _SEED, batch, sampler, precision)
                    taken = settings.now() - start
                return _written(Path(out), networks), taken

        parts: dict[str, float] = {}
        range_m, taken = theirs(noise_of(networks, num, _SEED), parts)
        parts["all else"] = taken - sum(parts.values())
        reference = torch.from_numpy(range_m)
        differs = {case: _range_error_m(ours(case)[0], reference) for case in cases}
        _check("scenes", differs, (f"{_OURS}, equal NFE",), _SAME_RANGE_M)
        times = compare(
            {_OFFICIAL: lambda: theirs()[1]}
            | {case: partial(lambda case: ours(case)[1], case) for case in cases},
            settings.rounds,
        )
    return PartResult(
        f"{num} scenes to disk, {steps} Euler steps",
        "RMS of ranges in metres where both sides have a return",
        _SAME_RANGE_M,
        differs,
        times,
        {_OFFICIAL: parts},
        remarks,
    )


def _joint(code: OfficialCode, settings: OfficialSettings) -> PartResult:
    small = settings.size == "small"
    networks = random_networks(
        {**(_SMALL_SIT if small else {}), "learn_pos_embed": True}, _SMALL_VAE if small else {}
    )
    sit = networks.network("sit").arguments
    tokens = (sit["input_size"][0] // 2) * (sit["input_size"][1] // 2)
    image = torch.rand(1, 1, 64, 1024) * 2 - 1
    features = nn.functional.normalize(torch.randn(1, tokens, sit["feature_dim"]), dim=-1)
    noise = torch.randn(2, 1, 8, 16, 128)
    draws = (noise[0], torch.rand(1), noise[1])
    steps = 2  # the moments of the optimisers are made in the first, which is not counted

    def theirs() -> Any:
        with tempfile.TemporaryDirectory() as folder:
            return train_official(
                code, networks, image, features, draws, steps, Path(folder), settings.now
            )

    def ours() -> Any:
        return train_ours(networks, image, features, draws, steps, settings.now)

    start, reference, here = to_official(networks), theirs(), ours()
    keys = {"vae": "vae", "sit": "model", "discriminator": "discriminator"}
    differs = {}
    for name, key in keys.items():
        before = start[key]
        moved = {
            k: reference.weights[name][k] - v for k, v in before.items() if v.is_floating_point()
        }
        off = {k: here.weights[name][k] - reference.weights[name][k] for k in moved}
        differs[name] = _norm(off) / _norm(moved)
    differs = {_OURS: max(differs.values())}
    _check("joint", differs, (_OURS,), _SAME_STEP)
    times = compare(
        {_OFFICIAL: lambda: theirs().seconds[-1], _OURS: lambda: ours().seconds[-1]},
        settings.rounds,
    )
    return PartResult(
        f"joint step, batch 1, {settings.size}",
        "norm of the difference of the weights after two steps over how far they moved",
        _SAME_STEP,
        differs,
        times,
    )


# Comparing


def _check(part: str, differs: dict[str, float], exact: tuple[str, ...], tolerance: float) -> None:
    for case in exact:
        if not differs[case] <= tolerance:
            raise RuntimeError(
                f"{part}: {case} differs from the official result by {differs[case]:.2e}, more "
                f"than {tolerance:g}, so a ratio of their times would mean nothing; report it with "
                "the versions of torch and numpy"
            )


def _in_order(draws: Tensor) -> Callable[[Tensor], Tensor]:
    """Given draws in place of ``torch.randn_like``."""
    rest = iter(draws)
    return lambda values: next(rest)


def _written(out: Path, networks: Checkpoint) -> Tensor:
    """Range images ``(num, H, W)`` of the scans in a folder."""
    projection = ScanGeometry.from_dict(dict(networks.geometry or {})).projection
    scans = [torch.from_numpy(read_scan(path)[:, :3]) for path in sorted(out.glob("bin/*.bin"))]
    return torch.stack([range_image(points, projection)[0] for points in scans])


def _range_error_m(range_m: Tensor, reference_m: Tensor) -> float:
    both = (range_m > 0) & (reference_m > 1) & (reference_m < 56)
    return (range_m - reference_m)[both].double().square().mean().sqrt().item()


def _norm(tensors: dict[str, Tensor]) -> float:
    return sum(float(tensor.double().square().sum()) for tensor in tensors.values()) ** 0.5
