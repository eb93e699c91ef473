"""``r3dpa sample``: scenes of a checkpoint as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from jsonargparse.typing import PositiveInt

from r3dpa.scene_files.options import ODESolver, SceneOptions


def sample(
    *,
    num: PositiveInt = 16,
    quality: Literal["instant", "draft", "good", "best"] | None = None,
    solver: Literal[ODESolver, "euler_maruyama", "average_velocity", "ddpm", "ddim"] | None = None,
    steps: PositiveInt | None = None,
    shift: float | None = None,
    eta: float | None = None,
    sde_last: Literal["denoise", "mean"] | None = None,
    autoguidance: Path | None = None,
    guidance_scale: float | None = None,
    guidance_interval: tuple[float, float] | None = None,
    decoder: Literal["full", "thin"] | None = None,
    precision: Literal["fp32", "bf16"] = "fp32",
    compile: bool = False,
    sensor: str | None = None,
    **options: Any,
) -> str:
    """Generate scenes from a checkpoint: points, range images, pictures and an interactive page.

    Points have an intensity, and ``labels`` the classes of KITTI-360, where the checkpoint
    generates them. The same command completes an interrupted run; with a greater ``--num`` it adds
    scenes. Options that the solver does not read are refused. ``metadata.json`` holds everything
    needed to repeat the run.

    Args:
        num: Number of scenes.
        quality: Preset of solver, steps and shift; the options below override single values;
            default: good, or the published sampler of a baseline. ``instant`` needs a checkpoint
            of stage few_step, as does ``average_velocity``.
        solver: ODE solver, ``euler_maruyama`` for the SDE, ``ddpm`` or ``ddim`` for ancestral
            steps, or ``average_velocity`` for 1, 2, 4 or 8 steps of any length.
        steps: Solver steps.
        shift: Finer steps near noise (above 1) or data (below 1) of the ODE.
        eta: Noise strength of the SDE or of ``ddpm``; default: 1, as published.
        sde_last: Last SDE step: ``denoise`` (default) or ``mean`` as in the official sampler.
        autoguidance: Snapshot of a weaker model to guide away from; doubles the evaluations.
        guidance_scale: Strength of guidance, 1 for none; default: the strength of
            perturbed-attention guidance recorded in the checkpoint; 2 with ``--autoguidance``.
        guidance_interval: Times of autoguidance, such as ``0.2 0.8``; 0 is data, 1 noise; default:
            all.
        decoder: Decoder of the VAE or the thin one of stage few_step; default: thin for
            ``--quality instant`` where the checkpoint has one, else full.
        precision: Weights of the networks; ``bf16`` needs a processor or GPU that computes in it.
        compile: Compile the networks: a minute or more at first, then faster.
        sensor: Preset of ``r3dpa data sensors`` or YAML whose beams the scenes are seen by; refused
            where it sees more than the model knows; default: the sensor of the checkpoint.
        **options: See :class:`SceneOptions`.
    """
    from dataclasses import asdict, replace

    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.data.scene_writer import SceneWriter
    from r3dpa.generation import SamplerConfig, geometry_of
    from r3dpa.geometry import projection_for
    from r3dpa.io import number_of, usable_device
    from r3dpa.nn import ThinDecoder
    from r3dpa.scene_files.generated import (
        autoguidance_of,
        generate_all,
        provenance,
        sampler_of,
    )
    from r3dpa.stages import scene_generator
    from r3dpa.viz.scenes import draw_scenes

    settings: dict[str, Any] = {
        "solver": solver,
        "steps": steps,
        "shift": shift,
        "eta": eta,
        "sde_last": sde_last,
    }
    given = {name: value for name, value in settings.items() if value is not None}
    if autoguidance is None and guidance_interval:
        raise ValueError("--guidance_interval needs --autoguidance")
    files = SceneOptions(**options)
    device = usable_device(files.device)
    checkpoint = read_checkpoint(files.ckpt)
    seen_by = None
    if sensor is not None:
        seen_by = projection_for(sensor, geometry_of(checkpoint).projection)
    if given and decoder is None and quality == "instant" and "thin_decoder" in checkpoint.networks:
        decoder = "thin"
    guidance, about_guide = None, None
    if autoguidance is not None:
        scale = 2.0 if guidance_scale is None else guidance_scale
        guidance_scale = 1.0  # autoguidance replaces perturbed attention
        interval = guidance_interval or (0.0, 1.0)
        guidance, about_guide = autoguidance_of(
            autoguidance, checkpoint, files.weights, device, scale, interval
        )
    generator = scene_generator(
        checkpoint,
        sampler_of(checkpoint, quality, given),
        weights=files.weights,
        decoder=decoder,
        precision=precision,
        device=device,
        guidance_scale=guidance_scale,
        autoguidance=guidance,
        batch_size=files.batch_size if compile else None,
        compile=compile,
    )
    generator.prepare()
    geometry = generator.geometry
    if seen_by is not None:
        geometry = replace(geometry, projection=seen_by, grid_size=(1, 1))
    thin = isinstance(getattr(generator, "vae", None), ThinDecoder)  # a baseline has no VAE
    request = provenance(checkpoint, files, num, device, geometry) | {
        "precision": precision,
        "compile": compile,
        "decoder": "thin" if thin else "full",
        "sampler": asdict(generator.sampler),
        "autoguidance": about_guide,
        "guidance_scale": getattr(generator, "guidance_scale", 1.0),
    }
    projection = geometry.projection
    with SceneWriter(files.out, num, projection, files.formats, request, files.overwrite) as writer:
        measured = generate_all(generator, writer, files.batch_size, files.seed, seen_by)
        opened = draw_scenes(files.out, writer.range_path, files.pictures, geometry)
        writer.finish(request | measured)
    note = f"sampler: {generator.sampler.summary}"
    if not given and generator.sampler == SamplerConfig.of_quality(quality or "good"):
        note = SamplerConfig.quality_line(quality or "good")  # measured, unlike a baseline's
    line = (
        f"{number_of(num, 'scene')} in {files.out}: {measured['nfe']:.5g} network evaluations each"
    )
    if measured["drawn_by_last_run"]:
        line += f", {measured['seconds_per_scene']:.3g} s per scene"
    if seen_by is not None:
        view = seen_by.sensor
        line += (
            f", as seen by {sensor}: {view.beams} x {view.columns}, up to {view.range_max_m:g} m"
        )
    return "\n".join(filter(None, (note, line, opened)))
