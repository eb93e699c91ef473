"""Readers of files from elsewhere on damaged and hostile ones: mutated, but whole enough to go far.

``python tests/fuzz/fuzz_readers.py --inputs 100000`` prints the inputs per reader, and exits with 1
if one made its reader crash, hang or ask for much memory; each is kept for replay.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import re
import resource
import signal
import sys
import tempfile
import time
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

from r3dpa.checkpoints import Checkpoint, NetworkState, read_checkpoint, save_checkpoint
from r3dpa.data import FeatureGrids, Scan, read_samples
from r3dpa.data.feature_grids import GridSettings
from r3dpa.data.images import read_mask
from r3dpa.data.objects import ObjectClass, ObjectLibrary
from r3dpa.data.scans import read_beside, read_npz, read_ply, read_scan, write_npz, write_ply
from r3dpa.geometry import LidarSensor, SphericalProjection, projection_to_dict
from r3dpa.metrics.official_statistics import OfficialStatistics
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.scene import PROTOCOLS
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.simulation import expected_scans

SECONDS = 10.0  # a file of a few kilobytes takes milliseconds; the machine may be busy
MEMORY = 2**30  # more than the process has when it starts
_NUMBERS = [0, 1, 127, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63, 2**64 - 1]
_TEXTS = [b"-1", b"0", b"1e999", b"99999999999", b"9" * 25, b"NaN", b"null", b"[]", b"{}", b'"a"']
SENSOR = LidarSensor(4, 16)


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

    def add(name: str, file: Path, read: Callable[[], object], content=None, wrap=bytes) -> None:
        found[name] = Reader(file, read, file.read_bytes() if content is None else content, wrap)

    scan = folder / "drive" / "velodyne_points" / "data" / "0.bin"
    label = scan.parents[1] / "labels" / "0.label"
    for file, content in ((scan, points.tobytes()), (label, bytes(48))):
        file.parent.mkdir(parents=True)
        file.write_bytes(content)
    one = folder / "one.bin"
    one.write_bytes(points.tobytes())
    add(".bin", one, lambda: read_scan(one, SENSOR))
    add(".label", label, lambda: read_beside(scan, "labels"))
    ply = folder / "a.ply"
    write_ply(ply, points)
    add(".ply", ply, lambda: read_ply(ply))
    npz, packed = folder / "a.npz", folder / "packed.npz"
    write_npz(npz, {"a": points, "b/c": points}.items())
    add(".npz", npz, lambda: (consume(read_samples(npz, SENSOR)), read_npz(npz)))
    array = io.BytesIO()
    np.save(array, points)
    add(
        ".npz, member",
        packed,
        lambda: (consume(read_samples(packed, SENSOR)), read_npz(packed)),
        array.getvalue(),
        lambda content: archive({"a.npy": content}),
    )
    images = folder / "a.npy"
    np.save(images, np.full((2, 1, 4, 16), 5.0, np.float32))
    add(".npy", images, lambda: consume(read_samples(images, SENSOR)))
    tensors = folder / "a.pth"
    torch.save(torch.full((1, 4, 16), 5.0), tensors)
    add(".pth", tensors, lambda: consume(read_samples(tensors, SENSOR)))
    text = folder / "a.txt"
    text.write_text("1.5 2.5 0.5 0.25\n" * 4)
    add(".txt", text, lambda: consume(read_samples(text, SENSOR)))
    _add_stores(folder, add)
    _add_official(folder, add)
    _add_checkpoints(folder, add)
    _add_edits(folder, add)
    return found


def _add_stores(folder: Path, add: Callable[..., None]) -> None:
    """Feature store and the manifest of the simulator."""
    projection, store = SphericalProjection(SENSOR), folder / "grids"
    settings = GridSettings(
        projection=json.loads(json.dumps(projection_to_dict(projection))),
        grid_size=(2, 4),
        extractor={"name": "a", "settings": {}},
        dim=3,
        dtype="float16",
        precision="32-true",
    )
    scans = [Scan("drive", f"{n}", folder / f"{n}.bin") for n in range(3)]
    for scan in scans:
        scan.path.write_bytes(bytes(160))
    with settings.store(store).writer() as writer:
        writer.add([scan.cache_key for scan in scans], torch.randn(3, 8, 3))

    def read() -> None:
        grids = FeatureGrids(store, scans, projection, (2, 4))
        for scan in scans:
            grids.read(scan)

    for name in ("shard_00000.jsonl", "shard_00000.rows", "settings.json"):
        add(f"store, {name}", store / "2x4" / name, read)
    root = folder / "simulated"
    root.mkdir()
    manifest = root / "simulation.json"
    manifest.write_text(json.dumps({"scans": 10, "seed": 0, "drives": ["0003", "0000"]}))
    assert expected_scans(root) is not None
    add("simulation.json", manifest, lambda: expected_scans(root))


def _add_official(folder: Path, add: Callable[..., None]) -> None:
    """The official statistics, and ours."""
    moments = {"mu": np.ones(3), "sigma": np.eye(3)}
    clouds = {"points": [np.array([[1.0, 2.0], [3.0, 4.0]]) / 100]}
    official = folder / "statistics.npy"
    content = {"val": {"spvcnn": moments, "valset_voxelized_bev": clouds}}
    np.save(official, content, allow_pickle=True)
    add("official .npy", official, lambda: OfficialStatistics.load(official))
    reference = folder / "reference.safetensors"
    protocol = replace(PROTOCOLS["default"], sensor=SENSOR)
    ReferenceStatistics(protocol, {}, ["a/0", "b/0"], {"data": "a"}).save(reference)
    add("reference .safetensors", reference, lambda: ReferenceStatistics.load(reference))


def _add_checkpoints(folder: Path, add: Callable[..., None]) -> None:
    norm = NetworkState.of(LatentNorm(4), {"channels": 4})
    ours = folder / "ours" / "a.safetensors"
    save_checkpoint(Checkpoint(ours, "joint", {"latent_norm": norm}), ours)
    about = ours.with_suffix(".yaml")
    description = about.read_text()

    def hashed(content: bytes) -> bytes:
        fields = yaml.safe_load(description)
        fields["sha256"] = hashlib.sha256(content).hexdigest()
        about.write_text(yaml.safe_dump(fields))
        return content

    add(".safetensors", ours, lambda: read_checkpoint(ours), None, hashed)
    other = folder / "other" / "a.safetensors"
    save_checkpoint(Checkpoint(other, "joint", {"latent_norm": norm}), other)
    add(".safetensors, .yaml", other.with_suffix(".yaml"), lambda: read_checkpoint(other))
    lightning, member = folder / "a.ckpt", folder / "member.ckpt"
    content = {
        "pytorch-lightning_version": "2.6",
        "global_step": 3,
        "state_dict": {f"latent_norm.{k}": v for k, v in norm.state_dict.items()},
        "hyper_parameters": {},
    }
    torch.save(content, lightning)
    add(".ckpt", lightning, lambda: read_checkpoint(lightning))
    with zipfile.ZipFile(lightning) as parts:
        names = {name: parts.read(name) for name in parts.namelist()}
    pickled = next(name for name in names if name.endswith("data.pkl"))
    add(
        ".ckpt, data.pkl",
        member,
        lambda: read_checkpoint(member),
        names[pickled],
        lambda content: archive({**names, pickled: content}),
    )


def _add_edits(folder: Path, add: Callable[..., None]) -> None:
    """Masks and object libraries."""
    mask = folder / "mask.png"
    Image.new("L", (SENSOR.columns, SENSOR.beams), 255).save(mask)
    add("mask .png", mask, lambda: read_mask(mask, SENSOR))
    objects = folder / "objects.safetensors"
    car = ObjectClass("car", 1, 2, 3, 0.5)
    projection = json.loads(json.dumps(projection_to_dict(SphericalProjection(SENSOR))))
    extractor = {"name": "a", "settings": {}}
    ObjectLibrary(torch.ones(1, 3), (car,), extractor, projection, (2, 4)).save(objects)

    def load() -> None:
        library = ObjectLibrary.load(objects)
        for name in library.names:
            library.feature(name)
        assert isinstance(library.source, str)

    add("objects .safetensors", objects, load)


def archive(members: dict[str, bytes]) -> bytes:
    """A ``.zip`` file with these members, their checksums right."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as packed:
        for name, content in members.items():
            packed.writestr(name, content)
    return stream.getvalue()


def consume(items: Iterator) -> None:
    for _ in items:
        pass


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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz_failures"))
    options = parser.parse_args()
    failures = 0
    with tempfile.TemporaryDirectory() as folder:
        everything = readers(Path(folder))
        share = -(-options.inputs // len(everything))
        for name, reader in everything.items():
            start, wrong = time.perf_counter(), {}
            for data, reason in fuzz(name, reader, share, options.seed):
                failures += 1
                wrong.setdefault(re.sub(r"\d+|'[^']*'|/\S+", "", reason)[:60], (data, reason))
            for number, (data, reason) in enumerate(wrong.values()):
                options.keep.mkdir(exist_ok=True)
                safe = re.sub(r"\W+", "_", name)
                (options.keep / f"{safe}_{number}").write_bytes(data)
                sys.stdout.write(f"  {name}: {reason}\n")
            seconds = time.perf_counter() - start
            sys.stdout.write(f"{name:<26}{share:>8} inputs {seconds:>8.1f} s\n")
            sys.stdout.flush()
        sys.stdout.write(f"{share * len(everything)} inputs, {failures} taken wrongly\n")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
