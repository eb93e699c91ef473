"""The record store of r3dpa.data beside safetensors shards with one index, measured in pairs.

``python tests/bench/compare_stores.py`` prints, for rows of three sizes, the time of safetensors
over that of the store with its 95 % interval; the store over itself (A/A) says what a ratio is
worth. It reads batches of random rows from the page cache, writes batches of 4 rows, which must
survive a kill, and opens a store of 20,000 rows. Safetensors maps files: a batch is stacked, as a
loader does it, since a row alone is not read yet.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from r3dpa.bench.measure import compare, timed
from r3dpa.data.store import CachedTensors, ItemKey, Store
from r3dpa.io import atomic_path, write_text

SHAPES = {"posterior 64 kB": (8, 16, 128), "image 131 kB": (64, 1024), "grid 786 kB": (512, 768)}
NUM_ROWS, NUM_READ, BATCH, ROWS_PER_SHARD = 256, 64, 4, 32
NUM_OPENED, ROUNDS = 20_000, 12


class Item:
    """A scan that needs no file."""

    def __init__(self, number: int) -> None:
        self.name = f"2013_05_28_drive_0000_sync/{number:010d}"
        self.path = Path(self.name)
        self.cache_key: ItemKey = (self.name, 1_900_000 + number, 1_700_000_000_000_000_000)


class Shards:
    """Safetensors files of some rows each, written whole, and one index of all keys."""

    def __init__(self, folder: Path, by_key: bool, dtype: torch.dtype = torch.float32) -> None:
        self.folder, self.by_key, self.dtype = folder, by_key, dtype
        self.index: dict[str, list[int]] = {}
        self._open: dict[int, object] = {}

    def write(self, items: Sequence[Item], rows: Tensor) -> None:
        """A shard of these rows, then the index."""
        number = len(list(self.folder.glob("*.safetensors")))
        names = [str(place) for place in range(len(items))]
        assert rows.isfinite().all()
        if self.dtype == torch.float16:  # as the store does it
            largest = torch.finfo(torch.float16).max
            rows = rows.clamp(-largest, largest).half()
        tensors = dict(zip(names, rows.unbind(), strict=True)) if self.by_key else {"rows": rows}
        with atomic_path(self.folder / f"{number:05d}.safetensors") as temporary:
            save_file({name: value.contiguous() for name, value in tensors.items()}, temporary)
        self.index |= {json.dumps(item.cache_key): [number, row] for row, item in enumerate(items)}
        write_text(self.folder / "index.json", json.dumps(self.index))

    def open(self) -> Shards:
        """Read the index."""
        self.index = json.loads((self.folder / "index.json").read_text())
        return self

    def read(self, item: Item) -> Tensor:
        """Row of an item, float32."""
        shard, row = self.index[json.dumps(item.cache_key)]
        if shard not in self._open:
            path = self.folder / f"{shard:05d}.safetensors"
            self._open[shard] = safe_open(path, framework="pt").__enter__()
        file = self._open[shard]
        if self.by_key:
            return file.get_tensor(str(row)).float()  # type: ignore[attr-defined]
        return file.get_slice("rows")[row].float()  # type: ignore[attr-defined]


def report(title: str, cases: dict[str, Callable[[], object]]) -> None:
    """One line: the first case in seconds, the others over it, the first over itself."""
    found = compare({name: timed(function) for name, function in cases.items()}, ROUNDS)
    first, *others = cases
    seconds = np.median(found.seconds[first])
    ratios = [f"{name} {found.over_first(name)}" for name in others]
    print(f"{title}: {first} {seconds * 1e3:.2f} ms; {'; '.join(ratios)}; A/A {found.repeat}")  # noqa: T201


def measure(root: Path, title: str, shape: tuple[int, ...]) -> None:
    """Read and write rows of a shape, float32 for posteriors and else float16."""
    dtype = "float32" if title.startswith("posterior") else "float16"
    items = [Item(number) for number in range(NUM_ROWS)]
    rows = torch.randn(NUM_ROWS, *shape)
    store = Store(root / "store", "{}", shape, dtype)
    in_torch = getattr(torch, dtype)
    files = {by: Shards(root / f"shards_{by}", by, in_torch) for by in (True, False)}

    def fill_store(where: Store, num_rows: int = NUM_ROWS) -> None:
        shutil.rmtree(where.folder, ignore_errors=True)
        with where.writer() as writer:
            for first in range(0, num_rows, BATCH):
                keys = [item.cache_key for item in items[first : first + BATCH]]
                writer.add(keys, rows[first : first + BATCH])

    def fill_shards(where: Shards, per_shard: int, num_rows: int = NUM_ROWS) -> None:
        shutil.rmtree(where.folder, ignore_errors=True)
        where.folder.mkdir()
        where.index = {}
        for first in range(0, num_rows, per_shard):
            where.write(items[first : first + per_shard], rows[first : first + per_shard])

    fill_store(store)
    for shards in files.values():
        fill_shards(shards, ROWS_PER_SHARD)
    reader = CachedTensors(store, items)
    order = np.random.default_rng(0).permutation(NUM_ROWS)[:NUM_READ]
    by_key, sliced = files[True].open(), files[False].open()
    assert all(torch.equal(reader.read(items[i]), by_key.read(items[i])) for i in order)
    report(
        f"read {NUM_READ} rows, {title}",
        {
            "store": lambda: torch.stack([reader.read(items[i]) for i in order]),
            "tensor per row": lambda: torch.stack([by_key.read(items[i]) for i in order]),
            "slice of a shard": lambda: torch.stack([sliced.read(items[i]) for i in order]),
        },
    )
    num_written = 64
    report(
        f"write {num_written} rows, {title}",
        {
            "store": lambda: fill_store(Store(root / "w", "{}", shape, dtype), num_written),
            "a shard per batch": lambda: fill_shards(
                Shards(root / "w_batch", True, in_torch), BATCH, num_written
            ),
            "a shard of 32 rows": lambda: fill_shards(
                Shards(root / "w_shard", True, in_torch), ROWS_PER_SHARD, num_written
            ),
        },
    )


def measure_opening(root: Path) -> None:
    """Open stores of many rows of one number each."""
    items = [Item(number) for number in range(NUM_OPENED)]
    store = Store(root / "many", "{}", (1,), "float32")
    with store.writer() as writer:
        writer.add([item.cache_key for item in items], torch.zeros(NUM_OPENED, 1))
    shards = Shards(root / "many_shards", by_key=False)
    shards.folder.mkdir()
    shards.write(items, torch.zeros(NUM_OPENED, 1))
    report(
        f"open {NUM_OPENED} rows",
        {"store": store.places, "index": lambda: Shards(shards.folder, False).open()},
    )


def main() -> None:
    """Measure in a temporary folder, with one thread."""
    torch.set_num_threads(1)
    for title, shape in SHAPES.items():
        with tempfile.TemporaryDirectory() as folder:
            measure(Path(folder), title, shape)
    with tempfile.TemporaryDirectory() as folder:
        measure_opening(Path(folder))


if __name__ == "__main__":
    main()
