import io
import json
import os
import struct
import zipfile

import numpy as np
import pytest
import torch

from lidarsim.clouds import read_cloud
from lidarsim.scan_files import (
    ScanError,
    read_npz,
    read_points,
    read_scan,
    write_bin,
    write_npz,
    write_ply,
)
from r3dpa.data import read_samples
from r3dpa.data.scans import KITTI360_DRIVES, check, find_scans, kitti360_scans
from r3dpa.geometry import LidarSensor
from r3dpa.io import atomic_path, refuse_name

POINTS = np.array([[10, 0, -1, 0.5], [0, 20, 0.25, 0.0], [-30, 1, 2, 1.0]], np.float32)
ENOUGH = np.tile(POINTS, (6, 1))  # points for ``check``


def five_columns(count, times=None):
    """Rows x, y, z, intensity 0..255 and ring, as nuScenes has them."""
    generator = np.random.default_rng(0)
    xyz = generator.uniform(-40, 40, (count, 3))
    ring = np.arange(count) % 32 if times is None else np.full(count, times)
    return np.column_stack([xyz, generator.integers(0, 256, count), ring]).astype("<f4")


@pytest.mark.parametrize("count", [37, 40])  # 740 bytes are no multiple of 16, 800 are
def test_five_columns_are_told_from_their_values(tmp_path, count):
    file = tmp_path / "a.bin"
    rows = five_columns(count)
    rows.tofile(file)
    points = read_scan(file)
    assert np.array_equal(points[:, :3], rows[:, :3])
    assert np.array_equal(points[:, 3], rows[:, 3] / np.float32(255))
    five_columns(count, times=0.25).tofile(file)
    with pytest.raises(
        ScanError, match=r"a\.bin: its values do not fit .*, rather of 5 columns: name"
    ):
        read_scan(file)


@pytest.mark.parametrize("width", [6, 7, 8, 12])
@pytest.mark.parametrize("side", ["all", "left"])
def test_more_columns_are_never_read_as_four(tmp_path, width, side):
    """Also of points on one side, whose coordinates could be intensities."""
    random = np.random.default_rng(width)
    rows = random.uniform(0, 1, (1680, width))
    rows[:, :3] = random.uniform([-40, 2 if side == "left" else -40, -2], [40, 40, 2], (1680, 3))
    rows[:, 4] = np.arange(1680) % 64
    rows.astype("<f4").tofile(tmp_path / "a.bin")
    with pytest.raises(ScanError, match=rf"a\.bin: .*rather of {width} columns: name the columns"):
        read_scan(tmp_path / "a.bin")
    columns = ["x", "y", "z", "intensity", "ring", *(f"c{number}" for number in range(5, width))]
    points = read_scan(tmp_path / "a.bin", columns=columns)
    assert np.array_equal(points, rows[:, :4].astype("<f4"))


def test_arrays_are_not_read_as_rows_of_bin(tmp_path):
    np.save(tmp_path / "x.npy", POINTS)
    assert np.array_equal(read_scan(tmp_path / "x.npy"), POINTS)
    np.save(tmp_path / "x.npy", np.ones((3, 7), np.float32))
    with pytest.raises(ScanError, match=r"x\.npy: holds float32 of shape \(3, 7\), not rows"):
        read_scan(tmp_path / "x.npy")


def test_four_columns_of_a_size_that_fits_five(tmp_path):
    generator = np.random.default_rng(0)
    points = np.column_stack([generator.uniform(-40, 40, (40, 3)), generator.random(40)])
    for intensity in (points[:, 3], np.zeros(40)):
        points[:, 3] = intensity
        points.astype("<f4").tofile(tmp_path / "a.bin")
        assert np.array_equal(read_scan(tmp_path / "a.bin"), points.astype("<f4"))


def problems(path):
    """Lines about what is wrong with a data set."""
    text, usable = check(path)
    found = [line for line in text.splitlines() if line.startswith(("bad: ", "missing: "))]
    assert usable == (not found)
    return found


def test_check_says_the_intensities(tmp_path):
    write_bin(tmp_path / "a.bin", ENOUGH)
    text, usable = check(tmp_path)
    assert usable
    assert "intensity: 0..1\n" in text
    assert "1 scan in 1 drive, all usable" in text
    write_bin(tmp_path / "a.bin", ENOUGH - np.float32([0, 0, 0, 0.25]))
    (problem,) = problems(tmp_path)
    assert "its values do not fit 4 or 5 columns x, y, z, intensity" in problem


