"""``r3dpa gallery``: scenes in order, nearest scans, edits and weather on one page."""

import json
import re

import pytest

from r3dpa import SceneGenerator
from r3dpa.cli import main
from r3dpa.geometry import points_of


def data_file(folder, num_scans, **sensor):
    path, root = folder / "data.yaml", str(folder / "data")
    arguments = {"root": root, "num_scans": num_scans, "extractor": None, "sensor": sensor}
    data = {"class_path": "r3dpa.data.SimulatedImageDataModule", "init_args": arguments}
    path.write_text(json.dumps({"data": data}))
    return path


@pytest.fixture(scope="module")
def page(tiny_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("gallery") / "gallery.html"
    data = data_file(out.parent, 10, beams=16, columns=64)
    words = ["--ckpt", tiny_file, "--out", out, "--num", 3, "--batch_size", 2, "--data", data]
    main(["gallery", *map(str, words), "--quality", "draft", "--device", "cpu"])
    text = out.read_text()
    return json.loads(re.search(r'type="application/json"[^>]*>(.*?)</script>', text)[1])


def test_every_scene_is_on_the_page_in_order(page, tiny_file):
    made = SceneGenerator.from_checkpoint(tiny_file, "draft", device="cpu").generate(3)
    counts = [len(points_of(range_m, made.projection)) for range_m in made.range_m]
    assert [scan["name"] for scan in page["scans"][:3]] == ["seed 0", "seed 1", "seed 2"]
    assert [scan["count"] for scan in page["scans"][:3]] == pytest.approx(counts, rel=0.01)


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
