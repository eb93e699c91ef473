"""``r3dpa sample`` and ``gallery``: scenes of a checkpoint, as files and as one page."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from jsonargparse.typing import NonNegativeInt, PositiveInt

from r3dpa.feature_names import OWN_WEIGHTS
from r3dpa.io import check_file
from r3dpa.pretrained import DEFAULT_WEIGHTS, OBJECTS_SUFFIX, weights_file
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
    """Generate scenes from a checkpoint: points, range images, pictures and a page to turn.

    Points have an intensity, and ``labels`` the classes of KITTI-360, where the checkpoint
    generates them. The same command completes an interrupted run; with a greater ``--num`` it adds
    scenes. Options that the solver does not read are refused. ``metadata.json`` holds everything
    needed to repeat the run.

    Args:
        num: Number of scenes.
        quality: Measured solver, steps and shift, of which the options below change single ones;
            default: good, or of a baseline, its published sampler. ``instant`` needs a checkpoint
            of stage few_step, as does ``average_velocity``.
        solver: ODE solver, ``euler_maruyama`` for the SDE, ``ddpm``, or ``average_velocity`` for 1,
            2, 4 or 8 steps of any length.
        steps: Solver steps.
        shift: Finer steps near noise (above 1) or data (below 1) of the ODE.
        eta: Noise strength of the SDE; default: 1, as published.
        sde_last: Last SDE step: ``denoise`` (default) or ``mean`` as in the official sampler.
        autoguidance: Snapshot of a weaker model to guide away from; doubles the evaluations.
        guidance_scale: Strength of guidance, 1 for none; default: as the weights record, which are
            guided away from themselves without one attention map; 2 with ``--autoguidance``.
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

    from r3dpa.checkpoints import read_checkpoint, read_snapshot
    from r3dpa.data.scene_writer import SceneWriter
    from r3dpa.flow.sampler import Quality
    from r3dpa.generation import Autoguidance, SamplerConfig, geometry_of
    from r3dpa.geometry import projection_for
    from r3dpa.io import usable_device
    from r3dpa.nn import ThinDecoder
    from r3dpa.scene_files.generated import generate_all, provenance, written
    from r3dpa.stages import BASELINE_STAGES, published_sampler, scene_generator
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
    sampler: SamplerConfig | Quality | None = quality
    if given and checkpoint.stage in BASELINE_STAGES:
        sampler = published_sampler(checkpoint).changed(**given)
    elif given:
        sampler = SamplerConfig.of_quality(quality or "good").changed(**given)
        if decoder is None and quality == "instant" and "thin_decoder" in checkpoint.networks:
            decoder = "thin"
    guidance, about_guide = None, None
    if autoguidance is not None:
        weak = read_snapshot(autoguidance, checkpoint, files.weights)
        scale, guidance_scale = 2.0 if guidance_scale is None else guidance_scale, 1.0
        interval = guidance_interval or (0.0, 1.0)
        sit, latent_shift = weak.sit.to(device), weak.shift.to(device)
        guidance = Autoguidance(sit, scale, interval, weak.scale, latent_shift)
        about_guide = {
            "checkpoint": str(autoguidance),
            "checkpoint_written": written(autoguidance),
            "step": weak.step,
            "scale": scale,
            "interval": list(interval),
        }
    generator = scene_generator(
        checkpoint,
        sampler,
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
    request = provenance(checkpoint, files, num, device, geometry)
    thin = isinstance(getattr(generator, "vae", None), ThinDecoder)  # a baseline has no VAE
    request |= {"precision": precision, "compile": compile, "decoder": "thin" if thin else "full"}
    request |= {"sampler": asdict(generator.sampler), "autoguidance": about_guide}
    request["guidance_scale"] = getattr(generator, "guidance_scale", 1.0)
    projection = geometry.projection
    with SceneWriter(files.out, num, projection, files.formats, request, files.overwrite) as writer:
        measured = generate_all(generator, writer, files.batch_size, files.seed, seen_by)
        opened = draw_scenes(files.out, writer.range_path, files.pictures, geometry)
        writer.finish(request | measured)
    line = f"{num} scenes in {files.out}: {measured['nfe']:.5g} network evaluations each"
    if measured["drawn_by_last_run"]:
        line += f", {measured['seconds_per_scene']:.3g} s per scene"
    note = f"sampler: {generator.sampler.summary}"
    if not given and generator.sampler == SamplerConfig.of_quality(quality or "good"):
        note = SamplerConfig.quality_line(quality or "good")  # measured, unlike a baseline's
    if seen_by is not None:
        view = seen_by.sensor
        line += (
            f", as seen by {sensor}: {view.beams} x {view.columns}, up to {view.range_max_m:g} m"
        )
    return "\n".join(filter(None, (note, line, opened)))


def gallery(
    *,
    out: Path,
    ckpt: Path = Path(DEFAULT_WEIGHTS),
    num: PositiveInt = 64,
    data: Path | None = None,
    quality: Literal["draft", "good", "best"] = "good",
    seed: NonNegativeInt = 0,
    batch_size: PositiveInt = 8,
    device: str = "auto",
) -> str:
    """Write one page of scenes in order, none left out, with clouds to turn.

    The nearest training scan beside each scene shows what is memorised. Edits of the first scene
    follow, and fog, rain and snow in it. Where the weights have features of cars, a car is put into
    it: the two of eight draws that are most like one.

    Args:
        out: HTML file to write.
        ckpt: Checkpoint of stage joint or flow_matching, a name of ``r3dpa models``, or
            ``hf://owner/name``.
        num: Number of scenes.
        data: Training data, a folder of scans or a data YAML; default: no nearest scans.
        quality: Sampler of the scenes.
        seed: Scenes depend on it and on their number.
        batch_size: Scenes generated together.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from torch import Tensor

    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.cli.features import read_data
    from r3dpa.editing import SceneEditor, most_like_first, regions
    from r3dpa.editing.objects import ObjectLibrary
    from r3dpa.features import feature_source
    from r3dpa.generation import SceneGenerator
    from r3dpa.io import usable_device, write_text
    from r3dpa.scenes import Scene
    from r3dpa.viz.gallery import gallery_page

    check_file(out)
    checkpoint = read_checkpoint(ckpt)
    generator = SceneGenerator.from_checkpoint(checkpoint, quality, device=usable_device(device))
    car: Tensor | None = None
    teacher: Any = None
    objects = weights_file(ckpt).with_suffix(OBJECTS_SUFFIX)
    if objects.is_file():
        library = ObjectLibrary.load(objects)
        library.check_source(checkpoint.feature_source, generator.sit.feature_dim)
        car = library.feature("car") if "car" in library.names else None
        if library.source in OWN_WEIGHTS:
            teacher = feature_source(library.source, dim=generator.sit.feature_dim)
    module = None if data is None else read_data(data)
    if module is not None:
        module.setup("fit")
        if module.sensor != generator.geometry.projection.sensor:
            raise ValueError(f"{data}: is of another sensor than {ckpt}: {module.sensor}")
    projection = generator.geometry.projection
    editor = SceneEditor(generator, batch_size=batch_size)

    def edit(scene: Scene) -> dict[str, Tensor]:
        """Results ``(N, H, W)`` of edits of a scene, by what they show."""
        street_ahead = regions.angle_box(projection, -30, 30, -25, 3)
        kept_rows = range(0, projection.sensor.beams, 2)
        missing = regions.dropped_beams(projection, kept_rows)
        results = {
            "ahead generated anew": editor.inpaint(scene, street_ahead, 2, seed).range_m,
            "every other beam filled": editor.complete(scene, missing, 1, seed).range_m,
            "varied": editor.vary(scene, 2, seed).range_m,
        }
        if car is not None:
            place = regions.box3d(projection, (10.0, 0.0, -0.95), (4.2, 1.8, 1.5))
            draws = editor.inpaint(scene, place, 8, seed, feature=car)
            if teacher is not None:
                draws = most_like_first(draws, place, car, teacher, generator.sit.grid_size)
            results["a car 10 m ahead"] = draws.range_m[:2]
        return results

    page = gallery_page(generator, str(ckpt), num, edit, module, seed, batch_size)
    html = page.html("r3dpa gallery")
    write_text(out, html)
    return f"open {out}: {len(page.scans)} scenes, {len(html) / 1e6:.0f} MB"
