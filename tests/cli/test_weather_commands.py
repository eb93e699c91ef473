"""``r3dpa data weather`` and ``data corrupt`` on files and folders."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from lidarsim import Simulator, load_sensor
from lidarsim.scan_files import ScanError
from r3dpa.cli import main

FOG = ["--weather.visibility_m", "40"]


@pytest.fixture(scope="module")
def drive():
    """A simulated scan of 32 beams."""
    return Simulator(seed=1, sensor=load_sensor("hdl32e")).scan(0)


@pytest.fixture(scope="module")
def folder(drive, tmp_path_factory):
    """Three scans in two folders, with labels."""
    root = tmp_path_factory.mktemp("scans")
    for number, place in enumerate(("a/velodyne/0.bin", "a/velodyne/1.bin", "b/2.bin")):
        points, path = drive.points[number::3], root / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(points.tobytes())
    labels = root / "a/labels/0.label"
    labels.parent.mkdir()
    labels.write_bytes(drive.labels[::3].tobytes())
    return root


def weather(source, out, *words):
    main(["data", "weather", str(source), "--out", str(out), *map(str, words)])


def content(out):
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in out.rglob("*")
        if path.is_file()
    }


def report(out):
    return [json.loads(line) for line in (out / "report.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def foggy(folder, tmp_path_factory):
    """The three scans in fog."""
    out = tmp_path_factory.mktemp("foggy") / "out"
    weather(folder, out, *FOG)
    return out


class TestWeather:
    """Fog in a folder: files, report, page, and a run that was interrupted."""

    def test_kept_points_are_the_same_bytes_in_order_and_added_ones_last(self, folder, foggy):
        names = ["a/velodyne/0.bin", "a/velodyne/1.bin", "b/2.bin"]
        assert [line["scan"] for line in report(foggy)] == names
        for line in report(foggy):
            rows, old = (
                np.fromfile(root / line["scan"], "f4").reshape(-1, 4) for root in (foggy, folder)
            )
            num_lost, num_added = (sum(line[key].values()) for key in ("lost", "added"))
            assert num_lost > 0
            assert num_added > 0
            assert len(rows) == line["written"] == len(old) - num_lost + num_added
            places = {row.tobytes(): place for place, row in enumerate(old[:, :3])}
            kept = [places[row.tobytes()] for row in rows[: len(old) - num_lost, :3]]
            assert kept == sorted(kept)
            added = rows[len(old) - num_lost :]
            assert np.linalg.norm(added[:, :3], axis=1).max() < 40
            assert line["effects"]["fog"] == "visibility of 40 m"
            assert "4 columns of float32" in line["file"]
        labels = np.fromfile(foggy / "a/labels/0.label", "u4")
        assert len(labels) == report(foggy)[0]["written"]
        assert (labels[-num_added:] >= 0xFF00).any()

    def test_page_shows_scans_beside_their_results(self, foggy):
        text = (foggy / "scans.html").read_text()
        page = json.loads(re.search(r'id="page">(.*?)</script>', text, re.DOTALL)[1])
        assert page["shown"] == 3
        assert page["beside"] == [3, 4, 5]
        assert page["mode"] == "origin"
        named = {name for _, name, _ in page["categories"]["origin"]}
        assert {"surface", "fog", "lost"} <= named

    def test_page_of_a_repeated_command_shows_as_many_scans(self, folder, tmp_path):
        out = tmp_path / "out"
        for shown in (1, 2):
            weather(folder, out, *FOG, "--show", shown)
            text = (out / "scans.html").read_text()
            page = json.loads(re.search(r'id="page">(.*?)</script>', text, re.DOTALL)[1])
            assert page["shown"] == shown

    def test_an_interrupted_run_is_completed_to_the_same_bytes(self, folder, foggy, tmp_path):
        out = tmp_path / "out"
        weather(folder, out, *FOG)
        first, *_ = (out / "report.jsonl").read_text().splitlines(keepends=True)
        (out / ".unfinished.jsonl").write_text(first + '{"scan": "b/2.bin", "wr')
        (out / "report.jsonl").unlink()
        (out / "a/velodyne/1.bin").unlink()
        (out / "scans.html").unlink()
        (out / "b/.2.0123.partial.bin").touch()
        before = (out / "a/velodyne/0.bin").stat().st_mtime_ns
        weather(folder, out, *FOG)
        assert content(out) == content(foggy)
        assert (out / "a/velodyne/0.bin").stat().st_mtime_ns == before

    def test_finished_scans_are_kept_until_they_change(self, folder, tmp_path, capsys):
        source, out = tmp_path / "in", tmp_path / "out"
        source.mkdir()
        for name in "ab":
            (source / f"{name}.bin").write_bytes((folder / "b/2.bin").read_bytes())
        for expected in (2, 0):
            weather(source, out, *FOG)
            said = capsys.readouterr().out
            assert f"2 scans in {out}, {expected} of them written now" in said
            assert "intensity: 0..1, full scale 1, in 2 scans" in said
        time.sleep(0.01)
        (source / "b.bin").write_bytes((folder / "a/velodyne/1.bin").read_bytes())
        weather(source, out, *FOG)
        assert "1 of them written now" in capsys.readouterr().out

    def test_clear_air_gives_the_same_file(self, drive, tmp_path):
        names = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")]
        rows = "\n".join(" ".join(f"{v:.4f}" for v in row) for row in drive.points[:500])
        head = ["ply", "format ascii 1.0", "element vertex 500"]
        head += [f"property float {name}" for name, _ in names] + ["end_header", rows, ""]
        source = tmp_path / "a.ply"
        source.write_text("\n".join(head))
        weather(source, tmp_path / "out", "--show", 0, "--weather.sun_elevation_deg", -20)
        assert (tmp_path / "out/a.ply").read_bytes() == source.read_bytes()


@pytest.fixture
def pair(folder, tmp_path):
    """A finished run on ``in``: scan ``a`` with labels, and ``b`` without."""
    source = tmp_path / "in"
    source.mkdir()
    (source / "a.bin").write_bytes((folder / "a/velodyne/0.bin").read_bytes())
    (source / "a.label").write_bytes((folder / "a/labels/0.label").read_bytes())
    (source / "b.bin").write_bytes((folder / "b/2.bin").read_bytes())
    weather(source, tmp_path / "out", *FOG, "--show", 0)
    return source, tmp_path / "out"


def replace_in_place(path, data):
    """Another content with the time of the old one, as ``cp -p`` and ``tar`` leave older files."""
    before = path.stat()
    path.write_bytes(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns - 10**9))


def relabel(source, out):
    labels = np.fromfile(source / "a.label", "u4")
    (source / "a.label").write_bytes((labels ^ 1).tobytes())


CHANGES = {
    "older scan": lambda source, out: replace_in_place(
        source / "b.bin", (source / "a.bin").read_bytes()
    ),
    "other labels": relabel,
    "labels gone": lambda source, out: (source / "a.label").unlink(),
    "labels added": lambda source, out: (source / "b.label").write_bytes(
        bytes((source / "b.bin").stat().st_size // 4)
    ),
    "result of labels gone": lambda source, out: (out / "a.label").unlink(),
    "result cut": lambda source, out: os.truncate(out / "b.bin", 32),
}


@pytest.mark.parametrize("name", CHANGES)
def test_scans_and_results_that_have_changed_are_made_again(pair, tmp_path, capsys, name):
    source, out = pair
    CHANGES[name](source, out)
    capsys.readouterr()
    weather(source, out, *FOG, "--show", 0)
    assert "1 of them written now" in capsys.readouterr().out
    weather(source, tmp_path / "fresh", *FOG, "--show", 0)
    assert content(out) == content(tmp_path / "fresh")


def test_results_of_scans_that_are_gone_are_refused(pair, capsys):
    source, out = pair
    before = content(out)
    (source / "b.bin").unlink()
    with pytest.raises(ValueError, match=r"1 scan that .*in does not hold any more, .*out/b\.bin"):
        weather(source, out, *FOG)
    assert content(out) == before
    (out / "b.bin").unlink()
    weather(source, out, *FOG, "--show", 0)
    assert [line["scan"] for line in report(out)] == ["a.bin"]
    assert f"1 scan in {out}, 0 of them written now" in capsys.readouterr().out


def test_scans_one_by_one_share_a_report(pair, tmp_path):
    source, whole = pair
    for name in ("a.bin", "b.bin"):
        weather(source / name, tmp_path / "out", *FOG, "--show", 0)
    assert content(tmp_path / "out") == content(whole)


def test_results_of_another_folder_are_refused(pair, tmp_path):
    source, out = pair
    other = tmp_path / "other"
    other.mkdir()
    for name, swapped in (("a.bin", "b.bin"), ("b.bin", "a.bin")):
        (other / name).write_bytes((source / swapped).read_bytes())
        os.utime(other / name, (0, 0))
    before = content(out)
    with pytest.raises(ValueError, match=r"another request \(source '.*in' there, '.*other' now\)"):
        weather(other, out, *FOG)
    assert content(out) == before


def test_scans_that_share_labels_are_refused(pair, tmp_path):
    source, _ = pair
    np.save(source / "a.npy", np.fromfile(source / "a.bin", "f4").reshape(-1, 4)[::-1])
    out = tmp_path / "new"
    with pytest.raises(
        ScanError, match=r"a\.label: would be the labels of .*a\.bin and of .*a\.npy"
    ):
        weather(source, out, *FOG)
    assert not out.exists()
    weather(source / "a.bin", out, *FOG, "--show", 0)
    before = content(out)
    with pytest.raises(ScanError, match=r"a\.label: would be the labels of"):
        weather(source / "a.npy", out, *FOG)
    assert content(out) == before


def test_a_link_in_place_of_the_report_is_not_written_to(pair, tmp_path):
    source, out = pair
    victim = tmp_path / "victim.txt"
    victim.write_text("notes\n")
    (out / ".unfinished.jsonl").symlink_to(victim)
    (out / "b.bin").unlink()
    with pytest.raises(ValueError, match=r"\.unfinished\.jsonl is damaged .*: delete it"):
        weather(source, out, *FOG)
    assert victim.read_text() == "notes\n"


@pytest.mark.parametrize("is_fresh", [True, False])
def test_a_linked_folder_in_the_results_is_not_written_to(folder, tmp_path, is_fresh):
    """Neither a new scan, nor one whose result has another size."""
    out, private = tmp_path / "out", tmp_path / "private"
    weather(folder / "a", out, *FOG, "--show", 0)
    (out / "velodyne").rename(tmp_path / "moved")
    private.mkdir()
    if not is_fresh:
        (private / "0.bin").write_text("notes")
    (out / "velodyne").symlink_to(private)
    before = content(private)
    with pytest.raises(
        ScanError, match=r"velodyne/.\.bin: a link leads out of .*out; give another --out"
    ):
        weather(folder / "a", out, *FOG)
    assert content(private) == before


def test_faults_act_on_every_file(folder, tmp_path, capsys):
    words = ["--fault", "crosstalk", "--severity", "3", "--show", "1"]
    main(["corrupt", str(folder), "--out", str(tmp_path / "out"), *words])
    assert "moved: 1.00%" in capsys.readouterr().out
    for line in report(tmp_path / "out"):
        assert line["moved"] == round(0.01 * line["points"])


def test_a_scan_without_a_point_left_is_not_written(folder, tmp_path):
    words = ["--fault", "dropped_sectors", "--strength", "360"]
    with pytest.raises(ScanError, match=r"2\.bin: none of its \d+ points is left"):
        main(["corrupt", str(folder / "b"), "--out", str(tmp_path / "out"), *words])
    far = np.full((30, 4), 0.2, "f4") * [200, 200, 0, 1]
    (tmp_path / "far.bin").write_bytes(far.astype("f4").tobytes())
    with pytest.raises(ScanError, match=r"far\.bin: none of its 30 points is left"):
        weather(tmp_path / "far.bin", tmp_path / "out", "--weather.visibility_m", 1)
    assert not (tmp_path / "out").exists()


BAD = {
    "none": ([], "give an option such as --weather.visibility_m 60 or --weather.rain_mm_h 10"),
    "idle": (["--effects.range_noise", "on"], "no weather is given, so that scans would stay"),
    "none on": (["--effects.range_noise", "off"], "no weather is given, so that scans would stay"),
    "traffic": (["--weather.traffic_m_s", "20"], "throws up spray on a wet road only: give --wea"),
    "visibility": (["--weather.visibility_m", "0"], "visibility_m must be 1 or greater"),
    "negative": (["--weather.visibility_m", "-5"], "visibility_m must be 1 or greater"),
    "rain": (["--weather.rain_mm_h", "10000"], "rain_mm_h must be at most"),
    "effect": ([*FOG, "--effects.glass", "on"], "effect glass cannot act on a recorded scan"),
    "sensor": ([*FOG, "--instrument.sensor", "hdl99"], "'hdl99'; choose from hdl32e"),
    "columns": ([*FOG, "--columns", "x,y,i"], "not a multiple of 12 (x, y, i as float32)"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_requests_are_one_line_and_write_nothing(name, drive, tmp_path, capsys):
    words, message = BAD[name]
    source, out = tmp_path / "a.bin", tmp_path / "out"
    source.write_bytes(drive.points[:997].tobytes())
    with pytest.raises((ValueError, SystemExit)) as raised:
        weather(source, out, *words)
    said = capsys.readouterr().err or str(raised.value)
    assert message in said
    assert len(said.strip().splitlines()) == 1
    assert not out.exists()


def test_bad_scans_of_a_folder_are_named_and_the_others_done(folder, tmp_path):
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    (source / "good.bin").write_bytes((folder / "b/2.bin").read_bytes())
    (source / "empty.bin").touch()
    for _ in range(2):
        with pytest.raises(ScanError, match=r"empty\.bin: is empty \(1 of 2 scans cannot be used"):
            weather(source, out, *FOG)
        assert sorted(content(out)) == ["good.bin", "report.jsonl", "request.json"]
    (source / "empty.bin").unlink()
    weather(source, out, *FOG)
    assert [line["scan"] for line in report(out)] == ["good.bin"]


def test_intensities_of_zero_are_said_in_the_report(drive, tmp_path):
    points = drive.points * np.array([1, 1, 1, 0], "f4")
    (tmp_path / "a.bin").write_bytes(points.tobytes())
    weather(tmp_path / "a.bin", tmp_path / "out", *FOG, "--show", 0)
    assert "intensity is 0 throughout" in report(tmp_path / "out")[0]["intensity"]


def test_folders_that_must_not_be_written_to(folder, tmp_path):
    with pytest.raises(ValueError, match="is the folder of the scans, or in it"):
        weather(folder, folder / "out", *FOG)
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ValueError, match="holds other files"):
        weather(folder, tmp_path, *FOG)
    out = tmp_path / "out"
    weather(folder / "b/2.bin", out, *FOG, "--show", 0)
    with pytest.raises(ValueError, match=r"another request \(seed 0 there, 1 now\)"):
        weather(folder / "b/2.bin", out, *FOG, "--seed", 1)


@pytest.mark.slow
def test_killed_at_random_and_resumed_with_other_workers_gives_the_same_bytes(folder, tmp_path):
    weather(folder, tmp_path / "whole", *FOG)
    words = ["data", "weather", folder, "--out", tmp_path / "parts", *FOG, "--workers", 2]
    command = [sys.executable, "-m", "r3dpa", *map(str, words)]
    for seconds in (6.0, 8.0, 9.0):
        process = subprocess.Popen(command)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
    subprocess.run(command, check=True)
    assert content(tmp_path / "parts") == content(tmp_path / "whole")
