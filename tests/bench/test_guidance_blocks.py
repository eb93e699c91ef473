import json
from dataclasses import replace

import torch
import yaml
from guidance_blocks import main
from tiny_labelled import labelled_checkpoint

import r3dpa.cli.evaluate as command
from lidarsim.scan_files import write_bin
from r3dpa.metrics import scene


def test_each_block_has_a_row_and_changes_the_scenes(tmp_path, monkeypatch):
    coarse = replace(scene.DEFAULT, voxel_m=0.5)  # a hundredth of the work
    monkeypatch.setattr(scene, "PROTOCOLS", {"default": coarse})
    ckpt = labelled_checkpoint(tmp_path)
    sensor = {"class_path": "r3dpa.geometry.LidarSensor"}
    sensor["init_args"] = {"beams": 16, "columns": 64}
    generator = torch.Generator().manual_seed(0)
    for number in range(6):
        points = torch.rand(500, 4, generator=generator)
        points[:, :3] = points[:, :3] * torch.tensor([20.0, 20.0, 2.0]) - torch.tensor([0, 5, 2.0])
        write_bin(tmp_path / "scans" / f"{number}.bin", points.numpy())
    settings = {"scans": str(tmp_path / "scans"), "sensor": sensor, "val_every": 2}
    data = {"class_path": "r3dpa.data.LidarDataModule", "init_args": settings}
    path, reference = tmp_path / "data.yaml", tmp_path / "reference.safetensors"
    path.write_text(yaml.safe_dump({"data": data}))
    command.reference(data=path, out=reference, spaces=("fgeo",))
    words = ["--ckpt", ckpt, "--reference", reference, "--blocks", 1, 2, "--scales", 3.0]
    words += ["--num", 3, "--steps", 2, "--out", tmp_path / "blocks.json"]
    main([str(word) for word in words])
    rows = json.loads((tmp_path / "blocks.json").read_text())["rows"]
    assert [(row["block"], row["scale"]) for row in rows] == [(None, None), (1, 3.0), (2, 3.0)]
    assert len({row["FGEO"][0] for row in rows}) == 3
