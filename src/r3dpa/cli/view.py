"""``r3dpa data view``: scans as pictures and as a page of point clouds to turn."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from r3dpa.cli.parser import check_folder, check_least

MYPY = False  # true for mypy; jsonargparse would run a TYPE_CHECKING block, and import torch
if MYPY:
    from collections.abc import Callable

    from r3dpa import viz

__all__ = ["view"]


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
    from r3dpa.cli.scene_files import write_page
    from r3dpa.data.scans import evenly
    from r3dpa.geometry import LidarSensor, SphericalProjection

    check_least(1, num=num)
    check_folder(out)
    readers = _readers(source)
    scans = [read() for read in evenly(readers, num)]
    beside = None
    if reference is not None:
        first = _readers(reference)[0]()
        beside = replace(first, name=f"reference: {first.name}")  # unlike every other name
    drawn = {scan.name: scan.points for scan in [*scans, *([beside] if beside else [])]}
    resolved = source.resolve()
    out = out or Path("view") / (resolved.name if resolved.is_dir() else resolved.stem)
    pictures = {
        "range_images.png": viz.range_strips(drawn, SphericalProjection(LidarSensor())),
        "birds_eye.png": viz.birds_eye_sheet(drawn),
    }
    paths = [viz.save(figure, out / name) for name, figure in pictures.items()]
    paths.append(write_page(out / "view.html", scans, f"{resolved.name} - r3dpa view", beside))
    lines = [f"{len(scans)} of {len(readers)} scans in {source}"]
    if beside:
        lines.append(beside.name)
    return "\n".join([*lines, *map(str, paths), "open the .html file in a browser"])


def _readers(source: Path) -> list[Callable[[], viz.PageScan]]:
    """Readers of the scans of a folder or file, in order."""
    from r3dpa import viz
    from r3dpa.cli.scene_files import read_clouds
    from r3dpa.data.scans import find_scans, read_beside

    def read(name: str, path: Path) -> viz.PageScan:
        (points,) = read_clouds(path).values()
        if path.suffix == ".ply":
            return viz.PageScan(name, points)
        return viz.PageScan(name, points, read_beside(path, "labels"), read_beside(path, "origins"))

    if source.suffix == ".npz" and source.is_file():
        clouds = read_clouds(source).items()
        return [partial(viz.PageScan, f"{source.stem}/{name}", points) for name, points in clouds]
    scans = find_scans(source)
    if not source.is_file():
        return [partial(read, scan.name, scan.path) for scan in scans]
    path = scans[0].path
    in_layout = path.parts[-3:-1] == ("velodyne_points", "data")  # of KITTI-360
    parent = path.parents[2] if in_layout else path.parent
    return [partial(read, f"{parent.name}/{path.stem}", path)]
