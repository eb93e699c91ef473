"""``r3dpa data simulate``, ``sensors``, ``sensor``, ``check``, ``view``, ``objects``, and so on."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_networks import SIT_ARGS

from lidarsim import Origin, Semantic, load_sensor, simulate
from lidarsim.scan_files import ScanError, read_scan, write_bin, write_npz, write_ply
from r3dpa import viz
from r3dpa.cli import main
from r3dpa.cli.data import objects, view
from r3dpa.cli.evaluate import realism
from r3dpa.editing.objects import ObjectLibrary
from r3dpa.features import GeometricFeatures
from r3dpa.geometry import share_outside_view, view_limits_deg

PICTURE = np.zeros((2, 2, 3), np.uint8)
CALIBRATION = "lasers: [{vert_correction: 0.02}, {vert_correction: -0.1}]"


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Four scans of two drives."""
    root = tmp_path_factory.mktemp("simulated")
    simulate(root, 4, drives=["0003", "0004"])
    return root


class TestSensors:
    """Presets, and a sensor estimated from scans."""

    def test_presets_are_listed_with_their_source(self, capsys):
        main(["data", "sensors"])
        lines = capsys.readouterr().out.splitlines()
        row = next(line for line in lines if line.startswith("hdl32e"))
        assert re.search(r"32 +2170 +\+10\.67 to -30\.67 +0\.9 to 100 +Datasheet", row)
        assert any(line.startswith("os1_128") for line in lines)

    def test_an_estimate_is_a_file_for_simulate_and_a_picture(self, simulated, tmp_path, capsys):
        out = tmp_path / "mine.yaml"
        main(["data", "sensor", str(simulated), "--out", str(out), "--num", "2"])
        text = capsys.readouterr().out
        assert re.search(r"beams +64 by the order +100%", text)
        assert re.search(r"columns +2083", text)
        assert re.search(r"\d% of the points of 2 scans .* range image of 64 x 2083", text)
        assert "note: a turn about z cannot be seen in a scan: x has to point forward" in text
        assert load_sensor(out).num_beams == 64
        with Image.open(tmp_path / "mine.png") as picture:
            assert picture.size[0] > 500

    def test_nothing_is_written_where_scans_are_refused(self, tmp_path):
        write_bin(tmp_path / "scan.bin", np.ones((10, 4), np.float32))
        with pytest.raises(ScanError, match="holds 10 of at least 16 points"):
            main(["sensor", str(tmp_path / "scan.bin"), "--out", str(tmp_path / "mine.yaml")])
        assert [path.name for path in tmp_path.iterdir()] == ["scan.bin"]

    @pytest.mark.parametrize("name", ["mine.yaml", "mine.png"])
    def test_an_existing_file_is_not_replaced(self, name, tmp_path):
        (tmp_path / name).write_text("mine")
        with pytest.raises(ValueError, match=rf"{name} exists: delete it, or give another --out$"):
            main(["sensor", str(tmp_path), "--out", str(tmp_path / "mine.yaml")])
        assert [path.name for path in tmp_path.iterdir()] == [name]
        assert (tmp_path / name).read_text() == "mine"


class TestSimulate:
    """One small scan each; what is asked for is recorded in the manifest."""

    @pytest.fixture
    def simulate(self, tmp_path):
        """``simulate(*words)``: manifest of a data set of one scan."""
        calibration = tmp_path / "lasers.yaml"
        calibration.write_text(CALIBRATION)
        out = tmp_path / "out"

        def run(*words):
            fixed = ["--out", out, "--scans", 1, "--sensor", calibration]
            main(["simulate", *map(str, [*fixed, *words])])
            return json.loads((out / "simulation.json").read_text())

        return run

    def test_options_of_both_kinds_reach_the_manifest_and_the_table(
        self, simulate, tmp_path, capsys
    ):
        config = tmp_path / "request.yaml"
        config.write_text(
            "seed: 3\ndrives: ['0003']\nweather: {visibility_m: 50}\n"
            "effects: {range_noise: off, soft_raydrop: on}\n"
        )
        words = ["--config", config, "--return_mode", "dual", "--weather.clear_sky", "false"]
        manifest = simulate(*words, "--effects.ego_occlusion=off")
        assert manifest["effects"] == {"ego_occlusion": "off", "range_noise": "off"}
        assert (manifest["seed"], manifest["drives"]) == (3, ["0003"])
        assert manifest["sensor"]["return_mode"] == "dual"
        assert manifest["sensor"]["lasers"]["inclination_rad"] == [0.02, -0.1]
        weather = manifest["weather"]
        assert (weather["visibility_m"], weather["clear_sky"]) == (50, False)
        assert weather["rain_mm_h"] == 0
        lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
        assert lines["range_noise"].split()[1:4] == ["0", "0", "1"]
        assert lines["range_noise"].endswith("switched off")
        assert lines["detection_limit"].split()[1:4] == ["1", "0", "0"]

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (["--effects.fogg", "off"], "unknown effect 'fogg'; choose from dual_return, "),
            (["--sensor", "hdl65e"], r"'hdl65e' \(did you mean 'hdl64e'\?\); choose"),
            (["--weather.rain_mm_h", "-1"], "^rain_mm_h must be 0 or greater, got -1"),
        ],
    )
    def test_wrong_options_of_simulate_are_named(self, simulate, words, message, tmp_path):
        with pytest.raises(ValueError, match=message):
            simulate(*words)
        assert not (tmp_path / "out").exists()


