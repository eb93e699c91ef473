from __future__ import annotations

import json
import math

import numpy as np
import pytest

from r3dpa.cli.evaluate import realism
from r3dpa.data.scans import ScanError, write_bin
from r3dpa.simulation import simulate


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    root = tmp_path_factory.mktemp("realism")
    simulate(root, 4, drives=["0003", "0004"])
    return root


def test_folders_are_compared_drive_by_drive(simulated, tmp_path):
    out = tmp_path / "realism.json"
    table = realism(scans=simulated, reference=simulated, out=out)
    assert "A: 4 scans of 2 drives, 2 to 2 each" in table.notes
    assert all(row.pooled == 0 for row in table.rows)
    # Two drives: pairs (0, 0), (0, 1), (1, 0), (1, 1), so the median is half the floor.
    assert all(row.ratio == pytest.approx(0.5) for row in table.rows if row.floor)
    assert json.loads(out.read_text())["rows"][0]["name"] == "returns per scan"
    assert list(tmp_path.iterdir()) == [out]


def test_a_single_drive_is_halved_and_says_so(simulated):
    drive = next(simulated.glob("data_3d_raw/*0003*"))
    table = realism(scans=simulated, reference=drive)
    assert "B: 2 scans of 2 drives, 1 to 1 each" in table.notes
    assert "first half" in table.notes[-1]
    assert any(row.within is not None for row in table.rows)


def test_a_single_scan_has_no_floor(simulated):
    scan = min(simulated.rglob("*.bin"))
    table = realism(scans=simulated, reference=scan)
    assert all(math.isnan(row.floor) for row in table.rows)
    assert "there is no floor" in str(table)


def test_a_scan_of_the_wrong_intensity_is_named(simulated, tmp_path):
    write_bin(tmp_path / "raw.bin", np.float32([[10, 0, 0, 255]]))
    with pytest.raises(ScanError, match=r"raw\.bin: intensity must lie in \[0, 1\]"):
        realism(scans=tmp_path, reference=simulated)
