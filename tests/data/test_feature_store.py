import json
import multiprocessing
import os
import pickle
import re
import resource
import signal
import struct
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from r3dpa.data import (
    FeatureGridError,
    FeatureGrids,
    FeatureGridWriter,
    GridSettings,
    Scan,
    row_store,
    stored_feature_dim,
    stored_source,
)
from r3dpa.data.feature_store import folder_lock, known_grids
from r3dpa.geometry import LidarSensor, SphericalProjection

SIZE = (2, 4)
SHAPE = (8, 4)  # cells, width of the features


@pytest.fixture
def projection(sensor):
    return SphericalProjection(sensor)


@pytest.fixture
def settings(projection, scaled_points):
    """``settings(size=..., dtype=..., precision=...)`` for the extractor of the fixtures."""

    def make(size=SIZE, extractor=None, **options):
        return GridSettings.of(extractor or scaled_points(), projection, size, **options)

    return make


def samples(first, last, num_bytes=160):
    names = [f"{frame:010d}" for frame in range(first, last)]
    return [(Scan("drive", name, Path(f"drive/{name}.bin")), num_bytes) for name in names]


def grid_of(scan, num_bytes=160, shape=SHAPE):
    """A different grid for each scan and size of its file; one of the cells is empty."""
    generator = torch.Generator().manual_seed(int(scan.frame) * 1000 + num_bytes)
    grid = torch.randn(shape, generator=generator)
    grid[3] = 0
    return grid


def grids_of(given):
    return torch.stack([grid_of(*sample) for sample in given])


def fill(root, settings, *ranges, shard=0):
    for first, last in ranges:
        with FeatureGridWriter(root, settings, shard) as writer:
            writer.add(samples(first, last), grids_of(samples(first, last)))


def opened(root, projection, given, size=SIZE):
    return FeatureGrids(root, [scan for scan, _ in given], projection, size)


def assert_holds(root, projection, given):
    grids = opened(root, projection, given)
    for sample in given:
        assert torch.equal(grids.read(*sample), grid_of(*sample).half().float())


# --- the format


def test_float16_rows_and_journal_by_hand(tmp_path, projection, scaled_points):
    """One cell of width 2, two scans: 1, -0.5 are 0x3c00, 0xb800; 1e9 is clamped to 65504."""
    extractor = scaled_points()
    extractor.dim = 2
    settings = GridSettings.of(extractor, projection, (1, 1), precision="bf16-mixed")
    with FeatureGridWriter(tmp_path, settings) as writer:
        writer.add(samples(5, 7), torch.tensor([[[1, -0.5]], [[1e9, -1e9]]]))
    folder = tmp_path / "1x1"
    assert (folder / "shard_00000.rows").read_bytes() == bytes.fromhex("003c00b8ff7bfffb")
    assert (folder / "shard_00000.jsonl").read_text() == (
        '{"scan": "drive/0000000005", "bytes": 160, "row": 0}\n'
        '{"scan": "drive/0000000006", "bytes": 160, "row": 1}\n'
    )
    stored = json.loads((folder / "settings.json").read_text())
    assert stored.pop("projection")["sensor"]["beams"] == 8
    assert stored == {
        "grid_size": [1, 1],
        "extractor": {"name": "scaled", "settings": {"gain": 1.0}},
        "dim": 2,
        "dtype": "float16",
        "precision": "bf16-mixed",
    }


