"""RGB images from folders and tar shards, cropped to squares.

Letters: H x W image size, S side of a square image.
"""

from __future__ import annotations

import io
import tarfile
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lidarsim.cloud_formats import DataError
from lidarsim.scan_folders import files_below
from r3dpa.data.store import ItemKey
from r3dpa.geometry import LidarSensor
from r3dpa.io import first_line, refuse_name

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
# A SyntaxError is what Pillow makes of a damaged PNG.
_DECODING_ERRORS = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)
_BRIGHT = 128
_MIRRORED = ".mirrored"  # end of the name of a mirrored entry


class ImageError(DataError):
    """An image or shard that cannot be used; the message names the file."""


@dataclass(frozen=True)
class ImageEntry:
    """One image of a source, ``num_bytes`` from ``offset`` of ``path``; 0 if it is computed.

    ``name`` is unique within the source; ``mtime_ns`` is the time of change of ``path``.
    """

    name: str
    path: Path
    num_bytes: int
    offset: int = 0
    mirrored: bool = False
    mtime_ns: int = 0

    @property
    def cache_key(self) -> ItemKey:
        """Name, size and time of change of the file."""
        return self.name, self.num_bytes, self.mtime_ns

    def mirror(self) -> ImageEntry:
        """The same image with left and right exchanged."""
        return replace(self, name=self.name + _MIRRORED, mirrored=not self.mirrored)


class ImageSource(ABC):
    """Source of square RGB images."""

    @abstractmethod
    def entries(self) -> list[ImageEntry]:
        """All images, sorted by name.

        Raises:
            ImageError: If there is none, or a file is damaged.
        """

    def read(self, entry: ImageEntry, size: int) -> NDArray[np.uint8]:
        """Square image ``(S, S, 3)`` of an entry, not mirrored.

        Raises:
            ImageError: Naming a file that is no image.
        """
        try:
            with entry.path.open("rb") as file:
                file.seek(entry.offset)
                data = file.read(entry.num_bytes)
            with Image.open(io.BytesIO(data)) as image:
                return center_crop(image.convert("RGB"), size)
        except _DECODING_ERRORS as error:
            raise ImageError(
                f"{entry.path}: {entry.name} is no image that can be read ({error}); remove it"
            ) from error

    def settings(self) -> dict[str, Any]:
        """Settings that the pixels depend on beside the entry, as JSON values."""
        return {}


@dataclass(frozen=True)
class ImageFolder(ImageSource):
    """Images below a folder, at any depth, as files or in ``.tar`` shards as of WebDataset.

    The headers of uncompressed shards are read once; an image is then one read at a known offset.

    Args:
        root: The folder, such as one of ImageNet's with ``<class>/<image>.JPEG``, or one shard;
            links are followed, hidden files and members (``.name``) left out.
    """

    root: str

    def entries(self) -> list[ImageEntry]:
        """All images, by their path relative to the folder: ``<shard>/<member>`` in a shard."""
        root = Path(self.root)
        base = root.parent if root.is_file() else root
        entries: list[ImageEntry] = []
        for path in [root] if root.is_file() else files_below(root):
            name = path.relative_to(base)
            if path.suffix.lower() in _SUFFIXES:
                entries.append(_entry(path, str(name)))
            elif path.suffix.lower() == ".tar":
                entries += _members(path, str(name.with_suffix("")))
        if not entries:
            raise ImageError(f"{root} holds no image ({', '.join(_SUFFIXES)}), nor a .tar of them")
        entries.sort(key=lambda entry: entry.name)
        for before, entry in pairwise(entries):
            if before.name == entry.name:
                raise ImageError(f"{entry.path} holds {entry.name!r} twice: pack it again")
        return entries


def _entry(path: Path, name: str) -> ImageEntry:
    try:
        about = path.stat()
    except OSError as error:
        reason = error.strerror or error
        raise ImageError(f"{path}: cannot be read ({reason}); mend or remove it") from error
    return ImageEntry(name, path, about.st_size, mtime_ns=about.st_mtime_ns)


def _members(shard: Path, prefix: str) -> list[ImageEntry]:
    whole, entries = _entry(shard, prefix), []
    try:
        # Not compressed, since members of compressed shards have no known place.
        with shard.open("rb") as data, tarfile.open(fileobj=data, mode="r:") as file:
            for member in file:
                path = PurePath(member.name)
                hidden = any(part.startswith(".") and part != ".." for part in path.parts)
                if not member.isfile() or path.suffix.lower() not in _SUFFIXES or hidden:
                    continue
                name = f"{prefix}/{member.name.removeprefix('./')}"
                if reason := refuse_name(name):
                    raise ImageError(f"{shard}: name of member {reason}")
                entries.append(
                    replace(whole, name=name, num_bytes=member.size, offset=member.offset_data)
                )
            data.seek(file.offset)
            # Where a header is damaged or cut off, tarfile stops as if the shard ended there.
            if data.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
                raise ImageError(
                    f"{shard} is damaged or cut short at byte {file.offset}: pack or copy it again"
                )
    except (tarfile.TarError, OSError) as error:
        raise ImageError(f"{shard} is no uncompressed tar file, or damaged ({error})") from error
    return entries


def center_crop(image: Image.Image, size: int) -> NDArray[np.uint8]:
    """Largest centred square ``(S, S, 3)`` uint8 of an RGB image, resized.

    While the shorter side is at least twice ``size`` it is halved by averaging 2 x 2 pixels; then
    bicubic.

    Source: preprocessing of ADM (Dhariwal and Nichol, 2021), which REPA-E and R3DPA use.
    """
    while min(image.size) >= 2 * size:
        image = image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX)
    scale = size / min(image.size)
    width, height = (max(size, round(side * scale)) for side in image.size)
    image = image.resize((width, height), Image.Resampling.BICUBIC)
    left, top = (width - size) // 2, (height - size) // 2
    return np.asarray(image)[top : top + size, left : left + size]


def read_mask(path: str | Path, sensor: LidarSensor) -> Tensor:
    """Mask ``(H, W)`` bool from a picture of H x W pixels: True where bright and opaque.

    Raises:
        ValueError: If the file is no picture of 8 bits per colour, or of another size.
    """
    try:
        with Image.open(path) as picture:
            if picture.size != (sensor.columns, sensor.beams):
                width, height = picture.size
                raise ValueError(
                    f"{path}: has {height} x {width} pixels (rows x columns), but the range image "
                    f"{sensor.beams} x {sensor.columns}: draw one pixel for each"
                )
            if picture.mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
                raise ValueError(
                    f"{path}: has pixels of type {picture.mode}; save it with 8 bits per colour"
                )
            pixels = np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(
            f"{path}: cannot be read as a picture ({first_line(error)}); give a picture, such as "
            f"a .png, of {sensor.beams} x {sensor.columns} pixels, white inside the mask"
        ) from error
    return torch.from_numpy((pixels[..., :3].max(axis=2) >= _BRIGHT) & (pixels[..., 3] >= _BRIGHT))
