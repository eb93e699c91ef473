"""``r3dpa edit``: inpaint, mix, complete, vary and interpolate scans."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from jsonargparse.typing import PositiveInt

from r3dpa.cli.parser import EditOptions


def inpaint(
    *,
    scan: Path,
    box: tuple[float, float, float, float] | None = None,
    box3d: tuple[float, float, float, float, float, float, float] | None = None,
    mask: Path | None = None,
    objects: Path | None = None,
    object: str | None = None,
    strength: float | None = None,
    window: tuple[float, float] | None = None,
    start: float = 1.0,
    dilation: int = 0,
    num: PositiveInt = 8,
    **options: Any,
) -> str:
    """Generate a part of a scan anew, as an object if one is named.

    The part is one of --box, --box3d and --mask; pixels outside it stay those of the scan. The
    object is a class of a library (--objects FILE --object car); without one the edit is unguided.
    Azimuth 0 looks forward and grows to the left; 180 is behind.

    Args:
        scan: Scan to edit: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        box: Azimuth from and to (leftwards), inclination from and to: degrees, ``-10 10 -20 0``.
        box3d: Centre x y z, length, width, height (metres, frame of the sensor), yaw (degrees).
        mask: Picture of H x W pixels as the range image, bright where it is to change.
        objects: File of ``r3dpa data objects``, made with the feature source of the checkpoint.
        object: Class of that file.
        strength: Guidance in velocities, 0 to 1; default: 0.5.
        window: First and last guided time; 0 data, 1 noise; default: all.
        start: First time of the edit; below 1 keeps some of the original part.
        dilation: Rings of tokens around the part to generate too; pixels outside are restored.
        num: Number of results, one per seed index.
        **options: See :class:`EditOptions`.
    """
    arguments = dict(locals())
    from r3dpa.cli.edit_session import EditSession
    from r3dpa.cli.scene_files import feature_source_of
    from r3dpa.editing import regions
    from r3dpa.editing.objects import ObjectLibrary

    if sum(region is not None for region in (box, box3d, mask)) != 1:
        raise ValueError("give one of --box, --box3d and --mask: the part that is to change")
    if (objects is None) != (object is None):
        raise ValueError(
            "--objects FILE and --object NAME go together; `r3dpa data objects` writes one"
        )
    if objects is None and (strength, window) != (None, None):
        raise ValueError("--strength and --window need --object")
    session = EditSession(EditOptions(**options), num, strength, window)
    source = session.read(scan)
    if mask is not None:
        region = session.read_mask(mask)
    elif box is not None:
        region = regions.angle_box(session.projection, *box)
    elif box3d is not None:
        region = regions.box3d(session.projection, box3d[:3], box3d[3:6], box3d[6])
    feature = None
    if objects is not None and object is not None:
        library = ObjectLibrary.load(objects)
        library.check_source(feature_source_of(session.checkpoint), session.sit.feature_dim)
        feature = library.feature(object)
    run = partial(session.editor.inpaint, source.range_m, region, num, session.options.seed)
    run = partial(run, feature=feature, start=start, dilation=dilation)
    scans, names = {f"scan {scan.stem}": source}, ("kept", object or "generated anew")
    return session.write("inpaint", arguments, scans, run, region, names, feature is not None)


def mix(
    *,
    left: Path,
    right: Path,
    split: float = 0.0,
    blend: float = 20.0,
    features_ckpt: Path | None = None,
    strength: float = 0.5,
    window: tuple[float, float] = (0.0, 1.0),
    num: PositiveInt = 8,
    **options: Any,
) -> str:
    """Generate scenes that follow one scan on one side and another scan on the other.

    The features of the scans are stitched, and guide scenes from noise. Azimuth 0 looks forward
    and grows to the left; 180 is behind.

    Args:
        left: Scan of the left half: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        right: Scan of the right half.
        split: Azimuth in degrees where the left half starts; it ends half a turn further.
        blend: Width of the seams in degrees.
        features_ckpt: Weights of the feature source, if it has none of its own.
        strength: Guidance in velocities, 0 to 1.
        window: First and last guided time; 0 data, 1 noise.
        num: Number of results, one per seed index.
        **options: See :class:`EditOptions`.
    """
    arguments = dict(locals())
    from r3dpa.cli.edit_session import EditSession
    from r3dpa.editing.regions import mask_of_tokens, sector_weights

    session = EditSession(EditOptions(**options), num, strength, window)
    paths = enumerate((left, right))
    scans = {f"{number}: {path.stem}": session.read(path) for number, path in paths}
    grids = session.feature_grids(scans.values(), features_ckpt)
    weights = sector_weights([(split, 0), (split + 180, 1)], session.sit.grid_size, blend)
    size = session.sensor.beams, session.sensor.columns
    numbers = mask_of_tokens(weights.argmax(dim=0), session.sit.grid_size, size)
    run = partial(session.editor.mix, grids, weights, num, session.options.seed)
    return session.write("mix", arguments, scans, run, numbers, list(scans), guided=True)


def complete(
    *,
    scan: Path,
    sector: tuple[float, float] | None = None,
    keep_every: int | None = None,
    empty_beams: bool = False,
    other_sensor: tuple[int, float, float] | None = None,
    mask: Path | None = None,
    start: float | None = None,
    resamplings: PositiveInt | None = None,
    num: PositiveInt = 8,
    **options: Any,
) -> str:
    """Fill a missing sector, dropped beams, or any pixels of a scan.

    All named gaps are filled; where the scan has returns in them, the result is compared with
    these. Azimuth 0 looks forward and grows to the left; 180 is behind. R2DM and R2Flow complete by
    RePaint, LiDM its latents, all in ``--steps`` intervals from noise; they read no other option
    of the solver.

    Args:
        scan: Scan to complete: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        sector: Azimuth from and to, counted to the left, degrees.
        keep_every: Keep the first of so many beams: 2 makes 64 of 32, 4 of 16.
        empty_beams: Rows without a return are missing, as in a scan of fewer beams.
        other_sensor: Keep what so many beams between two inclinations (degrees) see: ``32 -25 3``.
        mask: Picture of H x W pixels as the range image, bright where it is missing.
        start: Time at which R3DPA starts, in (0, 1], default 0.3; large gaps need more.
        resamplings: How often RePaint crosses each interval; default: 10.
        num: Number of results, one per seed index.
        **options: See :class:`EditOptions`.
    """
    arguments = dict(locals())
    from dataclasses import replace

    import torch

    from r3dpa.cli.edit_session import EditSession, held_out_errors
    from r3dpa.editing import regions
    from r3dpa.geometry import SphericalProjection

    session = EditSession(EditOptions(**options), num)
    stage = session.checkpoint.stage
    if start is not None and session.baseline is not None:
        raise ValueError(f"--start is for R3DPA: stage {stage} starts from noise")
    if resamplings is not None and stage not in ("r2dm", "r2flow"):
        raise ValueError(f"--resamplings is for R2DM and R2Flow, not for stage {stage}")
    projection, rows = session.projection, session.sensor.beams
    masks = []
    if sector is not None:
        masks.append(regions.sector(projection, *sector))
    if keep_every is not None:
        if not 2 <= keep_every <= rows // 2:
            raise ValueError(f"--keep_every must be 2 to {rows // 2}, got {keep_every}")
        masks.append(regions.dropped_beams(projection, range(0, rows, keep_every)))
    if other_sensor is not None:
        count, low, high = other_sensor
        sensor = replace(
            session.sensor, beams=count, inclination_min_deg=low, inclination_max_deg=high
        )
        masks.append(regions.sensor_pair(projection, SphericalProjection(sensor)))
    if mask is not None:
        masks.append(session.read_mask(mask))
    source = session.read(scan, check=False)
    if empty_beams:
        empty = ~(source.range_m > 0).any(dim=1, keepdim=True)
        masks.append(empty.expand_as(source.range_m))
    if not masks:
        raise ValueError(
            "nothing is missing: give --sector, --keep_every, --empty_beams, --other_sensor or "
            "--mask"
        )
    missing = regions.check_mask(torch.stack(masks).any(dim=0), "all that is missing")
    session.check(source, missing)
    known = source._replace(range_m=torch.where(missing, -1.0, source.range_m))
    if session.baseline is not None:
        run = partial(session.complete, source, missing, resamplings or 10)
    else:
        run = partial(session.editor.complete, source.range_m, missing, num, session.options.seed)
        run = partial(run, start=0.3 if start is None else start)
    scans = {f"scan {scan.stem}": source, "known part": known}
    measure = partial(held_out_errors, range_m=source.range_m, missing=missing)
    names = ("kept", "missing")
    return session.write("complete", arguments, scans, run, missing, names, measure=measure)


def vary(*, scan: Path, start: float = 0.5, num: PositiveInt = 8, **options: Any) -> str:
    """Generate scenes similar to a scan: part of the way to noise and back.

    Args:
        scan: Scan to vary: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        start: Time of the noise, in (0, 1]; larger values differ more from the scan.
        num: Number of results, one per seed index.
        **options: See :class:`EditOptions`.
    """
    arguments = dict(locals())
    from r3dpa.cli.edit_session import EditSession

    session = EditSession(EditOptions(**options), num)
    source = session.read(scan)
    run = partial(session.editor.vary, source.range_m, num, session.options.seed, start=start)
    return session.write("vary", arguments, {f"scan {scan.stem}": source}, run)


def interpolate(*, left: Path, right: Path, frames: int = 8, **options: Any) -> str:
    """Generate the scenes on the way from one scan to another, through noise.

    Args:
        left: Scan of the first frame: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        right: Scan of the last frame.
        frames: Number of scenes, both ends among them.
        **options: See :class:`EditOptions`.
    """
    arguments = dict(locals())
    from r3dpa.cli.edit_session import EditSession

    if frames < 2:
        raise ValueError(f"frames must be at least 2, the two scans; got {frames}")
    session = EditSession(EditOptions(**options), frames)
    first, last = session.read(left), session.read(right)
    run = partial(session.editor.interpolate, first.range_m, last.range_m, frames)
    scans = {f"left: {left.stem}": first, f"right: {right.stem}": last}
    return session.write("interpolate", arguments, scans, run)
