import json
import math
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from lidarsim import drive_files, drives
from lidarsim.drive_files import drive_name, velodyne_to_world
from lidarsim.drives import TRAIN_DRIVES, VAL_DRIVES, expected_scans, simulate, split_scans
from lidarsim.scan import simulate_scan
from lidarsim.scene import Conditions, Pose
from lidarsim.sensors import hdl64e, load_sensor
from lidarsim.street import Street
from r3dpa.io import only_writer

SMALL = {"sensor": hdl64e(32)}
KINDS = {"labels": ".label", "origins": ".origin", "sim": ".json", "data": ".bin"}


def files_of(root):
    return {p.relative_to(root): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def points_folder(root, drive):
    return root / "data_3d_raw" / drive_name(drive) / "velodyne_points"


def stems(root, kind="data"):
    return sorted(p.stem for p in root.rglob(f"{kind}/*") if not p.name.startswith("."))


def test_a_simulated_data_set_has_the_layout_of_kitti360(tmp_path):
    assert expected_scans(tmp_path) is None
    report = simulate(tmp_path, 5, seed=3, drives=["0000", "0004"], **SMALL)
    assert (report.scans_per_drive, report.num_written) == ({"0004": 4, "0000": 1}, 5)
    expected = expected_scans(tmp_path)
    assert list(expected.items()) == [(drive_name("0000"), 1), (drive_name("0004"), 4)]
    for drive, count in report.scans_per_drive.items():
        folder = points_folder(tmp_path, drive)
        times = (folder / "timestamps.txt").read_text().splitlines()
        assert len(times) == count
        assert times[0] == "2013-05-28 08:46:02.000000000"
        assert [time[-12:] for time in times[1:2]] == ["02.100000000"][: count - 1]
        names = [f"{number:010d}" for number in range(count)]
        for kind, suffix in KINDS.items():
            assert sorted(p.name for p in (folder / kind).iterdir()) == [n + suffix for n in names]
    manifest = json.loads((tmp_path / "simulation.json").read_text())
    assert (manifest["seed"], manifest["scans"], manifest["sensor"]["shots"]) == (3, 5, 32)
    assert len(manifest["sensor"]["lasers"]["inclination_rad"]) == 64
    assert (manifest["effects"], manifest["weather"]) == ({}, None)
    assert json.loads((tmp_path / "report.json").read_text()) == report.to_dict()
    top = {path.name for path in tmp_path.iterdir()}
    assert top == {"data_3d_raw", "data_poses", "simulation.json", "classes.yaml", "report.json"}


def test_files_of_a_scan_say_what_was_simulated(tmp_path):
    """And its pose. YAML 1.1 reads a bare ``on`` as true and ``off`` as false."""
    weather, sensor = Conditions(rain_mm_h=4.0), SMALL["sensor"]
    effects = {"range_noise": False, "rolling_shutter": True, "soft_raydrop": "auto"}
    simulate(tmp_path, 3, seed=2, drives=["0003"], weather=weather, effects=effects, **SMALL)
    scene = Street(2, 3, weather).scene(2, sensor.mount_height_m)
    scan = simulate_scan(scene, sensor, (2, "effects", 3, 2), {"range_noise": "off"})
    folder = points_folder(tmp_path, "0003")
    for kind in ("points", "labels", "origins"):
        path = folder / kind.replace("points", "data") / "0000000002"
        path = path.with_suffix(KINDS[path.parent.name])
        assert path.read_bytes() == getattr(scan, kind).tobytes()
    summary = json.loads((folder / "sim" / "0000000002.json").read_text())
    assert (summary["drive"], summary["scan"], summary["points"]) == ("0003", 2, len(scan.points))
    assert Pose(**summary["pose"]) == scene.pose
    assert summary["motion"]["speed_m_s"] == scene.motion.speed_m_s
    assert (summary["weather"]["rain_mm_h"], summary["weather"]["visibility_m"]) == (4.0, None)
    found = [(n, e["status"], e["rays"]) for n, e in summary["effects"].items()]
    assert found == [(record.name, record.status, record.rays) for record in scan.effects]
    manifest = json.loads((tmp_path / "simulation.json").read_text())
    assert manifest["effects"] == {"range_noise": "off"}
    assert manifest["weather"]["rain_mm_h"] == 4.0
    table = np.loadtxt(tmp_path / "data_poses" / drive_name("0003") / "velodyne_to_world.txt")
    assert table[:, 0].tolist() == [0, 1, 2]
    np.testing.assert_allclose(table[2, 1:].reshape(3, 4), velodyne_to_world(scene.pose), rtol=1e-9)


def test_a_point_ahead_of_a_car_that_heads_north():
    """10 m ahead and 2 m to the left is 10 m north and 2 m west; nose down lowers it."""
    pose = Pose(5.0, 7.0, 2.0, heading_rad=math.pi / 2)
    expected = [5.0 - 2.0, 7.0 + 10.0, 2.0 + 1.0]
    np.testing.assert_allclose(velodyne_to_world(pose) @ [10, 2, 1, 1], expected)
    dipped = velodyne_to_world(Pose(z_m=2.0, pitch_rad=0.1)) @ [10, 0, 0, 1]
    np.testing.assert_allclose(dipped, [10 * math.cos(0.1), 0, 2.0 - 10 * math.sin(0.1)])
    leaning = velodyne_to_world(Pose(z_m=2.0, roll_rad=0.1)) @ [0, 3, 0, 1]
    np.testing.assert_allclose(leaning, [0, 3 * math.cos(0.1), 2.0 + 3 * math.sin(0.1)])


def test_same_seed_same_bytes_for_any_number_of_workers(tmp_path):
    roots = [tmp_path / name for name in ("one", "two", "other")]
    for root, seed, workers in zip(roots, (1, 1, 2), (1, 2, 1), strict=True):
        simulate(root, 3, seed=seed, workers=workers, drives=["0003", "0000"], **SMALL)
    one, two, other = map(files_of, roots)
    assert one == two
    scans = [path for path in one if path.parent.name == "data"]
    assert len(scans) == 3
    assert len({one[path] for path in scans}) == 3
    assert all(one[path] != other[path] for path in scans)


def test_an_unfinished_request_is_completed(tmp_path):
    simulate(tmp_path, 7, drives=["0003"], **SMALL)
    whole, folder = files_of(tmp_path), points_folder(tmp_path, "0003")
    for number, (kind, suffix) in enumerate(KINDS.items()):
        (folder / kind / f"{number:010d}{suffix}").unlink()
    (folder / "boxes" / "0000000006.txt").unlink()
    (folder / "data" / "0000000004.bin").write_bytes(b"")
    labels = folder / "labels" / "0000000005.label"
    labels.write_bytes(labels.read_bytes()[:-4])
    for path in (folder / "timestamps.txt", *tmp_path.rglob("velodyne_to_world.txt")):
        path.unlink()
    report = simulate(tmp_path, 7, drives=["0003"], **SMALL)
    assert report.num_written == 7
    assert files_of(tmp_path) == whole


def test_points_are_the_last_file_of_a_scan(tmp_path, monkeypatch):
    written, write = [], drive_files.write
    monkeypatch.setattr(
        drive_files, "write", lambda path, content: (written.append(path), write(path, content))
    )
    simulate(tmp_path, 1, **SMALL)
    kinds = [path.parent.name for path in written[:5]]
    assert kinds == ["boxes", "labels", "origins", "sim", "data"]


def test_another_request_is_refused_with_both_values(tmp_path):
    simulate(tmp_path, 2, seed=5, effects={"range_noise": "off"}, **SMALL)
    before = files_of(tmp_path)
    base = {"scans": 2, "seed": 5, "effects": {"range_noise": "off"}, **SMALL}
    for change, message in (
        ({"seed": 6}, r"\(seed 5 there, 6 now\)"),
        ({"sensor": hdl64e(40)}, r"\(sensor\.shots 32 there, 40 now\)"),
        ({"sensor": load_sensor("hdl32e")}, r"sensor\.lasers\.inclination_rad 64 values there"),
        ({"effects": {}}, r"\(effects\.range_noise 'off' there, None now\)"),
        ({"weather": Conditions()}, r"\(weather None there, {'visibility_m': None, "),
    ):
        with pytest.raises(ValueError, match=message):
            simulate(tmp_path, **base | change)
    assert files_of(tmp_path) == before
    manifest = tmp_path / "simulation.json"
    stored = json.loads(manifest.read_text()) | {"simulator_version": 1}
    manifest.write_text(json.dumps(stored))
    with pytest.raises(ValueError, match=r"\(simulator_version 1 there, \d+ now\)"):
        simulate(tmp_path, **base)


def test_a_data_set_grows_and_then_serves_a_smaller_request(tmp_path):
    """A set made at once has the same bytes; of a smaller one only lost scans are made."""
    grown, whole = tmp_path / "grown", tmp_path / "whole"
    request = {"drives": ["0003", "0009", "0000"]} | SMALL
    simulate(grown, 3, **request)
    times = {path: path.stat().st_mtime_ns for path in grown.rglob("data/*.bin")}
    report = simulate(grown, 5, **request)
    assert (report.num_written, sum(report.scans_per_drive.values())) == (2, 5)
    assert times == {path: path.stat().st_mtime_ns for path in times}
    simulate(whole, 5, **request)
    before = files_of(grown)
    assert before == files_of(whole)

    report = simulate(grown, 3, **request)
    assert report.scans_per_drive == {"0003": 1, "0009": 1, "0000": 1}
    assert "\n3 scans (0003 1, 0009 1, 0000 1), " in str(report)
    assert "\n1 scan (0003 1), " in str(replace(report, scans_per_drive={"0003": 1}))
    assert (report.num_written, files_of(grown)) == (0, before)
    for number in (0, 1):
        (points_folder(grown, "0003") / "data" / f"{number:010d}.bin").unlink()
    assert simulate(grown, 3, **request).num_written == 1
    assert simulate(grown, 5, **request).num_written == 1
    assert files_of(grown) == before


def test_a_smaller_request_after_a_larger_one_that_was_interrupted_is_finished(tmp_path):
    request = {"drives": ["0003"]} | SMALL
    simulate(tmp_path / "whole", 2, **request)
    simulate(tmp_path / "out", 4, **request)
    for path in (tmp_path / "out" / "report.json", *(tmp_path / "out").rglob("*times*.txt")):
        path.unlink()
    simulate(tmp_path / "out", 2, **request)
    whole, out = files_of(tmp_path / "whole"), files_of(tmp_path / "out")
    named = [path for path in whole if path.name in ("report.json", "timestamps.txt")]
    assert [out[path] for path in named] == [whole[path] for path in named]
    assert simulate(tmp_path / "out", 4, **request).scans_per_drive == {"0003": 4}


def test_times_of_a_stride_are_its_multiple_apart(tmp_path):
    simulate(tmp_path, 2, drives=["0003"], every=40, **SMALL)
    times = (points_folder(tmp_path, "0003") / "timestamps.txt").read_text().split()
    assert times[1::2] == ["08:46:02.000000000", "08:46:06.000000000"]


def test_scans_without_a_point_are_complete(tmp_path):
    request = {"drives": ["0003"], "weather": Conditions(visibility_m=1)} | SMALL
    for num_written in (2, 0):
        report = simulate(tmp_path, 2, **request)
        assert (report.num_written, report.num_empty) == (num_written, 2)


def test_foreign_data_are_left_alone(tmp_path):
    (tmp_path / "data_3d_raw").mkdir()
    with pytest.raises(ValueError, match=r"was not simulated"):
        simulate(tmp_path, 2, **SMALL)
    assert not (tmp_path / "simulation.json").exists()
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "000000.bin").write_bytes(bytes(16))
    with pytest.raises(ValueError, match=r"holds scans that were not simulated, such as 000000\.b"):
        simulate(tmp_path / "own", 2, **SMALL)
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(ValueError, match="is a file"):
        simulate(file, 2, **SMALL)


