"""``r3dpa edit``: files that its commands write, and what they refuse before networks run."""

import json
import multiprocessing
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_labelled import labelled_checkpoint
from tiny_networks import GEOMETRY, tiny_checkpoint

from lidarsim import simulate
from lidarsim.clouds import read_cloud
from r3dpa import viz
from r3dpa.cli import main
from r3dpa.data import read_scan, write_bin, write_npz, write_ply
from r3dpa.data.labels import read_labels
from r3dpa.editing import SceneEditor
from r3dpa.editing.objects import ObjectLibrary
from r3dpa.geometry import (
    points_of,
    project_pixels,
    range_image,
)
from r3dpa.scene_files import edits
from r3dpa.scene_files.options import EditOptions

PROJECTION = GEOMETRY.projection
SENSOR = PROJECTION.sensor


def checkpoint(folder, feature_source="geometric"):
    return tiny_checkpoint(
        folder / f"{feature_source}.safetensors",
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


def test_edits_take_16_steps_by_default(files, tmp_path):
    options = EditOptions(out=tmp_path, ckpt=files / "geometric.safetensors", device="cpu")
    assert edits.EditSession(options, 1).settings.steps == 16


class TestFiles:
    def test_inpaint_writes_everything_and_leaves_the_rest_of_the_scan(
        self, files, tmp_path, request
    ):
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
        assert sorted(about["draws"]) == [0, 1]
        assert about["likeness"] == sorted(about["likeness"], reverse=True)
        page = (tmp_path / "o" / "edit.html").read_text()
        assert "before: scan a" in page
        assert "inpaint 1" in page

        request.getfixturevalue("no_sheet")  # from here on
        # More draws are sorted anew, so they do not go on from these.
        with pytest.raises(ValueError, match="sorted_of"):
            edit(files, "inpaint", tmp_path / "o", *scan, *library, num=3)

        # An object is moved into its box, at the step to t = 0.5, and its points there are counted.
        box = ["--scan", files / "a.bin", "--box3d", 12, 0, -0.5, 4, 4, 3, 0]
        about = edit(files, "inpaint", tmp_path / "box", *box, *library)
        assert about["nfe"] == 8 + 1
        assert len(about["points_inside"]) == 2
        assert about["points_of_class"] is None  # geometric features know no classes
        assert edit(files, "inpaint", tmp_path / "anew", *box, num=1)["nfe"] == 8

        # Without --objects, the library beside the weights.
        beside = files / "geometric.objects"
        with pytest.raises(FileNotFoundError, match=r"no object features .*geometric\.objects"):
            edit(files, "inpaint", tmp_path / "beside", *scan, "--object", "car")
        beside.write_bytes((files / "lib.safetensors").read_bytes())
        about = edit(files, "inpaint", tmp_path / "beside", *scan, "--object", "car")
        assert about["objects"] == str(beside)
        assert np.array_equal(np.load(tmp_path / "beside" / "range_m.npy"), made.numpy())
        beside.unlink()

        # The mask that was written is one that can be read.
        again = ["--scan", files / "a.bin", "--mask", tmp_path / "o" / "mask.png"]
        edit(files, "inpaint", tmp_path / "again", *again, *library)
        assert np.array_equal(np.load(tmp_path / "again" / "range_m.npy"), made.numpy())
        # A second edit leaves nothing of the first.
        edit(files, "vary", tmp_path / "again", "--scan", files / "a.bin", "--overwrite")
        assert not (tmp_path / "again" / "mask.png").exists()

    def test_draws_keep_their_order_without_weights_of_the_source(self, files, no_sheet, tmp_path):
        checkpoint(tmp_path, "scalr")
        library = ObjectLibrary.load(files / "lib.safetensors")
        replace(library, extractor={"name": "scalr"}).save(tmp_path / "scalr.objects")
        box = ["--scan", files / "a.bin", "--box", "-40", "40", "-20", "0", "--object", "car"]
        about = edit(tmp_path, "inpaint", tmp_path / "o", *box, ckpt="scalr")
        assert about["draws"] is about["likeness"] is None
        assert len(about["cosine"]) == 2

    def test_labels_beside_a_scan_stay_outside_of_the_mask(self, files, no_sheet, tmp_path):
        labelled_checkpoint(tmp_path)
        path = sorted((files / "data").rglob("data/*.bin"))[0]
        box = ["--scan", path, "--box", "-40", "40", "-20", "0"]
        edit(tmp_path, "inpaint", tmp_path / "o", *box, num=1, ckpt="labelled")
        points = torch.from_numpy(read_scan(path))
        labels = torch.from_numpy(read_labels(path, len(points)))
        before = project_pixels(points, PROJECTION, labels)
        after = project_pixels(
            torch.from_numpy(read_scan(tmp_path / "o/bin/000000.bin")),
            PROJECTION,
            torch.from_numpy(np.fromfile(tmp_path / "o/labels/000000.label", "<u4").astype(int)),
        )
        kept = torch.from_numpy(np.asarray(Image.open(tmp_path / "o/mask.png")) == 0)
        assert (before.classes[kept] >= 0).any()
        assert torch.equal(after.classes[kept], before.classes[kept])

    def test_named_columns_of_a_scan(self, files, no_sheet, tmp_path):
        points = read_scan(files / "a.bin")
        rows = np.column_stack([points, -points[:, :2]])
        (tmp_path / "six.bin").write_bytes(rows.tobytes())
        words = ["--start", 0.3]
        edit(files, "vary", tmp_path / "four", "--scan", files / "a.bin", *words)
        words += ["--columns", "x,y,z,intensity,u,v"]
        edit(files, "vary", tmp_path / "six", "--scan", tmp_path / "six.bin", *words)
        four, six = (np.load(tmp_path / name / "range_m.npy") for name in ("four", "six"))
        assert np.array_equal(four, six)

    def test_mix_of_two_scans(self, files, no_sheet, tmp_path):
        sides = ["--left", files / "a.bin", "--right", files / "b.bin", "--split", "30"]
        about = edit(files, "mix", tmp_path / "sides", *sides)
        assert list(about["scans"]) == ["0: a", "1: b"]
        assert np.load(tmp_path / "sides" / "range_m.npy").shape == (2, 16, 64)
        mask = np.asarray(Image.open(tmp_path / "sides" / "mask.png"))
        assert set(np.unique(mask)) == {0, 255}

    def test_vary_and_interpolate(self, files, no_sheet, tmp_path):
        about = edit(files, "vary", tmp_path / "v", "--scan", files / "a.bin", "--start", 0.3)
        assert about["nfe"] == 4
        assert "strength" not in about["settings"]
        ends = ["--left", files / "a.bin", "--right", files / "b.bin", "--frames", 3]
        about = edit(files, "interpolate", tmp_path / "i", *ends)
        assert np.load(tmp_path / "i" / "range_m.npy").shape == (3, 16, 64)
        assert not (tmp_path / "i" / "mask.png").exists()


@pytest.fixture
def forked_workers(monkeypatch, one_thread):
    """Workers that need not import torch; they are spawned in test_simulation_drives.py."""
    fork = multiprocessing.get_context("fork")
    monkeypatch.setattr("lidarsim.io.multiprocessing.get_context", lambda _: fork)


def missing_of(out):
    return torch.from_numpy(np.asarray(Image.open(out / "mask.png")) > 0)


@pytest.mark.usefixtures("no_sheet")
class TestComplete:
    def test_errors_are_measured_where_returns_were_left_out(self, files, tmp_path, capsys):
        out, more = tmp_path / "out", ["--keep_every", 2, "--sector", 170, -170]
        about = edit(files, "complete", out, "--scan", files / "one.npz", *more, num=1)
        image, missing = torch.from_numpy(np.load(out / "range_m.npy"))[0], missing_of(out)
        assert missing[1::2].all()
        assert missing[:, [0, 63]].all()
        assert image[~missing].equal(images(files)[~missing])
        assert set(about["held_out"]) == {"completed", "nearest", "linear"}
        linear, nearest = (about["held_out"][how]["mae_m"] for how in ("linear", "nearest"))
        assert linear < nearest
        text = capsys.readouterr().out
        assert (
            f"linear interpolation {linear:.2f} m, nearest beam or column {nearest:.2f} m" in text
        )

    def test_empty_beams_are_filled_and_nothing_else_is_lost(self, files, tmp_path, capsys):
        """Of every second beam no point is in the file; the others come back bit for bit."""
        sparse = images(files)
        sparse[1::2] = -1
        write_ply(tmp_path / "sparse.ply", points_of(sparse, PROJECTION))
        out = tmp_path / "out"
        edit(files, "complete", out, "--scan", tmp_path / "sparse.ply", "--empty_beams", num=1)
        assert missing_of(out)[1::2].all()
        given = read_cloud(tmp_path / "sparse.ply").points
        completed = read_cloud(out / "scans/sparse.ply").points
        assert completed[: len(given)].tobytes() == given.tobytes()
        assert len(completed) > 1.5 * len(given)
        image = torch.from_numpy(np.load(out / "range_m.npy"))[0]
        added = torch.where(sparse > 0, -1.0, image)
        assert np.array_equal(completed[len(given) :], points_of(added, PROJECTION).numpy())
        assert "no return was held out; on 30 real scans" in capsys.readouterr().out

    def test_points_come_back_with_every_column_and_beyond_the_range(self, files, tmp_path):
        """Columns of nuScenes, intensities to 255, a point at 90 m, one above the view, labels."""
        points = read_scan(files / "a.bin")
        sparse = points[PROJECTION.pixel_of(torch.from_numpy(points[:, :3]))[0] % 2 == 0]
        rows = np.column_stack([sparse, np.arange(len(sparse)) % 32]).astype(np.float32)
        rows[:, 3] = np.round(255 * rows[:, 3])
        rows[7, :3], rows[8, :3] = (90, 0, 0), (5, 0, 5)
        (tmp_path / "scan.pcd.bin").write_bytes(rows.tobytes())
        labels = np.arange(len(rows), dtype="<u4")
        (tmp_path / "scan.label").write_bytes(labels.tobytes())
        words = ["--scan", tmp_path / "scan.pcd.bin", "--empty_beams"]
        edit(files, "complete", tmp_path / "out", *words, num=2)
        for number in range(2):
            path = tmp_path / "out" / "scans" / str(number) / "scan.pcd.bin"
            completed = np.fromfile(path, "<f4").reshape(-1, 5)
            assert completed[: len(rows)].tobytes() == rows.tobytes()
            assert len(completed) > len(rows)
            added = completed[len(rows) :, 3]
            assert added.max() > 1  # in the units of the file
            written = np.fromfile(path.with_name("scan.label"), "<u4")
            assert np.array_equal(written[: len(rows)], labels)
            assert not written[len(rows) :].any()

    def test_generated_points_have_intensities_of_the_scan(self, files, tmp_path):
        """A model knows those of its own sensor; the scan is of one that sees everything dim."""
        labelled_checkpoint(tmp_path)
        points = read_scan(files / "a.bin")
        points[:, 3] = 0.02
        write_bin(tmp_path / "dim.bin", points)
        words = ["--scan", tmp_path / "dim.bin", "--sector", -90, 90]
        edit(tmp_path, "complete", tmp_path / "out", *words, num=1, ckpt="labelled")
        completed = read_scan(tmp_path / "out/scans/dim.bin")
        assert len(completed) > len(points)
        assert np.ptp(completed[:, 3]) == 0

    @pytest.mark.usefixtures("forked_workers")
    def test_a_folder_is_completed_alike_by_any_number_of_workers(self, files, tmp_path):
        for drive, name in (("x", "a"), ("y", "b"), ("y", "a")):
            write_bin(tmp_path / "in" / drive / f"{name}.bin", read_scan(files / f"{name}.bin"))
        written = []
        for workers in (1, 2):
            out = tmp_path / str(workers)
            words = ["--scan", tmp_path / "in", "--keep_every", 4, "--workers", workers]
            about = edit(files, "complete", out, *words, num=1)
            assert about["scans"] == ["x/a.bin", "y/a.bin", "y/b.bin"]
            assert set(about["held_out_by_scan"]) == set(about["scans"])
            written.append([(out / "scans" / name).read_bytes() for name in about["scans"]])
            written[-1].append(np.load(out / "range_m.npy").tobytes())
        assert written[0] == written[1]
        assert written[0][0] == written[0][1] != written[0][2]

    def test_another_sensor_has_the_same_columns_and_half_of_the_beams(self, files, tmp_path):
        more = ["--scan", files / "a.bin", "--other_sensor", "[8, -25, 3]"]
        about = edit(files, "complete", tmp_path / "o", *more, num=1)
        missing = missing_of(tmp_path / "o")
        assert missing.all(dim=1).sum() == missing.any(dim=1).sum() == 8
        assert about["other_sensor"] == [8, -25.0, 3.0]

    def test_a_scan_of_fewer_beams_is_told_of_the_option(self, files, tmp_path):
        sparse = images(files)
        sparse[1::2] = -1
        write_ply(tmp_path / "sparse.ply", points_of(sparse, PROJECTION))
        words = ["--scan", tmp_path / "sparse.ply", "--sector", 0, 30]
        with pytest.raises(ValueError, match="which `r3dpa edit complete --empty_beams` fills"):
            edit(files, "complete", tmp_path / "o", *words)


REFUSED = [
    ("inpaint", "", "one of --box, --box3d and --mask"),
    ("inpaint", "--mask m.png --objects lib.safetensors", "--objects FILE needs --object NAME"),
    ("inpaint", "--mask m.png --strength 0.3", "--strength, --window and --fe.* need"),
    ("inpaint", "--mask m.png --features_ckpt f.pth", "--strength, --window and --fe.* need"),
    (
        "inpaint",
        "--ckpt waffleiron-s.safetensors --mask m.png --objects lib.safetensors --object car",
        "'geometric'.*'waffleiron-s'",
    ),
    ("complete", "", "nothing is missing"),
    ("complete", "--keep_every 1", "2 to 8, got 1"),
    ("complete", "--keep_every 2 --start 3", "start must be a time above 0 .* got 3"),
    ("inpaint", "--mask m.png --start 0", "start must be a time above 0 .* got 0"),
    ("inpaint", "--mask m.png --dilation -1", "dilation must be 0 or greater, got -1"),
    ("inpaint", "--mask m.png --dilation 99", "tokens with any of their .* pixels selected"),
    ("vary", "--start 2", "start must be a time above 0 .* got 2"),
    ("vary", "--device tpu", "device 'tpu' cannot be used here"),
    ("vary", "--scan tilted.bin", r"tilted.bin: .*outside the field"),
    ("vary", "--scan two.npz", "must hold one scan.*its arrays are x, y"),
    ("vary", "--scan gone.bin", "gone.bin"),
    ("interpolate", "--left a.bin --right b.bin --num 1", "--num must be at least 2"),
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
    # Nor has --overwrite taken away what an earlier edit wrote.
    earlier = tmp_path / "earlier"
    earlier.mkdir()
    (earlier / "metadata.json").write_text('{"num": 1, "nfe": 1}')
    with pytest.raises(ValueError, match=message):
        edit(files, command, earlier, *scan, "--overwrite", *more.split())
    assert [path.name for path in earlier.iterdir()] == ["metadata.json"]


@pytest.mark.usefixtures("no_sheet")
@pytest.mark.parametrize("changed", ["a.bin", "m.png"])
@pytest.mark.parametrize("command", ["inpaint", "complete"])
def test_no_scene_is_added_to_those_of_other_inputs(files, tmp_path, command, changed):
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    for name in ("a.bin", "m.png"):
        (source / name).write_bytes((files / name).read_bytes())
    scan = source / "a.bin" if command == "inpaint" else source
    words = ["--scan", scan, "--mask", source / "m.png"]
    edit(files, command, out, *words, num=1)
    (source / changed).touch()
    with pytest.raises(ValueError, match=rf"1 scenes of another request .*inputs.*{changed}"):
        edit(files, command, out, *words, num=2)


@pytest.mark.parametrize("command", ["vary", "complete --keep_every 2"])
def test_no_edit_writes_into_the_folder_of_its_scans(files, tmp_path, command):
    write_bin(tmp_path / "scans" / "a.bin", read_scan(files / "a.bin"))
    name, *more = command.split()
    with pytest.raises(ValueError, match=r"scans/a\.bin lies in --out .*: give another folder"):
        edit(files, name, tmp_path, "--scan", tmp_path / "scans/a.bin", "--overwrite", *more)
    assert (tmp_path / "scans" / "a.bin").exists()


def test_a_folder_is_not_completed_into_itself(files, tmp_path):
    """The next run would take the completed scans for scans to complete."""
    for name in ("a.bin", "b.bin"):
        write_bin(tmp_path / name, read_scan(files / name))
    with pytest.raises(ValueError, match=r"--out .*done is the folder of the scans, or in it"):
        edit(files, "complete", tmp_path / "done", "--scan", tmp_path, "--keep_every", 2, num=1)
    assert not (tmp_path / "done").exists()


@pytest.mark.parametrize(
    "words",
    [
        "mix --left a.bin --right b.bin --out o",
        "inpaint --scan a.bin --object car --mask m.png --out o",
        "objects --data data --out o.safetensors",
    ],
)
def test_a_model_without_features_is_refused_before_anything_is_loaded(files, monkeypatch, words):
    monkeypatch.chdir(files)
    monkeypatch.setattr("r3dpa.checkpoints.files.load_file", lambda *_: pytest.fail("loaded"))
    monkeypatch.setattr(edits, "read_checkpoint", lambda *_: pytest.fail("loaded"))
    with pytest.raises(ValueError, match=r"None.safetensors was trained without 3D features"):
        main([*words.split(), "--ckpt", "None.safetensors"])


@pytest.mark.parametrize(
    ("command", "more", "line"),
    [
        ("vary", (), "r3dpa vary: stopped\n"),
        (
            "complete",
            ("--keep_every", 2),
            "r3dpa complete: stopped; the same command continues\n",
        ),
    ],
)
def test_an_interrupt_ends_in_one_line_and_leaves_nothing(
    files, tmp_path, monkeypatch, capsys, command, more, line
):
    """Nothing of the first scan; completions go on with the scan after the last finished one."""

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(SceneEditor, command, interrupted)
    with pytest.raises(SystemExit, match="130"):
        edit(files, command, tmp_path / "out", "--scan", files / "a.bin", *more)
    assert capsys.readouterr().err.endswith(line)
    assert not list((tmp_path / "out").rglob("*"))