def test_intensities_of_another_full_scale_are_refused(tmp_path):
    """Features and reflectance of 0..255 would be wrong in silence; single bright returns stay."""
    intensity = np.tile(POINTS[1], (2000, 1))
    intensity[:, 3] = np.linspace(0, 255, 2000)
    write_bin(tmp_path / "a.bin", intensity)
    with pytest.raises(ScanError, match=r"a\.bin: has intensities up to 255 .* not 0\.\.1: divide"):
        read_scan(tmp_path / "a.bin")
    (problem,) = problems(tmp_path)
    assert "has intensities up to 255" in problem
    intensity[:, 3] = np.where(np.arange(2000) < 2, 1.5, 1.0)
    write_bin(tmp_path / "a.bin", intensity)
    assert read_scan(tmp_path / "a.bin")[:, 3].max() == 1.5
    intensity[2, 3] = 1.5
    write_bin(tmp_path / "a.bin", intensity)
    with pytest.raises(ScanError, match=r"up to 1\.5 and above 1 in 3 of 2000 points"):
        read_scan(tmp_path / "a.bin")


def test_points_are_little_endian_float32_rows(tmp_path):
    file = tmp_path / "a.bin"
    file.write_bytes(struct.pack("<8f", 1.5, -2, 3, 0.25, 4, 5, 6, 1))
    points = read_scan(file)
    assert points.dtype == np.float32
    assert points.tolist() == [[1.5, -2, 3, 0.25], [4, 5, 6, 1]]


def changed(place, value):
    points = POINTS.copy()
    points[place] = value
    return points.tobytes()


@pytest.mark.numerics
@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (POINTS.tobytes()[:-3], "45 bytes, not a multiple of 16"),
        (b"", "is empty"),
        (changed((1, 2), np.nan), "NaN or infinite values in 1 of 3 points"),
        (changed((2, 3), np.inf), "NaN or infinite values in 1 of 3 points"),
        (changed(np.s_[:, :3], 0.5), r"no point within the sensor's range 1\.\.56 m"),
        (None, "cannot be read"),
    ],
)
def test_broken_scan_is_named_with_its_reason(tmp_path, data, reason):
    file = tmp_path / "a.bin"
    if data is None:
        file.symlink_to(tmp_path / "gone")
    else:
        file.write_bytes(data)
    with pytest.raises(ScanError, match=rf"a\.bin: .*{reason}"):
        read_scan(file, LidarSensor())
    (problem,) = problems(tmp_path)
    assert problem.startswith(f"bad: {file}: ")
    if "NaN" in reason:  # numpy reads it without a word
        assert not np.isfinite(np.fromfile(file, np.float32).mean())
    elif "multiple" in reason:
        with pytest.raises(ValueError, match=r"^cannot reshape array"):  # of which file?
            np.fromfile(file, np.float32).reshape(-1, 4)


