"""``r3dpa data view``: scans as pictures and as a page of point clouds to turn."""

from __future__ import annotations

import re
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

from r3dpa.cli.parser import check_folder

MYPY = False  # true for mypy; jsonargparse would run a TYPE_CHECKING block, and import torch
if MYPY:
    from numpy.typing import NDArray

    from r3dpa import viz

__all__ = ["view", "write_page"]

# Colours that people expect (plants are green), and quiet ones for what is everywhere; a category
# that is not named here takes one of the palette.
_COLOURS = dict(
    re.findall(
        r"(\w+) (#\w+)",
        "UNLABELED #8a8f98 ROAD #75688f SIDEWALK #c77dba TERRAIN #a7c957 BUILDING #c9b48c "
        "WALL #a08c80 FENCE #c08552 POLE #f2f2f2 SIGN #ffd84d VEGETATION #46b36b PERSON #ff5c5c "
        "RIDER #ff9f1c CAR #4e9bff TRUCK #2459c4 BUS #00b8a9 BICYCLE #e056fd SURFACE #56606e "
        "MIXED #ffb000 FOLIAGE #46b36b GLASS #5ce1e6 MIRROR #c792ea FOG #aab4c8 RAIN #4e9bff "
        "SNOW #ffffff SPRAY #7fd1ff BLOOMING #ff6b6b SUN #ffe14d SECOND_RETURN #f78fb3",
    )
)
_DATA = ("velodyne_points", "data")  # of a scan in the KITTI-360 layout, beside labels and origins


class _Source(NamedTuple):
    """A scan: a file still to be read, or the points of a member of a ``.npz`` file."""

    name: str
    path: Path
    points: NDArray | None = None


def view(
    source: Path, *, out: Path | None = None, num: int = 8, reference: Path | None = None
) -> str:
    """Draw scans as range images, from above, and as a page with point clouds to turn.

    Args:
        source: A ``.bin``, ``.ply`` or ``.npz`` file, or a folder of ``.bin`` scans in any layout.
        out: Folder for the pictures and the page; default: ``view/<name of the source>``.
        num: Scans to show at most, evenly spread over the folder.
        reference: Scan to show beside the others, such as a real one beside simulated ones.
    """
    from r3dpa import viz
    from r3dpa.data.scans import evenly
    from r3dpa.geometry import LidarSensor, SphericalProjection

    if num < 1:
        raise ValueError(f"num must be 1 or greater, got {num}")
    check_folder(out)
    sources = _sources(source)
    scans = [_read(entry) for entry in evenly(sources, num)]
    beside = None
    if reference is not None:
        first = _sources(reference)[0]
        beside = _read(first._replace(name=f"reference: {first.name}"))  # unlike every other name
    drawn = {scan.name: scan.points for scan in [*scans, *([beside] if beside else [])]}
    resolved = source.resolve()
    out = out or Path("view") / (resolved.name if resolved.is_dir() else resolved.stem)
    pictures = {
        "range_images.png": viz.range_strips(drawn, SphericalProjection(LidarSensor())),
        "birds_eye.png": viz.birds_eye_sheet(drawn),
    }
    paths = [viz.save(figure, out / name) for name, figure in pictures.items()]
    paths.append(write_page(out / "view.html", scans, f"{resolved.name} - r3dpa view", beside))
    lines = [f"{len(scans)} of {len(sources)} scans in {source}"]
    if beside:
        lines.append(beside.name)
    return "\n".join([*lines, *map(str, paths), "open the .html file in a browser"])


def write_page(
    path: Path, scans: Sequence[viz.PageScan], title: str, beside: viz.PageScan | None = None
) -> Path:
    """Writes a page of point clouds, coloured by the classes and origins of the simulator too."""
    from r3dpa import viz
    from r3dpa.io import atomic_path
    from r3dpa.simulation import Origin, Semantic

    page = viz.scan_page(scans, title, _categories(Semantic), _categories(Origin), beside)
    with atomic_path(path) as temporary:
        temporary.write_text(page, "utf-8")
    return path


def _sources(source: Path) -> list[_Source]:
    """Scans of a folder or file, in order."""
    from r3dpa.data.scans import find_scans

    if source.suffix == ".npz" and source.is_file():
        members = _members(source).items()
        return [_Source(f"{source.stem}/{name}", source, points) for name, points in members]
    scans = find_scans(source)
    if source.is_file():
        path = scans[0].path
        if path.suffix not in (".bin", ".ply"):
            raise ValueError(f"{source}: is no scan; give a .bin, .ply or .npz file, or a folder")
        parent = path.parents[2] if path.parts[-3:-1] == _DATA else path.parent
        return [_Source(f"{parent.name}/{path.stem}", path)]
    return [_Source(scan.name, scan.path) for scan in scans]


def _members(path: Path) -> dict[str, NDArray]:
    """Scans of a ``.npz`` file by name."""
    from zipfile import BadZipFile

    from r3dpa.data.scans import read_npz

    try:
        members = read_npz(path)
    except (EOFError, ValueError, BadZipFile) as error:
        raise ValueError(f"{path}: is no .npz file of scans ({error})") from error
    if not members:
        raise ValueError(f"{path}: holds no scan")
    for name, points in members.items():
        if points.ndim != 2 or points.shape[1] not in (3, 4):
            raise ValueError(
                f"{path}: {name} must be points (P, 3) or (P, 4), got shape {points.shape}"
            )
    return members


def _read(source: _Source) -> viz.PageScan:
    """A scan with its labels and origins where there are files of them."""
    from r3dpa import viz
    from r3dpa.data.scans import read_beside, read_ply, read_scan

    name, path, points = source
    if points is not None:
        return viz.PageScan(name, points)
    if path.suffix == ".ply":
        return viz.PageScan(name, read_ply(path))
    points = read_scan(path)
    return viz.PageScan(name, points, read_beside(path, "labels"), read_beside(path, "origins"))


def _categories(names: type[IntEnum]) -> dict[int, viz.Category]:
    """Names and colours of the members of an enumeration."""
    from r3dpa import viz

    return {
        int(member): viz.Category(member.name.lower().replace("_", " "), _COLOURS.get(member.name))
        for member in names
    }
