"""Readers of files from elsewhere on damaged ones: mutated, but whole enough to go far."""

from __future__ import annotations

import hashlib
import io
import json
import re
import resource
import signal
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import yaml
from PIL import Image

from lidarsim import expected_scans
from lidarsim.clouds import PointCloud, read_cloud, write_cloud
from r3dpa.checkpoints import Checkpoint, NetworkState, read_checkpoint, save_checkpoint
from r3dpa.data import (
    FeatureGrids,
    Scan,
    read_beside,
    read_npz,
    read_points,
    read_samples,
    read_scan,
    write_bin,
    write_npz,
    write_ply,
)
from r3dpa.data.feature_grids import GridSettings
from r3dpa.data.images import read_mask
from r3dpa.editing.objects import ObjectClass, ObjectLibrary
from r3dpa.geometry import LidarSensor, SphericalProjection, projection_to_dict
from r3dpa.metrics.official_statistics import OfficialStatistics
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.scene import PROTOCOLS
from r3dpa.nn.latent_norm import LatentNorm

SECONDS = 10.0  # a file of a few kilobytes takes milliseconds; the machine may be busy
MEMORY = 2**30  # more than the process has when it starts
_NUMBERS = [0, 1, 127, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1]
_TEXTS = [b"-1", b"0", b"1e999", b"99999999999", b"9" * 25, b"NaN", b"null", b"[]", b"{}", b'"a"']
SENSOR = LidarSensor(4, 16)
PROJECTION = json.loads(json.dumps(projection_to_dict(SphericalProjection(SENSOR))))


class Hang(BaseException):
    """A reader that did not end; no reader catches it."""


class Reader(NamedTuple):
    """A reader of a file, bytes of a valid one, and what packs mutated content again."""

    file: Path
    read: Callable[[], object]
    content: bytes
    wrap: Callable[[bytes], bytes] = bytes


def mutated(content: bytes, random: np.random.Generator) -> bytes:
    """A few changes: flipped bits, numbers in binary and text, parts cut, repeated or added."""
    data = bytearray(content)
    for _ in range(random.integers(1, 5)):
        kind = random.integers(7)
        # Heads are short and matter most.
        end = max(1, min(len(data), 256) if random.random() < 0.5 else len(data))
        place = int(random.integers(end))
        if kind == 0 and data:
            data[place] ^= 1 << int(random.integers(8))
        elif kind == 1:
            del data[place:]
        elif kind == 2:
            data += random.bytes(int(random.integers(1, 64)))
        elif kind == 3:
            size = int(random.choice([1, 2, 4, 8]))
            number = int(random.choice(np.array(_NUMBERS, object))) % 256**size
            data[place : place + size] = number.to_bytes(size, "little")
        elif kind == 4:
            part = data[place : place + int(random.integers(1, 32))]
            data[place:place] = part * int(random.integers(1, 4))
        elif kind == 5:
            del data[place : place + int(random.integers(1, 16))]
        elif found := list(re.finditer(rb"-?\d+(\.\d+)?|\"[^\"]*\"", data[:65536])):
            match = found[int(random.integers(len(found)))]
            data[match.start() : match.end()] = _TEXTS[int(random.integers(len(_TEXTS)))]
    return bytes(data)


