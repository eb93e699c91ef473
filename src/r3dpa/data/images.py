"""RGB images from folders, tar shards and the dead-leaves model, cropped to squares.

Letters: H x W image size, S side of a square image.
"""

from __future__ import annotations

import io
import math
import tarfile
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lidarsim.cloud_formats import DataError
from lidarsim.clouds import files_below
from r3dpa.data.store import ItemKey
from r3dpa.geometry import LidarSensor
from r3dpa.io import first_line, refuse_name

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
# A SyntaxError is what Pillow makes of a damaged PNG.
_DECODING_ERRORS = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)
_BRIGHT = 128
_MIRRORED = ".mirrored"  # end of the name of a mirrored entry
# Of dead leaves.
_VERSION = 1  # to be raised when other pixels come out of the same settings
_OVERSAMPLING = 2  # samples per pixel and axis, averaged: edges are no staircases
_COVERED = 0.99  # share of an image at which the rest is left to the background
_MOST_SHAPES = 600
_PALETTE = 6  # colours that the shapes of an image vary


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
        """All images, sorted by name; ``ImageError`` if there is none, or a file is damaged."""

    def read(self, entry: ImageEntry, size: int) -> NDArray[np.uint8]:
        """Square image ``(S, S, 3)`` of an entry, not mirrored; ``ImageError`` names a bad file."""
        try:
            with entry.path.open("rb") as file:
                file.seek(entry.offset)
                data = file.read(entry.num_bytes)
            with Image.open(io.BytesIO(data)) as image:
                return center_crop(image.convert("RGB"), size)
        except _DECODING_ERRORS as error:
            raise ImageError(
                f"{entry.path}: {entry.name} is no image that can be read ({error}); remove it."
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
        found: list[ImageEntry] = []
        for path in [root] if root.is_file() else files_below(root):
            name = path.relative_to(base)
            if path.suffix.lower() in _SUFFIXES:
                found.append(_entry(path, str(name)))
            elif path.suffix.lower() == ".tar":
                found += _members(path, str(name.with_suffix("")))
        if not found:
            raise ImageError(f"{root} holds no image ({', '.join(_SUFFIXES)}), nor a .tar of them.")
        found.sort(key=lambda entry: entry.name)
        for before, entry in pairwise(found):
            if before.name == entry.name:
                raise ImageError(f"{entry.path} holds {entry.name!r} twice: pack it again.")
        return found


def _entry(path: Path, name: str) -> ImageEntry:
    try:
        about = path.stat()
    except OSError as error:
        reason = error.strerror or error
        raise ImageError(f"{path}: cannot be read ({reason}); mend or remove it.") from error
    return ImageEntry(name, path, about.st_size, mtime_ns=about.st_mtime_ns)


def _members(shard: Path, prefix: str) -> list[ImageEntry]:
    whole, found = _entry(shard, prefix), []
    try:
        # Not compressed, or nothing could be found fast.
        with shard.open("rb") as data, tarfile.open(fileobj=data, mode="r:") as file:
            for member in file:
                path = PurePath(member.name)
                hidden = any(part.startswith(".") and part != ".." for part in path.parts)
                if not member.isfile() or path.suffix.lower() not in _SUFFIXES or hidden:
                    continue
                name = f"{prefix}/{member.name.removeprefix('./')}"
                if reason := refuse_name(name):
                    raise ImageError(f"{shard}: name of member {reason}")
                found.append(
                    replace(whole, name=name, num_bytes=member.size, offset=member.offset_data)
                )
            data.seek(file.offset)
            # Where a header is damaged or cut off, tarfile stops as if the shard ended there.
            if data.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
                raise ImageError(
                    f"{shard} is damaged or cut short at byte {file.offset}: pack or copy it again."
                )
    except (tarfile.TarError, OSError) as error:
        raise ImageError(f"{shard} is no uncompressed tar file, or damaged ({error}).") from error
    return found


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

    ``ValueError`` if the file is no picture of 8 bits a colour, or of another size.
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
                    f"{path}: has pixels of type {picture.mode}; save it with 8 bits a colour"
                )
            pixels = np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: cannot be read as a picture ({first_line(error)})") from error
    return torch.from_numpy((pixels[..., :3].max(axis=2) >= _BRIGHT) & (pixels[..., 3] >= _BRIGHT))