def test_int8_row_by_hand(tmp_path, projection, settings):
    """Largest magnitudes 254, 0 and 6.35: scales 2, 0 and 0.05."""
    grid = torch.zeros(1, *SHAPE)
    grid[0, 0] = torch.tensor([254, -254, 1.1, -2.9])
    grid[0, 2] = torch.tensor([6.35, 0.026, 0.024, -0.3])
    with FeatureGridWriter(tmp_path, settings(dtype="int8")) as writer:
        writer.add(samples(0, 1), grid)
    data = (tmp_path / "2x4/shard_00000.rows").read_bytes()
    assert len(data) == 8 * 4 + 8 * 4
    assert struct.unpack("<8f", data[:32]) == pytest.approx((2, 0, 0.05, 0, 0, 0, 0, 0))
    codes = struct.unpack("<32b", data[32:])
    assert codes[:12] == (127, -127, 1, -1, 0, 0, 0, 0, 127, 1, 0, -6)
    assert not any(codes[12:])
    read = opened(tmp_path, projection, samples(0, 1)).read(*samples(0, 1)[0])
    assert read[0].tolist() == [254, -254, 2, -2]


@pytest.mark.numerics
@pytest.mark.parametrize("magnitude", [1e-44, 1e-38, 1e-36, 1e-3, 1.0, 1e5, 1e37])
def test_int8_is_off_by_half_a_scale_at_most(tmp_path, projection, settings, magnitude):
    """Heavy tails, and values in the middle between two codes. One scale over all cells fails."""
    generator = np.random.default_rng(0)
    given = samples(0, 40)
    values = generator.standard_t(2, (40, *SHAPE)) * 10.0 ** generator.uniform(-3, 0, (40, 8, 1))
    values *= magnitude / np.abs(values).max()
    values[20:] = np.rint(values[20:] / magnitude * 127 - 0.5) + 0.5
    values[20:, :, 0] = 127
    values[20:] *= magnitude / 127
    values[:, 3] = 0
    values = values.astype(np.float32)
    with FeatureGridWriter(tmp_path, settings(dtype="int8")) as writer:
        writer.add(given, torch.from_numpy(values))
    grids = opened(tmp_path, projection, given)
    read = np.stack([grids.read(*sample).numpy() for sample in given]).astype(np.float64)
    largest = np.abs(values.astype(np.float64)).max(axis=2, keepdims=True)
    # The quotient and the product round to float32: 127 * 2^-24 of a scale each, and the scale
    # itself. Below the normal numbers of float32 everything is 0.
    bound = np.where(largest / 127 < 2.0**-126, largest, largest / 254 * (1 + 2.0**-15))
    error = np.abs(read - values)
    assert (error <= bound * (1 + 2.0**-23)).all()
    assert not read[:, 3].any()
    if magnitude > 1e-30:
        assert (error > bound * 0.99).any()  # the bound is reached
        common = np.abs(values).max() / 127
        assert (np.abs(np.rint(values / common) * common - values) > bound).any()


def test_int8_takes_half_the_disk(settings, scaled_points):
    extractor = scaled_points()
    extractor.dim = 768
    sizes = [
        settings(extractor=extractor, dtype=dtype).row.itemsize for dtype in ("float16", "int8")
    ]
    assert sizes == [8 * 768 * 2, 8 * (768 + 4)]


def test_unknown_dtype_and_wrong_shapes_are_refused(tmp_path, settings):
    with pytest.raises(ValueError, match="dtype must be one of float16, int8, got 'int4'"):
        settings(dtype="int4")
    with pytest.raises(ValueError, match="3 x 4 cells does not divide"):
        settings(size=(3, 4))
    with FeatureGridWriter(tmp_path, settings()) as writer:
        for wrong in (torch.zeros(2, 8, 4), torch.zeros(1, 4, 8), torch.zeros(8, 4)):
            with pytest.raises(ValueError, match=r"grids must be \(1, 8, 4\), got"):
                writer.add(samples(0, 1), wrong)
    assert (tmp_path / "2x4/shard_00000.rows").stat().st_size == 0


# --- several shards, scans given again


