"""``r3dpa data convert``: formats, labels, and what is refused."""

import numpy as np
import pytest

from lidarsim import Simulator, load_sensor
from lidarsim.clouds import PointCloud, read_cloud, write_cloud
from lidarsim.scan_files import ScanError, read_scan
from r3dpa.cli import main


@pytest.fixture(scope="module")
def points():
    """A scan of 32 beams, ring after ring."""
    return Simulator(seed=1, sensor=load_sensor("hdl32e")).scan(0).points[:8000]


@pytest.fixture
def folder(points, tmp_path):
    """Two scans, one with labels, and a file of text."""
    root = tmp_path / "in"
    for name in ("a/0.bin", "b/1.bin"):
        (root / name).parent.mkdir(parents=True)
        (root / name).write_bytes(points.tobytes())
    (root / "a/0.label").write_bytes(np.arange(len(points), dtype="<u4").tobytes())
    (root / "notes.txt").touch()
    return root


def convert(*words):
    main(["data", "convert", *map(str, words)])


def files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))


def test_a_folder_to_nuscenes_and_back_is_the_same(folder, points, tmp_path, capsys):
    convert(folder, tmp_path / "five", "--to", "pcd.bin")
    assert files(tmp_path / "five") == ["a/0.label", "a/0.pcd.bin", "b/1.pcd.bin"]
    assert "2 scans written to" in capsys.readouterr().out
    cloud = read_cloud(tmp_path / "five/a/0.pcd.bin")
    assert cloud.intensity.max() > 1
    # nuScenes counts from the lowest beam; KITTI files begin with the highest.
    assert (np.diff(cloud.ring) <= 0).all()
    assert cloud.labels.tolist() == list(range(len(points)))
    convert(tmp_path / "five", tmp_path / "back", "--to", "bin")
    assert (tmp_path / "back/b/1.bin").read_bytes() == points.tobytes()
    capsys.readouterr()
    convert(folder / "b/1.bin", tmp_path / "one.ply")
    assert capsys.readouterr().out.startswith("1 scan written to")


def test_rings_counted_from_the_highest_are_turned_round(folder, tmp_path):
    convert(folder, tmp_path / "first", "--to", "pcd.bin")
    cloud = read_cloud(tmp_path / "first/a/0.pcd.bin")
    for name, ring in (("down", cloud.ring), ("up", cloud.ring.max() - cloud.ring)):
        write_cloud(tmp_path / f"{name}.ply", cloud.with_column("ring", ring.astype("u2")))
        convert(tmp_path / f"{name}.ply", tmp_path / f"{name}.pcd.bin")
        again = read_cloud(tmp_path / f"{name}.pcd.bin")
        np.testing.assert_array_equal(again.ring, cloud.ring)


def test_named_columns_and_full_scale(points, tmp_path):
    rows = np.column_stack([points[:, :3], points[:, 3] * 4000, np.zeros((len(points), 2))])
    (tmp_path / "six.bin").write_bytes(rows.astype("<f4").tobytes())
    with pytest.raises(ScanError, match=r"rather of 6 columns: name the columns with --columns"):
        convert(tmp_path / "six.bin", tmp_path / "four.bin")
    named = ["--columns", "x,y,z,intensity,ring,time"]
    with pytest.raises(
        ScanError, match=r"intensities up to 3.*full scale: give it to `r3dpa data c"
    ):
        convert(tmp_path / "six.bin", tmp_path / "four.bin", *named)
    convert(tmp_path / "six.bin", tmp_path / "four.bin", *named, "--full_intensity", "4000")
    np.testing.assert_allclose(read_scan(tmp_path / "four.bin"), points, atol=1e-6)


def test_further_columns_and_precision_stay(points, tmp_path):
    columns = {"time_s": np.arange(len(points)) / 1e6, "return_type": np.ones(len(points), "u1")}
    cloud = PointCloud.of(points.astype("f8"), **columns)
    for suffix in ("npz", "ply"):
        write_cloud(tmp_path / f"a.{suffix}", cloud)
        again = read_cloud(tmp_path / f"a.{suffix}")
        assert again.points.dtype == np.float64
        np.testing.assert_array_equal(again.points, cloud.points)
        np.testing.assert_array_equal(again.time_s, columns["time_s"])
        assert again.columns["return_type"].dtype == np.uint8


