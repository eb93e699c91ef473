import json
import os

import numpy as np
import pytest

from r3dpa.simulation import (
    TRAIN_DRIVES,
    VAL_DRIVES,
    drive_name,
    drives,
    expected_scans,
    simulate,
    split_scans,
)

SMALL = {"shots": 32}


def files_of(root):
    return {p.relative_to(root): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def points_folder(root, drive):
    return root / "data_3d_raw" / drive_name(drive) / "velodyne_points"


def test_layout_and_contents(tmp_path):
    report = simulate(tmp_path, 11, seed=3, **SMALL)
    assert sum(report.scans_per_drive.values()) == 11
    assert report.num_written == 11
    assert report.ms_per_scan > 0
    for drive, count in report.scans_per_drive.items():
        folder = points_folder(tmp_path, drive)
        assert len((folder / "timestamps.txt").read_text().splitlines()) == count
        names = [f"{number:010d}" for number in range(count)]
        assert sorted(p.name for p in (folder / "data").iterdir()) == [n + ".bin" for n in names]
        assert sorted(p.name for p in (folder / "labels").iterdir()) == [
            n + ".label" for n in names
        ]
        for name in names:
            points = np.fromfile(folder / "data" / f"{name}.bin", np.float32).reshape(-1, 4)
            labels = np.fromfile(folder / "labels" / f"{name}.label", np.uint32)
            assert len(points) == len(labels) > 1000
    manifest = json.loads((tmp_path / "simulation.json").read_text())
    assert manifest["seed"] == 3
    assert manifest["scans"] == 11
    assert manifest["sensor"]["shots"] == 32


def test_timestamps_are_ten_per_second(tmp_path):
    simulate(tmp_path, 12, drives=["0003"], shots=8)
    lines = (points_folder(tmp_path, "0003") / "timestamps.txt").read_text().splitlines()
    assert lines[0] == "2013-05-28 08:46:02.000000000"
    assert lines[11] == "2013-05-28 08:46:03.100000000"


def test_same_seed_same_bytes_for_any_number_of_workers(tmp_path):
    roots = [tmp_path / name for name in ("one", "two", "other")]
    for root, seed, workers in zip(roots, (1, 1, 2), (1, 2, 1), strict=True):
        simulate(root, 20, seed=seed, workers=workers, **SMALL)
    one, two, other = map(files_of, roots)
    assert one == two
    scans = [path for path in one if path.suffix == ".bin"]
    assert len(scans) == 20
    assert len({one[path] for path in scans}) == 20
    assert all(one[path] != other[path] for path in scans)


def test_repeating_a_request_does_nothing_and_an_unfinished_one_is_completed(tmp_path):
    simulate(tmp_path, 4, **SMALL)
    whole = files_of(tmp_path)
    stamps = {path: (tmp_path / path).stat().st_mtime_ns for path in whole}
    report = simulate(tmp_path, 4, **SMALL)
    assert (report.num_written, report.ms_per_scan) == (0, 0.0)
    assert stamps == {path: (tmp_path / path).stat().st_mtime_ns for path in whole}

    for path in [p for p in whole if p.suffix == ".bin"][:2]:
        (tmp_path / path).unlink()
    (tmp_path / next(p for p in whole if p.suffix == ".label")).unlink()
    (tmp_path / next(p for p in whole if p.suffix == ".txt")).unlink()
    assert simulate(tmp_path, 4, workers=2, **SMALL).num_written == 2
    assert files_of(tmp_path) == whole


def test_another_request_is_refused_with_both_values(tmp_path):
    simulate(tmp_path, 2, seed=5, **SMALL)
    before = files_of(tmp_path)
    with pytest.raises(ValueError, match="seed 5 there, 6 now"):
        simulate(tmp_path, 2, seed=6, **SMALL)
    with pytest.raises(ValueError, match="scans 2 there, 3 now"):
        simulate(tmp_path, 3, seed=5, **SMALL)
    with pytest.raises(ValueError, match=r"'shots': 32.* there, .*'shots': 40.* now"):
        simulate(tmp_path, 2, seed=5, shots=40)
    assert files_of(tmp_path) == before


def test_foreign_data_are_left_alone(tmp_path):
    (tmp_path / "data_3d_raw").mkdir()
    with pytest.raises(ValueError, match=r"was not simulated"):
        simulate(tmp_path, 2, **SMALL)
    assert not (tmp_path / "simulation.json").exists()
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(ValueError, match="is a file"):
        simulate(file, 2, **SMALL)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "simulation.json").write_text("{")
    with pytest.raises(ValueError, match=r"simulation.json is damaged"):
        simulate(tmp_path / "broken", 2, **SMALL)