@pytest.fixture
def before(tmp_path):
    """The files of a data set of two scans."""
    simulate(tmp_path, 2, drives=["0003"], **SMALL)
    return files_of(tmp_path)


def test_files_of_a_killed_run_are_deleted_and_those_of_others_are_not(tmp_path, before):
    folder, poses = points_folder(tmp_path, "0003"), tmp_path / "data_poses" / drive_name("0003")
    for path in (
        folder / "data" / ".0000000001.1a2b3c4d.partial.bin",
        poses / ".velodyne_to_world.1a2b3c4d.partial.txt",
        tmp_path / ".simulation.1a2b3c4d.partial.json",
        tmp_path / ".classes.1a2b3c4d.partial.yaml",
    ):
        path.write_bytes(b"half")
    grid = tmp_path / "feature_grids" / ".index.1a2b3c4d.partial.json"
    grid.parent.mkdir()
    grid.write_bytes(b"half")
    simulate(tmp_path, 2, drives=["0003"], **SMALL)
    assert files_of(tmp_path) == before | {grid.relative_to(tmp_path): b"half"}


def test_after_a_failure_waiting_tasks_do_not_run(tmp_path, monkeypatch):
    """The first of 30 tasks finds a folder in the place of its file."""
    monkeypatch.setattr(drives, "_SCANS_PER_TASK", 1)
    folder = points_folder(tmp_path, "0003")
    request = {"out": tmp_path, "scans": 30, "drives": ["0003"], "sensor": hdl64e(8)}
    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(drives, "_run")
        with pytest.raises(NameError):  # only the manifest is written
            simulate(**request)
    (folder / "labels" / "0000000000.label").mkdir(parents=True)
    with pytest.raises(IsADirectoryError):
        simulate(**request, workers=2)
    assert len(list((folder / "data").iterdir())) < 20


