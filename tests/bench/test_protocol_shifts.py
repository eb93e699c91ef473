from dataclasses import replace

import protocol_shifts
import torch
from protocol_shifts import markdown, measure_choices

from lidarsim.scan_files import write_bin
from r3dpa.data import LidarDataModule
from r3dpa.geometry import LidarSensor, SphericalProjection, points_of
from r3dpa.metrics.scene import PUBLISHED

SENSOR = LidarSensor(beams=16, columns=32)


def test_each_choice_shifts_what_it_changes(tmp_path, monkeypatch):
    """Samples are the real scans with a wall at 60 m, which only wider range cuts see."""
    coarse = {"published": replace(PUBLISHED, voxel_m=0.5, num_mmd_samples=2)}
    monkeypatch.setattr(protocol_shifts, "PROTOCOLS", coarse)
    projection = SphericalProjection(SENSOR)
    generator = torch.Generator().manual_seed(0)
    for index in range(8):
        image = 4 + 20 * torch.rand(1, 32, generator=generator).expand(16, 32).clone()
        image += torch.rand(16, 32, generator=generator)
        for folder, wall_m in ((f"real/{'ab'[index % 2]}", -1.0), ("samples", 60.0)):
            image[0] = wall_m
            write_bin(tmp_path / folder / f"{index}.bin", points_of(image, projection))
    module = LidarDataModule(str(tmp_path / "real"), sensor=SENSOR, val_drives=["b"])
    train, val = module.limited_split()
    scans = {"all": train + val, "train": train, "val": val}

    entries = measure_choices(tmp_path / "samples", module, scans)
    shifts = {entry["choice"]: entry["metrics"]["W1 range"] for entry in entries}
    unchanged = next(iter(shifts.values()))
    assert unchanged["value"] == unchanged["shift"] == 0
    for choice in ("0.5-63 m", "1.45-80 m"):
        assert shifts[choice]["shift"] > 0
        assert shifts[choice]["beyond_interval"]
    for choice in ("centre", "points out of range hide others"):
        assert shifts[choice]["shift"] == 0
    counts = {entry["choice"]: (entry["samples"], entry["scans"]) for entry in entries}
    assert counts["a half"] == (4, 8)
    assert counts["val alone"] == (8, 4)
    assert "| range: 0.5-63 m " in markdown(entries)