def check(root, capsys):
    """Exit status, and lines, of ``r3dpa data check``."""
    capsys.readouterr()
    status = 0
    try:
        main(["check", str(root)])
    except SystemExit as stop:
        status = stop.code
    return status, capsys.readouterr().out.splitlines()


def test_check_names_every_bad_scan(tmp_path, capsys):
    (tmp_path / "lasers.yaml").write_text(CALIBRATION)
    words = ["--scans", "3", "--drives", "0000", "0003", "--sensor", tmp_path / "lasers.yaml"]
    main(["simulate", "--out", str(tmp_path), *map(str, words)])
    truncated, *_, infinite = sorted(tmp_path.rglob("data/*.bin"))
    status, lines = check(tmp_path, capsys)
    assert status == 0
    assert "3 scans in 2 drives, all usable" in lines[-1]
    assert all(" 2 beams by order, " in line for line in lines[:3]), lines
    truncated.write_bytes(truncated.read_bytes()[:-3])
    points = read_scan(infinite)
    points[1, 2] = np.inf
    infinite.write_bytes(points.tobytes())
    status, lines = check(tmp_path, capsys)
    assert status == 1
    bad = [line.split(": ")[1] for line in lines if line.startswith("bad: ")]
    assert bad == [str(truncated), str(infinite)]


def test_check_says_the_columns_and_beams_of_other_formats(tmp_path, capsys):
    azimuth = np.linspace(0, 6.2, 100)
    rows = [[5 * np.cos(a), 5 * np.sin(a), z, 0.5, z] for z in (2, 1, 0) for a in azimuth]
    np.save(tmp_path / "a.npy", np.array(rows, "f4"))
    (tmp_path / "a.pcd.bin").write_bytes(np.array(rows, "f4").tobytes())
    status, lines = check(tmp_path, capsys)
    assert (status, len(lines)) == (0, 3)
    assert lines[-1] == f"{tmp_path}: 2 scans, all usable"
    for line in lines[:2]:
        assert "(x, y, z, intensity, ring), 300 points, range 5..5.385, intensity 0.5..0.5" in line
        assert line.endswith("3 beams by stored, 100% of the points sure")
    np.save(tmp_path / "b.npy", np.array(rows, "f4") * 100)
    status, lines = check(tmp_path, capsys)
    assert status == 1
    assert lines[2].startswith(f"bad: {tmp_path / 'b.npy'}: ranges have the median")
    assert lines[-1] == f"{tmp_path}: 3 scans, problems: 1"


