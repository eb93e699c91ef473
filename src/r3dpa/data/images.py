"""RGB images from folders and tar shards, cropped to squares.

Letters: H x W image size, S side of a square image.
"""

from __future__ import annotations

import io
import os
import tarfile
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path, PurePath
from typing import Any, NotRequired, TypedDict

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.utils.data import Dataset

from r3dpa.data.scans import evenly
from r3dpa.data.store import CachedTensors, DataError, ItemKey
from r3dpa.geometry import LidarSensor
from r3dpa.io import refuse_name

_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp")
# A SyntaxError is what Pillow makes of a damaged PNG.
_DECODING_ERRORS = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)
_IMAGES_TO_MEASURE = 10_000
_BRIGHT = 128
_MIRRORED = ".mirrored"  # end of the name of a mirrored entry


class ImageError(DataError):
    """An image or shard that cannot be used; the message names the file."""


class ImageBatch(TypedDict):
    """Batch of the stages on RGB images.

    ``image`` ``(B, 3, S, S)`` float32 red, green, blue in [-1, 1], absent where posteriors suffice;
    ``posterior_moments`` ``(B, 2C, h, w)`` float32, means, then log-variances of the raw latents,
    where they are cached; ``index`` ``(B,)`` int64; ``name`` B strings.
    """

    image: NotRequired[Tensor]
    posterior_moments: NotRequired[Tensor]
    index: Tensor
    name: list[str]


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

    @abstractmethod
    def read(self, entry: ImageEntry, size: int) -> NDArray[np.uint8]:
        """Square image ``(S, S, 3)`` of an entry, not mirrored; ``ImageError`` names a bad file."""

    def settings(self) -> dict[str, Any]:
        """Settings that the pixels depend on beside the entry, as JSON values."""
        return {}


class ImageFolder(ImageSource):
    """Images below a folder, at any depth: ImageNet's ``<split>/<class>/<image>.JPEG`` or others.

    Args:
        root: The folder; links are followed, hidden files (``.name``) left out.
    """

    def __init__(self, root: str) -> None:
        self.root = root

    def entries(self) -> list[ImageEntry]:
        """All images, by their path relative to the folder."""
        root = Path(self.root)
        if not root.is_dir():
            raise ImageError(f"no folder {root}: give one that holds images.")
        found = [_entry(path, str(path.relative_to(root))) for path in _files(root, _SUFFIXES)]
        if not found:
            raise ImageError(f"{root} holds no image ({', '.join(_SUFFIXES)}).")
        return sorted(found, key=lambda entry: entry.name)

    def read(self, entry: ImageEntry, size: int) -> NDArray[np.uint8]:
        """Square image ``(S, S, 3)`` of a file."""
        return _decoded(entry, str(entry.path), size)


class TarImages(ImageSource):
    """Images of uncompressed tar files, as WebDataset writes them.

    The headers of all shards are read once; an image is then one read at a known offset.

    Args:
        root: Folder of the ``.tar`` files, searched with its sub-folders, or one such file. Hidden
            files and members (``.name``) are left out.
    """

    def __init__(self, root: str) -> None:
        self.root = root

    def entries(self) -> list[ImageEntry]:
        """All images of all shards, as ``<shard>/<member>``."""
        root = Path(self.root)
        shards = [root] if root.is_file() else sorted(_files(root, (".tar",)))
        base = root.parent if root.is_file() else root
        found = [
            entry
            for shard in shards
            for entry in _members(shard, str(shard.relative_to(base).with_suffix("")))
        ]
        if not found:
            raise ImageError(f"no image ({', '.join(_SUFFIXES)}) in a .tar file of {root}.")
        found.sort(key=lambda entry: entry.name)
        for before, entry in pairwise(found):
            if before.name == entry.name:
                raise ImageError(f"{entry.path} holds {entry.name!r} twice: pack it again.")
        return found

    def read(self, entry: ImageEntry, size: int) -> NDArray[np.uint8]:
        """Square image ``(S, S, 3)`` of a member."""
        return _decoded(entry, f"{entry.path}: {entry.name}", size)