def test_targets_that_cannot_be_written_are_refused_before_anything_is(folder, points, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=r"unknown format ''; choose --to from bin, pcd\.bin, ply"):
        convert(folder, out)
    (folder / "a/0.npy").write_bytes((folder / "a/0.bin").read_bytes())
    with pytest.raises(ScanError, match=r"0\.npy: would be written as .*0\.ply, as would .*0\.bin"):
        convert(folder, out, "--to", "ply")
    assert not out.exists()
    (folder / "a/0.npy").unlink()
    with pytest.raises(ScanError, match=r"0\.bin: exists: delete it, or give another name"):
        convert(folder, folder, "--to", "bin")
    with pytest.raises(ScanError, match=r"1\.bin: exists: delete it, or give another name"):
        convert(folder / "a/0.bin", folder / "b/1.bin")
    shuffled = np.random.default_rng(0).normal(0, 9, (500, 4)).astype("<f4")
    shuffled[:, 3] = 0
    shuffled.tofile(folder / "b/1.bin")
    with pytest.raises(ScanError, match=r"1\.bin: has no column ring, and only \d+% of its points"):
        convert(folder / "b", out, "--to", "pcd.bin")
    assert not out.exists()


def test_the_command_that_is_advised_for_nan_leaves_them_out(points, tmp_path):
    rows = points.copy()
    rows[3, 2] = np.nan
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    with pytest.raises(ScanError, match=r"`r3dpa data convert SCANS OUT .*` leaves") as raised:
        read_scan(tmp_path / "a.bin")
    options = str(raised.value).split("`")[1].partition("SCANS OUT")[2].split()
    convert(tmp_path / "a.bin", tmp_path / "out", *options)
    assert np.array_equal(read_scan(tmp_path / "out/a.bin"), np.delete(points, 3, axis=0))


def test_labels_of_another_file_of_that_name_stay(points, tmp_path):
    """Without the dropped point there are fewer labels; the ones beside the source are all."""
    rows = points.copy()
    rows[3, 2] = np.nan
    np.save(tmp_path / "a.npy", rows)
    labels = np.arange(len(points), dtype="<u4").tobytes()
    (tmp_path / "a.label").write_bytes(labels)
    with pytest.raises(ScanError, match=r"a\.label: exists: delete it, or give another name"):
        convert(tmp_path / "a.npy", tmp_path / "a.bin", "--drop_nan", "true")
    assert (tmp_path / "a.label").read_bytes() == labels
    assert not (tmp_path / "a.bin").exists()
    np.save(tmp_path / "a.npy", points)
    convert(tmp_path / "a.npy", tmp_path / "a.bin")
    assert (tmp_path / "a.label").read_bytes() == labels


def test_a_topic_is_for_bags(folder, tmp_path):
    with pytest.raises(ValueError, match="topic '/points' is given, but it is no bag"):
        convert(folder, tmp_path / "out", "--to", "ply", "--topic", "/points")


def test_las_keeps_classes_above_31(points, tmp_path):
    pytest.importorskip("laspy")
    classes = np.arange(len(points)) % 256
    cloud = PointCloud.of(points, classification=classes.astype("u1"))
    write_cloud(tmp_path / "a.las", cloud)
    assert read_cloud(tmp_path / "a.las").columns["classification"].tolist() == classes.tolist()


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("classification", np.uint16([300])),
        ("classification", np.float32([0.7])),
        ("return_number", np.int64([20])),
        ("half", np.float16([0.5])),
        ("flag", np.bool_([True])),
        ("a name of more than thirty-two characters", np.float32([0.5])),
    ],
)
def test_las_refuses_what_it_cannot_hold(points, tmp_path, name, values):
    pytest.importorskip("laspy")
    cloud = PointCloud.of(points, **{name: np.resize(values, len(points))})
    message = f"column '{name}' of {values.dtype} does not fit into .las"
    with pytest.raises(ScanError, match=message):
        write_cloud(tmp_path / "a.las", cloud)
    assert not (tmp_path / "a.las").exists()


def test_a_full_intensity_is_positive(folder, tmp_path):
    for full in ("0", "-1"):
        with pytest.raises(ValueError, match="full_intensity must be positive"):
            convert(folder, tmp_path / "out", "--to", "npy", f"--full_intensity={full}")
    assert not (tmp_path / "out").exists()
