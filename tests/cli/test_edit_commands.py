"""``r3dpa edit``: files that its commands write, and what they refuse before networks run."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_networks import tiny_checkpoint

from lidarsim import simulate
from r3dpa import viz
from r3dpa.cli import main
from r3dpa.data import read_scan, write_bin, write_npz, write_ply
from r3dpa.editing import SceneEditor
from r3dpa.geometry import (
    LidarSensor,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
    points_of,
    range_image,
)

SENSOR = LidarSensor(beams=16, columns=64)
PROJECTION = SphericalProjection(SENSOR)


def checkpoint(folder, feature_source="geometric"):
    return tiny_checkpoint(
        folder / f"{feature_source}.safetensors",
        ScanGeometry(PROJECTION, RangeCodec(), (2, 8)),
        spread=0.05,
        sit_args={"feature_dim": 16},
        feature_source=feature_source,
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Folder with checkpoints, two simulated scans and a library of their objects."""
    folder = tmp_path_factory.mktemp("edit")
    simulate(folder / "data", 2, drives=["0000"])
    for number, path in enumerate(sorted((folder / "data").rglob("data/*.bin"))):
        (folder / f"{'ab'[number]}.bin").symlink_to(path)
    checkpoint(folder)
    checkpoint(folder, "waffleiron-s")
    checkpoint(folder, None)
    points = read_scan(folder / "a.bin")
    write_bin(folder / "tilted.bin", read_scan(folder / "a.bin", SENSOR)[:, [2, 1, 0, 3]])
    write_npz(folder / "one.npz", {"scan": points}.items())
    write_npz(folder / "two.npz", {"x": points, "y": points}.items())
    mask = Image.new("L", (64, 16))
    mask.putpixel((20, 8), 255)
    mask.save(folder / "m.png")
    words = ["--data", folder / "data", "--out", folder / "lib.safetensors"]
    main(["objects", *map(str, [*words, "--ckpt", folder / "geometric.safetensors"])])
    return folder


def edit(files, command, out, *more, num=2, ckpt="geometric", pictures=0):
    words = ["--ckpt", files / f"{ckpt}.safetensors", "--out", out, "--steps", 2, "--device", "cpu"]
    if command != "interpolate":
        words += ["--num", num]
    main([command, *map(str, [*words, "--pictures", pictures, *more])])
    return json.loads((out / "metadata.json").read_text())


def images(files, name="a"):
    points = torch.from_numpy(read_scan(files / f"{name}.bin"))
    return range_image(points[:, :3], PROJECTION)[0]


@pytest.fixture
def no_sheet(monkeypatch):
    """The sheet takes longer than a tiny edit; one test draws it."""
    monkeypatch.setattr(viz, "edit_sheet", lambda *_: np.zeros((2, 2, 3), np.uint8))