def _files(root: Path, suffixes: tuple[str, ...]) -> Iterator[Path]:
    """Files below a folder by their suffix, also through links, without hidden ones."""
    for folder, names, files in os.walk(root, followlinks=True):
        here = Path(folder).resolve()
        # A link to a folder above leads to the same files again, without end.
        names[:] = [
            name
            for name in names
            if not _hidden(name) and not here.is_relative_to(Path(folder, name).resolve())
        ]
        for path in (Path(folder, name) for name in files if not _hidden(name)):
            if path.suffix.lower() in suffixes:
                yield path
            elif path.is_symlink() and not path.exists():  # such as a folder of images
                raise ImageError(f"{path} is a link to nothing: mend or remove it.")


def _hidden(name: str) -> bool:
    return any(part.startswith(".") and part != ".." for part in PurePath(name).parts)


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
                suffix = PurePath(member.name).suffix.lower()
                if not member.isfile() or suffix not in _SUFFIXES or _hidden(member.name):
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


def _decoded(entry: ImageEntry, name: str, size: int) -> NDArray[np.uint8]:
    try:
        with entry.path.open("rb") as file:
            file.seek(entry.offset)
            data = file.read(entry.num_bytes)
    except OSError as error:
        raise ImageError(f"{name}: cannot be read ({error.strerror or error})") from error
    try:
        with Image.open(io.BytesIO(data)) as opened:
            image: Image.Image = opened
            if image.mode.startswith("I"):  # 16 bits of grey, which convert() would clip at 255
                image = Image.fromarray((np.asarray(image) // 256).astype(np.uint8))
            return center_crop(image.convert("RGB"), size)
    except _DECODING_ERRORS as error:
        raise ImageError(f"{name}: is no image that can be read ({error}); remove it.") from error


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


class ImageDataset(Dataset[dict[str, Any]]):
    """Square images of some entries of a source, or cached posteriors of a VAE, or both."""

    def __init__(
        self,
        source: ImageSource,
        entries: Sequence[ImageEntry],
        size: int,
        posteriors: CachedTensors[ImageEntry] | None = None,
        with_images: bool = True,
    ) -> None:
        self.source, self.entries, self.size = source, list(entries), size
        self.posteriors, self.with_images = posteriors, with_images

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> dict[str, Any]:
        entry = self.entries[index]
        sample: dict[str, Any] = {"index": index, "name": entry.name}
        if self.with_images:
            pixels = self.source.read(entry, self.size)
            if entry.mirrored:
                pixels = pixels[:, ::-1]
            values = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)))
            sample["image"] = values.float() / 127.5 - 1.0
        if self.posteriors is not None:
            sample["posterior_moments"] = self.posteriors.read(entry)
        return sample


def latent_statistics(posteriors: CachedTensors[ImageEntry]) -> tuple[Tensor, Tensor]:
    """Mean and variance ``(C,)`` of the raw latents, samples of the posteriors ``(2C, h, w)``.

    At most 10 000 posteriors, spread evenly, are read.
    """
    chosen = evenly(posteriors.items, _IMAGES_TO_MEASURE)
    channels, rows, columns = posteriors.store.shape
    sums = torch.zeros(3, channels // 2, dtype=torch.float64)
    for entry in chosen:
        mean, logvar = posteriors.read(entry).double().flatten(1).chunk(2)
        sums += torch.stack([mean.sum(1), mean.square().sum(1), logvar.exp().sum(1)])
    mean, square, noise = sums / (len(chosen) * rows * columns)
    return mean.float(), (square - mean.square() + noise).float()


def read_mask(path: str | Path, sensor: LidarSensor) -> Tensor:
    """Mask ``(H, W)`` bool from a picture of H x W pixels: True where bright and opaque.

    ``ValueError`` if the file is no picture of 8 bits a colour, or of another size.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # refused by size below
            with Image.open(path) as picture:
                if picture.size != (sensor.columns, sensor.beams):
                    width, height = picture.size
                    raise ValueError(
                        f"{path}: has {height} x {width} pixels (rows x columns), but the range "
                        f"image {sensor.beams} x {sensor.columns}: draw one pixel for each"
                    )
                if picture.mode not in ("1", "L", "LA", "P", "RGB", "RGBA"):
                    raise ValueError(
                        f"{path}: has pixels of type {picture.mode}; save it with 8 bits a colour"
                    )
                pixels = np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: cannot be read as a picture ({reason})") from error
    bright = pixels[..., :3].max(axis=2) >= _BRIGHT
    return torch.from_numpy(bright & (pixels[..., 3] >= _BRIGHT))