class TestCheck:
    """What is no scan, what is skipped, and frames."""

    def test_scans_in_millimetres_and_of_few_points_are_bad(self, tmp_path, capsys):
        for number in range(6):  # more than are described
            write_bin(tmp_path / f"{number}.bin", 1000 * points(seed=number) * [1, 1, 1, 0])
        write_bin(tmp_path / "few.bin", points()[:10])
        status, lines = check(tmp_path, capsys)
        assert status == 1
        bad = [line for line in lines if line.startswith("bad: ")]
        assert len(bad) == 7
        for line in bad[:6]:
            assert "which are no metres: divide the coordinates, by 100 or 1000" in line
        assert bad[6].endswith("few.bin: holds 10 of at least 16 points; remove it")
        assert lines[-1].endswith("7 scans in 1 drive, problems: 7")

    def test_what_prevents_a_description_is_a_problem(self, tmp_path, capsys):
        write_bin(tmp_path / "a.bin", points())
        (tmp_path / "a.label").write_bytes(bytes(12))
        status, lines = check(tmp_path, capsys)
        assert status == 1
        assert sum("a.label: holds 3 labels but" in line for line in lines) == 1
        assert lines[-1].endswith("problems: 1")

    @pytest.mark.parametrize(
        ("name", "says"),
        [
            ("gone", "gone: is no folder and no file; can be read: .bin, "),
            ("empty", "empty: is an empty folder; can be read: .bin, "),
            ("texts", "texts: is no folder with scans, it holds 1 other files, such as a.csv; can"),
            ("texts/a.csv", "a.csv: is of no known format; can be read: .bin, "),
        ],
    )
    def test_formats_that_can_be_read_are_said(self, name, says, tmp_path, capsys):
        (tmp_path / "empty").mkdir()
        (tmp_path / "texts").mkdir()
        (tmp_path / "texts/a.csv").write_text("1,2,3")
        status, lines = check(tmp_path / name, capsys)
        assert status == 1
        assert lines[0].startswith("bad: ")
        assert says in lines[0]
        assert not any("missing: " in line or "skipped " in line for line in lines)
        assert name == "gone" or re.search(r": [01] scans?, problems: 1$", lines[-1])

    def test_skipped_files_are_counted(self, simulated, tmp_path, capsys):
        scan = next(simulated.rglob("data/*.bin"))
        (tmp_path / "a.bin").write_bytes(scan.read_bytes())
        for name in ("a.csv", "b.csv", "c.pcd", "a.label", "readme.md"):
            (tmp_path / name).touch()
        (tmp_path / "a.label").unlink()
        status, lines = check(tmp_path, capsys)
        assert status == 0
        assert "skipped files: 2 .csv, 1 .pcd" in lines

    def test_points_at_the_origin_are_counted_and_have_no_beam(self, simulated, tmp_path, capsys):
        scan = read_scan(next(simulated.rglob("data/*.bin")))
        scan[::5] = 0
        write_bin(tmp_path / "a.bin", scan)
        status, lines = check(tmp_path, capsys)
        assert status == 0
        assert (
            "20.0% of the points at (0, 0, 0), 64 beams by order, 100% of the points sure"
            in lines[0]
        )

    def test_the_frame_of_a_vehicle_is_noticed(self, simulated, tmp_path, capsys):
        points = read_scan(next(simulated.rglob("data/*.bin")))
        for name, height in (("sensor", 0), ("vehicle", 1.73)):
            write_bin(tmp_path / f"{name}.bin", points + np.float32([0, 0, height, 0]))
        _, lines = check(tmp_path, capsys)
        (note,) = [line for line in lines if line.startswith("note: ")]
        assert "vehicle.bin: its ground lies at z = " in note

    def test_beams_after_weather_are_those_of_before(self, simulated, tmp_path, capsys):
        scan = next(simulated.rglob("data/*.bin"))
        words = ["--out", str(tmp_path / "out"), "--weather.visibility_m", "40", "--show", "0"]
        main(["weather", str(scan), *words])
        _, lines = check(tmp_path / "out", capsys)
        assert ", 64 beams by order, " in lines[0]

    def test_named_columns(self, tmp_path, capsys):
        rows = np.concatenate([points(), np.zeros((200, 2), np.float32)], axis=1)
        rows.tofile(tmp_path / "a.bin")
        status, lines = check(tmp_path, capsys)
        assert status == 1
        assert "rather of 6 columns: name the columns with --columns" in "".join(lines)
        columns = ["--columns", "x,y,z,intensity,ring,time"]
        apart = ["--columns", "x,", "y,", "z,", "intensity,", "ring,", "time"]
        for words in (
            [*columns, str(tmp_path)],
            [str(tmp_path), *columns],
            [str(tmp_path), *apart],
        ):
            main(["check", *words])
            assert "(x, y, z, intensity, ring, time), 200 points" in capsys.readouterr().out


class TestObjects:
    def test_writes_a_library_and_says_what_it_holds(self, simulated, tiny_file, tmp_path):
        out = tmp_path / "objects.safetensors"
        text = objects(data=str(simulated), ckpt=tiny_file, out=out, device="cpu")
        library = ObjectLibrary.load(out)
        assert {"road", "car"} <= set(library.names)
        assert library.source == GeometricFeatures.name
        library.check_source("geometric", SIT_ARGS["feature_dim"])
        for name in library.names:
            assert name in text
        assert "4 scans" in text

    def test_an_object_library_of_another_format_is_refused(self, simulated, tiny_file, tmp_path):
        with pytest.raises(
            ValueError, match=r"\.safetensors or \.objects file, got .*objects\.npz"
        ):
            objects(data=str(simulated), ckpt=tiny_file, out=tmp_path / "objects.npz")