def test_shards_are_merged_and_nothing_is_written_twice(tmp_path, projection, settings):
    fill(tmp_path, settings(), (0, 3))
    written = (tmp_path / "2x4/settings.json").stat().st_ino
    fill(tmp_path, settings(), (2, 5), (5, 6), shard=3)  # number 2 is there already
    fill(tmp_path, settings(), (4, 8))  # 4 and 5 are
    sizes = {p.name: p.stat().st_size // 64 for p in (tmp_path / "2x4").glob("*.rows")}
    assert sizes == {"shard_00000.rows": 3 + 2, "shard_00003.rows": 3}
    assert (tmp_path / "2x4/settings.json").stat().st_ino == written  # once
    assert_holds(tmp_path, projection, samples(0, 8)[::-1])
    with FeatureGridWriter(tmp_path, settings()) as writer:
        writer.add(samples(8, 9) * 2, grids_of(samples(8, 9) * 2))
        writer.add(samples(8, 9), grids_of(samples(8, 9)))
    assert (tmp_path / "2x4/shard_00000.rows").stat().st_size == 6 * 64


def test_writers_never_share_a_shard(tmp_path, projection, settings):
    numbers = []
    with (
        FeatureGridWriter(tmp_path, settings()) as first,
        FeatureGridWriter(tmp_path, settings(), 1) as second,
        FeatureGridWriter(tmp_path, settings()) as third,
    ):
        for start in (0, 3):
            for i, writer in enumerate((first, second, third)):
                given = samples(start + i, start + i + 1)
                writer.add(given, grids_of(given))
                numbers.append(writer.shard)
    assert numbers == [0, 1, 2] * 2
    with FeatureGridWriter(tmp_path, settings()) as again:
        assert again.shard == 0
    assert_holds(tmp_path, projection, samples(0, 6))


def test_locks_end_with_their_block_whatever_was_forked_within(tmp_path, settings):
    """Loader processes may outlive it, with copies of the open files."""
    with folder_lock(tmp_path), FeatureGridWriter(tmp_path, settings()):
        child = multiprocessing.get_context("fork").Process(target=time.sleep, args=[10])
        child.start()
    with folder_lock(tmp_path), FeatureGridWriter(tmp_path, settings()) as again:
        assert again.shard == 0
    child.kill()
    child.join()


def test_a_replaced_scan_has_a_row_of_its_own(tmp_path, projection, settings):
    """Both rows stay, so that the first file, put back, has its grid."""
    old, new = samples(0, 1, 160), samples(0, 1, 320)
    fill(tmp_path, settings(), (0, 2))
    with pytest.raises(
        FeatureGridError, match=r"0000000000\.bin has 320 bytes, .* from 160: .*replaced"
    ):
        opened(tmp_path, projection, old).read(*new[0])
    with FeatureGridWriter(tmp_path, settings(), shard=1) as writer:
        writer.add(new, grids_of(new))
    assert_holds(tmp_path, projection, old + new)
    with pytest.raises(FeatureGridError, match="made from 160 or 320"):
        opened(tmp_path, projection, old).read(old[0][0], 1)


def test_shards_are_mapped_without_taking_memory(tmp_path, projection, settings):
    """A map that may be written counts as memory as a whole: large shards could not be opened."""
    fill(tmp_path, settings(), (0, 2))
    mapping, _ = opened(tmp_path, projection, samples(0, 2))._reader.find(("drive/0000000000", 160))
    assert memoryview(mapping).readonly


# --- killed writers and damaged files


def in_child(function):
    """Exit code of a forked process that runs a function."""
    child = multiprocessing.get_context("fork").Process(target=function)
    child.start()
    child.join()
    return child.exitcode


@pytest.mark.parametrize("part", [0, 0.5, 1])
@pytest.mark.parametrize("moment", range(4))
def test_killed_at_every_step_of_a_batch(tmp_path, projection, settings, monkeypatch, moment, part):
    """Two batches of a row and a journal each: killed with none, half or all of one written."""
    append, seen = row_store.append, []

    def killing(file, data):
        seen.append(file)
        if len(seen) - 1 == moment:
            append(file, data[: int(part * len(data))])
            os.kill(os.getpid(), signal.SIGKILL)
        append(file, data)

    def write():
        with FeatureGridWriter(tmp_path, settings()) as writer:
            for first, last in ((0, 2), (2, 5)):
                writer.add(samples(first, last), grids_of(samples(first, last)))

    with monkeypatch.context() as patch:
        patch.setattr(row_store, "append", killing)
        assert in_child(write) == -signal.SIGKILL
    there = 0
    for sample in samples(0, 5):
        try:
            assert_holds(tmp_path, projection, [sample])
            there += 1
        except FeatureGridError:
            pass
    # Half of a journal of two lines or three holds one whole line.
    assert there == [0, {0: 0, 0.5: 1, 1: 2}[part], 2, {0: 2, 0.5: 3, 1: 5}[part]][moment]
    write()
    fill(tmp_path / "undisturbed", settings(), (0, 2), (2, 5))
    for name in ("shard_00000.rows", "shard_00000.jsonl"):
        store, undisturbed = (tmp_path / "2x4", tmp_path / "undisturbed/2x4")
        assert (store / name).read_bytes() == (undisturbed / name).read_bytes()


def test_rows_are_on_disk_before_the_journal_names_them(tmp_path, settings, monkeypatch):
    """As a power failure needs it: one flush a batch, in between."""
    append, sync, calls = row_store.append, os.fdatasync, []

    def note(name, function):
        return lambda file, *data: (
            calls.append((name, Path(file.name).suffix)),
            function(file, *data),
        )

    monkeypatch.setattr(row_store, "append", note("append", append))
    monkeypatch.setattr(os, "fdatasync", note("sync", sync))
    fill(tmp_path, settings(), (0, 5))
    assert calls == [("append", ".rows"), ("sync", ".rows"), ("append", ".jsonl")]


@pytest.mark.parametrize("tail", ['{"scan": "drive/0000000001", "bytes": 16', "\0" * 20, "{"])
def test_a_torn_line_and_rows_beyond_the_journal_do_not_count(tmp_path, projection, settings, tail):
    fill(tmp_path, settings(), (0, 1))
    folder = tmp_path / "2x4"
    with (folder / "shard_00000.jsonl").open("a") as journal:
        journal.write(tail)
    with (folder / "shard_00000.rows").open("ab") as rows:
        rows.write(b"\x7f" * 100)  # a row and a half
    assert_holds(tmp_path, projection, samples(0, 1))
    with pytest.raises(FeatureGridError, match=r"No feature grid .*0000000001\.bin"):
        opened(tmp_path, projection, samples(0, 2))
    fill(tmp_path, settings(), (1, 3))
    assert_holds(tmp_path, projection, samples(0, 3))
    assert (folder / "shard_00000.rows").stat().st_size == 3 * 64


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda lines: lines[:1] + lines[2:], "line 2 is of row 2"),
        (lambda lines: [lines[0], b"[1]\n", lines[2]], "TypeError"),
        (lambda lines: [lines[0][:20] + b"\n", *lines[1:]], "JSONDecodeError"),
        (lambda lines: [b"{}\n", *lines[1:]], "KeyError"),
        (lambda lines: [*lines, lines[2].replace(b"2}", b"3}")], "fewer than its 4 rows"),
    ],
)
def test_a_damaged_journal_is_named(tmp_path, projection, settings, change, reason):
    fill(tmp_path, settings(), (0, 3))
    path = tmp_path / "2x4/shard_00000.jsonl"
    path.write_bytes(b"".join(change(path.read_bytes().splitlines(keepends=True))))
    message = rf"shard_00000\.jsonl is damaged \(.*{reason}.*shard_00000\.rows .*r3dpa features"
    for attempt in (
        lambda: opened(tmp_path, projection, samples(0, 3)),
        lambda: FeatureGridWriter(tmp_path, settings()),
    ):
        with pytest.raises(FeatureGridError, match=message):
            attempt()
    path.unlink()  # the remedy
    (tmp_path / "2x4/shard_00000.rows").unlink()
    fill(tmp_path, settings(), (0, 3))
    assert_holds(tmp_path, projection, samples(0, 3))


