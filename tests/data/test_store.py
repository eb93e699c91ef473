"""The store of tensors: format, keys, kills, damage, several processes."""

import json
import multiprocessing
import os
import pickle
import signal
import tracemalloc
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from torch.utils.data import DataLoader

from lidarsim import io
from r3dpa.data import StoreError, store
from r3dpa.data.store import CachedTensors, Store, tensor_cache

SHAPE = (8, 4)


class Item(NamedTuple):
    """A scan that needs no file."""

    number: int
    num_bytes: int = 160
    mtime_ns: int = 7

    @property
    def name(self):
        return f"drive/{self.number:010d}"

    @property
    def path(self):
        return Path(f"{self.name}.bin")

    @property
    def cache_key(self):
        return self.name, self.num_bytes, self.mtime_ns


def items(first, last, **changes):
    return [Item(number, **changes) for number in range(first, last)]


def tensor_of(item, shape=SHAPE):
    """A different tensor for each item and state of its file; one of the cells is zero."""
    generator = torch.Generator().manual_seed(hash(item) % 2**31)
    tensor = torch.randn(shape, generator=generator)
    tensor[3] = 0
    return tensor


def add(writer, given):
    writer.add([item.cache_key for item in given], torch.stack([tensor_of(i) for i in given]))


def fill(where, *ranges, shard=0):
    for first, last in ranges:
        with where.writer(shard) as writer:
            add(writer, items(first, last))


def assert_holds(where, given):
    read = CachedTensors(where, given)
    for item in given:
        assert torch.equal(read.read(item), tensor_of(item).half().float())


@pytest.fixture
def halves(tmp_path):
    return Store(tmp_path / "s", "{}", SHAPE, "float16", "grids", "with a command")


def test_rows_and_journal_by_hand(tmp_path):
    """One cell of width 2, two scans: 1, -0.5 are 0x3c00, 0xb800; 1e9 is clamped to 65504."""
    where = Store(tmp_path / "s", '{"a": 1}', (1, 2), "float16")
    with where.writer() as writer:
        keys = [item.cache_key for item in items(5, 7)]
        writer.add(keys, torch.tensor([[[1, -0.5]], [[1e9, -1e9]]]))
    assert (tmp_path / "s/shard_00000.rows").read_bytes() == bytes.fromhex("003c00b8ff7bfffb")
    assert (tmp_path / "s/shard_00000.jsonl").read_text() == (
        '{"scan": "drive/0000000005", "bytes": 160, "mtime_ns": 7, "row": 0}\n'
        '{"scan": "drive/0000000006", "bytes": 160, "mtime_ns": 7, "row": 1}\n'
    )
    assert json.loads((tmp_path / "s/settings.json").read_text()) == {"a": 1}


def test_wrong_shapes_and_unwritable_folders_are_named(halves, tmp_path):
    keys = [items(0, 1)[0].cache_key]
    with halves.writer() as writer:
        for wrong in (torch.zeros(2, 8, 4), torch.zeros(1, 4, 8), torch.zeros(8, 4)):
            with pytest.raises(ValueError, match=r"grids must be \(1, 8, 4\), got"):
                writer.add(keys, wrong)
    assert not list(halves.folder.glob("*.rows"))
    (tmp_path / "file").write_text("")
    cache = tensor_cache(tmp_path / "file", "a", {}, SHAPE)
    with pytest.raises(StoreError, match="cannot be written to"), cache.writer():
        pass


@pytest.mark.parametrize("value", [torch.inf, torch.nan])
def test_rows_that_are_not_finite_are_not_stored(halves, value):
    """It would cost a step in every epoch; the rows before it stay."""
    tensors = torch.zeros(5, *SHAPE)
    tensors[3, 1, 2] = value
    keys = [item.cache_key for item in items(0, 5)]
    with halves.writer() as writer:
        writer.add(keys[:2], tensors[:2])
        with pytest.raises(StoreError, match="grids of drive/0000000003 are not finite"):
            writer.add(keys[2:], tensors[2:])
    assert halves.missing(items(0, 5)) == items(2, 5)


