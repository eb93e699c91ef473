"""``r3dpa sample``, ``convert`` and ``report``: scenes, checkpoints and loss curves as files."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from r3dpa.cli.parser import check_folder

MYPY = False  # true for mypy; jsonargparse would run a TYPE_CHECKING block, and import torch
if MYPY:
    import torch
    from torch import Tensor

    from r3dpa.data.scene_writer import SceneWriter
    from r3dpa.generation import SamplerConfig, SceneGenerator
    from r3dpa.geometry import ScanGeometry

__all__ = ["convert", "draw_scene", "report", "sample", "written"]

_ON_SHEET = 16
_ON_PAGE = 8


def sample(
    *,
    ckpt: Path,
    out: Path,
    num: int = 16,
    seed: int = 0,
    quality: Literal["draft", "good", "best"] | None = None,
    solver: Literal[
        "euler", "heun", "midpoint", "ab2", "ab3", "dpmpp_2m", "unipc", "dopri5", "euler_maruyama"
    ]
    | None = None,
    steps: int | None = None,
    shift: float | None = None,
    eta: float | None = None,
    sde_last: Literal["denoise", "mean"] | None = None,
    sde_last_time: float | None = None,
    autoguidance: Path | None = None,
    guidance_scale: float | None = None,
    guidance_interval: tuple[float, float] | None = None,
    allow_other_latents: bool = False,
    batch_size: int = 8,
    decode_batch_size: int | None = None,
    precision: Literal["fp32", "bf16"] = "fp32",
    compile: bool = False,
    device: str = "auto",
    weights: Literal["ema", "last"] = "ema",
    formats: tuple[str, ...] = ("bin",),
    pictures: int = 64,
    overwrite: bool = False,
) -> str:
    """Generate scenes from a checkpoint: points, range images, pictures and a page to turn.

    The same command completes an interrupted run. An option that the solver does not read is an
    error. ``metadata.json`` holds everything needed to repeat the run.

    Args:
        ckpt: Checkpoint of stage joint or flow_matching, ``.ckpt`` or exported ``.safetensors``.
        out: Folder for scenes, pictures and metadata; must not hold other scenes.
        num: Number of scenes.
        seed: Scene i depends on (seed, i) alone, not on the batch size.
        quality: Measured choice of solver, steps and shift: ``draft``, ``good`` or ``best``;
            default: ``good``, unless an option of the solver is given.
        solver: ODE solver, or ``euler_maruyama`` for the SDE; default: the latter.
        steps: Solver steps; default: 256.
        shift: Finer steps near noise (above 1) or data (below 1) of the ODE; default: 1.
        eta: Noise strength of the SDE; default: 1, as published.
        sde_last: Last SDE step: ``denoise`` (default) or ``mean`` as in the official sampler.
        sde_last_time: Time at which the last SDE step starts; default: 0.04.
        autoguidance: Snapshot of a weaker model to be guided away from; doubles the evaluations.
        guidance_scale: Strength of autoguidance, 1 for none; default: 2.
        guidance_interval: Guided times, such as ``0.2 0.8``; 0 is data, 1 noise; default: all.
        allow_other_latents: Accept a snapshot whose latents are only about the same.
        batch_size: Scenes sampled together.
        decode_batch_size: Scenes decoded together; default: ``batch_size``.
        precision: Weights of the networks; ``bf16`` needs a processor or GPU that computes in it.
        compile: Compile the networks: a minute or more at first, then faster.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        weights: Averaged (``ema``) or last weights of the SiT.
        formats: Files of points: ``bin``, ``ply``, ``npz``; the range images are always in
            ``range_m.npy``.
        pictures: Number of scenes to draw.
        overwrite: Write into a folder that holds scenes already, and start anew.
    """
    from dataclasses import asdict

    import r3dpa
    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.checkpoints.snapshots import read_snapshot
    from r3dpa.data.scene_writer import SceneWriter
    from r3dpa.generation import Autoguidance, SceneGenerator
    from r3dpa.io import source_commit, usable_device

    given = {
        "solver": solver,
        "steps": steps,
        "shift": shift,
        "eta": eta,
        "sde_last": sde_last,
        "sde_last_time": sde_last_time,
    }
    sampler, note = _sampler(quality, {k: v for k, v in given.items() if v is not None})
    if autoguidance is None and (guidance_scale or guidance_interval or allow_other_latents):
        raise ValueError(
            "--guidance_scale, --guidance_interval and --allow_other_latents need --autoguidance"
        )
    for name, value, least in (
        ("num", num, 1),
        ("batch_size", batch_size, 1),
        ("seed", seed, 0),
        ("pictures", pictures, 0),
    ):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    check_folder(out)
    device = usable_device(device)
    checkpoint = read_checkpoint(ckpt)
    guidance, about_guide = None, None
    if autoguidance is not None:
        weak = read_snapshot(autoguidance, checkpoint, weights, allow_other_latents)
        scale = 2.0 if guidance_scale is None else guidance_scale
        interval = guidance_interval or (0.0, 1.0)
        sit, latent_shift = weak.sit.to(device), weak.shift.to(device)
        guidance = Autoguidance(sit, scale, interval, weak.scale, latent_shift)
        about_guide = {
            "checkpoint": str(autoguidance),
            "checkpoint_written": written(autoguidance),
            "step": weak.step,
            "feature_source": weak.feature_source,
            "scale": scale,
            "interval": list(interval),
        }
    generator = SceneGenerator.from_checkpoint(
        checkpoint,
        sampler,
        weights=weights,
        precision=precision,
        device=device,
        autoguidance=guidance,
        batch_size=batch_size if compile else None,
        decode_batch_size=decode_batch_size,
        compile=compile,
    )
    generator.prepare()
    request = {
        "checkpoint": str(ckpt),
        "checkpoint_written": written(ckpt),
        "stage": checkpoint.stage,
        "step": checkpoint.step,
        "feature_source": checkpoint.feature_source,
        "weights": weights,
        "num": num,
        "seed": seed,
        "sampler": asdict(sampler),
        "autoguidance": about_guide,
        "interpolant": checkpoint.interpolant,
        "precision": precision,
        "device": device,
        "compile": compile,
        "batch_size": batch_size,
        "decode_batch_size": decode_batch_size,
        "formats": list(formats),
        "geometry": generator.geometry.to_dict(),
        "r3dpa": r3dpa.__version__,
        "commit": source_commit(),
        "torch": _torch_version(),
    }
    with SceneWriter(
        out, num, generator.geometry.projection, formats, request, overwrite
    ) as writer:
        measured = _generate(generator, writer, batch_size, seed)
        drawn = _draw(out, writer.range_path, pictures, generator.geometry)
        writer.finish(request | measured)
    lines = [note, f"{num} scenes in {out}: {measured['nfe']:.5g} network evaluations each"]
    if measured["drawn_by_last_run"]:
        lines[-1] += (
            f", {measured['device_seconds_per_scene']:.3g} s a scene on the device, "
            f"{measured['seconds_per_scene']:.3g} s end to end"
        )
    return "\n".join(line for line in [*lines, *drawn] if line)


def _sampler(quality: Any, given: dict[str, Any]) -> tuple[SamplerConfig, str]:
    """Sampler of the options, and a line that describes a chosen quality."""
    from r3dpa.generation import SamplerConfig

    if quality is not None and given:
        raise ValueError(f"--quality {quality} chooses what --{next(iter(given))} gives; drop one")
    if given:
        return SamplerConfig(**given), ""
    quality = quality or "good"
    return SamplerConfig.of_quality(quality), SamplerConfig.quality_line(quality)


def _torch_version() -> str:
    import torch

    return torch.__version__


def _generate(
    generator: SceneGenerator, writer: SceneWriter, batch_size: int, seed: int
) -> dict[str, Any]:
    """Generates and writes the missing scenes; returns evaluations and times."""
    import torch
    from tqdm import tqdm

    first_index, device_seconds = writer.num_done, _DeviceClock(generator.device)
    start = time.perf_counter()
    with tqdm(
        total=writer.num, initial=first_index, unit="scene", desc="sampling", disable=None
    ) as progress:
        for first in range(first_index, writer.num, batch_size):
            indices = range(first, min(first + batch_size, writer.num))
            device_seconds.mark()
            batch = generator.generate(indices, seed)
            device_seconds.mark()
            writer.put(batch.range_m, batch.nfe)
            progress.update(len(indices))
    writer.close()
    elapsed, drawn = time.perf_counter() - start, writer.num - first_index
    nfe = writer.evaluations / writer.num  # a fraction only if a solver chooses its steps
    return {
        "nfe": int(nfe) if nfe.is_integer() else nfe,
        "drawn_by_last_run": drawn,
        "device_seconds_per_scene": device_seconds.total() / drawn if drawn else None,
        "seconds_per_scene": elapsed / drawn if drawn else None,
        "threads": torch.get_num_threads(),
    }


class _DeviceClock:
    """Seconds between pairs of marks; on a GPU by its own events, without a synchronisation."""

    def __init__(self, device: torch.device) -> None:
        self._on_gpu = device.type == "cuda"
        self._marks: list[Any] = []

    def mark(self) -> None:
        import torch

        if self._on_gpu:
            self._marks.append(torch.cuda.Event(enable_timing=True))
            self._marks[-1].record()
        else:
            self._marks.append(time.perf_counter())

    def total(self) -> float:
        import torch

        pairs = zip(self._marks[::2], self._marks[1::2], strict=True)
        if not self._on_gpu:
            return sum(stop - start for start, stop in pairs)
        torch.cuda.synchronize()
        return sum(start.elapsed_time(stop) / 1000 for start, stop in pairs)


def _draw(out: Path, range_path: Path, pictures: int, geometry: ScanGeometry) -> list[str]:
    """Draws the first scenes, a sheet of them and a page; returns what to open."""
    import numpy as np
    import torch

    from r3dpa import viz
    from r3dpa.cli.view import write_page
    from r3dpa.geometry import points_of

    ranges = np.load(range_path, mmap_mode="r")
    drawn = [torch.from_numpy(np.array(range_m)) for range_m in ranges[:pictures]]
    if not drawn:
        return []
    for index, range_m in enumerate(drawn):
        draw_scene(out, f"{index:06d}", range_m, geometry)
    viz.save(viz.scenes_sheet(drawn[:_ON_SHEET], geometry.projection), out / "scenes.png")
    opened = [str(out / "scenes.png")]
    scans = [
        viz.PageScan(f"scene {index:06d}", points_of(image, geometry.projection).numpy())
        for index, image in enumerate(drawn[:_ON_PAGE])
        if (image > 0).any()  # neither empty nor NaN
    ]
    if scans:
        title = f"{out.resolve().name} - r3dpa sample"
        opened.append(str(write_page(out / "scenes.html", scans, title)))
    return [f"open {' and '.join(opened)}"]


def draw_scene(out: Path, name: str, range_m: Tensor, geometry: ScanGeometry) -> None:
    """Pictures of a scene ``(H, W)``: range image, from above and from behind."""
    from r3dpa import viz
    from r3dpa.geometry import points_of

    sensor, points = geometry.projection.sensor, points_of(range_m, geometry.projection)
    picture = viz.range_image_picture(range_m, sensor, scale=max(1, 1024 // sensor.columns))
    viz.save(picture, out / "range" / f"{name}.png")
    viz.save(viz.birds_eye_view(points), out / "birds_eye" / f"{name}.png")
    viz.save(viz.scene_3d(points), out / "scene_3d" / f"{name}.png")


def written(path: Path) -> str:
    """Time of the last change of a file: the same name may hold other weights later."""
    return datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat()


def convert(
    source: Path,
    out: Path,
    *,
    to: Literal["r3dpa", "official"] = "r3dpa",
    overwrite: bool = False,
    sit_args: dict[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
    into: Path | None = None,
) -> str:
    """Convert official checkpoints into ours, or ours into official ones.

    Args:
        source: Official ``.pt``, Lightning ``.ckpt`` or exported ``.safetensors``.
        out: File to write, ``.safetensors`` for ours and ``.pt`` for the official layout.
        to: Layout of the result.
        overwrite: Replace ``out`` if it exists.
        sit_args: Official files only: SiT arguments that the file lacks, such as
            ``{alignment_depth: 4}``.
        encoding: Official files only: range encoding, if the file lacks it.
        into: Put RGB weights into the SiT of this YAML, such as ``conf/net/sit_b2.yaml``, and list
            what was kept, resized and dropped; ``--model.init_args.rgb_weights`` takes ``out``.
    """
    from r3dpa.checkpoints import convert as convert_checkpoint

    return convert_checkpoint(
        source, out, to, overwrite=overwrite, sit_args=sit_args, encoding=encoding, into=into
    ).table()


def report(run: Path) -> str:
    """Draw the loss curves of a run and list where each loss started and ended.

    The table has the mean of the first and of the last tenth of the values of a quantity, their
    difference and, if both are positive, their ratio. A value that was logged once stands alone.

    Args:
        run: Folder given to ``r3dpa fit`` as ``--run_dir``.
    """
    from statistics import fmean

    from tabulate import tabulate

    from r3dpa import viz

    paths = sorted(run.glob("version_*/metrics.csv"), key=lambda path: path.stat().st_mtime)
    if not paths:
        raise ValueError(f"{run} holds no version_*/metrics.csv; give the --run_dir of a fit")
    curves: dict[str, viz.Series] = {}
    for path in paths:  # one for each start of the run
        for name, (steps, values) in viz.read_metrics(path).items():
            before = curves.get(name, ([], []))
            curves[name] = ([*before[0], *steps], [*before[1], *values])
    drawn = {name: curve for name, curve in curves.items() if len(curve[1]) > 1}
    if drawn:
        viz.save(viz.loss_curves(drawn), run / "loss_curves.png")
    rows: list[list[str]] = []
    for name, (_, values) in curves.items():
        tenth = max(1, len(values) // 10)
        first, last = fmean(values[:tenth]), fmean(values[-tenth:])
        ratio = f"{last / first:.3f}" if first > 0 and last > 0 else ""
        change = [f"{last:.5g}", f"{last - first:+.5g}", ratio] if name in drawn else []
        rows.append([name, f"{first:.5g}", *change])
    head = ["quantity", "first tenth", "last tenth", "change", "ratio"]
    table = tabulate(
        rows,
        head,
        tablefmt="plain",
        disable_numparse=True,
        colalign=("left", "right", "right", "right", "right"),
    )
    return f"{table}\ncurves: {run / 'loss_curves.png'}" if drawn else table