def test_lost_rows_are_noticed(tmp_path, projection, settings):
    fill(tmp_path, settings(), (0, 3))
    (tmp_path / "2x4/shard_00000.rows").unlink()
    with pytest.raises(FeatureGridError, match=r"damaged .*shard_00000\.rows"):
        opened(tmp_path, projection, samples(0, 3))


@pytest.mark.parametrize(
    "text", ["{", "{}", "3", '{"grid_size": 3}', '{"grid_size": [2, 4], "dim": 4}', None]
)
def test_damaged_settings_are_named(tmp_path, projection, settings, text):
    fill(tmp_path, settings(), (0, 1))
    path = tmp_path / "2x4/settings.json"
    path.write_text(text or path.read_text().replace("4", "8"))
    with pytest.raises(FeatureGridError, match=r"2x4/settings\.json is damaged .*r3dpa features"):
        opened(tmp_path, projection, samples(0, 1))


def test_a_disk_that_fills_up(tmp_path, projection, settings):
    """A limit on the size of files, in the middle of the fourth row."""
    fill(tmp_path, settings(), (0, 2))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = FeatureGridWriter(tmp_path, settings())
    resource.setrlimit(resource.RLIMIT_FSIZE, (3 * 64 + 32, hard))
    try:
        with pytest.raises(
            FeatureGridError, match=r"cannot be written to .*2x4 \(.*\): give a features_dir"
        ):
            writer.add(samples(2, 4), grids_of(samples(2, 4)))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with pytest.raises(ValueError, match="closed"):
        writer.add(samples(2, 4), grids_of(samples(2, 4)))
    assert_holds(tmp_path, projection, samples(0, 2))
    fill(tmp_path, settings(), (2, 4))
    assert_holds(tmp_path, projection, samples(0, 4))