@pytest.mark.parametrize("text", ['{"drive": "0003", "scan', "null", "[" * 100_000])
def test_a_damaged_summary_is_named_and_made_again_when_deleted(tmp_path, before, text):
    summary = points_folder(tmp_path, "0003") / "sim" / "0000000001.json"
    summary.write_text(text)
    with pytest.raises(ValueError, match=r"sim/0000000001\.json is damaged .* delete it"):
        simulate(tmp_path, 2, drives=["0003"], **SMALL)
    summary.unlink()
    simulate(tmp_path, 2, drives=["0003"], **SMALL)
    assert files_of(tmp_path) == before


class TestInterrupted:
    @pytest.mark.slow
    def test_workers_of_a_killed_run_end_with_it(self, tmp_path):
        """Its five tasks on their way would be 40 more scans."""
        killed = tmp_path / "killed"
        code = (
            "from pathlib import Path; from lidarsim import hdl64e, simulate; "
            f"simulate(Path({str(killed)!r}), 60, seed=4, workers=2, sensor=hdl64e(32))"
        )
        process = subprocess.Popen([sys.executable, "-c", code])
        while not stems(killed):
            assert process.poll() is None
            time.sleep(0.002)
        process.kill()
        process.wait()
        time.sleep(0.2)
        soon_after = len(stems(killed))
        time.sleep(0.6)
        assert len(stems(killed)) == soon_after < 60
        report = simulate(killed, 60, seed=4, **SMALL)
        assert 60 - soon_after - 16 <= report.num_written <= 60 - soon_after

    def test_a_killed_worker_is_an_error_and_the_next_call_goes_on(self, tmp_path):
        def kill_one():
            while not stems(tmp_path):
                time.sleep(0.002)
            os.kill(multiprocessing.active_children()[0].pid, signal.SIGKILL)

        killer = threading.Thread(target=kill_one)
        killer.start()
        with pytest.raises(ChildProcessError, match=r"worker process ended .* fewer workers"):
            simulate(tmp_path / "a", 200, workers=2, **SMALL)
        killer.join()
        assert 0 < len(stems(tmp_path)) < 200

    def test_a_second_call_waits_for_the_first(self, tmp_path, until_logged):
        simulate(tmp_path, 3, **SMALL)
        second = threading.Thread(target=simulate, args=(tmp_path, 3), kwargs=SMALL)
        with only_writer(tmp_path / ".lock", "simulates"):
            second.start()
            until_logged("waiting for another process")
            second.join(0.1)
            assert second.is_alive()
        second.join(10)
        assert not second.is_alive()


