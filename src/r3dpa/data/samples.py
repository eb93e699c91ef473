"""Samples of any generator from plain files, one scene at a time.

========  ========================================================================================
suffix    content, and who writes it
========  ========================================================================================
``.bin``  float32 rows x, y, z, intensity: ``r3dpa sample``, and RangeLDM (``ldm/inference.py``,
          pixels of 90 m and more left out)
``.ply``  binary: ``r3dpa sample``; other formats of :mod:`lidarsim.clouds`, too
``.txt``  text rows x, y, z, intensity or x, y, z, r, g, b: ``pcd/*.txt`` of R3DPA and
          LiDAR-Diffusion (three decimals, colours 0)
``.npz``  clouds ``(P, 3)`` or ``(P, 4)`` by name: ``scenes.npz`` of ``r3dpa sample``; or images
          ``(N, C, H, W)``: ``numpy/img.npz`` of R3DPA (``generate.py``)
``.npy``  one such array, or clouds ``(N, P, 3)`` or ``(N, P, 4)``
``.pth``  an image ``(C, H, W)``: R2DM (``sample_and_save.py``); a dictionary of ``depth``, ``xyz``,
          ``reflectance`` ``(c, H, W)``: R2Flow (``sample.py``); or stacks of these
========  ========================================================================================

The channels of an image are range; range and intensity; range, x, y, z; or these and intensity, all
in metres. R3DPA marks empty pixels by ranges outside its limits, R2DM and R2Flow by 0. No file can
run code: pickled lists of clouds, ``numpy/samples.pcd``, are not read; ``pcd/*.txt`` lie beside it.

Sources: valeoai/R3DPA 2789885, hancyran/LiDAR-Diffusion 1d1bba5, kazuto1011/r2dm 004a1e4,
kazuto1011/r2flow 819d7d3, WoodwindHu/RangeLDM 4358507.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidarsim.cloud_formats import ScanError, is_one_cloud, npz_arrays
from lidarsim.scan_files import out_of_range, read_points, read_scan
from lidarsim.scan_folders import files_below
from r3dpa.data.scans import find_scans
from r3dpa.geometry import EMPTY_RANGE_M, LidarSensor, SphericalProjection, in_range, points_of
from r3dpa.io import UNPICKLING_ERRORS, first_line

Arrays = Iterator[tuple[str, np.ndarray]]  # name within the file and cloud (P, ...) or (C, H, W)
READABLE = (
    "clouds as .bin, .pcd.bin, .ply, .pcd, .las, .laz, .txt, .npz, .npy; range images as .npz, "
    ".npy, .pth, .pt"
)
# Of the range: more than bfloat16 rounds off, far less than channels in another order differ.
_LENGTH_TOLERANCE = 0.02


class Sample(NamedTuple):
    """One scene of a generator.

    ``points`` ``(P, 3)`` or ``(P, 4)`` float32 x, y, z in metres and, where the file holds it,
    intensity, P >= 1, all within the range limits; of images also ``range_m`` ``(H, W)`` metres,
    ``EMPTY_RANGE_M`` without a return, and ``intensity`` ``(H, W)``, 0 without a return.
    """

    name: str
    points: Tensor
    range_m: Tensor | None = None
    intensity: Tensor | None = None


@dataclass
class Samples:
    """Samples that are read while they are iterated over, see :func:`read_samples`.

    ``bad`` holds the messages of the samples that the last iteration left out.
    """

    files: list[tuple[str, Path]]
    sensor: LidarSensor
    corner: bool
    skip_bad: bool
    bad: list[str] = field(default_factory=list, init=False)

    def __iter__(self) -> Iterator[Sample]:
        self.bad, num_read = [], 0
        for prefix, file in self.files:
            arrays = _arrays_of(file)
            while True:
                try:
                    part, array = next(arrays)  # an error here ends the file
                    name = "/".join(filter(None, (prefix, part))) or file.stem
                    where = f"{file}, sample {part}" if part else str(file)
                    sample = _sample(name, where, array, self.sensor, self.corner)
                except StopIteration:
                    break
                except (ScanError, OSError) as error:
                    if not self.skip_bad:
                        advice = "skip_bad leaves such samples out, and lists them"
                        raise ScanError(f"{error}. {advice}") from error
                    self.bad.append(str(error))
                else:
                    num_read += 1
                    yield sample
        if not num_read:
            first = f"all are bad; the first: {self.bad[0]}" if self.bad else "the files are empty"
            raise ScanError(f"{self.files[0][1]}: no sample can be used; {first}")
        if self.bad:
            warnings.warn(
                f"{len(self.bad)} bad samples left out beside {num_read} good ones. "
                f"The first: {self.bad[0]}",
                stacklevel=2,
            )


def read_samples(
    path: str | Path,
    sensor: LidarSensor,
    unprojection: Literal["corner", "centre"] = "centre",
    skip_bad: bool = False,
) -> Samples:
    """Samples of a file, or of all files of one format in a folder and its sub-folders.

    Points and pixels outside the range limits are left out. One sample is in memory at a time, of
    ``.npz`` one array, of ``.pth`` one file. The folders that ``r3dpa sample`` and the official
    R3DPA write hold each scene several times; of these ``scenes.npz``, else ``bin/*.bin``, else
    ``ply/*.ply``, else ``range_m.npy``, and ``numpy/img.npz`` are read.

    Args:
        path: File or folder, whose files are read in the order of their names.
        sensor: Image size and range limits of the samples.
        unprojection: Which point of a pixel its ray passes, for images without points.
        skip_bad: Leave bad samples out, list them in ``bad`` and warn of them.

    Raises:
        ScanError: If nothing is found, or a folder holds several formats; while iterating, if a
            sample cannot be used.
    """
    path = Path(path)
    files = [("", path)] if path.is_file() else _find(path)
    return Samples(files, sensor, unprojection == "corner", skip_bad)


def _find(folder: Path) -> list[tuple[str, Path]]:
    if not folder.is_dir():
        raise ScanError(f"{folder}: there is no such file or folder")
    ours = (folder / "metadata.json").is_file()
    for place, known in (("numpy/img.npz", True), ("scenes.npz", ours)):
        if known and (folder / place).is_file():
            return [("", folder / place)]
    clouds = [folder / name for name in ("bin", "ply") if ours and (folder / name).is_dir()]
    if clouds:
        folder = clouds[0]
    files: dict[str, list[Path]] = {}
    for file in sorted(files_below(folder)):
        if file.suffix.lower() in _READERS:
            files.setdefault(file.suffix.lower(), []).append(file)
    if not files:
        raise ScanError(f"{folder}: holds no samples; what can be read: {READABLE}")
    if ".bin" in files and (len(files) == 1 or (folder / "data_3d_raw").is_dir()):
        # Named as scans are; KITTI-360 has time stamps beside its scans.
        return [(scan.name, scan.path) for scan in find_scans(folder)]
    if len(files) > 1:
        formats = ", ".join(f"{len(files[suffix])} {suffix}" for suffix in sorted(files))
        raise ScanError(
            f"{folder}: holds several formats ({formats}), perhaps each scene more than once; "
            "give one file or sub-folder"
        )
    (paths,) = files.values()
    return [(path.relative_to(folder).with_suffix("").as_posix(), path) for path in paths]


def _arrays_of(file: Path) -> Arrays:
    read = _READERS.get(file.suffix.lower())
    if read is None:
        raise ScanError(f"{file}: is of no known format; what can be read: {READABLE}")
    if not file.stat().st_size:
        raise ScanError(f"{file}: is empty")
    yield from read(file)


def _cloud(file: Path) -> Arrays:
    yield "", read_points(file)


def _text_rows(file: Path) -> Arrays:
    try:
        rows = np.loadtxt(file, dtype=np.float32, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise ScanError(f"{file}: is not text rows of numbers ({error})") from error
    yield "", rows[:, :3] if rows.shape[1] == 6 else rows  # without colours


def _npy_parts(file: Path) -> Arrays:
    try:
        array = np.lib.format.open_memmap(file, mode="r")
    except UNPICKLING_ERRORS as error:
        raise ScanError(f"{file}: cannot be read as an array ({first_line(error)})") from error
    yield from _parts(str(file), array)


def _npz_parts(file: Path) -> Arrays:
    if is_one_cloud(file):
        yield "", read_points(file)
        return
    for number, (key, array) in enumerate(npz_arrays(file)):
        unnamed = key == "arr_0" and number == 0  # NumPy's name where none is given
        for part, values in _parts(f"{file}, array {key}", array):
            yield "/".join(filter(None, ("" if unnamed else key, part))), values


def _parts(where: str, array: np.ndarray) -> Arrays:
    """A cloud, or each cloud or image of a stack; images without a channel axis are ranges."""
    if array.dtype.kind != "f":
        raise ScanError(f"{where}: holds {array.dtype} numbers; metres must be floats")
    if array.ndim == 2:
        yield "", array
        return
    if array.ndim not in (3, 4) or 0 in array.shape[1:]:
        raise ScanError(
            f"{where}: has shape {array.shape}; needs (P, 3) or (P, 4) points, "
            "(N, P, 3) clouds or (N, C, H, W) images"
        )
    clouds = array.ndim == 3 and array.shape[2] in (3, 4)
    for index, part in enumerate(array):
        yield f"{index:06d}", part if clouds or part.ndim == 3 else part[None]


def _tensors(file: Path) -> Arrays:
    """Images or a cloud of a file of ``torch.save``; the parts of R2Flow become channels."""
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
        parts = [content]
        if isinstance(content, dict) and {"depth", "xyz"} <= content.keys():
            parts = [content[key] for key in ("depth", "xyz", "reflectance") if key in content]
        axis = -3 if len(parts) > 1 else 0  # parts become channels
        values = torch.cat([part.detach().float() for part in parts], dim=axis)
    except UNPICKLING_ERRORS as error:
        raise ScanError(
            f"{file}: cannot be read as tensors alone ({first_line(error)}); needs a tensor "
            "(C, H, W) or (N, C, H, W), or a dictionary of depth, xyz and reflectance"
        ) from error
    array = values.numpy()
    if array.ndim == 3:
        yield "", array
    else:
        yield from _parts(str(file), array)


_READERS: dict[str, Callable[[Path], Arrays]] = {
    ".bin": lambda file: iter([("", read_scan(file))]),
    **dict.fromkeys((".ply", ".pcd", ".las", ".laz"), _cloud),
    ".txt": _text_rows,
    ".npz": _npz_parts,
    ".npy": _npy_parts,
    ".pth": _tensors,
    ".pt": _tensors,
}


def _sample(name: str, where: str, array: np.ndarray, sensor: LidarSensor, corner: bool) -> Sample:
    """Sample of a cloud ``(P, ...)`` or an image ``(C, H, W)``; ``where`` is for messages."""
    values = torch.from_numpy(np.array(array, dtype=np.float32, order="C"))
    if values.ndim == 3:
        return _image_sample(name, where, values, sensor, corner)
    if values.shape[1] not in (3, 4):
        raise ScanError(f"{where}: has rows of {values.shape[1]} numbers; needs 3 or 4 (x, y, z)")
    if bad := int((~values.isfinite().all(dim=1)).sum()):
        raise ScanError(f"{where}: has NaN or infinite values in {bad} of {len(values)} points")
    kept = in_range(values[:, :3], sensor)
    if not kept.any():
        raise out_of_range(where, sensor)
    return Sample(name, values[kept])


def _image_sample(
    name: str, where: str, image: Tensor, sensor: LidarSensor, corner: bool
) -> Sample:
    channels, *size = image.shape
    if size != [sensor.beams, sensor.columns]:
        raise ScanError(
            f"{where}: has an image of {size[0]} x {size[1]} pixels, but the sensor has "
            f"{sensor.beams} x {sensor.columns}; use images of that size, or a reference for theirs"
        )
    if channels not in (1, 2, 4, 5):
        raise ScanError(
            f"{where}: has {channels} channels; needs range, range and intensity, or range, x, y, "
            "z without or with intensity"
        )
    distance = image[0]
    valid = (distance > sensor.range_min_m) & (distance < sensor.range_max_m)
    intensity = torch.where(valid, image[-1], 0.0) if channels in (2, 5) else None
    read = distance if intensity is None else torch.stack([distance, intensity])
    if bad := int((~read.isfinite()).sum()):
        raise ScanError(f"{where}: has NaN or infinite ranges or intensities in {bad} pixels")
    if not valid.any():
        span = f"{distance.min():g} to {distance.max():g}"
        raise ScanError(
            f"{out_of_range(where, sensor)}; values go from {span}, and must be metres, not an "
            "encoded image"
        )
    range_m = torch.where(valid, distance, EMPTY_RANGE_M)
    if channels < 4:
        points = points_of(range_m, SphericalProjection(sensor), corner)
    else:
        points = image[1:4, valid].T
        error = (torch.linalg.vector_norm(points, dim=1) - distance[valid]).abs()
        if wrong := int((~(error <= _LENGTH_TOLERANCE * distance[valid])).sum()):  # NaN too
            raise ScanError(
                f"{where}: channel 0 is not the length of channels 1 to 3 in {wrong} of "
                f"{len(points)} pixels; their order must be range, x, y, z, in metres"
            )
    if intensity is not None:
        points = torch.cat([points, intensity[valid].unsqueeze(1)], dim=1)
    return Sample(name, points.contiguous(), range_m, intensity)
