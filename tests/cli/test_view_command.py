"""``r3dpa view``: which scans it takes, what it writes and what it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from r3dpa.cli.data import view
from r3dpa.data.scans import write_bin, write_npz, write_ply
from r3dpa.simulation import Origin, Semantic

WRITTEN = ["birds_eye.png", "range_images.png", "view.html"]


def points(num_points=200, seed=0):
    generator = np.random.default_rng(seed)
    scale = np.array([20, 20, 1, 0])
    return (generator.uniform(-1, 1, (num_points, 4)) * scale).astype(np.float32)


def shown(folder):
    """The data of the written page."""
    page = (folder / "view.html").read_text("utf-8")
    return json.loads(re.search(r'id="page">(.*?)</script>', page, re.DOTALL)[1])


def names(folder):
    return [header["name"] for header in shown(folder)["scans"]]


@pytest.fixture
def drive(tmp_path) -> Path:
    """A drive in the KITTI-360 layout with one scan, its labels and its origins."""
    folder = tmp_path / "root" / "data_3d_raw" / "2013_05_28_drive_0003_sync" / "velodyne_points"
    write_bin(folder / "data" / "0000000004.bin", points())
    for name in ("labels", "origins"):
        (folder / name).mkdir()
    labels = np.full(200, int(Semantic.CAR) | 3 << 16, "<u4")
    (folder / "labels" / "0000000004.label").write_bytes(labels.tobytes())
    origins = np.full(200, int(Origin.RAIN), np.uint8)
    (folder / "origins" / "0000000004.origin").write_bytes(origins.tobytes())
    return folder


def test_writes_two_pictures_and_a_page_and_prints_their_paths(drive, tmp_path):
    out = tmp_path / "new" / "out"
    text = view(drive / "data" / "0000000004.bin", out=out, num=8, reference=None)
    assert sorted(path.name for path in out.iterdir()) == WRITTEN
    for name in WRITTEN:
        assert str(out / name) in text.splitlines()
    for name in WRITTEN[:2]:
        assert np.asarray(Image.open(out / name)).std() > 10
    assert names(out) == ["2013_05_28_drive_0003_sync/0000000004"]


def test_labels_and_origins_beside_the_scan_are_read_and_named(drive, tmp_path):
    view(tmp_path / "root", out=tmp_path / "out", num=8, reference=None)
    page = shown(tmp_path / "out")
    assert {"semantic", "instance", "origin"} < set(page["scans"][0]["columns"])
    assert [row[:2] for row in page["categories"]["semantic"]] == [[int(Semantic.CAR), "car"]]
    assert [row[:2] for row in page["categories"]["origin"]] == [[int(Origin.RAIN), "rain"]]


def test_missing_labels_and_origins_are_not_offered(drive, tmp_path):
    (drive / "labels" / "0000000004.label").unlink()
    (drive / "origins" / "0000000004.origin").unlink()
    view(drive, out=tmp_path / "out", num=8, reference=None)
    assert shown(tmp_path / "out")["scans"][0]["columns"] == ["x", "y", "z", "intensity"]


@pytest.mark.parametrize(
    ("folder", "suffix", "num_bytes", "count"),
    [
        ("labels", "label", 796, "199"),
        ("labels", "label", 798, "199.5"),
        ("origins", "origin", 0, "0"),
    ],
)
def test_another_length_than_the_scan_names_both_files_and_counts(
    drive, tmp_path, folder, suffix, num_bytes, count
):
    path = drive / folder / f"0000000004.{suffix}"
    path.write_bytes(bytes(num_bytes))
    scan = drive / "data" / "0000000004.bin"
    message = f"{path} holds {count} numbers but {scan} 200 points"
    with pytest.raises(ValueError, match=re.escape(message)):
        view(drive, out=tmp_path / "out", num=8, reference=None)
    assert not (tmp_path / "out").exists()


def test_of_a_folder_scans_are_spread_evenly(tmp_path):
    for number in range(10):
        write_bin(tmp_path / "scans" / f"{number:03d}.bin", points(seed=number))
    text = view(tmp_path / "scans", out=tmp_path / "out", num=4, reference=None)
    assert names(tmp_path / "out") == [f"scans/{number:03d}" for number in (0, 2, 5, 7)]
    assert text.startswith("4 of 10 scans")


def test_the_default_folder_is_named_after_the_source(drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    view(Path("root"), out=None, num=1, reference=None)
    view(drive / "data" / "0000000004.bin", out=None, num=1, reference=None)
    assert sorted(path.name for path in (tmp_path / "view").iterdir()) == ["0000000004", "root"]


def test_ply_and_npz_files_are_scans_too(tmp_path):
    write_ply(tmp_path / "one.ply", points()[:, :3])
    write_npz(tmp_path / "many.npz", {"a": points(), "b": points()[:, :3]})
    view(tmp_path / "one.ply", out=tmp_path / "ply", num=8, reference=None)
    view(tmp_path / "many.npz", out=tmp_path / "npz", num=8, reference=None)
    assert names(tmp_path / "ply") == [f"{tmp_path.name}/one"]
    assert names(tmp_path / "npz") == ["many/a", "many/b"]


def test_a_reference_stands_beside_also_where_it_is_the_same_scan(drive, tmp_path):
    scan = drive / "data" / "0000000004.bin"
    view(scan, out=tmp_path / "out", num=8, reference=scan)
    name = "2013_05_28_drive_0003_sync/0000000004"
    assert names(tmp_path / "out") == [name, f"reference: {name}"]
    assert shown(tmp_path / "out")["reference"] == 1


def test_a_file_with_an_evil_name_is_harmless(tmp_path):
    write_bin(tmp_path / "<script>alert(1)<&$x$.bin", points())
    view(tmp_path, out=tmp_path / "out", num=8, reference=None)
    assert names(tmp_path / "out") == [f"{tmp_path.name}/<script>alert(1)<&$x$"]
    assert "<script>alert" not in (tmp_path / "out" / "view.html").read_text("utf-8")


def test_refuses_what_it_cannot_show(tmp_path):
    (tmp_path / "notes.txt").write_text("no scan")
    with pytest.raises(ValueError, match=r"notes.txt: is no scan; give a .bin, .ply or .npz"):
        view(tmp_path / "notes.txt", out=tmp_path / "out", num=8, reference=None)
    with pytest.raises(ValueError, match="No scan found"):
        view(tmp_path / "absent", out=tmp_path / "out", num=8, reference=None)
    with pytest.raises(ValueError, match="num must be at least 1, got 0"):
        view(tmp_path, out=tmp_path / "out", num=0, reference=None)


def test_a_npz_file_of_something_else_is_named(tmp_path):
    path = tmp_path / "some.npz"
    path.write_bytes(b"")
    with pytest.raises(ValueError, match=r"some\.npz: is damaged or no \.npz file of scans"):
        view(path, out=tmp_path / "out", num=8, reference=None)
    np.savez(path, counts=np.zeros(3))
    with pytest.raises(ValueError, match=r"some\.npz: counts must be points .*, got shape \(3,\)"):
        view(path, out=tmp_path / "out", num=8, reference=None)
    np.savez(path)
    with pytest.raises(ValueError, match=r"some\.npz: holds no scan"):
        view(path, out=tmp_path / "out", num=8, reference=None)


@pytest.mark.data
def test_real_scans(real_scans_dir, tmp_path):
    view(real_scans_dir, out=tmp_path / "out", num=3, reference=None)
    page = shown(tmp_path / "out")
    assert len(page["scans"]) == 3
    assert all(header["step_m"] == 0.005 for header in page["scans"])
    size = (tmp_path / "out" / "view.html").stat().st_size
    assert size < 0.6e6 * 3  # half a megabyte a scan, as documented