def test_a_folder_in_place_of_a_scan_is_said_to_be_one(tmp_path):
    for read, name in ((read_scan, "a.bin"), (read_npz, "b.npz")):
        (tmp_path / name).mkdir()
        with pytest.raises(ScanError, match=rf"{name}: is a folder; give one scan$"):
            read(tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_pipes_and_devices_are_not_read(tmp_path):
    """A pipe would be waited for, and a device may never end."""
    device, pipe, archive = (tmp_path / name for name in ("a.bin", "b.bin", "c.npz"))
    device.symlink_to(os.devnull)
    os.mkfifo(pipe)
    os.mkfifo(archive)
    for file, read in ((device, read_scan), (device, read_cloud), (pipe, read_scan)):
        with pytest.raises(ScanError, match=rf"{file.name}: is no regular file"):
            read(file)
    with pytest.raises(ScanError, match=r"c\.npz: is no regular file"):
        read_npz(archive)
    assert problems(tmp_path) == [f"bad: {file}: is no regular file" for file in (device, pipe)]


@pytest.mark.parametrize("width", [3, 4])
def test_written_scans_come_back(tmp_path, width):
    points = POINTS[:, :width]
    write_bin(tmp_path / "new/a.bin", points)
    expected = np.concatenate([POINTS[:, :3], POINTS[:, 3:] * (width == 4)], 1)
    assert np.array_equal(read_scan(tmp_path / "new/a.bin"), expected)
    write_ply(tmp_path / "a.ply", torch.from_numpy(points))
    assert np.array_equal(read_points(tmp_path / "a.ply"), points)
    write_npz(tmp_path / "a.npz", {"one": points, "two": torch.from_numpy(points[:1])}.items())
    archive = read_npz(tmp_path / "a.npz")
    assert np.array_equal(archive["one"], points)
    assert np.array_equal(archive["two"], points[:1])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.npz", "a.ply", "new"]


def test_ply_of_other_programs(tmp_path):
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment made elsewhere\nelement vertex 1\n"
        "property double x\nproperty double y\nproperty double z\nproperty uchar red\nend_header\n"
    )
    (tmp_path / "a.ply").write_bytes(header.encode() + struct.pack("<3dB", 1, 2, 3, 255))
    assert read_points(tmp_path / "a.ply").tolist() == [[1, 2, 3]]
    (tmp_path / "b.ply").write_bytes(header.encode() + b"12")
    with pytest.raises(ScanError, match=r"b\.ply: .*\(2 bytes for 1 points of 25\)"):
        read_points(tmp_path / "b.ply")
    (tmp_path / "i.ply").write_bytes(
        header.replace("uchar red", "int label").encode() + struct.pack("<3di", 1, 2, 3, -7)
    )
    assert read_points(tmp_path / "i.ply").tolist() == [[1, 2, 3]]
    (tmp_path / "l.ply").write_text(header.replace("uchar red", "list uchar int rest"))
    with pytest.raises(ScanError, match=r"l\.ply: must hold only points"):
        read_points(tmp_path / "l.ply")
    with pytest.raises(ScanError, match=r"gone\.ply: cannot be read"):
        read_points(tmp_path / "gone.ply")
    (tmp_path / "c.ply").write_text("ply\nformat ascii 2.0\nend_header\n")
    with pytest.raises(ScanError, match=r"c\.ply: is no \.ply file of one of ascii 1\.0, "):
        read_points(tmp_path / "c.ply")
    text = header.replace("binary_little_endian", "ascii")
    (tmp_path / "t.ply").write_text(f"{text}1 2 3 255\n")
    assert read_points(tmp_path / "t.ply").tolist() == [[1, 2, 3]]


def test_killed_writer_leaves_no_scan(tmp_path, make_scans):
    """A kill leaves the temporary file, which no search takes for a scan."""
    raw = tmp_path / "data_3d_raw" / KITTI360_DRIVES["train"][0] / "velodyne_points/data"
    for folder in (tmp_path / "plain", raw):
        make_scans(folder, 1)
        with atomic_path(folder / "0000000001.bin") as temporary:
            temporary.write_bytes(ENOUGH.tobytes())
        temporary.write_bytes(b"half")
        assert len(list(folder.iterdir())) == 3
        assert [scan.frame for scan in find_scans(folder)] == ["0000000000", "0000000001"]
        assert not problems(folder)
    assert [scan.frame for scan in find_scans(f"{tmp_path}/plain/*")] == [
        "0000000000",
        "0000000001",
    ]
    assert len(kitti360_scans(tmp_path, "train")) == 2


def test_writers_refuse_what_no_reader_would_take(tmp_path):
    with pytest.raises(ValueError, match=r"got \(3, 2\)"):
        write_bin(tmp_path / "a.bin", POINTS[:, :2])
    with pytest.raises(ValueError, match="NaN or infinite"):
        write_ply(tmp_path / "a.ply", np.full((1, 3), np.nan))
    assert list(tmp_path.iterdir()) == []


def test_find_scans_in_folder_glob_list_and_file(tmp_path, make_scans):
    make_scans(tmp_path / "udacity/data_1", 2)
    make_scans(tmp_path / "kitti", 1)
    names = ["kitti/0000000000", "udacity/data_1/0000000000", "udacity/data_1/0000000001"]
    assert [scan.name for scan in find_scans(tmp_path)] == names
    assert [scan.name for scan in find_scans(f"{tmp_path}/**/*.bin")] == names
    both = [f"{tmp_path}/udacity", str(tmp_path / "kitti/0000000000.bin")]
    assert [scan.name for scan in find_scans(both)] == names
    (single,) = find_scans(str(tmp_path / "kitti/0000000000.bin"))
    assert single.name == "kitti/0000000000"
    assert [scan.name for scan in find_scans(tmp_path / "kitti")] == names[:1]
    with pytest.raises(ValueError, match=r"no scan found in .*nowhere"):
        find_scans(str(tmp_path / "nowhere"))
    (tmp_path / "mixed").mkdir()
    for name in ("a.ply", "a.pcd"):
        (tmp_path / "mixed" / name).touch()
    with pytest.raises(ValueError, match=r"1 \.pcd, 1 \.ply.*: give a folder of one \(in Python"):
        find_scans(tmp_path / "mixed")
    with pytest.raises(ValueError, match=r"given twice: .*kitti/0000000000\.bin"):
        find_scans([f"{tmp_path}/kitti", f"{tmp_path}/**/*.bin"])


