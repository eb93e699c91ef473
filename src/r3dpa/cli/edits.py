"""The commands that edit scans; heavy imports stay inside."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from r3dpa.cli.files import check_file, print_text

__all__ = ["EDITS", "EditJob", "joined_numbers"]


@contextmanager
def _stoppable(command: str, out: Path) -> Iterator[None]:
    """Ends the process with one line after Ctrl-C."""
    try:
        yield
    except KeyboardInterrupt:
        sys.stderr.write(f"r3dpa {command}: stopped before {out} was complete; start it again\n")
        sys.exit(130)  # as a shell reports an interrupt


@dataclass(frozen=True)
class EditJob:
    """What all edits are asked.

    Args:
        ckpt: Checkpoint of stage joint or flow_matching, ``.ckpt`` or exported ``.safetensors``.
        out: Folder for scenes, pictures, page, mask and metadata; must not hold other scenes.
        seed: Scene i depends on (seed, i) alone, not on the batch size.
        solver: ODE solver, to noise and back; ``midpoint`` loses least on that way.
        steps: Solver steps of a whole way.
        shift: Finer steps near noise (above 1) or data (below 1).
        batch_size: Scenes made together.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        weights: Averaged (``ema``) or last weights of the SiT.
        formats: Files of points, separated by commas: ``bin``, ``ply``, ``npz``.
        pictures: Draw this many scenes.
        overwrite: Write into a folder that holds scenes already.
    """

    ckpt: Path
    out: Path
    seed: int = 0
    solver: Literal["midpoint", "heun", "euler", "ab2", "ab3", "dpmpp_2m", "unipc"] = "midpoint"
    steps: int = 32
    shift: float = 1.0
    batch_size: int = 8
    device: str = "auto"
    weights: Literal["ema", "last"] = "ema"
    formats: str = "bin"
    pictures: int = 8
    overwrite: bool = False


def inpaint(
    scan: Path,
    box: tuple[float, float, float, float] | None = None,
    box3d: tuple[float, float, float, float, float, float, float] | None = None,
    mask: Path | None = None,
    objects: Path | None = None,
    object: str | None = None,
    features_from: Path | None = None,
    label: str | None = None,
    features_box3d: tuple[float, float, float, float, float, float, float] | None = None,
    features_ckpt: Path | None = None,
    strength: float | None = None,
    window: tuple[float, float] | None = None,
    start: float = 1.0,
    dilation: int = 0,
    num: int = 8,
    **options: Any,
) -> None:
    """Generate a part of a scan anew, as an object where one is named.

    The part is one of --box, --box3d and --mask; pixels outside it stay those of the scan. The
    object is a class of a library (--objects FILE --object car), or what another scan shows
    (--features_from SCAN with --label or --features_box3d); without any, whatever fits is drawn.
    Azimuth 0 looks forward and grows to the left; 180 is behind.

    Args:
        scan: Scan to edit: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        box: Azimuth from and to (counted to the left) and inclination from and to, degrees.
        box3d: Centre x y z, length, width, height in metres and yaw in degrees, in the frame of
            the sensor.
        mask: Picture of one pixel for each of the range image, bright where it is to change.
        objects: File of ``r3dpa objects``, made with the feature source of the checkpoint.
        object: Class of that file.
        features_from: Scan that shows the object.
        label: Class of its points, from the labels beside the scan.
        features_box3d: Box around its points, as ``box3d``.
        features_ckpt: Weights of the feature source, where it has none of its own.
        strength: Guidance in velocities, 0 to 1; 0.5 where not given.
        window: First and last guided time; 0 data, 1 noise. All where not given.
        start: Time that the edit starts from; below 1 keeps some of what was there.
        dilation: Rings of tokens around those of the part that are generated anew too, before
            what lies outside is put back.
        num: Number of results, one per seed index.
        **options: See :class:`EditJob`.
    """
    job = EditJob(**options)
    with _stoppable("inpaint", job.out):
        from r3dpa.cli.edit_runs import inpaint as run

        regions = box, box3d, mask
        source = objects, object, features_from, label, features_box3d
        guidance = strength, window
        text = run(job, scan, regions, source, features_ckpt, guidance, start, dilation, num)
    print_text(text)


def mix(
    left: Path | None = None,
    right: Path | None = None,
    split: float = 0.0,
    blend: float = 20.0,
    layout: list[tuple[float, Path]] | None = None,
    mask: Path | None = None,
    features_ckpt: Path | None = None,
    strength: float = 0.5,
    window: tuple[float, float] = (0.0, 1.0),
    num: int = 8,
    **options: Any,
) -> None:
    """Draw scenes that follow one scan on one side and another scan on the other.

    The features of the scans are stitched, and guide scenes from noise. Azimuth 0 looks forward
    and grows to the left; 180 is behind.

    Args:
        left: Scan of the left half: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        right: Scan of the right half.
        split: Azimuth in degrees where the left half starts; it ends half a turn further.
        blend: Width of the seams in degrees.
        layout: In place of left and right: azimuth where each sector starts, and its scan, such as
            '[[0, a.bin], [120, b.bin], [240, c.bin]]'.
        mask: In place of split and blend: picture of one pixel for each of the range image, bright
            where the right scan is to be followed.
        features_ckpt: Weights of the feature source, where it has none of its own.
        strength: Guidance in velocities, 0 to 1.
        window: First and last guided time; 0 data, 1 noise.
        num: Number of results, one per seed index.
        **options: See :class:`EditJob`.
    """
    job = EditJob(**options)
    with _stoppable("mix", job.out):
        from r3dpa.cli.edit_runs import mix as run

        scans = left, right, layout, mask
        text = run(job, scans, split, blend, features_ckpt, (strength, window), num)
    print_text(text)


def complete(
    scan: Path,
    sector: tuple[float, float] | None = None,
    keep_every: int | None = None,
    beams: list[int] | None = None,
    empty_beams: bool = False,
    other_sensor: tuple[int, float, float] | None = None,
    mask: Path | None = None,
    start: float = 0.3,
    num: int = 8,
    **options: Any,
) -> None:
    """Fill a missing sector, dropped beams, or any pixels of a scan.

    What is missing is all that is named; of a scan that is complete there, the result is compared
    with what was left out. Azimuth 0 looks forward and grows to the left; 180 is behind.

    Args:
        scan: Scan to complete: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        sector: Azimuth from and to, counted to the left, degrees.
        keep_every: Keep the first of so many beams: 2 makes 64 of 32, 4 of 16.
        beams: Rows of the range image that are kept, such as '[0, 4, 8]'.
        empty_beams: Rows without a return are missing, as in a scan of fewer beams.
        other_sensor: Keep what a sensor of so many beams would see, between two inclinations in
            degrees: '[32, -25, 3]'.
        mask: Picture of one pixel for each of the range image, bright where it is missing.
        start: Time that the completion starts from, in (0, 1]; large gaps need more.
        num: Number of results, one per seed index.
        **options: See :class:`EditJob`.
    """
    job = EditJob(**options)
    with _stoppable("complete", job.out):
        from r3dpa.cli.edit_runs import complete as run

        gaps = (sector, keep_every, beams, empty_beams, other_sensor, mask)
        text = run(job, scan, gaps, start, num)
    print_text(text)


def vary(scan: Path, start: float = 0.5, num: int = 8, **options: Any) -> None:
    """Draw scenes like a scan: part of the way to noise and back.

    Args:
        scan: Scan to vary: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        start: Time of the noise, in (0, 1]; the more, the less like the scan.
        num: Number of results, one per seed index.
        **options: See :class:`EditJob`.
    """
    job = EditJob(**options)
    with _stoppable("vary", job.out):
        from r3dpa.cli.edit_runs import vary as run

        text = run(job, scan, start, num)
    print_text(text)


def interpolate(first: Path, second: Path, frames: int = 8, **options: Any) -> None:
    """Draw the scenes on the way from one scan to another, through noise.

    Args:
        first: Scan that the first frame shows: ``.bin``, ``.ply``, or ``.npz`` of one scan.
        second: Scan that the last frame shows.
        frames: Number of scenes, both ends among them.
        **options: See :class:`EditJob`.
    """
    job = EditJob(**options)
    with _stoppable("interpolate", job.out):
        from r3dpa.cli.edit_runs import interpolate as run

        text = run(job, first, second, frames)
    print_text(text)


def objects(
    data: str,
    out: Path,
    like: Path | None = None,
    source: str = "geometric",
    features_ckpt: Path | None = None,
    classes: str | None = None,
    limit: int = 200,
    dim: int = 768,
    grid_size: tuple[int, int] = (8, 64),
    device: str = "auto",
) -> None:
    """Write the mean feature of each class of labelled scans, to be inpainted as objects.

    Args:
        data: Folder, file or glob of scans with labels beside them: of ``r3dpa simulate``,
            KITTI-360, SemanticKITTI, or the boxes of the KITTI object benchmark.
        out: File to write, ``.safetensors``.
        like: Checkpoint of a model that the objects are for: source, dim, sensor and grid_size are
            its own.
        source: Feature source: ``geometric``, ``waffleiron-s`` or ``scalr``.
        features_ckpt: Weights of the feature source, where it has none of its own.
        classes: Names, separated by commas; all that the scans show where not given.
        limit: Use this many scans at most, evenly spread.
        dim: Width of the features.
        grid_size: Rows and columns of the cells.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    check_file(out)
    names = [] if classes is None else [name.strip() for name in classes.split(",")]
    with _stoppable("objects", out):
        from r3dpa.cli.objects import objects as write

        sensor = None
        if like is not None:
            from r3dpa.cli.edit_runs import library_settings

            source, dim, sensor, grid_size = library_settings(like)
        text = write(data, out, source, features_ckpt, names, limit, dim, sensor, grid_size, device)
    print_text(text)


EDITS: dict[str, Callable[..., None]] = {
    edit.__name__: edit for edit in (inpaint, mix, complete, vary, interpolate, objects)
}


def joined_numbers(words: Sequence[str]) -> list[str]:
    """Command line in which several numbers after an option are one list.

    So that ``--box -10 10 -20 0`` need not be written ``--box '[-10, 10, -20, 0]'``.
    """
    joined: list[str] = []
    numbers: list[str] = []
    for word in [*words, ""]:
        if joined and joined[-1].startswith("--") and _is_number(word):
            numbers.append(word)
            continue
        if numbers:
            joined.append(numbers[0] if len(numbers) == 1 else f"[{', '.join(numbers)}]")
            numbers = []
        joined.append(word)
    return joined[:-1]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
