"""``r3dpa sample``, ``convert`` and ``report``: scenes, checkpoints and loss curves as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from r3dpa.cli.parser import check_folder, check_least

__all__ = ["convert", "report", "sample"]


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
        quality: Measured solver, steps and shift; default: good, unless one of these is given.
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
        formats: Files of points: ``bin``, ``ply``, ``npz``; ``range_m.npy`` is always written.
        pictures: Number of scenes to draw.
        overwrite: Write into a folder that holds scenes already, and start anew.
    """
    arguments = dict(locals())
    from dataclasses import asdict

    from r3dpa.checkpoints import read_checkpoint, read_snapshot
    from r3dpa.cli.scene_files import draw_all, generate_all, provenance, written
    from r3dpa.data.scene_writer import SceneWriter
    from r3dpa.generation import Autoguidance, SamplerConfig, SceneGenerator
    from r3dpa.io import usable_device

    of_solver = ("solver", "steps", "shift", "eta", "sde_last", "sde_last_time")
    given = {name: arguments[name] for name in of_solver if arguments[name] is not None}
    if quality is not None and given:
        raise ValueError(f"--quality {quality} chooses what --{next(iter(given))} gives; drop one")
    chosen = quality or "good"
    sampler = SamplerConfig(**given) if given else SamplerConfig.of_quality(chosen)
    if autoguidance is None and (guidance_scale or guidance_interval or allow_other_latents):
        raise ValueError(
            "--guidance_scale, --guidance_interval and --allow_other_latents need --autoguidance"
        )
    check_least(1, num=num, batch_size=batch_size)
    check_least(0, seed=seed, pictures=pictures)
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
    request = provenance(checkpoint, ckpt, generator.geometry)
    names = ("weights", "num", "seed", "precision", "compile", "batch_size", "decode_batch_size")
    request |= {name: arguments[name] for name in names}
    request |= {
        "device": device,
        "formats": list(formats),
        "sampler": asdict(sampler),
        "autoguidance": about_guide,
    }
    projection = generator.geometry.projection
    with SceneWriter(out, num, projection, formats, request, overwrite) as writer:
        measured = generate_all(generator, writer, batch_size, seed)
        opened = draw_all(out, writer.range_path, pictures, generator.geometry)
        writer.finish(request | measured)
    line = f"{num} scenes in {out}: {measured['nfe']:.5g} network evaluations each"
    if measured["drawn_by_last_run"]:
        line += (
            f", {measured['device_seconds_per_scene']:.3g} s a scene on the device, "
            f"{measured['seconds_per_scene']:.3g} s end to end"
        )
    note = "" if given else SamplerConfig.quality_line(chosen)
    return "\n".join(filter(None, (note, line, opened)))


def convert(
    source: Path,
    out: Path,
    *,
    to: Literal["r3dpa", "official"] = "r3dpa",
    overwrite: bool = False,
    sit_args: dict[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
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
    """
    from r3dpa.checkpoints import convert as convert_checkpoint

    return convert_checkpoint(
        source, out, to, overwrite=overwrite, sit_args=sit_args, encoding=encoding
    )


def report(run: Path) -> str:
    """Draw the loss curves of a run and list where each loss started and ended.

    The table has the mean of the first and of the last tenth of the values of a quantity, their
    difference and, if both are positive, their ratio. A value that was logged once stands alone.

    Args:
        run: Folder given to ``r3dpa fit`` as ``--run_dir``.
    """
    from statistics import fmean

    from r3dpa import viz
    from r3dpa.io import text_table

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
    table = text_table(rows, head, "lrrrr", "plain")
    return f"{table}\ncurves: {run / 'loss_curves.png'}" if drawn else table