@dataclass(frozen=True)
class DeadLeaves(ImageSource):
    """The dead-leaves model of natural images, drawn when an image is read.

    Discs and polygons occlude each other, their radii with density ``r^-3`` between ``smallest``
    and ``largest`` times the side of the image, so that the power spectrum falls as ``1 / f^2``.
    Each has a colour near one of a palette, a gradient of light, and its part of a texture with
    spectrum ``1 / f``. An image is a function of ``seed`` and its number alone.

    Source: Lee, Mumford and Huang, "Occlusion models for natural images" (IJCV 2001); as training
    data: Baradad et al., "Learning to see by looking at noise" (NeurIPS 2021).

    Args:
        num_images: Number of images.
        seed: Seed of all of them.
        smallest: Smallest radius in sides of the image.
        largest: Largest radius in sides of the image.
    """

    num_images: int = 100_000
    seed: int = 0
    smallest: float = 0.06
    largest: float = 0.5

    def entries(self) -> list[ImageEntry]:
        """Entries named by their number."""
        place = Path("dead_leaves")
        return [ImageEntry(f"{index:09d}", place, 0) for index in range(self.num_images)]

    def read(self, entry: ImageEntry, size: int) -> NDArray[np.uint8]:
        """Draw an image ``(S, S, 3)``."""
        generator = np.random.default_rng((self.seed, int(entry.name.partition(".")[0])))
        return dead_leaves(generator, size, self.smallest, self.largest)

    def settings(self) -> dict[str, Any]:
        """All but the number of images, which changes none of them."""
        values = {**asdict(self), "version": _VERSION}
        del values["num_images"]
        return values


def dead_leaves(
    generator: np.random.Generator, size: int, smallest: float = 0.06, largest: float = 0.5
) -> NDArray[np.uint8]:
    """One image ``(S, S, 3)`` uint8 of the model that :class:`DeadLeaves` describes.

    Shapes are drawn from the front to the back, each where nothing is drawn yet.
    """
    side = size * _OVERSAMPLING
    # Lightness varies more than hue, as in nature.
    lightness = generator.uniform(0.1, 0.9, (_PALETTE, 1))
    palette = (lightness + generator.normal(0, 0.1, (_PALETTE, 3))).astype(np.float32)
    texture = _texture(generator, side)
    image = np.empty((side, side, 3), np.float32)
    image[:] = palette[0] + 0.1 * texture[..., None]
    free = np.ones((side, side), bool)
    num_free, enough = side * side, (1 - _COVERED) * side * side
    for _ in range(_MOST_SHAPES):
        # Inverse of the distribution of r^-3 between the two radii.
        low, high = (smallest * side) ** -2, (largest * side) ** -2
        radius = (low + generator.random() * (high - low)) ** -0.5
        centre = generator.uniform(-radius, side + radius, 2)
        first = np.clip(np.floor(centre - radius).astype(int), 0, side)
        last = np.clip(np.ceil(centre + radius).astype(int) + 1, 0, side)
        box = slice(first[0], last[0]), slice(first[1], last[1])
        if not free[box].any():
            continue
        rows = np.arange(first[0], last[0], dtype=np.float32)[:, None] - np.float32(centre[0])
        columns = np.arange(first[1], last[1], dtype=np.float32)[None] - np.float32(centre[1])
        drawn = _inside(generator, rows, columns, radius) & free[box]
        count = int(drawn.sum())
        colour = palette[generator.integers(_PALETTE)] + generator.normal(0, 0.05, 3)
        slope = generator.normal(0, 0.06, 2).astype(np.float32)
        roughness = float(generator.exponential(0.06))
        shade = slope[0] * rows / radius + slope[1] * columns / radius + roughness * texture[box]
        image[box][drawn] = colour.astype(np.float32) + shade[drawn][:, None]
        free[box][drawn] = False
        num_free -= count
        if num_free <= enough:
            break
    pixels = image.reshape(size, _OVERSAMPLING, size, _OVERSAMPLING, 3).mean(axis=(1, 3))
    return np.clip(255.0 * pixels + 0.5, 0, 255).astype(np.uint8)


def _inside(
    generator: np.random.Generator,
    rows: NDArray[np.float32],
    columns: NDArray[np.float32],
    radius: float,
) -> NDArray[np.bool_]:
    """Whether points relative to the centre lie in a random disc or convex polygon."""
    corners = int(generator.integers(2, 8))
    if corners == 2:  # a disc
        return rows**2 + columns**2 <= radius**2
    turns = np.arange(corners) + generator.random() + generator.uniform(-0.3, 0.3, corners)
    angles = 2 * math.pi / corners * turns
    inner = radius * math.cos(math.pi / corners)
    inside = np.ones((len(rows), columns.shape[1]), bool)
    for row, column in zip(np.sin(angles), np.cos(angles), strict=True):
        inside &= np.float32(row) * rows + np.float32(column) * columns <= inner
    return inside & (rows**2 + columns**2 <= radius**2)


def _texture(generator: np.random.Generator, side: int) -> NDArray[np.float32]:
    """Gaussian field ``(side, side)`` of mean 0 and variance 1 with amplitude ``1 / f``."""
    noise = np.fft.rfft2(generator.standard_normal((side, side)))
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    frequency[0, 0] = np.inf  # no mean
    field = np.fft.irfft2(noise / frequency, (side, side))
    return (field / field.std()).astype(np.float32)