def test_a_failed_write_leaves_no_part_of_a_file(tmp_path, monkeypatch):
    def full_disk(self, content):
        with self.open("wb") as stream:
            stream.write(content[: len(content) // 2])
        raise OSError("No space left on device")

    folder = points_folder(tmp_path, "0003")
    simulate(tmp_path, 2, drives=["0003"], **SMALL)
    scan = folder / "data" / "0000000001.bin"
    content = scan.read_bytes()
    scan.unlink()
    with monkeypatch.context() as patch:
        patch.setattr(drives.Path, "write_bytes", full_disk)
        with pytest.raises(OSError, match="No space left"):
            simulate(tmp_path, 2, drives=["0003"], **SMALL)
    assert sorted(p.name for p in (folder / "data").iterdir()) == ["0000000000.bin"]
    assert not list(tmp_path.rglob(".*.partial*"))
    simulate(tmp_path, 2, drives=["0003"], **SMALL)
    assert scan.read_bytes() == content


def test_files_of_a_killed_run_are_deleted_and_those_of_a_running_one_are_not(tmp_path):
    simulate(tmp_path, 2, drives=["0003"], **SMALL)
    before = files_of(tmp_path)
    old = points_folder(tmp_path, "0003") / "data" / ".0000000001.1a2b3c4d.partial.bin"
    new = tmp_path / ".simulation.1a2b3c4d.partial.json"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (0, 0))
    simulate(tmp_path, 2, drives=["0003"], **SMALL)
    assert files_of(tmp_path) == before | {new.relative_to(tmp_path): b"half"}


def test_after_a_failure_waiting_tasks_do_not_run(tmp_path, monkeypatch):
    """The first of 60 tasks finds a folder in the place of its file."""
    request = {"out": tmp_path, "scans": 480, "drives": ["0003"], "shots": 8}
    folder = points_folder(tmp_path, "0003")
    with monkeypatch.context() as patch:
        patch.delattr(drives, "_run")
        with pytest.raises(NameError):  # only the folders are made
            simulate(**request)
    (folder / "labels" / "0000000000.label").mkdir()
    with pytest.raises(IsADirectoryError):
        simulate(**request, workers=2)
    assert len(list((folder / "data").iterdir())) < 400


def test_expected_scans_are_those_of_a_complete_data_set(tmp_path):
    assert expected_scans(tmp_path) is None
    simulate(tmp_path, 5, drives=["0000", "0004"], **SMALL)
    expected = expected_scans(tmp_path)
    assert expected == {drive_name("0000"): 1, drive_name("0004"): 4}
    assert list(expected) == sorted(expected)
    for drive, count in expected.items():
        data = tmp_path / "data_3d_raw" / drive / "velodyne_points" / "data"
        assert len(list(data.iterdir())) == count


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "{}",
        '{"scans": "ten", "drives": ["0003"]}',
        '{"scans": 0, "drives": ["0003"]}',
        '{"scans": 5, "drives": ["0001"]}',
        '{"scans": 5, "drives": null}',
    ],
)
def test_a_damaged_manifest_is_named(tmp_path, text):
    (tmp_path / "simulation.json").write_text(text)
    with pytest.raises(ValueError, match=r"simulation.json .*simulate the data set again"):
        expected_scans(tmp_path)


@pytest.mark.parametrize("scans", [1, 2, 3, 10, 100, 1001])
def test_split(scans):
    counts = split_scans(scans, (*TRAIN_DRIVES, *VAL_DRIVES))
    train = [counts.get(drive, 0) for drive in TRAIN_DRIVES]
    val = [counts.get(drive, 0) for drive in VAL_DRIVES]
    assert sum(train) + sum(val) == scans
    assert max(train) - min(train) <= 1
    assert max(val) - min(val) <= 1
    assert sum(train) >= 1
    if scans >= 2:
        assert sum(val) == max(1, round(0.2 * scans))
    assert all(counts.values())


def test_split_of_chosen_drives():
    assert split_scans(5, ["0009"]) == {"0009": 5}
    assert split_scans(5, ["0002"]) == {"0002": 5}
    assert split_scans(10, ["0000", "0004"]) == {"0004": 8, "0000": 2}
    for wrong in (["0001"], ["0003", "0003"], []):
        with pytest.raises(ValueError, match="drives must be different ones of 0003"):
            split_scans(5, wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scans": 0}, "scans must be 1 or greater, got 0"),
        ({"workers": 0}, "workers must be 1 or greater, got 0"),
        ({"seed": -1}, "seed must be 0 or greater, got -1"),
        ({"shots": 3}, "shots must be at least 8"),
        ({"drives": ["3"]}, "got 3"),
    ],
)
def test_bad_requests_leave_nothing_behind(tmp_path, wrong, message):
    with pytest.raises(ValueError, match=message):
        simulate(tmp_path / "out", **({"scans": 2} | wrong))
    assert not (tmp_path / "out").exists()
