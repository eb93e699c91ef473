"""The Python of the README runs, one block after the other, in a folder with the files it names."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from tiny_networks import tiny_checkpoint

from r3dpa import pretrained
from r3dpa.data import write_bin
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection

README = Path(__file__).resolve().parents[1] / "README.md"


def test_python_of_the_readme_runs(tmp_path, monkeypatch):
    geometry = ScanGeometry(SphericalProjection(LidarSensor(16, 64)), RangeCodec(), (2, 8))
    monkeypatch.setattr(pretrained, "_FOLDER", tmp_path)
    tiny_checkpoint(tmp_path / "r3dpa-s.safetensors", geometry)
    points = np.random.default_rng(0).normal(size=(4000, 4)).astype(np.float32) * 10
    points[:, 3] = 0.5
    for place in ("scan.bin", "scans/0.bin", "runs/demo/scenes/bin/0.bin"):
        write_bin(tmp_path / place, points)
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names: dict = {}
    for block in blocks:
        exec(block, names)  # noqa: S102
    assert names["scenes"].range_m.shape[0] == 4
    assert names["jsd"] == 0
    assert names["image_m"].shape == (64, 1024)