DAMAGED = ["{", "[" * 100_000, "{}", '{"scans": "ten", "drives": ["0003"]}']
DAMAGED += ['{"scans": 5, "drives": ["0001"]}']


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_manifest_is_named(tmp_path, text):
    (tmp_path / "simulation.json").write_text(text)
    with pytest.raises(ValueError, match=r"simulation.json .*simulate the data set again"):
        expected_scans(tmp_path)


@pytest.mark.parametrize("scans", [1, 2, 3, 10, 100, 1001])
def test_scans_are_split_over_training_and_validation_drives(scans):
    counts = split_scans(scans, (*TRAIN_DRIVES, *VAL_DRIVES))
    train, val = ([counts.get(d, 0) for d in group] for group in (TRAIN_DRIVES, VAL_DRIVES))
    assert sum(val) == (max(1, round(0.2 * scans)) if scans >= 2 else 0)
    assert sum(train) == scans - sum(val) >= 1
    assert max(max(group) - min(group) for group in (train, val)) <= 1
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
        ({"workers": 0}, "workers must be a whole number, 1 or greater, got 0"),
        ({"every": 1.5}, "every must be a whole number, 1 or greater, got 1.5"),
        (
            {"scans": 7, "every": 200_000, "drives": ["0003"]},
            "every 200000 leads to scan 1200000 of a drive, which has 1000000",
        ),
        ({"seed": -1}, "seed must be a whole number, 0 or greater, got -1"),
        ({"sensor": "lidar"}, "unknown sensor 'lidar'"),
        ({"drives": ["3"]}, "got 3"),
        ({"effects": {"fogg": "off"}}, r"unknown effect 'fogg'; choose from dual_return, "),
        ({"effects": {"range_noise": "of"}}, "range_noise must be auto, on or off, got 'of'"),
    ],
)
def test_bad_requests_leave_nothing_behind(tmp_path, wrong, message):
    with pytest.raises(ValueError, match=message):
        simulate(tmp_path / "out", **({"scans": 2} | wrong))
    assert not (tmp_path / "out").exists()


