"""``r3dpa edit``: inpaint, mix, complete, vary and interpolate scans."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from jsonargparse.typing import PositiveInt

from r3dpa.feature_names import OWN_WEIGHTS
from r3dpa.pretrained import check_features, objects_file
from r3dpa.scene_files.options import EditOptions


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
    features_ckpt: Path | None = None,
    num: PositiveInt = 8,
    **options: Any,
) -> str:
    """Generate a part of a scan anew, as an object if one is named.

    The part is one of --box, --box3d and --mask; pixels outside it keep the scan's values. The
    object is a class of the mean features beside the weights, such as car or tree, or of a file
    (--objects FILE --object car); without one the edit is unguided. Not every draw becomes the
    object: the feature source looks at all of them, and the one that is most like it comes first;
    in a box, those that it takes for the object come first, and the numbers of points that say so
    are printed. With r3dpa-s, objects much smaller than a cell of its feature grid (11 degrees),
    such as poles and pedestrians, hardly ever appear. Azimuth 0 looks forward and grows to the
    left; 180 is behind.

    Args:
        scan: Scan to edit: .bin, .pcd, .ply, .npy, .npz or .las.
        box: Azimuth from and to (leftwards), inclination from and to: degrees, ``-10 10 -20 0``.
        box3d: Centre x y z, length, width, height (metres, frame of the sensor), yaw (degrees). An
            object is moved into the box where it is drawn in front of it.
        mask: Picture of H x W pixels as the range image, bright where it is to change.
        objects: File of ``r3dpa data objects``, made with the feature source of the checkpoint;
            default: the one beside the weights.
        object: Class of object.
        strength: Guidance relative to the velocity, 0 to 1; default: 0.5.
        window: First and last guided time; 0 data, 1 noise; default: all.
        start: First time of the edit; below 1 keeps some of the original part.
        dilation: Rings of tokens around the part to generate as well; pixels outside are restored.
        features_ckpt: Weights of the feature source, if it has none of its own; without them, the
            results stay in the order of the draws.
        num: Number of results, one per seed index.
        **options: See :class:`EditOptions`.
    """
    arguments = {
        "scan": scan,
        "box": box,
        "box3d": box3d,
        "mask": mask,
        "objects": objects,
        "object": object,
        "strength": strength,
        "window": window,
        "start": start,
        "dilation": dilation,
        "features_ckpt": features_ckpt,
    }
    if sum(region is not None for region in (box, box3d, mask)) != 1:
        raise ValueError("give one of --box, --box3d and --mask: the part that is to change")
    if object is None and objects is not None:
        raise ValueError("--objects FILE needs --object NAME, a class of the file")
    if object is None and (strength, window, features_ckpt) != (None, None, None):
        raise ValueError("--strength, --window and --features_ckpt need --object")
    shared = EditOptions(**options)
    if object is not None:
        check_features(shared.ckpt)
        arguments["objects"] = objects = objects or objects_file(shared.ckpt)
        arguments["sorted_of"] = num  # another number of draws is sorted anew
    from r3dpa.editing import EditResult, most_like_first, regions
    from r3dpa.editing.objects import ObjectLibrary
    from r3dpa.editing.settings import check_start
    from r3dpa.scene_files.edits import EditSession
    from r3dpa.scene_files.generated import feature_source_of

    check_start(start)
    feature = semantic_class = extractor = inside = front_m = None
    if object is not None and objects is not None:
        library = ObjectLibrary.load(objects)
        feature = library.feature(object)  # an unknown name is refused before the weights are read
        semantic_class = library.semantic_class(object)
    session = EditSession(shared, num, strength, window)
    source = session.read(scan)
    if mask is not None:
        region = session.read_mask(mask)
    elif box is not None:
        region = regions.angle_box(session.projection, *box)
    elif box3d is not None:
        place: dict[str, Any] = {
            "centre_m": box3d[:3],
            "size_m": box3d[3:6],
            "yaw_deg": box3d[6],
        }
        region = regions.box3d(session.projection, **place)
        inside = partial(regions.in_box3d, **place)
        if feature is not None:
            front_m = regions.box3d_front_m(session.projection, **place)
    # The editor refuses such a part too, but --overwrite has emptied the folder by then.
    regions.token_mask(region, session.sit.grid_size, dilation)
    if feature is not None:
        library.check_source(feature_source_of(session.checkpoint), session.sit.feature_dim)
        if features_ckpt is not None or library.source in OWN_WEIGHTS:
            extractor = session.extractor(features_ckpt)

    def run() -> EditResult:
        edits = session.editor.inpaint(
            source.pixels,
            region,
            num,
            session.options.seed,
            feature=feature,
            front_m=front_m,
            start=start,
            dilation=dilation,
        )
        if feature is None or extractor is None:
            return edits
        grid_size = session.sit.grid_size
        return most_like_first(edits, region, feature, extractor, grid_size, inside, semantic_class)

    scans = {f"scan {scan.stem}": source}
    parts = ("kept", object or "generated anew")
    is_guided = feature is not None
    return session.write("inpaint", arguments, scans, run, region, parts, guided=is_guided)


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
        left: Scan of the left half: .bin, .pcd, .ply, .npy, .npz or .las.
        right: Scan of the right half.
        split: Azimuth in degrees where the left half starts; it ends half a turn further.
        blend: Width of the seams in degrees.
        features_ckpt: Weights of the feature source, if it has none of its own.
        strength: Guidance relative to the velocity, 0 to 1.
        window: First and last guided time; 0 data, 1 noise.
        num: Number of results, one per seed index.
        **options: See :class:`EditOptions`.
    """
    arguments = {
        "left": left,
        "right": right,
        "split": split,
        "blend": blend,
        "features_ckpt": features_ckpt,
        "strength": strength,
        "window": window,
    }
    shared = EditOptions(**options)
    check_features(shared.ckpt)
    from r3dpa.editing.regions import mask_of_tokens, sector_weights
    from r3dpa.scene_files.edits import EditSession

    session = EditSession(shared, num, strength, window)
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
    num: PositiveInt = 1,
    workers: PositiveInt = 1,
    **options: Any,
) -> str:
    """Fill a missing sector, dropped beams, or any pixels of a scan or a folder of scans.

    Every point of a scan comes back as it was, in its format and order; generated points follow,
    where the scan has none. ``range_m.npy`` holds the completed images; where the scan has returns
    in what is missing, these are not read, and errors of the completion, of linear interpolation
    and of the nearest beam are compared. The completion aims at a small error: large parts are made
    up by ``r3dpa edit inpaint``.

    Azimuth 0 looks forward and grows to the left; 180 is behind. R2DM and R2Flow run RePaint on
    images, LiDM on latents, in ``--steps`` intervals; they ignore other solver options, and R3DPA
    ignores all. ``--formats`` is ignored.

    Args:
        scan: Scan or folder of scans to complete: .bin, .pcd, .ply, .npy, .npz or .las.
        sector: Azimuth from and to, counted to the left, degrees.
        keep_every: Keep every n-th beam and fill the rest: 2 upsamples 32 beams to 64.
        empty_beams: Fill what the beams do not reach, as in a scan of fewer beams: rows without a
            return, and empty pixels between two returns at most 8 rows apart.
        other_sensor: Keep what a sensor of n beams between two inclinations (degrees) sees:
            ``32 -25 3``.
        mask: Picture of H x W pixels as the range image, bright where it is missing.
        start: Time of the noise that R3DPA adds, in (0, 1]; default: 0.2.
        resamplings: How often RePaint crosses each interval; default: 10.
        num: Number of results per scan, which differ little.
        workers: Processes that complete scans of a folder.
        **options: See :class:`EditOptions`.
    """
    arguments = {
        "scan": scan,
        "sector": sector,
        "keep_every": keep_every,
        "empty_beams": empty_beams,
        "other_sensor": other_sensor,
        "mask": mask,
        "start": start,
        "resamplings": resamplings,
    }
    if not empty_beams and all(part is None for part in (sector, keep_every, other_sensor, mask)):
        raise ValueError(
            "nothing is missing: give --sector, --keep_every, --empty_beams, --other_sensor or "
            "--mask"
        )
    from r3dpa.scene_files.completions import CompletionJob, MissingPixels, complete_files

    missing = MissingPixels(sector, keep_every, empty_beams, other_sensor, mask)
    job = CompletionJob(EditOptions(**options), missing, num, start, resamplings)
    return complete_files(scan, job, arguments, workers)