@pytest.mark.parametrize(
    ("source", "names"),
    [
        (["a", "a/../b"], ["a/0000000000", "b/0000000000"]),
        (["below/c", "below/../../b"], ["b/0000000000", "run/below/c/0000000000"]),
        ("a/../*/*.bin", ["a/0000000000", "b/0000000000"]),
        ("below/link/../d", ["d/0000000000"]),  # as the system reads it: the one beside far/e
        (["below/link/../d", "../far/e"], ["d/0000000000", "e/0000000000"]),
    ],
)
def test_dots_in_a_source_lead_no_name_out_of_its_folder(
    source, names, tmp_path, make_scans, monkeypatch
):
    for folder in ("a", "b", "run/a", "run/b", "run/below/c", "run/below/d", "far/e", "far/d"):
        make_scans(tmp_path / folder, 1)
    (tmp_path / "run/below/link").symlink_to(tmp_path / "far/e")
    monkeypatch.chdir(tmp_path / "run")
    scans = find_scans(source)
    assert [scan.name for scan in scans] == names
    assert all(refuse_name(scan.name) is None for scan in scans)
    if "link" in str(source):
        assert scans[0].path.samefile(tmp_path / "far/d/0000000000.bin")


def test_one_file_under_two_names_is_given_twice(tmp_path, make_scans, monkeypatch):
    make_scans(tmp_path / "a", 1)
    monkeypatch.chdir(tmp_path)
    for other in ("a/../a", f"../{tmp_path.name}/a/*.bin", tmp_path / "a"):
        with pytest.raises(ValueError, match=r"given twice: .*a/0000000000\.bin"):
            find_scans(["a", other])


def test_names_that_no_file_can_have_everywhere_are_refused(tmp_path, make_scans):
    make_scans(tmp_path, 1)
    (tmp_path / "0000000000.bin").rename(tmp_path / "b\\0.bin")
    with pytest.raises(ValueError, match=r"name of the scan leads out of its folder.* rename"):
        find_scans(tmp_path)


def make_kitti360(root, make_scans, drives):
    for seed, drive in enumerate(drives):
        make_scans(root / "data_3d_raw" / drive / "velodyne_points/data", 2, seed)


def test_scans_in_the_official_layout_are_found(tmp_path, make_scans):
    drives = KITTI360_DRIVES["train"] + KITTI360_DRIVES["val"]
    make_kitti360(tmp_path, make_scans, drives)
    make_scans(tmp_path / "data_3d_raw" / drives[0] / "sick_points/data", 1)  # another sensor
    make_scans(tmp_path / "data_2d_raw", 1)
    assert not problems(tmp_path)
    assert {scan.drive for scan in kitti360_scans(tmp_path, "val")} == set(KITTI360_DRIVES["val"])
    assert set(find_scans(tmp_path)) == {
        scan for split in ("train", "val") for scan in kitti360_scans(tmp_path, split)
    }
    assert check(tmp_path)[0].startswith("".join(f"{drive}: 2 scans\n" for drive in sorted(drives)))


def test_links_to_folders_are_followed_once(tmp_path, make_scans):
    drives = KITTI360_DRIVES["train"] + KITTI360_DRIVES["val"]
    make_kitti360(tmp_path / "disk", make_scans, drives)
    for drive in drives:
        (tmp_path / "kitti/data_3d_raw").mkdir(parents=True, exist_ok=True)
        link = tmp_path / "kitti/data_3d_raw" / drive
        link.symlink_to(tmp_path / "disk/data_3d_raw" / drive)
    assert not problems(tmp_path / "kitti")
    assert len(kitti360_scans(tmp_path / "kitti", "val")) == 4
    make_scans(tmp_path / "elsewhere", 2)
    make_scans(tmp_path / "plain/b", 1)
    (tmp_path / "plain/a").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "plain/b/loop").symlink_to(tmp_path / "plain")
    (tmp_path / "plain/c").symlink_to(tmp_path / "plain/b")
    make_scans(tmp_path / "plain/.trash", 1)
    names = ["a/0000000000", "a/0000000001", "b/0000000000"]
    for source in ("plain", "plain/**/*.bin", "pl*/**/00*.bin", "plain/**/**"):
        assert [scan.name for scan in find_scans(tmp_path / source)] == names
    direct = [scan.drive for scan in find_scans(tmp_path / "plain/*/*0.bin")]
    assert direct == ["a", "b", "c"]
    assert [scan.name for scan in find_scans(tmp_path / "plain/**/b/**/*.bin")] == ["b/0000000000"]


