"""Arrays of sample files: which format a file is of, and what it holds, read one at a time.

No file can run code: pickles are read with nothing but arrays allowed in them. The formats are
those of the table in :mod:`r3dpa.data.samples`.

Source: joblib's layout from its ``numpy_pickle``.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import torch
from torch import Tensor

from r3dpa.data.scans import (
    ARCHIVE_ERRORS,
    ScanError,
    check_archive,
    read_array_header,
    read_ply,
    read_scan,
)
from r3dpa.io import UNPICKLING_ERRORS
from r3dpa.unpickling import ArraysOnly

SampleFormat = Literal["bin", "bin_xyz", "ply", "txt", "npz", "npy", "pth", "joblib"]
SUFFIXES: dict[SampleFormat, tuple[str, ...]] = {
    "bin_xyz": (".bin",),
    "bin": (".bin",),  # the later one is meant where no format is given
    "ply": (".ply",),
    "txt": (".txt",),
    "npz": (".npz",),
    "npy": (".npy",),
    "pth": (".pth", ".pt"),
    "joblib": (".pcd", ".pkl", ".joblib"),
}
READABLE = (
    "clouds as .bin, .ply, .txt, .npz; range images as .npz, .npy, .pth; joblib's samples.pcd"
)


_AT_ONCE = 2**24  # bytes


class SampleError(ScanError):
    """A sample that cannot be judged; the message names the file and the reason."""


def _format_of(file: Path) -> SampleFormat:
    """Format of a file by its first bytes; ``.bin`` by its name, since it has no head."""
    if file.suffix.lower() == ".bin":
        return "bin"
    try:
        with file.open("rb") as stream:
            head = stream.read(128)
    except OSError as error:
        raise SampleError(f"{file}: cannot be read ({error.strerror or error})") from error
    if not head:
        raise SampleError(f"{file}: is empty")
    if head.startswith(b"\x93NUMPY"):
        return "npy"
    if head.startswith(b"ply"):
        return "ply"
    if head.startswith(b"PK"):
        try:
            with zipfile.ZipFile(file) as archive:
                return "npz" if any(n.endswith(".npy") for n in archive.namelist()) else "pth"
        except ARCHIVE_ERRORS as error:
            raise SampleError(f"{file}: is a damaged archive ({error})") from error
    if head[0] == 0x80 and file.suffix.lower() in SUFFIXES["pth"]:
        return "pth"  # torch before 1.6
    if head[0] == 0x80:
        return "joblib"
    try:
        float(head.split(maxsplit=1)[0])
    except (ValueError, IndexError):
        raise SampleError(
            f"{file}: starts with {head[:16]!r}, which is no known format; what can be read: "
            f"{READABLE}"
        ) from None
    return "txt"


def arrays_of(file: Path, given: SampleFormat | None) -> Iterator[tuple[str, np.ndarray]]:
    """Name within the file, if it holds many, and cloud ``(P, ...)`` or image ``(C, H, W)``."""
    kind = given or _format_of(file)
    if kind == "bin":
        yield "", read_scan(file)
    elif kind == "bin_xyz":
        data = file.read_bytes()
        if len(data) % 12:
            raise SampleError(f"{file}: has {len(data)} bytes, not a multiple of 12 (x, y, z)")
        yield "", np.frombuffer(data, "<f4").reshape(-1, 3)
    elif kind == "ply":
        yield "", read_ply(file)
    elif kind == "txt":
        yield "", _text_rows(file)
    elif kind == "npz":
        yield from _archive(file)
    elif kind == "npy":
        with file.open("rb") as stream:
            yield from _numpy_stream(stream, str(file))
    elif kind == "pth":
        yield from _tensors(file)
    else:
        yield from _joblib_clouds(file)


def _text_rows(file: Path) -> np.ndarray:
    """Points of a text file, without the colours that three more columns are."""
    if not file.stat().st_size:
        raise SampleError(f"{file}: is empty")
    try:
        rows = np.loadtxt(file, dtype=np.float32, ndmin=2)
    except (ValueError, UnicodeDecodeError) as error:
        raise SampleError(f"{file}: is not text rows of numbers ({error})") from error
    return rows[:, :3] if rows.shape[1] == 6 else rows


def _archive(file: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays of a ``.npz`` file, unpacked as they are read."""
    try:
        with zipfile.ZipFile(file) as archive:
            members = check_archive(archive, file)
            if not members:
                raise SampleError(f"{file}: holds no array")
            for member in members:
                key = member.removesuffix(".npy")
                unnamed = members == ["arr_0.npy"]  # NumPy's name where none is given
                with archive.open(member) as stream:
                    for part, array in _numpy_stream(stream, f"{file}, array {key}"):
                        yield "/".join(filter(None, ("" if unnamed else key, part))), array
    except ScanError:
        raise
    except ARCHIVE_ERRORS as error:
        raise SampleError(f"{file}: is damaged or no .npz file ({error})") from error