def test_a_folder_that_cannot_be_written_is_named(tmp_path, settings):
    (tmp_path / "file").touch()
    with pytest.raises(FeatureGridError, match=r"to .*file/2x4 \(.*\): give a features_dir"):
        FeatureGridWriter(tmp_path / "file", settings())


# --- settings


def test_other_settings_are_refused_when_writing(tmp_path, settings, scaled_points):
    fill(tmp_path, settings(), (0, 1))
    for other, words in (
        (settings(dtype="int8"), "dtype float16, but dtype int8"),
        (settings(precision="bf16-mixed"), "precision 32-true, but precision bf16-mixed"),
        (settings(extractor=scaled_points(gain=3.0)), r"'gain': 1\.0.*, but .*'gain': 3\.0"),
        (settings((4, 4), scaled_points(gain=3.0)), r"'gain': 1\.0.*, but .*'gain': 3\.0"),
    ):
        with pytest.raises(FeatureGridError, match=f"{words}.*features_dir .*r3dpa features"):
            FeatureGridWriter(tmp_path, other)
    fill(tmp_path, settings((4, 4), dtype="int8"), shard=1)  # another size may be stored otherwise
    assert stored_feature_dim(tmp_path) == 4
    assert stored_source(tmp_path) == "scaled"


def test_reading_does_not_ask_for_dtype_or_precision(tmp_path, projection, settings):
    fill(tmp_path, settings(precision="bf16-mixed"), (0, 2))
    assert_holds(tmp_path, projection, samples(0, 2))


@pytest.mark.parametrize("function", [stored_feature_dim, stored_source])
def test_an_empty_folder_has_no_source(tmp_path, function):
    with pytest.raises(FeatureGridError, match=r"No feature grids in .*r3dpa features"):
        function(tmp_path / "nothing")


def test_other_sensor_names_both(tmp_path, settings):
    fill(tmp_path, settings(), (0, 1))
    other = SphericalProjection(LidarSensor(beams=8, columns=32, range_max_m=40.0))
    with pytest.raises(FeatureGridError, match=r"projection .*56\.0.*, but projection .*40\.0"):
        opened(tmp_path, other, samples(0, 1))