def test_a_complete_data_set_is_read_from_a_read_only_disk(tmp_path, monkeypatch):
    written = simulate(tmp_path, 2, drives=["0003"], sensor=hdl64e(8))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    monkeypatch.setattr(drives.os, "access", lambda path, mode: mode != drives.os.W_OK)
    report = simulate(tmp_path, 2, drives=["0003"], sensor=hdl64e(8))
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    assert report.num_written == 0
    assert report.to_dict() == written.to_dict()


def summary(drive, status, reason, rays):
    record = {"status": status, "reason": reason, "rays": rays}
    return {"drive": drive, "points": 5, "effects": {"range_noise": record}}


def test_report_by_hand():
    summaries = [
        summary("0003", "not_called", "nothing", 0),
        summary("0003", "ran", "sigma 1 cm", 30),
        summary("0003", "ran", "second", 50),
        summary("0000", "off", "switched off", 0),
    ]
    report = drives.make_report(summaries, 3)
    assert report.effects["range_noise"] == (2, 1, 1, "sigma 1 cm", 20)
    assert report.scans_per_drive == {"0003": 3, "0000": 1}
    lines = {line.split()[0]: line.split()[1:] for line in str(report).splitlines() if line}
    assert lines["range_noise"] == ["2", "1", "1", "20", "sigma", "1", "cm"]
    idle = drives.make_report([summaries[0], summaries[3]], 0)
    assert idle.effects["range_noise"].why == "nothing"
    assert idle.num_written == 0
    empty = drives.make_report([summaries[0] | {"points": 0}], 0)
    assert "1 of them hold no points" in str(empty)


@pytest.mark.fuzz
@pytest.mark.parametrize("drive", ["../../x", "/etc", "0003/../..", ""])
def test_drives_of_a_manifest_that_leave_the_folder_are_refused(drive, tmp_path):
    (tmp_path / "simulation.json").write_text(json.dumps({"scans": 3, "drives": [drive]}))
    with pytest.raises(ValueError, match=r"simulation\.json does not say"):
        expected_scans(tmp_path)