class TestFiles:
    def test_inpaint_writes_everything_and_leaves_the_rest_of_the_scan(self, files, tmp_path):
        scan = ["--scan", files / "a.bin", "--box", "-40", "40", "-20", "0"]
        library = ["--objects", files / "lib.safetensors", "--object", "car"]
        about = edit(files, "inpaint", tmp_path / "o", *scan, *library, pictures=1)
        names = {path.name for path in (tmp_path / "o").iterdir()}
        assert names == {
            *("range_m.npy", "bin", "range", "birds_eye", "scene_3d", "metadata.json"),
            *("before.npy", "mask.png", "edit.png", "edit.html"),
        }
        made = torch.from_numpy(np.load(tmp_path / "o" / "range_m.npy"))
        mask = torch.from_numpy(np.asarray(Image.open(tmp_path / "o" / "mask.png")) > 0)
        assert mask.shape == (16, 64)
        assert made.shape == (2, 16, 64)
        assert all(one[~mask].equal(images(files)[~mask]) for one in made)
        assert about["command"] == "inpaint"
        assert about["box"] == [-40, 40, -20, 0]
        assert about["object"] == "car"
        assert about["feature_source"] == "geometric"
        assert about["nfe"] == 8  # two midpoint steps there, two back
        assert len(about["cosine"]) == 2
        page = (tmp_path / "o" / "edit.html").read_text()
        assert "before: scan a" in page
        assert "inpaint 1" in page

        # The mask that was written is one that can be read.
        again = ["--scan", files / "a.bin", "--mask", tmp_path / "o" / "mask.png"]
        edit(files, "inpaint", tmp_path / "again", *again, *library)
        assert np.array_equal(np.load(tmp_path / "again" / "range_m.npy"), made.numpy())
        # A second edit leaves nothing of the first.
        edit(files, "vary", tmp_path / "again", "--scan", files / "a.bin", "--overwrite")
        assert not (tmp_path / "again" / "mask.png").exists()

    def test_mix_of_two_scans(self, files, no_sheet, tmp_path):
        sides = ["--left", files / "a.bin", "--right", files / "b.bin", "--split", "30"]
        about = edit(files, "mix", tmp_path / "sides", *sides)
        assert list(about["scans"]) == ["0: a", "1: b"]
        assert np.load(tmp_path / "sides" / "range_m.npy").shape == (2, 16, 64)
        mask = np.asarray(Image.open(tmp_path / "sides" / "mask.png"))
        assert set(np.unique(mask)) == {0, 255}

    def test_complete_takes_any_file_and_measures_what_was_left_out(
        self, files, no_sheet, tmp_path
    ):
        more = ["--scan", files / "one.npz", "--keep_every", 2, "--sector", 170, -170]
        about = edit(files, "complete", tmp_path / "out", *more, num=1)
        made = torch.from_numpy(np.load(tmp_path / "out" / "range_m.npy"))[0]
        missing = torch.from_numpy(np.asarray(Image.open(tmp_path / "out" / "mask.png")) > 0)
        assert missing[1::2].all()
        assert missing[:, [0, 63]].all()
        assert made[~missing].equal(images(files)[~missing])
        assert set(about["held_out"]) == {"completed", "nearest", "linear"}
        assert about["held_out"]["linear"]["mae_m"] < about["held_out"]["nearest"]["mae_m"]
        # Of the beams that were left out here no point is in the file.
        sparse = images(files)
        sparse[1::2] = -1
        write_ply(tmp_path / "sparse.ply", points_of(sparse, PROJECTION))
        more = ["--scan", tmp_path / "sparse.ply", "--empty_beams"]
        edit(files, "complete", tmp_path / "o", *more)
        assert (np.asarray(Image.open(tmp_path / "o" / "mask.png"))[1::2] == 255).all()
        # Another sensor has the same columns, and half of the beams.
        more = ["--scan", files / "a.bin", "--other_sensor", "[8, -25, 3]", "--overwrite"]
        about = edit(files, "complete", tmp_path / "o", *more, num=1)
        missing = np.asarray(Image.open(tmp_path / "o" / "mask.png")) > 0
        assert missing.all(axis=1).sum() == missing.any(axis=1).sum() == 8
        assert about["other_sensor"] == [8, -25.0, 3.0]

    def test_vary_and_interpolate(self, files, no_sheet, tmp_path):
        about = edit(files, "vary", tmp_path / "v", "--scan", files / "a.bin", "--start", 0.3)
        assert about["nfe"] == 4
        assert "strength" not in about["settings"]
        ends = ["--left", files / "a.bin", "--right", files / "b.bin", "--frames", 3]
        about = edit(files, "interpolate", tmp_path / "i", *ends)
        assert np.load(tmp_path / "i" / "range_m.npy").shape == (3, 16, 64)
        assert not (tmp_path / "i" / "mask.png").exists()


REFUSED = [
    ("inpaint", "", "one of --box, --box3d and --mask"),
    ("inpaint", "--mask m.png --object car", "--objects FILE and --object NAME go together"),
    ("inpaint", "--mask m.png --strength 0.3", "--strength and --window need"),
    (
        "inpaint",
        "--ckpt waffleiron-s.safetensors --mask m.png --objects lib.safetensors --object car",
        "'geometric'.*'waffleiron-s'",
    ),
    ("complete", "", "nothing is missing"),
    ("complete", "--keep_every 1", "2 to 8, got 1"),
    ("vary", "--device tpu", "device 'tpu' cannot be used here"),
    ("vary", "--scan tilted.bin", r"tilted.bin: .*outside the field"),
    ("vary", "--scan two.npz", r"holds 2 scans \(x, y\)"),
    ("vary", "--scan gone.bin", "gone.bin"),
    (
        "mix",
        "--ckpt None.safetensors --left a.bin --right b.bin",
        "None.safetensors was trained without 3D features",
    ),
    ("interpolate", "--left a.bin --right b.bin --frames 1", "at least 2"),
]


@pytest.mark.parametrize(("command", "more", "message"), REFUSED)
def test_bad_input_is_refused_before_networks_run(
    files, tmp_path, monkeypatch, command, more, message
):
    monkeypatch.chdir(files)
    monkeypatch.setattr(SceneEditor, "encode", lambda *_: pytest.fail("a network ran"))
    scan = [] if command in ("mix", "interpolate") else ["--scan", "a.bin"]
    with pytest.raises(ValueError, match=message):
        edit(files, command, tmp_path / "out", *scan, *more.split())
    assert not (tmp_path / "out").exists()


def test_an_interrupt_ends_in_one_line_and_leaves_nothing(files, tmp_path, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(SceneEditor, "vary", interrupted)
    with pytest.raises(SystemExit, match="130"):
        edit(files, "vary", tmp_path / "out", "--scan", files / "a.bin")
    assert capsys.readouterr().err.endswith("r3dpa vary: stopped\n")
    assert not list((tmp_path / "out").rglob("*"))
