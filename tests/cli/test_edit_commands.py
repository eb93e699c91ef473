"""``r3dpa inpaint`` and its like: files they write, and what they refuse before networks run."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_networks import tiny_checkpoint

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
from r3dpa.simulation import simulate

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
    data = sorted((folder / "data").rglob("velodyne_points/data"))[0]
    words = ["--data", data, "--out", folder / "lib.safetensors"]
    main(["objects", *map(str, [*words, "--like", folder / "geometric.safetensors"])])
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
        # A second edit leaves nothing of the first, if it may.
        scan = ["--scan", files / "a.bin"]
        with pytest.raises(ValueError, match="holds scenes already"):
            edit(files, "vary", tmp_path / "again", *scan)
        edit(files, "vary", tmp_path / "again", *scan, "--overwrite")
        assert not (tmp_path / "again" / "mask.png").exists()

    @pytest.mark.parametrize("source", [["--label", "car"], ["--features_box3d"]])
    def test_an_object_of_another_scan_guides(self, files, tmp_path, source):
        if source[0] == "--features_box3d":
            points = read_scan(files / "b.bin", SENSOR)
            near = points[np.linalg.norm(points[:, :3], axis=1) > 5][0]
            source = [*source, *map(float, near[:3]), 2, 2, 2, 30]
        box = ["--scan", files / "a.bin", "--box3d", 10, 0, -0.5, 4, 3, 2, 0]
        other = max((files / "data").rglob("data/*.bin"))  # with its labels beside it
        about = edit(files, "inpaint", tmp_path, *box, "--features_from", other, *source, num=1)
        assert about["guided"]
        assert about["cosine"]

    def test_mix_of_two_halves_is_that_of_a_layout(self, files, tmp_path):
        sides = ["--left", files / "a.bin", "--right", files / "b.bin", "--split", "30"]
        edit(files, "mix", tmp_path / "sides", *sides)
        layout = [30, files / "a.bin", 210, files / "b.bin"]
        about = edit(files, "mix", tmp_path / "layout", "--layout", *layout)
        made = [np.load(tmp_path / name / "range_m.npy") for name in ("sides", "layout")]
        assert np.array_equal(*made)
        assert list(about["scans"]) == ["0: a", "1: b"]
        mask = np.asarray(Image.open(tmp_path / "sides" / "mask.png"))
        assert set(np.unique(mask)) == {0, 255}

    def test_complete_takes_any_file_and_measures_what_was_left_out(self, files, tmp_path):
        write_npz(tmp_path / "scan.npz", {"scan": read_scan(files / "a.bin")})
        more = ["--scan", tmp_path / "scan.npz", "--keep_every", 2, "--sector", 170, -170]
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

    def test_another_sensor_sees_fewer_beams(self, files, tmp_path):
        more = ["--scan", files / "a.bin", "--other_sensor", "[8, -25, 3]"]
        about = edit(files, "complete", tmp_path / "o", *more, num=1)
        missing = np.asarray(Image.open(tmp_path / "o" / "mask.png")) > 0
        assert missing.all(axis=1).sum() == 8  # of 16 rows; its columns are ours
        assert missing.any(axis=1).sum() == 8
        assert about["other_sensor"] == [8, -25.0, 3.0]

    def test_vary_and_interpolate(self, files, tmp_path):
        about = edit(files, "vary", tmp_path / "v", "--scan", files / "a.bin", "--start", 0.3)
        assert about["nfe"] == 4
        assert "strength" not in about["settings"]
        ends = ["--left", files / "a.bin", "--right", files / "b.bin", "--frames", 3]
        about = edit(files, "interpolate", tmp_path / "i", *ends)
        assert np.load(tmp_path / "i" / "range_m.npy").shape == (3, 16, 64)
        assert not (tmp_path / "i" / "mask.png").exists()


REFUSED = {
    "no part": ("inpaint", "", "one of --box, --box3d and --mask"),
    "beyond range": (
        *("inpaint", "--box3d 90 0 0 4 2 2 0"),
        r"88.0 to 92.\d m away.*no ray meets it.*1 to 56 m",
    ),
    "mask of another size": (
        *("inpaint", "--mask other.png"),
        "has 32 x 128 pixels .* but the range image 16 x 64",
    ),
    "unknown class": (
        *("inpaint", "--mask m.png --objects lib --object tram"),
        "no 'tram' among the objects; there are .*car",
    ),
    "class without library": (
        *("inpaint", "--mask m.png --object car"),
        "--objects FILE and --object NAME go together",
    ),
    "strength without guidance": (
        *("inpaint", "--mask m.png --strength 0.3"),
        "--strength and --window need",
    ),
    "box of no size": (
        *("inpaint", "--mask m.png --features_from a.bin --features_box3d 9 0 0 2 2 -1 0"),
        "a size above 0 on every axis, got .*-1",
    ),
    "no number": ("inpaint", "--mask m.png --num 0", "num must be at least 1"),
    "nothing missing": ("complete", "", "nothing is missing"),
    "all missing": ("complete", "--sector -180 180", "selects all"),
    "keep every beam": ("complete", "--keep_every 1", "2 to 8, .* 16 beams remain; got 1"),
    "device": ("vary", "--device tpu", "device 'tpu' cannot be used here"),
    "start": ("vary", "--start 0", "start must be a time above 0"),
    "one scan": ("mix", "--left a.bin --right a.bin", "nothing to mix: .*a.bin"),
    "one side": ("mix", "--left a.bin", "--left and --right, or a --layout"),
    "one frame": ("interpolate", "--frames 1", "at least 2"),
}


@pytest.mark.parametrize(("command", "more", "message"), REFUSED.values(), ids=list(REFUSED))
def test_bad_input_is_refused_before_networks_run(
    files, tmp_path, monkeypatch, command, more, message
):
    places = {"lib": files / "lib.safetensors", "a.bin": files / "a.bin"}
    for name, size in (("m.png", (64, 16)), ("other.png", (128, 32))):
        places[name] = tmp_path / name
        mask = Image.new("L", size)
        mask.putpixel((20, 8), 255)
        mask.save(places[name])
    words = [places.get(word, word) for word in more.split()]
    if command == "interpolate":
        words += ["--left", files / "a.bin", "--right", files / "b.bin"]
    elif command != "mix":
        words += ["--scan", files / "a.bin"]
    monkeypatch.setattr(SceneEditor, "encode", lambda *_: pytest.fail("a network ran"))
    with pytest.raises(ValueError, match=message):
        edit(files, command, tmp_path / "out", *words)
    assert not (tmp_path / "out").exists()


def test_an_interrupt_ends_in_one_line_and_leaves_nothing(files, tmp_path, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(SceneEditor, "vary", interrupted)
    with pytest.raises(SystemExit, match="130"):
        edit(files, "vary", tmp_path / "out", "--scan", files / "a.bin")
    error = capsys.readouterr().err
    assert error.endswith("r3dpa vary: stopped\n")
    assert not list((tmp_path / "out").rglob("*"))
    # Nothing is in the way of another edit.
    edit(files, "complete", tmp_path / "out", "--scan", files / "a.bin", "--keep_every", 2)


class TestScansAndCheckpoints:
    def refused(self, files, tmp_path, scan, message, ckpt="geometric", more=()):
        box = ["--scan", scan, "--box", -40, 40, -20, 0, *more]
        with pytest.raises(ValueError, match=message):
            edit(files, "inpaint", tmp_path / "out", *box, ckpt=ckpt)

    def test_a_scan_of_another_sensor(self, files, tmp_path):
        write_bin(tmp_path / "tilted.bin", read_scan(files / "a.bin", SENSOR)[:, [2, 1, 0, 3]])
        self.refused(files, tmp_path, tmp_path / "tilted.bin", r"tilted.bin: .*outside the field")

    def test_files_that_are_no_single_scan(self, files, tmp_path):
        points = read_scan(files / "a.bin")
        write_npz(tmp_path / "two.npz", {"x": points, "y": points})
        self.refused(files, tmp_path, tmp_path / "two.npz", r"holds 2 scans \(x, y\)")
        (tmp_path / "scan.pcd").write_bytes(b"VERSION")
        self.refused(files, tmp_path, tmp_path / "scan.pcd", "scan.pcd: is no scan")
        self.refused(files, tmp_path, tmp_path / "gone.bin", "gone.bin")

    def test_features_that_the_checkpoint_was_not_aligned_with(self, files, tmp_path):
        library = ["--objects", files / "lib.safetensors", "--object", "car"]
        self.refused(
            files, tmp_path, files / "a.bin", "'geometric'.*'waffleiron-s'", "waffleiron-s", library
        )
        self.refused(files, tmp_path, files / "a.bin", "without 3D features", "None", library)