def test_shards_are_merged_and_nothing_is_written_twice(halves):
    fill(halves, (0, 3))
    written = (halves.folder / "settings.json").stat().st_ino
    fill(halves, (2, 5), (5, 6), shard=3)  # number 2 is there already
    fill(halves, (4, 8), (0, 8))  # 4 and 5 are, and all
    sizes = {path.name: path.stat().st_size // 64 for path in halves.folder.glob("*.rows")}
    assert sizes == {f"shard_{n:05d}.rows": rows for n, rows in ((0, 3), (1, 2), (3, 2), (4, 1))}
    assert (halves.folder / "settings.json").stat().st_ino == written  # once
    assert_holds(halves, items(0, 8)[::-1])
    with halves.writer() as writer:
        add(writer, items(8, 9) * 2)
        add(writer, items(8, 9))
    assert (halves.folder / "shard_00002.rows").stat().st_size == 64


@pytest.mark.parametrize("name", ["shard_00000.rows", "shard_00000.jsonl"])
def test_a_link_in_a_foreign_folder_is_not_followed(name, halves, tmp_path):
    (tmp_path / "mine").write_text("mine")
    halves.folder.mkdir()
    (halves.folder / name).symlink_to(tmp_path / "mine")
    if name.endswith(".jsonl"):
        with pytest.raises(StoreError, match="symbolic links"):
            fill(halves, (0, 3))
    else:  # the next shard is taken
        fill(halves, (0, 3))
        assert (halves.folder / "shard_00001.rows").stat().st_size == 3 * 64
    assert (tmp_path / "mine").read_text() == "mine"


def test_writers_never_share_a_shard(halves):
    with halves.writer() as first, halves.writer(1) as second, halves.writer() as third:
        for start in (0, 3):
            for place, writer in enumerate((first, second, third)):
                add(writer, items(start + place, start + place + 1))
    sizes = [path.stat().st_size for path in sorted(halves.folder.glob("*.rows"))]
    assert sizes == [128] * 3
    assert_holds(halves, items(0, 6))


@pytest.mark.parametrize("change", [{"num_bytes": 320}, {"mtime_ns": 8}])
def test_a_replaced_file_is_noticed_and_has_a_row_of_its_own(halves, change):
    """Both rows stay, so that the first file, put back, has its row."""
    old, new = items(0, 1), items(0, 1, **change)
    fill(halves, (0, 2))
    assert halves.missing(new) == new
    with pytest.raises(StoreError, match=r"0000000000\.bin.* was replaced.*with a command"):
        CachedTensors(halves, old).read(*new)
    with pytest.raises(StoreError, match=r"0000000000\.bin.* was replaced"):
        CachedTensors(halves, new)
    with halves.writer(1) as writer:
        add(writer, new)
    assert_holds(halves, old)
    assert_holds(halves, new)


@pytest.mark.parametrize(
    ("name", "settings", "shape"), [("b", {"x": 1}, SHAPE), ("a", {"x": 2}, SHAPE), ("a", {}, (4,))]
)
def test_other_settings_never_find_these_rows(tmp_path, name, settings, shape):
    cache = tensor_cache(tmp_path, "a", {"x": 1}, SHAPE)
    fill(cache, (0, 5))
    other = tensor_cache(tmp_path, name, settings, shape)
    assert other.missing(items(0, 5)) == items(0, 5)
    with pytest.raises(StoreError, match=r"no cached tensors of drive.*0000\.bin and 4 more"):
        CachedTensors(other, items(0, 5))
    assert tensor_cache(tmp_path, "a", {"x": 1}, SHAPE) == cache


@pytest.mark.parametrize("part", [0, 0.5, 1])
@pytest.mark.parametrize("moment", range(4))
def test_killed_at_every_step_of_a_batch(halves, monkeypatch, moment, part):
    """Two batches of a row and a journal each: killed with none, half or all of one written."""
    append, seen = store.append, []

    def killing(file, data):
        seen.append(file)
        if len(seen) - 1 == moment:
            append(file, data[: int(part * len(data))])
            os.kill(os.getpid(), signal.SIGKILL)
        append(file, data)

    def write():
        with halves.writer() as writer:
            for first, last in ((0, 2), (2, 5)):
                add(writer, items(first, last))

    with monkeypatch.context() as patch:
        patch.setattr(store, "append", killing)  # of the rows
        patch.setattr(io, "append", killing)  # of the journal
        child = multiprocessing.get_context("fork").Process(target=write)
        child.start()
        child.join()
    assert child.exitcode == -signal.SIGKILL
    there = [item for item in items(0, 5) if not halves.missing([item])]
    # Half of a journal of two lines or three holds one whole line.
    expected = [0, {0: 0, 0.5: 1, 1: 2}[part], 2, {0: 2, 0.5: 3, 1: 5}[part]][moment]
    assert there == items(0, expected)
    assert_holds(halves, there)
    write()
    assert_holds(halves, items(0, 5))


def test_rows_are_on_disk_before_the_journal_names_them(halves, monkeypatch):
    """As a power failure needs it: one flush a batch, in between."""
    calls = []

    def note(name, function):
        return lambda file, *data: (
            calls.append((name, Path(file.name).suffix)),
            function(file, *data),
        )

    noted = note("append", io.append)
    monkeypatch.setattr(store, "append", noted)
    monkeypatch.setattr(io, "append", noted)
    monkeypatch.setattr(os, "fdatasync", note("sync", os.fdatasync))
    fill(halves, (0, 5))
    assert calls == [("append", ".rows"), ("sync", ".rows"), ("append", ".jsonl")]


@pytest.mark.parametrize("tail", ['{"scan": "drive/0000000001", "bytes": 16', "\0" * 20, "{"])
def test_a_torn_line_and_rows_beyond_the_journal_do_not_count(halves, tail):
    fill(halves, (0, 1))
    with (halves.folder / "shard_00000.jsonl").open("a") as journal:
        journal.write(tail)
    with (halves.folder / "shard_00000.rows").open("ab") as rows:
        rows.write(b"\x7f" * 100)  # a row and a half
    assert_holds(halves, items(0, 1))
    with pytest.raises(StoreError, match=r"no grids of .*0000000001\.bin in"):
        CachedTensors(halves, items(0, 2))
    fill(halves, (1, 3))
    assert_holds(halves, items(0, 3))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda lines: lines[:1] + lines[2:], "line 2 is of row 2"),
        (lambda lines: [lines[0], b"[1]\n", lines[2]], "TypeError"),
        (lambda lines: [lines[0][:20] + b"\n", *lines[1:]], "JSONDecodeError"),
        (lambda lines: [b"{}\n", *lines[1:]], "KeyError"),
        (lambda lines: [lines[0].replace(b"160", b"1.5"), *lines[1:]], "no whole number"),
        (lambda lines: [*lines, lines[2].replace(b"2}", b"3}")], "fewer than its 4 rows"),
        (lambda lines: [lines[0].replace(b"drive", b".."), *lines[1:]], "name of scan in line 1"),
    ],
)
def test_a_damaged_journal_is_named(halves, change, reason):
    fill(halves, (0, 3))
    path = halves.folder / "shard_00000.jsonl"
    path.write_bytes(b"".join(change(path.read_bytes().splitlines(keepends=True))))
    message = rf"shard_00000\.jsonl is damaged \(.*{reason}.*shard_00000\.rows .*with a command"
    for attempt in (lambda: CachedTensors(halves, items(0, 3)), halves.writer):
        with pytest.raises(StoreError, match=message):
            attempt()
    path.unlink()  # the remedy
    (halves.folder / "shard_00000.rows").unlink()
    fill(halves, (0, 3))
    assert_holds(halves, items(0, 3))