# --- reading


class Reading(Dataset):
    def __init__(self, grids, given):
        self.grids, self.given = grids, given

    def __len__(self):
        return len(self.given)

    def __getitem__(self, index):
        return self.grids.read(*self.given[index])


def test_readers_in_several_processes_while_another_one_writes(tmp_path, projection, settings):
    fill(tmp_path, settings(), (0, 20))
    fill(tmp_path, settings(), (20, 40), shard=1)
    given = [samples(0, 40)[i] for i in torch.randperm(40).tolist()]
    grids = opened(tmp_path, projection, given)
    grids.read(*given[0])
    loader = DataLoader(Reading(grids, given), None, num_workers=2)
    with FeatureGridWriter(tmp_path, settings()) as writer:
        for number, (sample, read) in enumerate(zip(given, loader, strict=True)):
            assert torch.equal(read, grid_of(*sample).half().float())
            new = samples(40 + number, 41 + number)
            writer.add(new, grids_of(new))
    assert_holds(tmp_path, projection, samples(0, 80))


def test_what_a_reader_sees_of_a_growing_store_is_right(tmp_path, projection, settings):
    def write():
        with FeatureGridWriter(tmp_path, settings()) as writer:
            for first in range(0, 200, 4):
                writer.add(samples(first, first + 4), grids_of(samples(first, first + 4)))

    fill(tmp_path, settings(), (0, 4))
    child = multiprocessing.get_context("fork").Process(target=write)
    child.start()
    counts = []
    while child.is_alive():
        counts.append(len(known_grids(tmp_path, settings())))
        assert_holds(tmp_path, projection, samples(0, counts[-1]))
    assert child.exitcode == 0
    assert counts == sorted(counts)
    assert len(set(counts)) > 3
    assert_holds(tmp_path, projection, samples(0, 200))


@pytest.fixture
def wide_store(tmp_path, projection, scaled_points):
    """``wide_store(dtype)``: 256 rows of ones, 8 x 512: 16 kB each as float32, 4 MB in all."""

    def make(dtype="float16"):
        extractor = scaled_points()
        extractor.dim = 512
        given = samples(0, 256)
        with FeatureGridWriter(tmp_path, GridSettings.of(extractor, projection, SIZE, dtype)) as w:
            w.add(given, torch.ones(256, 8, 512))
        return opened(tmp_path, projection, given), given

    return make


def test_grids_travel_to_other_processes_without_their_maps(wide_store):
    grids, given = wide_store()
    expected = grids.read(*given[7])
    data = pickle.dumps(grids)
    assert len(data) < 50_000  # the names; a map would bring the rows
    copy = pickle.loads(data)  # noqa: S301 - made two lines above
    assert torch.equal(copy.read(*given[7]), expected)


@pytest.mark.parametrize("dtype", ["float16", "int8"])
def test_reading_copies_one_row_only(wide_store, dtype):
    grids, given = wide_store(dtype)
    grids.read(*given[0])
    tracemalloc.start()
    read = grids.read(*given[100])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert torch.equal(read, torch.ones(8, 512))
    assert read.untyped_storage().nbytes() == 2**14
    assert peak < 2**14  # nothing of the others
    read.zero_()
    assert torch.equal(grids.read(*given[100]), torch.ones(8, 512))  # the store is not written


def test_missing_grids_name_the_first_scan_and_how_many(tmp_path, projection, settings):
    fill(tmp_path, settings(), (0, 2))
    message = re.escape("No feature grid for scan drive/0000000002.bin and 2 more in ")
    with pytest.raises(FeatureGridError, match=f"{message}.*r3dpa features"):
        opened(tmp_path, projection, samples(0, 5))
    with pytest.raises(FeatureGridError, match=r"No feature grid .*0000000001\.bin in"):
        opened(tmp_path, projection, samples(0, 1)).read(*samples(1, 2)[0])
