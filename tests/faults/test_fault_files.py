"""Checkpoints, stores, caches and archives that were cut short."""

from __future__ import annotations

import errno
import os

import pytest
import torch
from fault_commands import cut, fit_words
from safetensors.torch import save_file
from torch import nn

from lidarsim.scan_files import ScanError
from r3dpa.cli import main
from r3dpa.data.datasets import LidarDataset
from r3dpa.data.feature_grids import FeatureGrids, write_feature_grids
from r3dpa.data.scans import find_scans
from r3dpa.data.store import StoreError
from r3dpa.geometry import LidarSensor, RangeCodec, SphericalProjection
from r3dpa.io import atomic_path, only_writer

PROJECTION = SphericalProjection(LidarSensor(beams=8, columns=32))


class PointsThemselves(nn.Module):
    name, dim, settings, prepare = "points", 4, {}, staticmethod(lambda points: points)

    def point_features(self, prepared):
        return list(prepared)


READERS = {
    **{
        f"fit {key}": lambda ckpt, out, scans, key=key: fit_words(scans, out, key, ckpt)
        for key in ("--ckpt_path", "--model.init_args.init_from")
    },
    "test": lambda ckpt, out, scans: ["test", *fit_words(scans, out, "--ckpt_path", ckpt)[1:]],
    "sample": lambda ckpt, out, scans: ["sample", "--ckpt", ckpt, "--out", out],
    "convert": lambda ckpt, out, scans: ["convert", ckpt, out.with_suffix(".safetensors")],
}


@pytest.mark.parametrize("reader", READERS)
def test_a_checkpoint_cut_short(reader, scans_folder, tmp_path):
    ckpt = tmp_path / "last.ckpt"
    torch.save({"state_dict": {"weight": torch.zeros(1000)}}, ckpt)
    words = READERS[reader](ckpt, tmp_path / "out", scans_folder)
    for kept in (ckpt.stat().st_size - 1, 0):
        os.truncate(ckpt, kept)
        with pytest.raises(ValueError, match=f"cannot read {ckpt}: .*damaged"):
            main([str(word) for word in words])
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path != ckpt]


@pytest.mark.parametrize(("kept", "says"), [(None, "No such file"), (0, "empty"), (8, "16")])
def test_a_scan_that_is_gone_since_the_index_was_made(own_scans, kept, says):
    scans = find_scans(own_scans)
    dataset = LidarDataset(scans, PROJECTION, RangeCodec())
    cut(scans[3].path, kept)
    with pytest.raises(ScanError, match=f"{scans[3].path}: .*{says}"):
        dataset[3]


@pytest.mark.parametrize("opened", [False, True])
@pytest.mark.parametrize("kept", [None, 0, 100])
def test_rows_of_a_store_that_are_cut(opened, kept, own_scans, tmp_path):
    """Without the check, the system kills whoever touches what is no longer there (SIGBUS)."""
    scans, extractor = find_scans(own_scans), PointsThemselves()
    write_feature_grids(scans, extractor, PROJECTION, [(2, 8)], tmp_path / "grids")
    grids = FeatureGrids(tmp_path / "grids", scans, PROJECTION, (2, 8), extractor)
    if opened:
        grids.read(scans[7])
    (rows,) = tmp_path.rglob("*.rows")
    cut(rows, kept)
    if opened and kept is None:  # the system keeps what is open
        assert grids.read(scans[7]).isfinite().all()
        return
    with pytest.raises(StoreError, match=f"{rows} .*make their feature grids again"):
        grids.read(scans[7])


@pytest.mark.parametrize("writer", ["bytes", "torch", "safetensors"])
def test_a_full_disk_is_told_with_the_name_of_the_file(writer, small_disk):
    path = small_disk(1_000_000) / "file"

    def write():
        tensors = {"a": torch.zeros(1_000_000)}
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            if writer == "bytes":
                file.write(bytes(2_000_000))
            elif writer == "torch":
                torch.save(tensors, file)
            else:
                save_file(tensors, temporary)

    with pytest.raises(OSError, match=rf"No space left on device: '{path}'"):
        write()
    assert not list(path.parent.iterdir())


def test_a_disk_without_locks_is_used_with_a_warning(tmp_path, monkeypatch, caplog):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with only_writer(tmp_path / ".lock", "writes here"):
        assert "has no locks: make sure that no other process writes here" in caplog.text