def _numpy_stream(stream: IO[bytes], where: str) -> Iterator[tuple[str, np.ndarray]]:
    """A cloud, or each image of a stack, of an array in NumPy's format."""
    shape, fortran, dtype = read_array_header(stream, where)
    _check_array(where, dtype, len(shape), stack=True)
    if len(shape) == 2:
        data = _exactly(stream, math.prod(shape) * dtype.itemsize, where)
        yield "", np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")
        return
    if fortran:
        raise SampleError(f"{where}: is in Fortran order; save np.ascontiguousarray of it")
    # A stack without a channel axis holds ranges alone.
    if shape[0] and not math.prod(shape):  # any number of them would fit
        raise SampleError(f"{where}: an array {shape} holds no image")
    image_shape = shape[1:] if len(shape) == 4 else (1, *shape[1:])
    size = math.prod(image_shape) * dtype.itemsize
    for index in range(shape[0]):
        data = _exactly(stream, size, f"{where}, sample {index:06d} of {shape[0]}")
        yield f"{index:06d}", np.frombuffer(data, dtype).reshape(image_shape)


def _check_array(where: str, dtype: np.dtype, ndim: int, stack: bool) -> None:
    """Refuse arrays that are neither clouds nor images of metres."""
    if dtype.kind != "f":
        advice = "objects are not unpickled" if dtype.hasobject else "metres must be floats"
        raise SampleError(f"{where}: holds {dtype} numbers; {advice}")
    if ndim not in ((2, 3, 4) if stack else (2,)):
        expected = "(P, 3) or (P, 4) points" + " or (N, C, H, W) images" * stack
        raise SampleError(f"{where}: has {ndim} axes; needs {expected}")


def _exactly(stream: IO[bytes], size: int, where: str) -> bytearray:
    data = bytearray()
    while part := stream.read(min(size - len(data), _AT_ONCE)):  # no more memory than the file has
        data += part
    if len(data) < size:
        raise SampleError(f"{where}: ends after {len(data)} of {size} bytes; copy the file again")
    return data


def _tensors(file: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Images or a cloud of a file of ``torch.save``; stacks stay on disk until they are read."""
    try:
        content = torch.load(
            file, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(file)
        )
    except UNPICKLING_ERRORS as error:
        reason = str(error).split("\n")[0]
        raise SampleError(f"{file}: cannot be read as tensors alone ({reason})") from error
    if isinstance(content, dict) and {"depth", "xyz"} <= content.keys():
        parts = [content[key] for key in ("depth", "xyz", "reflectance") if key in content]
    else:
        parts = [content]
    if not all(isinstance(part, Tensor) and part.is_floating_point() for part in parts):
        found = f"keys {', '.join(map(str, content))}" if isinstance(content, dict) else "no tensor"
        raise SampleError(
            f"{file}: holds {found}; needs a float tensor (C, H, W) or (N, C, H, W), or a "
            "dictionary of depth, xyz and reflectance"
        )
    sizes = [tuple(part.shape) for part in parts]
    agree = len({(*s[:-3], *s[-2:]) for s in sizes}) == 1
    if len(sizes[0]) not in (2, 3, 4) or not agree or (len(parts) > 1 and len(sizes[0]) == 2):
        raise SampleError(f"{file}: holds tensors {sizes}; needs (C, H, W) or (N, C, H, W)")
    if len(sizes[0]) < 4:
        yield "", torch.cat(parts).detach().float().numpy()
        return
    for index, images in enumerate(zip(*parts, strict=True)):
        yield f"{index:06d}", torch.cat(images).detach().float().numpy()


class _StoredArray:
    """Where joblib has put an array: stands for its ``NumpyArrayWrapper``.

    joblib writes the bytes of an array right after the pickled wrapper. They are passed over when
    its state arrives, and read when they are needed.
    """

    file: IO[bytes]

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.shape, self.order, self.dtype = state["shape"], state["order"], state["dtype"]
        _check_array(f"an array of shape {self.shape}", self.dtype, len(self.shape), stack=False)
        if state.get("numpy_array_alignment_bytes") is not None:  # since joblib 1.2
            self.file.seek(self.file.read(1)[0], 1)
        self.offset = self.file.tell()
        self.file.seek(math.prod(self.shape) * self.dtype.itemsize, 1)


def _joblib_clouds(file: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Clouds of a list that joblib has written without compression."""
    advice = "save the list as .npz, or give the .txt files beside it"
    # Unbuffered, so that the unpickler never reads on into the bytes of an array.
    with file.open("rb", buffering=0) as stream:
        stored = type("_StoredArrayHere", (_StoredArray,), {"file": stream})
        known = {("joblib.numpy_pickle", "NumpyArrayWrapper"): stored}
        try:
            clouds = ArraysOnly(stream, known).load()
        except UNPICKLING_ERRORS as error:
            reason = f"is not a joblib list of clouds ({error})"
            raise SampleError(f"{file}: {reason}; {advice}") from error
        if not isinstance(clouds, list) or not all(isinstance(c, _StoredArray) for c in clouds):
            raise SampleError(f"{file}: is not a joblib list of clouds; {advice}")
        for index, cloud in enumerate(clouds):
            stream.seek(cloud.offset)
            size = math.prod(cloud.shape) * cloud.dtype.itemsize
            data = _exactly(stream, size, f"{file}, sample {index:06d}")
            rows = np.frombuffer(data, cloud.dtype).reshape(cloud.shape, order=cloud.order)
            yield f"{index:06d}", rows