def vary(*, scan: Path, start: float = 0.5, num: PositiveInt = 8, **options: Any) -> str:
    """Generate scenes like a scan: part of the way to noise and back.

    Args:
        scan: Scan to vary: .bin, .pcd, .ply, .npy, .npz or .las.
        start: Time of the noise, in (0, 1]; larger values differ more from the scan.
        num: Number of results, one per seed index.
        **options: See :class:`EditOptions`.
    """
    arguments = {"scan": scan, "start": start}
    from r3dpa.editing.settings import check_start
    from r3dpa.scene_files.edits import EditSession

    check_start(start)
    session = EditSession(EditOptions(**options), num)
    source = session.read(scan)
    run = partial(session.editor.vary, source.pixels, num, session.options.seed, start=start)
    return session.write("vary", arguments, {f"scan {scan.stem}": source}, run)


def interpolate(*, left: Path, right: Path, frames: int = 8, **options: Any) -> str:
    """Generate scenes on the way from one scan to another, through noise of the scans themselves.

    Nothing is drawn, so that ``--seed`` changes nothing.

    Args:
        left: Scan of the first frame: .bin, .pcd, .ply, .npy, .npz or .las.
        right: Scan of the last frame.
        frames: Number of scenes, both ends included.
        **options: See :class:`EditOptions`.
    """
    arguments = {"left": left, "right": right, "frames": frames}
    if frames < 2:
        raise ValueError(f"--num must be at least 2, the two scans; got {frames}")
    from r3dpa.scene_files.edits import EditSession

    session = EditSession(EditOptions(**options), frames)
    first, last = session.read(left), session.read(right)
    run = partial(session.editor.interpolate, first.pixels, last.pixels, frames)
    scans = {f"left: {left.stem}": first, f"right: {right.stem}": last}
    return session.write("interpolate", arguments, scans, run)