def test_missing_folders_are_named(tmp_path, make_scans):
    raw = tmp_path / "data_3d_raw"
    assert problems(tmp_path / "none") == [f"missing: {tmp_path / 'none'}"]
    (tmp_path / "data_poses").mkdir()
    assert problems(tmp_path) == [f"missing: {raw}"]
    drives = sorted(KITTI360_DRIVES["train"] + KITTI360_DRIVES["val"])
    make_kitti360(tmp_path, make_scans, drives[:-2])
    (raw / drives[-2]).mkdir()
    missing = (raw / drives[-2] / "velodyne_points/data", raw / drives[-1])
    assert problems(tmp_path) == [f"missing: {folder}" for folder in missing]
    with pytest.raises(ValueError, match="r3dpa data check"):
        kitti360_scans(tmp_path / "none", "train")


def test_simulated_set_is_held_against_its_manifest(tmp_path, make_scans):
    drives = ["2013_05_28_drive_0003_sync", "2013_05_28_drive_0000_sync"]
    make_kitti360(tmp_path, make_scans, drives)
    manifest = tmp_path / "simulation.json"
    # One scan of up to seven goes to validation, the others to training.
    manifest.write_text(json.dumps({"scans": 3, "drives": ["0003", "0000"]}))
    assert not problems(tmp_path)
    manifest.write_text(json.dumps({"scans": 4, "drives": ["0003", "0000"]}))
    drive = tmp_path / "data_3d_raw" / drives[0]
    advice = "simulate again to complete it"
    assert problems(tmp_path) == [f"bad: {drive}: holds 2 of 3 scans; {advice}"]
    manifest.write_text(json.dumps({"scans": 4, "drives": ["0003", "0004", "0000"]}))
    gone = drive.with_name("2013_05_28_drive_0004_sync")
    assert problems(tmp_path) == [f"missing: {gone}"]
    manifest.write_text("{")
    with pytest.raises(ValueError, match="simulate the data set again"):
        check(tmp_path)


@pytest.mark.data
def test_real_scans(real_scans_dir):
    assert check(real_scans_dir)[0].splitlines()[:4] == [
        "kitti_object_vis/velodyne: 3 scans",
        "patchwork_plusplus: 6 scans",
        "udacity_sfnd/data_1: 10 scans",
        "udacity_sfnd/data_2: 11 scans",
    ]
    assert not problems(real_scans_dir)


@pytest.mark.fuzz
def test_a_member_of_an_archive_must_have_a_plain_name(tmp_path):
    array = io.BytesIO()
    np.save(array, POINTS)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("../../x.npy", array.getvalue())
    with pytest.raises(ValueError, match=r"a\.npz, member .*\(its name"):
        read_npz(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"a\.npz, member .*\(its name"):
        list(read_samples(tmp_path / "a.npz", LidarSensor(4, 16)))


@pytest.mark.fuzz
@pytest.mark.parametrize("count", [2**40, 2**62])
def test_an_array_that_claims_more_than_the_file_holds_is_refused(tmp_path, count):
    head = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({count}, 4)}}"
    data = b"\x93NUMPY\x01\x00\x76\x00" + head.encode().ljust(117) + b"\n" + bytes(64)
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.npy: cannot be read as an array"):
        list(read_samples(tmp_path / "a.npy", LidarSensor(4, 16)))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", data)
    with pytest.raises(ValueError, match=r"a\.npz, member 'a\.npy': is damaged"):
        read_npz(tmp_path / "a.npz")


@pytest.mark.fuzz
@pytest.mark.parametrize(("num_members", "claim"), [(1, 2**31), (4, 2**27)])
def test_an_archive_that_claims_more_than_it_holds_is_refused(tmp_path, num_members, claim):
    """One member alone, or all members together."""
    np.savez(tmp_path / "a.npz", *[POINTS] * num_members)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    size = 0
    for _ in range(num_members):
        size = data.index(b"PK\x01\x02", size) + 24  # of the unpacked size
        data[size : size + 4] = claim.to_bytes(4, "little")
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.npz: .*larger than the file"):
        read_npz(tmp_path / "a.npz")
