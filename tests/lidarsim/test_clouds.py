"""Formats of scans: columns, round trips, and what is wrong with a file."""

import math
import struct
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from numpy.lib.recfunctions import unstructured_to_structured

from lidarsim.changed_scans import write_below
from lidarsim.clouds import PointCloud, read_cloud, write_cloud
from lidarsim.faults import STRENGTHS, Fault
from lidarsim.scan_files import ScanError, read_clouds
from lidarsim.scan_folders import find_files
from lidarsim.weather import Weather, changed_cloud, recorded_scan

random = np.random.default_rng(0)
NUM = 40
POINTS = random.uniform(-30, 30, (NUM, 3)).astype(np.float32)
INTENSITY = random.integers(0, 256, NUM).astype(np.float32)
RING = np.repeat(np.arange(4), NUM // 4)
ROWS = np.concatenate([POINTS, INTENSITY[:, None], RING[:, None]], axis=1, dtype=np.float32)
FIELDS = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4"), ("ring", "u2"), ("t", "f8")]
TABLE = np.array([(*row, n / 300) for n, row in enumerate(ROWS)], FIELDS)


def text(table):
    return "".join(" ".join(f"{value:.9g}" for value in row) + "\n" for row in table.tolist())


def pcd(mode, body, table=TABLE):
    names, kinds, sizes = zip(*((n, k[0].upper(), k[1]) for n, k in FIELDS), strict=True)
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {' '.join(sizes)}\n"
    head += f"TYPE {' '.join(kinds)}\nCOUNT {' '.join('1' * len(FIELDS))}\nWIDTH 2\n"
    head += f"HEIGHT {len(table) // 2}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(table)}\n"
    return f"{head}DATA {mode}\n".encode() + body


def stored(data):
    """As liblzf writes what cannot be compressed: runs of 32 literals."""
    parts = (data[first : first + 32] for first in range(0, len(data), 32))
    packed = b"".join(bytes([len(part) - 1]) + part for part in parts)
    return struct.pack("<II", len(packed), len(data)) + packed


def ply(kind, order=""):
    names = {"f4": "float", "u2": "ushort", "f8": "double"}
    lines = [f"property {names[code]} {name}" for name, code in FIELDS]
    head = ["ply", f"format {kind} 1.0", "comment kept", f"element vertex {NUM}", *lines]
    body = (
        TABLE.astype(TABLE.dtype.newbyteorder(order)).tobytes() if order else text(TABLE).encode()
    )
    tail = ["element face 0", "property list uchar int vertex_index", "end_header", ""]
    return "\n".join([*head, *tail]).encode() + body


def npy(path):
    np.save(path, ROWS.astype("f8"))


def write(path, content):
    """A file of bytes, or of a function that writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content(path) if callable(content) else path.write_bytes(content)


FILES = {
    "kitti.bin": (4, ROWS[:, :4].tobytes()),
    "nuscenes.pcd.bin": (5, ROWS.tobytes()),
    "five.bin": (5, ROWS.tobytes()),
    "ascii.pcd": (6, pcd("ascii", text(TABLE).encode())),
    "binary.pcd": (6, pcd("binary", TABLE.tobytes())),
    "packed.pcd": (
        6,
        pcd("binary_compressed", stored(b"".join(TABLE[n].tobytes() for n, _ in FIELDS))),
    ),
    "ascii.ply": (6, ply("ascii")),
    "little.ply": (6, ply("binary_little_endian", "<")),
    "big.ply": (6, ply("binary_big_endian", ">")),
    "rows.npy": (4, lambda path: np.save(path, ROWS[:, :4].astype("f8"))),
    "named.npy": (6, lambda path: np.save(path, TABLE)),
    "rows.npz": (4, lambda path: np.savez(path, ROWS[:, :4])),
    "named.npz": (6, lambda path: np.savez(path, **{n: TABLE[n] for n, _ in FIELDS})),
}


@pytest.mark.parametrize("name", FILES)
def test_every_format_gives_the_columns_and_is_written_again(tmp_path, name):
    num_columns, content = FILES[name]
    path, out = tmp_path / "in" / "a" / name, tmp_path / "out"
    write(path, content)
    file = read_cloud(path)
    scan = recorded_scan(file)
    assert scan.points.dtype == np.float32
    assert len(file.table.dtype.names) == num_columns
    np.testing.assert_array_equal(scan.points, POINTS)
    np.testing.assert_array_equal(scan.intensity, INTENSITY)
    if num_columns > 4:
        np.testing.assert_array_equal(scan.ring, RING)
    if num_columns == 6:
        np.testing.assert_allclose(scan.time_s, TABLE["t"] - TABLE["t"].min(), atol=1e-12)
    low, high = INTENSITY.min(), INTENSITY.max()
    assert f"40 points, range {np.linalg.norm(POINTS, axis=1).min():.3g}.." in file.describe()
    assert f"intensity {low:g}..{high:g}" in file.describe()

    write_below(file, tmp_path / "in", out)
    again = read_cloud(out / "a" / name)
    np.testing.assert_array_equal(again.table, file.table)
    if name not in ("packed.pcd", "ascii.ply", "ascii.pcd", "binary.pcd", "rows.npz", "named.npz"):
        assert (out / "a" / name).read_bytes() == path.read_bytes()
    # Half of the rows are a smaller file of the same kind.
    half = replace(file, table=file.table[::2], file=file.file._replace(data=None))
    write_below(half, tmp_path / "in", out)
    np.testing.assert_array_equal(read_cloud(out / "a" / name).table, file.table[::2])


@pytest.mark.parametrize(
    ("unit", "kind"), [(1, "f4"), (1e3, "f4"), (1e6, "u4"), (1e9, "u4"), (1e9, "u8")]
)
def test_times_are_seconds_whatever_the_unit_of_the_file(unit, kind):
    """A tenth of a second of points, as in a turn of most sensors."""
    time_s = np.linspace(0, 0.1, len(POINTS))
    cloud = PointCloud.of(POINTS, t=(time_s * unit + unit).astype(kind))
    np.testing.assert_allclose(recorded_scan(cloud).time_s, time_s, atol=1e-6)


def test_a_cloud_without_points_says_so():
    with pytest.raises(ScanError, match=r"points must be \(P, 3\) with at least one point"):
        recorded_scan(PointCloud.of(np.zeros((0, 3), np.float32), t=[]))


NOTHING = [
    *({}, {"visibility_m": math.inf}, {"rain_mm_h": 0.0}, {"snow_mm_h": 0.0}),
    *({"water_film_mm": 0.0, "traffic_m_s": 25.0}, {"sun_elevation_deg": 80.0}),
]


@pytest.mark.parametrize("name", FILES)
def test_no_strength_of_any_effect_or_fault_gives_the_same_file(tmp_path, name):
    path, out = tmp_path / "in" / name, tmp_path / "out"
    write(path, FILES[name][1])
    file = read_cloud(path)
    changes = [Weather(**weather) for weather in NOTHING]
    changes += [Fault(kind, severity=0) for kind in STRENGTHS]
    for change in changes:
        write_below(change.apply(file), tmp_path / "in", out)
        assert (out / name).read_bytes() == path.read_bytes(), change


def test_added_points_have_the_other_columns_of_their_shot(tmp_path):
    path = tmp_path / "a.npy"
    np.save(path, TABLE)
    file = read_cloud(path)
    result = Weather(visibility_m=20).apply(recorded_scan(file))
    changed = changed_cloud(file, result)
    new = result.index < 0
    assert new.any()
    for name in ("ring", "t"):
        np.testing.assert_array_equal(changed.table[name], TABLE[name][result.shot])
    np.testing.assert_array_equal(changed.points[new], result.points[new])


@pytest.mark.parametrize(("kind", "unit"), [("f4", 1), ("u4", 1000), ("f8", 0.01)])
def test_ranges_follow_moved_and_added_points(kind, unit):
    range_m = np.linalg.norm(POINTS, axis=1)
    columns = {"intensity": INTENSITY, "range": (unit * range_m).astype(kind), "depth": RING}
    cloud = PointCloud.of(POINTS, **columns)
    changed = Weather(visibility_m=20).apply(cloud)
    kept = np.isin(changed.points, POINTS).all(axis=1)
    assert 0 < kept.sum() < len(changed)
    expected = unit * np.linalg.norm(changed.points, axis=1)
    step = 1 if kind == "u4" else 1e-5 * unit
    assert np.abs(changed.columns["range"] - expected).max() <= step * (1 + 1e-6 * NUM)
    assert set(changed.columns["depth"]) <= set(RING)  # no ranges, whatever the name


def test_an_organised_array_is_points_with_their_beam(tmp_path):
    xyz = POINTS.reshape(4, NUM // 4, 3).copy()
    xyz[1, 2], xyz[2, 3] = 0, np.nan
    shares = INTENSITY.reshape(4, -1)
    np.save(tmp_path / "a.npy", np.concatenate([xyz, shares[..., None]], axis=2))
    np.savez(tmp_path / "a.npz", intensity=shares, xyz=xyz, pose=np.eye(4))
    np.savez(tmp_path / "b.npz", points=xyz, intensity=shares, ring=shares.astype("u2") % 4)
    seen = xyz.any(axis=2) & np.isfinite(xyz).all(axis=2)
    np.savez(tmp_path / "c.npz", np.concatenate([xyz, shares[..., None]], axis=2))
    table = unstructured_to_structured(
        np.concatenate([xyz, shares[..., None]], axis=2),
        np.dtype([(n, "f4") for n in ("x", "y", "z", "intensity")]),
    )
    np.save(tmp_path / "d.npy", table)
    np.savez(tmp_path / "d.npz", table)
    for name in ("a.npy", "a.npz", "b.npz", "c.npz", "d.npy", "d.npz"):
        cloud = read_cloud(tmp_path / name)
        np.testing.assert_array_equal(cloud.points, xyz[seen])
        np.testing.assert_array_equal(cloud.intensity, shares[seen])
        ring = shares.astype("u2") % 4 if name == "b.npz" else np.indices((4, NUM // 4))[0]
        np.testing.assert_array_equal(cloud.ring, ring[seen])
        half = replace(cloud, table=cloud.table[::2], file=cloud.file._replace(data=None))
        write_cloud(tmp_path / f"half_{name}", half)
        again = read_cloud(tmp_path / f"half_{name}")
        np.testing.assert_array_equal(again.points, cloud.points[::2])
        np.testing.assert_array_equal(again.intensity, cloud.intensity[::2])
        np.testing.assert_array_equal(again.ring, cloud.ring[::2])
    with np.load(tmp_path / "half_a.npz") as arrays:
        assert arrays["pose"].tolist() == np.eye(4).tolist()


@pytest.mark.parametrize("suffix", ["bin", "npz", "ply"])
def test_a_changed_column_is_written(tmp_path, suffix):
    write_cloud(tmp_path / f"a.{suffix}", PointCloud.of(POINTS))
    cloud = read_cloud(tmp_path / f"a.{suffix}")
    halves = np.full(NUM, 0.5, np.float32)
    write_cloud(tmp_path / f"b.{suffix}", cloud.with_column("intensity", halves))
    assert (read_cloud(tmp_path / f"b.{suffix}").intensity == 0.5).all()


def test_arrays_of_npz_are_read_as_other_files_are(tmp_path):
    """One array may be organised; a file of several scans has no NaN either."""
    np.savez(tmp_path / "one.npz", POINTS.reshape(4, -1, 3))
    (points,) = read_clouds(tmp_path / "one.npz").values()
    np.testing.assert_array_equal(points, POINTS)
    np.savez(tmp_path / "two.npz", a=POINTS, b=NAN[:, :3])
    with pytest.raises(ScanError, match=r"two\.npz: b has NaN or infinite values in 1 of 40"):
        read_clouds(tmp_path / "two.npz")


def test_columns_named_by_two_axes_stay(tmp_path):
    cloud = PointCloud.of(POINTS, xy=np.arange(NUM), yz=-np.arange(NUM))
    write_cloud(tmp_path / "a.npz", cloud)
    columns = read_cloud(tmp_path / "a.npz").columns
    assert {name: column.tolist() for name, column in columns.items()} == {
        "xy": list(range(NUM)),
        "yz": [-number for number in range(NUM)],
    }


def test_clouds_need_numpy_alone():
    code = "import sys, lidarsim.clouds; print({'scipy', 'torch'} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "set()"


def bad_npz(path):
    np.savez(path, ROWS, RING)


NAN = ROWS[:, :4].copy()
NAN[3, 1] = np.nan
ZERO = ROWS[:, :4] * [1, 1, 1, -1]
BAD = {
    "empty.bin": (b"", "is empty"),
    "cut.bin": (
        ROWS.tobytes()[:-3],
        "797 bytes, not a multiple of 16 or 20 (x, y, z, intensity as float32)",
    ),
    "negative.bin": (ZERO.astype("f4").tobytes(), "name the columns with --columns"),
    "one.bin": (ROWS[:1, :4].tobytes(), "holds 1 of at least 16 points; remove it"),
    "nan.bin": (
        NAN.tobytes(),
        "NaN or infinite values in 1 of 40 points; `r3dpa data convert SCANS OUT --to bin --drop",
    ),
    "far.bin": ((ROWS[:, :4] * 100).tobytes(), "which are no metres: divide"),
    "near.bin": ((ROWS[:, :4] / 100).tobytes(), "which are no metres: multiply"),
    "scan.csv": (b"1,2,3", "is of no known format; can be read: .bin"),
    "scan.las": (b"LASF", "laspy" if find_spec("laspy") is None else "is damaged"),
    "short.pcd": (pcd("binary", TABLE.tobytes()[:-1]), "is damaged or of another layout"),
    "rows.pcd": (pcd("binary", TABLE[:-1].tobytes()), "is damaged: holds 39 of 40 points"),
    "head.pcd": (b"VERSION 0.7\n", "is damaged or of another layout"),
    "bomb.pcd": (pcd("binary_compressed", stored(bytes(99))), "is damaged"),
    "faces.ply": (ply("ascii").replace(b"face 0", b"face 2"), "must hold only points"),
    "noz.ply": (ply("ascii").replace(b"float z", b"float w"), "has no column z, only x, y, w"),
    "int.ply": (ply("ascii").replace(b"float z", b"int z"), "must"),
    "wide.npy": (lambda path: np.save(path, np.ones((40, 7))), "not rows of 5 floats"),
    "time.npy": (
        lambda path: np.save(path, np.column_stack([ROWS[:, :4], RING / 7])),
        "not rows of 5 floats that can be x, y, z, intensity, ring: name the columns",
    ),
    "two.npz": (bad_npz, "must hold one scan"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_named_in_one_line(tmp_path, name):
    content, message = BAD[name]
    path = tmp_path / name
    write(path, content)
    with pytest.raises(ScanError) as raised:
        read_cloud(path).check_metres()
    assert str(raised.value).startswith(f"{path}: ")
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("name", "file"), [("höhe", "a.ply"), ("file", "a.npz"), ("xyz", "a.npz")])
def test_a_column_that_a_format_cannot_name_is_refused(tmp_path, name, file):
    cloud = PointCloud.of(POINTS, **{name: RING})
    with pytest.raises(ScanError, match=rf"column '{name}' cannot be written to {file[1:]}"):
        write_cloud(tmp_path / file, cloud)
    assert not (tmp_path / file).exists()


def test_a_comment_in_utf_8_stays_in_the_header_of_a_ply(tmp_path):
    write_cloud(tmp_path / "a.ply", PointCloud.of(POINTS))
    head, _, rest = (tmp_path / "a.ply").read_bytes().partition(b"element")
    (tmp_path / "a.ply").write_bytes(head + "comment Höhe\nelement".encode() + rest)
    cloud = read_cloud(tmp_path / "a.ply")
    write_cloud(tmp_path / "b.ply", cloud.changed(np.arange(10), cloud.points[:10]))
    assert "comment Höhe\n".encode() in (tmp_path / "b.ply").read_bytes()
    np.testing.assert_array_equal(read_cloud(tmp_path / "b.ply").points, POINTS[:10])


def test_columns_can_be_named_and_points_without_return_dropped(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(NAN.tobytes())
    named = read_cloud(path, ("x", "y", "z", "time"), drop_nan=True)
    assert named.intensity is None
    np.testing.assert_array_equal(named.time_s, np.delete(INTENSITY, 3))
    with pytest.raises(ScanError, match="has no column z, only x, y, q, i"):
        read_cloud(path, ("x", "y", "q", "i"))


@pytest.mark.parametrize(
    ("scan", "labels", "written"),
    [
        ("s/a.bin", "s/a.label", "s/a.label"),
        ("s/a.bin", "s/labels/a.label", "s/labels/a.label"),
        ("velodyne/a.pcd.bin", "labels/a.label", "labels/a.label"),
        ("velodyne/100.1.bin", "labels/100.1.label", "labels/100.1.label"),
        ("a.bin", "../labels/a.label", "a.label"),
    ],
)
def test_labels_go_with_their_scan(tmp_path, scan, labels, written):
    root, out = tmp_path / "root", tmp_path / "out"
    values = np.arange(NUM, dtype="<u4") | 7 << 16
    for place, data in ((scan, ROWS), (labels, values)):
        (root / place).resolve().parent.mkdir(parents=True, exist_ok=True)
        (root / place).resolve().write_bytes(data.tobytes())
    folder, (path,) = find_files(root)
    file = read_cloud(path)
    np.testing.assert_array_equal(file.labels, values)
    write_below(file, folder, out)
    assert (out / written).read_bytes() == values.tobytes()
    (root / labels).resolve().write_bytes(values[:-1].tobytes())
    with pytest.raises(ScanError, match=r"holds 39 labels but .* 40 points: delete the one"):
        read_cloud(path)


def test_range_images_of_a_folder_of_scenes_are_no_scans(tmp_path):
    """An array of such a name elsewhere is one."""
    for place in ("range_m.npy", "edit/before.npy", "own/range_m.npy"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        np.save(tmp_path / place, np.ones((4, 4)))
    for place in ("metadata.json", "bin/000000.bin", "edit/metadata.json"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_bytes(ROWS.tobytes())
    found = [file.relative_to(tmp_path).as_posix() for file in find_files(tmp_path)[1]]
    assert found == ["bin/000000.bin", "own/range_m.npy"]


def test_labels_of_another_time_stamp_are_not_taken(tmp_path):
    for name in ("100.1.bin", "100.2.bin"):
        (tmp_path / name).write_bytes(ROWS.tobytes())
    for name in ("100.label", "100.2.label"):
        (tmp_path / name).write_bytes(bytes(4 * NUM))
    assert read_cloud(tmp_path / "100.1.bin").labels is None
    assert read_cloud(tmp_path / "100.2.bin").file.label_path == tmp_path / "100.2.label"


def test_a_missing_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pypcd4", None)
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd("binary", TABLE.tobytes()))
    with pytest.raises(ScanError, match=r"a\.pcd: \.pcd needs pypcd4: pip install 'r3dpa\[pcd\]'"):
        read_cloud(path)