def readers(folder: Path) -> dict[str, Reader]:
    """All readers by name, their files below a folder."""
    random = np.random.default_rng(0)
    points = np.concatenate([random.uniform(-20, 20, (12, 3)), random.random((12, 1))], 1)
    points = points.astype(np.float32)
    found: dict[str, Reader] = {}

    def add(
        name: str,
        file: str,
        write: Callable[[Path], object],
        read: Callable[[Path], object],
        content: bytes | None = None,
        wrap: Callable[[bytes], bytes] = bytes,
    ) -> None:
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path)
        content = path.read_bytes() if content is None else content
        found[name] = Reader(path, lambda: read(path), content, wrap)

    def both(path: Path) -> None:
        samples(path)
        read_npz(path)

    drive, array = "drive/velodyne_points", io.BytesIO()
    np.save(array, points)
    clouds, image = [("a", points), ("b/c", points)], np.full((2, 1, 4, 16), 5.0, np.float32)
    scan = f"{drive}/data/0.bin"
    add(".bin", scan, lambda at: write_bin(at, points), lambda at: read_scan(at, SENSOR))
    labels = bytes(4 * len(points))
    add(
        ".label",
        f"{drive}/labels/0.label",
        lambda at: at.write_bytes(labels),
        lambda _: read_beside(folder / scan, "labels"),
    )
    add(".ply", "a.ply", lambda at: write_ply(at, points), read_points)
    add(".npz", "a.npz", lambda at: write_npz(at, clouds), both)
    member = array.getvalue()
    add(".npz, member", "packed.npz", Path.touch, both, member, lambda c: archive({"a.npy": c}))
    rows = PointCloud.of(points, ring=np.arange(12) % 4, range_m=points[:, 0])
    for name in ("rows.npy", "rows.npz", "rows.ply", "rows.pcd.bin"):
        add(name, name, lambda at: write_cloud(at, rows), read_cloud)
    add(".npy", "a.npy", lambda at: np.save(at, image), samples)
    add(".pth", "a.pth", lambda at: torch.save(torch.from_numpy(image[0]), at), samples)
    add(".txt", "a.txt", lambda at: at.write_text("1.5 2.5 0.5 0.25\n" * 4), samples)
    _add_stores(folder, add)
    _add_official(add)
    _add_checkpoints(folder, add)
    _add_edits(add)
    return found


def samples(path: Path) -> None:
    for _ in read_samples(path, SENSOR):
        pass


def _add_stores(folder: Path, add: Callable[..., None]) -> None:
    """Feature store and the manifest of the simulator."""
    projection, store = SphericalProjection(SENSOR), folder / "grids"
    scans = [Scan("drive", f"{n}", folder / f"{n}.bin") for n in range(3)]
    about = {"name": "a", "settings": {}}
    settings = GridSettings(PROJECTION, (2, 4), about, 3, "float16", "32-true")
    for scan in scans:
        scan.path.write_bytes(bytes(160))
    with settings.store(store).writer() as writer:
        writer.add([scan.cache_key for scan in scans], torch.randn(3, 8, 3))

    def read(_: Path) -> None:
        grids = FeatureGrids(store, scans, projection, (2, 4))
        for scan in scans:
            grids.read(scan)

    for name in ("shard_00000.jsonl", "shard_00000.rows", "settings.json"):
        add(f"store, {name}", f"grids/2x4/{name}", Path.touch, read)
    manifest = json.dumps({"scans": 10, "seed": 0, "drives": ["0003", "0000"]})
    add(
        "simulation.json",
        "simulated/simulation.json",
        lambda at: at.write_text(manifest),
        lambda at: expected_scans(at.parent),
    )


def _add_official(add: Callable[..., None]) -> None:
    """The official statistics, and ours."""
    moments = {"mu": np.ones(3), "sigma": np.eye(3)}
    clouds = {"points": [np.array([[1.0, 2.0], [3.0, 4.0]]) / 100]}
    content = {"val": {"spvcnn": moments, "valset_voxelized_bev": clouds}}
    add(
        "official .npy",
        "statistics.npy",
        lambda at: np.save(at, content, allow_pickle=True),
        OfficialStatistics.load,
    )
    protocol = replace(PROTOCOLS["default"], sensor=SENSOR)
    ours = ReferenceStatistics(protocol, {}, ["a/0", "b/0"], {"data": "a"})
    add("reference .safetensors", "r.safetensors", ours.save, ReferenceStatistics.load)


