"""``r3dpa gallery``: scenes in order, nearest scans, edits and weather on one page."""

import json
import re
from dataclasses import replace

import pytest
import torch
from tiny_labelled import labelled_checkpoint

from lidarsim import Semantic
from r3dpa import SceneGenerator
from r3dpa.checkpoints import read_checkpoint, save_checkpoint
from r3dpa.cli import main
from r3dpa.editing import most_like_first
from r3dpa.editing.objects import ObjectClass, ObjectLibrary
from r3dpa.geometry import points_of


def data_file(folder, num_scans, **sensor):
    path, root = folder / "data.yaml", str(folder / "data")
    arguments = {"root": root, "num_scans": num_scans, "extractor": None, "sensor": sensor}
    data = {"class_path": "r3dpa.data.SimulatedImageDataModule", "init_args": arguments}
    path.write_text(json.dumps({"data": data}))
    return path


def content(page):
    text = page.read_text()
    return json.loads(re.search(r'type="application/json"[^>]*>(.*?)</script>', text)[1])


@pytest.fixture(scope="module")
def page(tiny_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("gallery") / "gallery.html"
    data = data_file(out.parent, 6, beams=16, columns=64)
    words = ["--ckpt", tiny_file, "--out", out, "--num", 2, "--batch_size", 1, "--data", data]
    main(["gallery", *map(str, words), "--quality", "draft", "--device", "cpu"])
    return content(out)


def test_every_scene_is_on_the_page_in_order(page, tiny_file):
    made = SceneGenerator.from_checkpoint(tiny_file, "draft", device="cpu").generate(2)
    counts = [len(points_of(range_m, made.projection)) for range_m in made.range_m]
    assert [scan["name"] for scan in page["scans"][:2]] == ["seed 0", "seed 1"]
    assert [scan["count"] for scan in page["scans"][:2]] == pytest.approx(counts, rel=0.01)


def test_scenes_have_nearest_scans_and_edits_and_weather_follow(page):
    groups = {group["title"]: group["tiles"] for group in page["film"]["groups"]}
    assert [name for name, _ in groups["Scenes"][0]["pictures"]] == ["scene", "nearest"]
    assert all("nearest training scan at" in tile["note"] for tile in groups["Scenes"])
    assert len(groups["Edits of seed 0"]) == 5
    assert len(groups["Weather in seed 0"]) == 3
    numbers = [tile["scan"] for tiles in groups.values() for tile in tiles]
    assert numbers == list(range(len(page["scans"])))
    found = r"nearest of \d+ training scans: [\d.]+, of held-out scans [\d.]+"
    assert re.search(found, page["film"]["about"][1])


def test_data_of_another_sensor_are_refused(tiny_file, tmp_path):
    data = data_file(tmp_path, 2, beams=8, columns=64)
    with pytest.raises(ValueError, match=r"data\.yaml: is of another sensor"):
        main(["gallery", "--ckpt", str(tiny_file), "--out", "g.html", "--data", str(data)])


def test_classes_and_a_car_where_the_weights_have_them(tmp_path, monkeypatch, capsys):
    ordered = []

    def recorded(edits, *rest):
        ordered.append(most_like_first(edits, *rest))
        return ordered[-1]

    monkeypatch.setattr("r3dpa.scene_files.shown_edits.most_like_first", recorded)
    path = labelled_checkpoint(tmp_path)
    checkpoint = replace(read_checkpoint(path), feature_source="geometric")
    save_checkpoint(checkpoint, path, overwrite=True)
    dim = checkpoint.network("ema").build().feature_dim
    car = ObjectLibrary(
        torch.ones(1, dim), (ObjectClass("car", 1, 1, 1, 0.0),), {"name": "geometric"}, {}, (2, 8)
    )
    car.save(path.with_suffix(".objects"))
    words = ["--ckpt", path, "--num", 1, "--out", tmp_path / "g.html", "--quality", "draft"]
    main(["gallery", *map(str, words), "--device", "cpu"])
    assert "g.html: 1 scene, " in capsys.readouterr().out  # edits and weather do not count
    made = content(tmp_path / "g.html")
    groups = {group["title"]: group["tiles"] for group in made["film"]["groups"]}
    edits = [made["scans"][tile["scan"]]["name"] for tile in groups["Edits of seed 0"]]
    assert edits.count("a car 10 m ahead") == 2
    assert [len(draws) for draws in ordered] == [8]
    assert ordered[0].nfe == 2 * 32 + 12  # and 12 of 16 steps move the car into its box
    assert len(made["categories"]["semantic"]) > 1
    assert {name for _, name, _ in made["categories"]["semantic"]} <= {
        member.name.lower().replace("_", " ") for member in Semantic
    }