def test_readers_in_several_processes_while_another_one_writes(halves):
    fill(halves, (0, 20))
    fill(halves, (20, 40), shard=1)
    given = [items(0, 40)[i] for i in torch.randperm(40).tolist()]
    tensors = CachedTensors(halves, given)
    tensors.read(given[0])
    loader = DataLoader(given, None, num_workers=2, collate_fn=tensors.read)
    with halves.writer() as writer:
        for number, (item, read) in enumerate(zip(given, loader, strict=True)):
            assert torch.equal(read, tensor_of(item).half().float())
            add(writer, items(40 + number, 41 + number))
    assert_holds(halves, items(0, 80))


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_reading_copies_one_row_only(tmp_path, dtype):
    """256 rows of ones, 8 x 512: 16 kB each as float32, 4 MB in all."""
    where, given = Store(tmp_path, "{}", (8, 512), dtype), items(0, 256)
    with where.writer() as writer:
        writer.add([item.cache_key for item in given], torch.ones(256, 8, 512))
    tensors = CachedTensors(where, given)
    tensors.read(given[0])
    tracemalloc.start()
    read = tensors.read(given[100])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert torch.equal(read, torch.ones(8, 512))
    assert read.untyped_storage().nbytes() == 2**14
    assert peak < 2**14 + 4000  # nothing of the others
    read.zero_()
    assert torch.equal(tensors.read(given[100]), torch.ones(8, 512))  # the store is not written
    data = pickle.dumps(tensors)
    assert len(data) < 50_000  # the names, not the rows
    copy = pickle.loads(data)  # noqa: S301 - made two lines above
    assert torch.equal(copy.read(given[7]), torch.ones(8, 512))


@pytest.mark.faults
@pytest.mark.parametrize("opened", [False, True])
@pytest.mark.parametrize("num_bytes", [None, 0, 100])
def test_rows_that_are_cut_after_the_journal_was_read_are_named(opened, num_bytes, halves):
    """Without the check, the system kills whoever touches what is no longer there (SIGBUS)."""
    fill(halves, (0, 8))
    tensors = CachedTensors(halves, items(0, 8))
    if opened:
        tensors.read(*items(7, 8))
    path = halves.folder / "shard_00000.rows"
    if num_bytes is None:
        path.unlink()
    else:
        os.truncate(path, num_bytes)
    if opened and num_bytes is None:  # the system keeps what is open
        assert torch.equal(tensors.read(*items(7, 8)), tensor_of(*items(7, 8)).half().float())
        return
    with pytest.raises(StoreError, match=f"{path} .*with a command"):
        tensors.read(*items(7, 8))