def _add_checkpoints(folder: Path, add: Callable[..., None]) -> None:
    norm = NetworkState.of(LatentNorm(4), {"channels": 4})

    def save(path: Path) -> None:
        path = path.with_suffix(".safetensors")
        save_checkpoint(Checkpoint(path, "joint", {"latent_norm": norm}), path)

    def hashed(content: bytes) -> bytes:
        about = folder / "ours/a.yaml"
        fields = yaml.safe_load(about.read_text())
        about.write_text(yaml.safe_dump(fields | {"sha256": hashlib.sha256(content).hexdigest()}))
        return content

    add(".safetensors", "ours/a.safetensors", save, read_checkpoint, None, hashed)
    add(
        ".safetensors, .yaml",
        "other/a.yaml",
        save,
        lambda at: read_checkpoint(at.with_suffix(".safetensors")),
    )
    content = {
        "pytorch-lightning_version": "2.6",
        "global_step": 3,
        "state_dict": {f"latent_norm.{k}": v for k, v in norm.state_dict.items()},
        "hyper_parameters": {},
    }
    add(".ckpt", "a.ckpt", lambda at: torch.save(content, at), read_checkpoint)
    with zipfile.ZipFile(folder / "a.ckpt") as parts:
        names = {name: parts.read(name) for name in parts.namelist()}
    pickled = next(name for name in names if name.endswith("data.pkl"))
    add(
        ".ckpt, data.pkl",
        "member.ckpt",
        Path.touch,
        read_checkpoint,
        names[pickled],
        lambda content: archive({**names, pickled: content}),
    )


def _add_edits(add: Callable[..., None]) -> None:
    """Masks and object libraries."""
    mask = Image.new("L", (SENSOR.columns, SENSOR.beams), 255)
    add("mask .png", "mask.png", mask.save, lambda at: read_mask(at, SENSOR))
    about, car = {"name": "a", "settings": {}}, ObjectClass("car", 1, 2, 3, 0.5)
    objects = ObjectLibrary(torch.ones(1, 3), (car,), about, PROJECTION, (2, 4))

    def load(path: Path) -> None:
        library = ObjectLibrary.load(path)
        for name in library.names:
            library.feature(name)
        assert isinstance(library.source, str)

    add("objects .safetensors", "objects.safetensors", objects.save, load)


def archive(members: dict[str, bytes]) -> bytes:
    """A ``.zip`` file with these members, their checksums right."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as packed:
        for name, content in members.items():
            packed.writestr(name, content)
    return stream.getvalue()


@contextmanager
def limits() -> Iterator[None]:
    """No more memory than the process has and :data:`MEMORY`; a signal that ends a hang."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    old = signal.signal(signal.SIGALRM, _end)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.signal(signal.SIGALRM, old)


def _end(*_: object) -> None:
    raise Hang


def verdict(reader: Reader, data: bytes) -> str | None:
    """What is wrong with how a reader takes a file; None if it reads or refuses it."""
    reader.file.write_bytes(reader.wrap(data))
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        reader.read()
    except ValueError as error:
        signal.setitimer(signal.ITIMER_REAL, 0)
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, MemoryError) or "enough memory" in str(cause):
                return f"asks for much memory: {cause!r:.200}"
            cause = cause.__cause__ or cause.__context__
        if not str(error):
            return "an error without a message"
    except Hang:
        return f"does not end within {SECONDS:g} s"
    except BaseException as error:  # noqa: BLE001 - whatever it is, it is reported
        return f"{type(error).__name__}: {error}"[:200]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return None


def fuzz(name: str, reader: Reader, count: int, seed: int) -> Iterator[tuple[bytes, str]]:
    """Inputs that a reader took wrongly, and how, of so many."""
    reader.file.write_bytes(reader.wrap(reader.content))
    reader.read()  # without a change it must be accepted, or nothing is tested
    random = np.random.default_rng([seed, *name.encode()])
    with limits(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(count):
            data = mutated(reader.content, random)
            if wrong := verdict(reader, data):
                yield data, wrong
    reader.file.write_bytes(reader.wrap(reader.content))