class TestRealism:
    def test_folders_are_compared_drive_by_drive(self, simulated, tmp_path, capsys):
        out = tmp_path / "realism.json"
        words = ["--scans", simulated, "--reference", simulated, "--out", out]
        main(["realism", *map(str, words)])
        rows = json.loads(out.read_text())["rows"]
        assert "A: 4 scans of 2 drives, 2 each" in capsys.readouterr().out
        assert all(row["pooled"] == 0 for row in rows)
        # Two drives: pairs (0, 0), (0, 1), (1, 0), (1, 1), so the median is half the floor. Numbers
        # of rows have a floor of 1.
        halves = [row for row in rows if row["floor"] and row["unit"] != "rows"]
        assert len(halves) > 20
        assert all(row["ratio"] == pytest.approx(0.5) for row in halves)
        assert rows[0]["name"] == "returns per scan"
        assert list(tmp_path.iterdir()) == [out]

    def test_a_single_drive_gives_no_floor(self, simulated):
        drive = next(simulated.glob("data_3d_raw/*0003*"))
        table = realism(scans=drive, reference=drive)
        assert all(math.isnan(row.floor) for row in table.rows)
        assert "there is no floor" in str(table)

    def test_a_scan_of_the_wrong_intensity_is_named(self, simulated, tmp_path):
        write_bin(tmp_path / "raw.bin", np.float32([[10, 0, 0, 255]]))
        with pytest.raises(ScanError, match=r"raw\.bin: has intensities up to 255 .* not 0\.\.1"):
            realism(scans=tmp_path, reference=simulated)


def points(num_points=200, seed=0):
    generator = np.random.default_rng(seed)
    scale = np.array([20, 20, 1, 0])
    return (generator.uniform(-1, 1, (num_points, 4)) * scale).astype(np.float32)


