import json

import numpy as np
import pytest
import torch
import yaml
from inpainting_success import NAMES, Teacher, free_box, judge, main
from tiny_labelled import labelled_checkpoint
from tiny_networks import SIT_ARGS
from torch import nn

from r3dpa.editing.objects import ObjectClass, ObjectLibrary
from r3dpa.features import ScanGrid, WaffleIron
from r3dpa.features.scalr import save_weights
from r3dpa.geometry import NUM_CLASSES, LidarSensor, Pixels, SphericalProjection, unproject

PROJECTION = SphericalProjection(LidarSensor(beams=64, columns=512))
CAR = (4.2, 1.8, 1.5)
CENTRE = (10.0, 0.0, -0.98)  # on ground 1.73 m below the sensor


def level_road():
    """A flat road everywhere."""
    down = unproject(torch.ones(64, 512), PROJECTION)[..., 2]
    range_m = torch.where(down < -0.05, 1.73 / -down.clamp(max=-0.05), 0.0)
    classes = torch.where(range_m > 0, NAMES.index("road"), -1)
    return Pixels(range_m, torch.zeros_like(range_m), classes)


def test_a_box_stands_on_free_ground_in_sight():
    pixels = level_road()
    centre, mask = free_box(pixels, PROJECTION, CAR, ("road",), np.random.default_rng(0))
    assert 8 - 3 < np.hypot(*centre[:2]) < 16 + 3
    assert centre[2] == pytest.approx(-1.73 + 0.75, abs=0.05)
    assert mask.any()
    assert free_box(pixels, PROJECTION, CAR, ("sidewalk",), np.random.default_rng(0)) is None
    walls = pixels.range_m.clone()
    walls[:24] = 4.0  # all around, where the road would be farther than 8 m
    hidden = pixels._replace(range_m=torch.where(walls > 0, walls, pixels.range_m))
    assert free_box(hidden, PROJECTION, CAR, ("road",), np.random.default_rng(0)) is None


def box_of_points(low, high, num=10):
    sides = (torch.linspace(a, b, num) for a, b in zip(low, high, strict=True))
    return torch.cat([torch.cartesian_prod(*sides), torch.zeros(num**3, 1)], dim=1)


@pytest.mark.parametrize(
    ("low", "high", "matches", "expected"),
    [
        ((8.5, -0.9, -1.7), (11.5, 0.9, -0.3), True, (True, True)),
        ((8.5, -0.9, -1.7), (11.5, 0.9, -0.3), False, (False, True)),
        ((8.5, -0.9, -1.7), (11.5, 0.9, -1.3), True, (True, False)),  # too low
        ((9.9, -0.1, -1.7), (10.1, 0.1, -0.3), True, (True, False)),  # a pole
        ((20.0, -0.9, -1.7), (22.0, 0.9, -0.3), True, (False, False)),  # elsewhere
    ],
)
def test_an_object_is_judged_by_class_and_by_size(low, high, matches, expected):
    points = box_of_points(low, high)
    assert judge(points, torch.full((len(points),), matches), CENTRE, CAR, 3.0) == expected


@pytest.mark.slow
def test_the_figures_of_a_tiny_model_are_written(tmp_path):
    torch.manual_seed(0)
    ckpt = labelled_checkpoint(tmp_path)
    dim = SIT_ARGS["feature_dim"]
    grid = ScanGrid((-16.0, -16.0, -4.0), (16.0, 16.0, 4.0), (4.0, 4.0, 4.0), 1.0, 4)
    network = WaffleIron(4, 3, grid.cells)
    weights, head = tmp_path / "waffleiron_s_2.safetensors", nn.Linear(4, NUM_CLASSES)
    save_weights(weights, network, nn.BatchNorm1d(4), grid, class_head=head)
    about = Teacher(dim, weights).extractor
    cars = (ObjectClass("car", 1, 1, 1, 0.0),)
    card = {"name": about.name, "settings": {}}
    library = ObjectLibrary(torch.ones(1, dim), cars, card, {}, (2, 8))
    library.save(tmp_path / "lib.objects")
    data = {"class_path": "r3dpa.data.SimulatedImageDataModule"}
    codec = {"return_channel": True, "intensity_channel": True, "num_classes": NUM_CLASSES}
    data["init_args"] = {"root": str(tmp_path / "images"), "num_scans": 10, "grid_size": [2, 8]}
    data["init_args"] |= {"sensor": {"beams": 16, "columns": 64}, "codec": codec}
    data["init_args"] |= {"simulation_sensor": "hdl32e"}
    (tmp_path / "data.yaml").write_text(yaml.safe_dump({"data": data}))
    words = ["--ckpt", ckpt, "--objects", tmp_path / "lib.objects", "--teacher", weights]
    words += ["--data", tmp_path / "data.yaml", "--num", 2, "--classes", "car", "--steps", 2]
    main([*map(str, words), "--out", str(tmp_path / "edits.json")])
    results = json.loads((tmp_path / "edits.json").read_text())
    assert results["mixing"]["scenes"] == 1
    for how in ("guided", "unguided"):
        assert -1 <= results["mixing"][how]["own"] <= 1
        if results["car"]["boxes"]:
            assert results["car"][how]["unchanged"] == 1
    assert str(tmp_path) not in json.dumps(results)
