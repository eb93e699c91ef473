"""How fast full-size networks sample: SiT-B/2 and the VAE of the paper, with random weights."""

from __future__ import annotations

import json
import tempfile
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

import torch

from r3dpa.bench.hardware import control_kernel, peak_of
from r3dpa.bench.official_networks import random_networks
from r3dpa.bench.problems import Make, ModelProblem, Setting
from r3dpa.bench.timing import measure
from r3dpa.checkpoints.networks import format_table
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import ScanGeometry
from r3dpa.io import atomic_path, command, machine, one_line, versions
from r3dpa.nn import VAE, LatentNorm, SiT

__all__ = ["random_generators", "speed"]

_PUBLISHED = SamplerConfig("euler_maruyama", 256)
_FEW = SamplerConfig("ab2", 32, shift=2.0)
_SMALL_SIT = {"hidden_size": 96, "depth": 2, "num_heads": 2, "alignment_depth": 1}
_SMALL_VAE = {"channels": 32, "num_res_blocks": 1}


def speed(
    make: Make, rounds: int, out: Path | None = None, large: int = 64, quick: bool = False
) -> str:
    """Measure what a scene takes, beside the limit that the device sets.

    On a GPU: the published sampler (256 steps) and AB2 with 32 steps in large batches, and single
    scenes, each compiled in bf16 and as written in both precisions. On a CPU: AB2 with 4 steps and
    single scenes.

    Args:
        make: Generators of the networks, see :func:`random_generators`.
        rounds: Of the timing.
        out: JSON file for the same figures, without rounding.
        large: Scenes of a large batch.
        quick: AB2 with 2 steps alone.

    Returns:
        A table with a row for each way, and a line each about timing, machine and versions.
    """
    device = make(Setting(_FEW)).device
    ways = _ways(device.type, large, quick)
    problem = ModelProblem(make, large)
    evaluation, rest = problem.flop()
    with tempfile.TemporaryDirectory(prefix="r3dpa_bench_") as folder:
        cases = {name: problem.case(way, Path(folder)) for name, way in ways.items()}
        timing = measure(cases, rounds, control_kernel(device), torch.get_num_threads())
    peaks = {way.precision: peak_of(device, way.precision) for way in ways.values()}
    rows: list[dict[str, Any]] = []
    for name, way in ways.items():
        series, peak = timing.series[name], peaks[way.precision]
        flop = way.sampler.steps * evaluation + rest
        seconds = median(series.of_kept(series.device))
        rows.append(
            {
                "case": name,
                "seconds": seconds,
                "end_to_end_seconds": median(series.of_kept(series.end_to_end)),
                "limit_seconds": flop / peak.flop_s,
                "tera_flop": flop / 1e12,
                "tera_flop_per_second": flop / seconds / 1e12,
                "share_of_peak": flop / seconds / peak.flop_s,
                "peak_bytes": problem.memory(way),
                "undisturbed": series.enough,
                "all_seconds": series.device,
            }
        )
    repeat = asdict(timing.repeat) | {"sound": timing.sound, "dropped": timing.dropped}
    gpu = torch.cuda.get_device_name() if device.type == "cuda" else None
    facts: dict[str, str | dict[str, Any]] = {
        "command": command(),
        "weights": "random, of the paper's sizes" if not quick else "random, small",
        "first case over itself": repeat,
        "peaks": {str(name): asdict(peak) for name, peak in peaks.items()},
        "machine": machine() | {"threads": torch.get_num_threads(), "gpu": gpu},
        "versions": versions(torch),
    }
    if out is not None:
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(facts | {"rows": rows}, indent=1) + "\n")
    header = ["per scene", "s", "end to end", "limit s", "TFLOP", "TFLOP/s", "of peak", "GiB"]
    table = [
        [
            row["case"] + " ~" * (not row["undisturbed"]),
            *(f"{row[key]:.4g}" for key in ("seconds", "end_to_end_seconds", "limit_seconds")),
            *(f"{row[key]:.4g}" for key in ("tera_flop", "tera_flop_per_second")),
            f"{row['share_of_peak']:.1%}",
            "-" if row["peak_bytes"] is None else f"{row['peak_bytes'] / 2**30:.2f}",
        ]
        for row in rows
    ]
    return "\n".join(
        [
            format_table(header, table),
            "~: other work disturbed most of its measurements",
            *(f"{name}: {one_line(values)}" for name, values in facts.items()),
        ]
    )


def random_generators(device: str, quick: bool = False) -> Make:
    """Generators over random networks of the paper's sizes.

    Args:
        device: ``cpu``, ``cuda`` or ``cuda:1``.
        quick: Small networks, only to try it.
    """
    torch.manual_seed(0)
    found = random_networks(_SMALL_SIT if quick else {}, _SMALL_VAE if quick else {})
    names = ("vae", "sit", "latent_norm")
    vae, sit, norm = (found.network(name).build().to(device) for name in names)
    assert isinstance(vae, VAE)
    assert isinstance(sit, SiT)
    assert isinstance(norm, LatentNorm)
    geometry = ScanGeometry.from_dict(dict(found.geometry or {}))

    def make(setting: Setting) -> SceneGenerator:
        return SceneGenerator(
            vae,
            sit,
            norm,
            geometry,
            setting.sampler,
            precision=setting.precision,
            batch_size=setting.batch if setting.compiled else None,
            compile=setting.compiled,
        )

    return make


def _ways(device: str, large: int, quick: bool) -> dict[str, Setting]:
    """What is measured, by name."""
    if quick or device == "cpu":
        few = SamplerConfig("ab2", 2 if quick else 4, shift=2.0)
        ways = [Setting(few, "bf16"), Setting(few, "fp32")]
    else:
        cases = ((_PUBLISHED, large), (_FEW, large), (_FEW, 1))
        ways = [Setting(sampler, "bf16", True, batch) for sampler, batch in cases]
        ways += [Setting(_FEW, precision, False, large) for precision in ("bf16", "fp32")]
        ways.append(Setting(_FEW, "bf16", False, 1))
    return {
        f"{way.name} {way.sampler.steps}, batch {way.batch}, {way.precision}"
        + " compiled" * way.compiled: way
        for way in ways
    }