class TestView:
    @pytest.fixture
    def drive(self, tmp_path) -> Path:
        """A drive in the KITTI-360 layout with one scan, its labels and its origins."""
        folder = tmp_path / "root/data_3d_raw/2013_05_28_drive_0003_sync/velodyne_points"
        write_bin(folder / "data" / "0000000004.bin", points())
        for name in ("labels", "origins"):
            (folder / name).mkdir()
        labels = np.full(200, int(Semantic.CAR) | 3 << 16, "<u4")
        (folder / "labels" / "0000000004.label").write_bytes(labels.tobytes())
        origins = np.full(200, int(Origin.RAIN), np.uint8)
        (folder / "origins" / "0000000004.origin").write_bytes(origins.tobytes())
        return folder

    def show(self, source, out):
        """Printed text, and the data of the written page."""
        text = view(source, out=out)
        page = (out / "view.html").read_text("utf-8")
        found = json.loads(re.search(r'id="page">(.*?)</script>', page, re.DOTALL)[1])
        return text, found, [header["name"] for header in found["scans"]]

    def test_writes_two_pictures_and_a_page_and_prints_their_paths(self, drive, tmp_path):
        out = tmp_path / "new" / "out"
        text, page, names = self.show(tmp_path / "root", out)
        written = ["birds_eye.png", "range_images.png", "view.html"]
        assert sorted(path.name for path in out.iterdir()) == written
        for name in written:
            assert str(out / name) in text.splitlines()
        for name in written[:2]:
            assert np.asarray(Image.open(out / name)).std() > 10
        assert names == ["2013_05_28_drive_0003_sync/0000000004"]
        assert {"semantic", "instance", "origin"} < set(page["scans"][0]["columns"])
        assert [row[:2] for row in page["categories"]["semantic"]] == [[int(Semantic.CAR), "car"]]
        assert [row[:2] for row in page["categories"]["origin"]] == [[int(Origin.RAIN), "rain"]]

    def test_a_file_of_several_scans_in_a_folder_is_named(self, tmp_path):
        np.savez(tmp_path / "two.npz", a=points(), b=points())
        with pytest.raises(ScanError, match=r"two\.npz: holds 2 scans: give the file alone"):
            view(tmp_path, out=tmp_path / "out")

    def test_labels_of_semantic_kitti_are_shown(self, tmp_path):
        write_bin(tmp_path / "velodyne" / "0.bin", points())
        (tmp_path / "labels").mkdir()
        (tmp_path / "labels" / "0.label").write_bytes(np.full(200, 10, "<u4").tobytes())  # cars
        _, page, _ = self.show(tmp_path, tmp_path / "out")
        assert [row[1] for row in page["categories"]["semantic"]] == ["car"]

    def test_labels_of_another_number_than_the_points_are_refused(self, drive, tmp_path):
        (drive / "labels/0000000004.label").write_bytes(bytes(798))
        with pytest.raises(ValueError, match=r"\.label: holds 199\.5 labels but .* 200 points"):
            self.show(drive, tmp_path / "out")
        assert not (tmp_path / "out").exists()

    def test_shown_scans_are_spread_evenly_over_a_folder(self, tmp_path, monkeypatch, capsys):
        """The default folder is named after the source."""
        monkeypatch.chdir(tmp_path)
        for number in range(10):
            write_bin(tmp_path / "scans" / f"{number:03d}.bin", points(seed=number))
        main(["view", "scans", "--num", "4"])
        assert capsys.readouterr().out.startswith("4 of 10 scans")
        page = (tmp_path / "view" / "scans" / "view.html").read_text("utf-8")
        assert re.findall(r"scans/\d{3}", page) == [
            f"scans/{number:03d}" for number in (0, 2, 5, 7)
        ]

    def test_ply_and_npz_files_are_scans_too(self, tmp_path):
        write_ply(tmp_path / "one.ply", points()[:, :3])
        write_npz(tmp_path / "many.npz", {"a": points(), "b": points()[:, :3]}.items())
        assert self.show(tmp_path / "one.ply", tmp_path / "ply")[2] == [f"{tmp_path.name}/one"]
        assert self.show(tmp_path / "many.npz", tmp_path / "npz")[2] == ["many/a", "many/b"]

    def test_labels_beside_a_scan_of_any_format_are_shown(self, tmp_path):
        write_ply(tmp_path / "a.ply", points())
        (tmp_path / "a.label").write_bytes(np.full(200, int(Semantic.CAR), "<u4").tobytes())
        _, page, _ = self.show(tmp_path / "a.ply", tmp_path / "out")
        assert [row[1] for row in page["categories"]["semantic"]] == ["car"]

    def test_a_scan_of_another_sensor_fills_its_picture(self, tmp_path, monkeypatch):
        """A sensor that looks up by 45 degrees, and as far as 100 m."""
        seen = []
        monkeypatch.setattr(viz, "range_strips", lambda *given: seen.append(given) or PICTURE)
        scan = np.random.default_rng(0).uniform(1, 70, (5000, 3))
        scan[:, 2] = np.hypot(scan[:, 0], scan[:, 1]) * np.linspace(0, 1, 5000)
        write_ply(tmp_path / "a.ply", scan)
        _, page, _ = self.show(tmp_path / "a.ply", tmp_path / "out")
        ((_, projection),) = seen
        assert share_outside_view(torch.from_numpy(scan), projection) == 0
        low_deg, high_deg = view_limits_deg(projection)
        assert -1 < low_deg < high_deg < 46
        farthest_m = np.linalg.norm(scan, axis=1).max()
        assert 0.9 * farthest_m < page["scales"]["range"]["high"] < farthest_m + 1

    @pytest.mark.parametrize("name", ["a.bin", "a.npz"])
    def test_scans_in_millimetres_are_refused(self, name, tmp_path):
        scan = 1000 * points()[:, :3]
        write = write_bin if name == "a.bin" else lambda path, scan: write_npz(path, [("a", scan)])
        write(tmp_path / name, scan)
        with pytest.raises(ScanError, match=r"a\.\w+: .*which are no metres: divide the coord"):
            view(tmp_path / name, out=tmp_path / "out")
        assert not (tmp_path / "out").exists()

    def test_refuses_what_it_cannot_show(self, tmp_path):
        (tmp_path / "notes.txt").write_text("no scan")
        (tmp_path / "damaged.npz").write_bytes(b"")
        np.savez(tmp_path / "counts.npz", counts=np.zeros(3))
        np.savez(tmp_path / "empty.npz")
        for name, message in (
            ("notes.txt", r"notes.txt: is of no known format; can be read: .bin, "),
            ("absent", "no scan found"),
            ("damaged.npz", r"damaged\.npz: is damaged or no \.npz file"),
            ("counts.npz", r"counts\.npz: holds float64 of shape \(3,\), not rows"),
            ("empty.npz", r"empty\.npz: holds no scan"),
        ):
            with pytest.raises(ValueError, match=message):
                view(tmp_path / name, out=tmp_path / "out")
