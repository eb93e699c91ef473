import json
import pickle
import re
import time
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import numpy as np
import pytest
import torch

from r3dpa.data.feature_grids import FeatureGridError, FeatureGrids, write_feature_grids
from r3dpa.data.scans import ScanError, find_scans, read_scan
from r3dpa.geometry import LidarSensor, RingProjection, SphericalProjection, pool_cells

GRID = (2, 4)
FILES = ("a/grids.npy", "a/index.json", "town/b/grids.npy", "town/b/index.json")


def read(grids, scan):
    return grids.read(scan, scan.path.stat().st_size)


@pytest.fixture
def projection(sensor):
    return SphericalProjection(sensor)


@pytest.fixture
def folder(tmp_path, make_scans):
    make_scans(tmp_path / "scans/a", 3)
    make_scans(tmp_path / "scans/town/b", 2, seed=1)
    return tmp_path / "scans"


@pytest.fixture
def made(folder, tmp_path, projection, scaled_points):
    scans = find_scans(folder)
    write_feature_grids(scans, scaled_points(), projection, GRID, tmp_path / "grids")
    return scans, tmp_path / "grids"


def test_grid_is_the_cell_mean_in_half_precision(made, projection, scaled_points):
    scans, root = made
    grids = FeatureGrids(root, scans, projection, GRID, scaled_points())
    assert grids.dim == 4
    for scan in scans:
        points = torch.from_numpy(read_scan(scan.path))
        expected, counts = pool_cells(points[:, :3], points, projection, GRID)
        grid = read(grids, scan)
        assert grid.dtype == torch.float32
        assert torch.equal(grid, expected.half().float())
        assert counts.sum() == len(points)
    assert np.load(root / "town/b/grids.npy", mmap_mode="r").dtype == np.float16


@pytest.mark.parametrize("workers", [0, 2])
def test_workers_give_the_same_files(tmp_path, made, projection, scaled_points, workers):
    scans, root = made
    calls = []
    count = write_feature_grids(
        scans,
        scaled_points(),
        projection,
        GRID,
        tmp_path / "again",
        workers=workers,
        progress=lambda done, total: calls.append((done, total)),
    )
    assert count == 5
    assert calls == [(i, 5) for i in range(1, 6)]
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (root / name).read_bytes()


def test_linear_last_step_is_taken_after_pooling(tmp_path, folder, projection, scaled_points):
    class Lifted(scaled_points):
        def point_features(self, points):
            return points * 0.5

        def lift(self, features):
            return features * 2

    scans, extractor = find_scans(folder), Lifted()
    write_feature_grids(scans, extractor, projection, GRID, tmp_path / "lifted")
    write_feature_grids(scans, scaled_points(), projection, GRID, tmp_path / "plain")
    assert extractor.calls == 0
    one, two = (np.load(tmp_path / kind / "a/grids.npy") for kind in ("lifted", "plain"))
    assert np.array_equal(one, two)


def refused(made, projection, grid_size, extractor, words):
    scans, root = made
    for attempt in (
        lambda: FeatureGrids(root, scans, projection, grid_size, extractor),
        lambda: write_feature_grids(scans, extractor, projection, grid_size, root),
    ):
        with pytest.raises(FeatureGridError) as caught:
            attempt()
        for word in [*words, "features_dir", "r3dpa features"]:
            assert word in str(caught.value)


def test_other_sensor_is_refused(made, scaled_points):
    other = SphericalProjection(LidarSensor(beams=8, columns=32, range_max_m=40.0))
    refused(made, other, GRID, scaled_points(), ["56.0", "40.0"])


def test_other_projection_is_refused(made, sensor, scaled_points):
    rings = RingProjection(sensor, tuple(float(-row) for row in range(8)))
    refused(made, rings, GRID, scaled_points(), ["'spherical'", "'rings'"])


def test_other_grid_size_is_refused(made, projection, scaled_points):
    refused(made, projection, (4, 4), scaled_points(), ["[2, 4]", "[4, 4]"])


def test_other_extractor_is_refused(made, projection, scaled_points):
    refused(made, projection, GRID, scaled_points(gain=3.0), ["'gain': 1.0", "'gain': 3.0"])
    other = scaled_points()
    other.name = "scalr"
    refused(made, projection, GRID, other, ["'scaled'", "'scalr'"])
    scans, root = made
    assert FeatureGrids(root, scans, projection, GRID).dim == 4  # any extractor, if none is named


def test_missing_grid_names_the_scan_and_the_command(made, projection, make_scans, folder):
    _, root = made
    make_scans(folder / "a", 4)
    with pytest.raises(FeatureGridError, match=r"a/0000000003\.bin.*r3dpa features"):
        FeatureGrids(root, find_scans(folder), projection, GRID)
    (folder / "a/0000000003.bin").unlink()
    make_scans(folder / "c", 1)
    with pytest.raises(FeatureGridError, match=r"c/0000000000\.bin.*r3dpa features"):
        FeatureGrids(root, find_scans(folder), projection, GRID)


def test_new_scans_are_added_and_old_grids_kept(
    made, projection, make_scans, folder, scaled_points
):
    _, root = made
    before = np.load(root / "a/grids.npy")
    make_scans(folder / "a", 4)
    extractor = scaled_points()
    assert write_feature_grids(find_scans(folder), extractor, projection, GRID, root) == 1
    assert extractor.calls == 1
    after = np.load(root / "a/grids.npy")
    assert np.array_equal(after[:3], before)
    scan = find_scans(folder)[3]
    points = torch.from_numpy(read_scan(scan.path))
    expected, _ = pool_cells(points[:, :3], points, projection, GRID)
    grids = FeatureGrids(root, find_scans(folder), projection, GRID)
    assert torch.equal(read(grids, scan), expected.half().float())


def test_replaced_scan_is_noticed(made, projection, scaled_points):
    scans, root = made
    before = [read(FeatureGrids(root, scans, projection, GRID), scan) for scan in scans]
    scans[1].path.write_bytes(scans[3].path.read_bytes()[:-16])
    with pytest.raises(FeatureGridError, match=re.escape(str(scans[1].path)) + ".*replaced"):
        read(FeatureGrids(root, scans, projection, GRID), scans[1])
    assert write_feature_grids(scans, scaled_points(), projection, GRID, root) == 1
    grids = FeatureGrids(root, scans, projection, GRID)
    same = [torch.equal(read(grids, scan), old) for scan, old in zip(scans, before, strict=True)]
    assert same == [True, False, True, True, True]


@pytest.mark.parametrize(("workers", "error"), [(0, RuntimeError), (0, ScanError), (2, ScanError)])
def test_an_error_keeps_what_was_made(tmp_path, made, projection, scaled_points, workers, error):
    """At the last of five scans, an interruption or a damaged file."""
    (scans, complete), root = made, tmp_path / "again"
    extractor, data = scaled_points(), scans[4].path.read_bytes()
    if error is RuntimeError:
        extractor.fail_after = 4
    else:
        scans[4].path.write_bytes(data[:-3])
    with pytest.raises(error):
        write_feature_grids(scans, extractor, projection, GRID, root, workers=workers)
    FeatureGrids(root, scans[:4], projection, GRID)
    with pytest.raises(FeatureGridError, match="No feature grid"):
        FeatureGrids(root, scans, projection, GRID)
    scans[4].path.write_bytes(data)
    assert write_feature_grids(scans, scaled_points(), projection, GRID, root) == 1
    for name in FILES:
        assert (root / name).read_bytes() == (complete / name).read_bytes()


def test_a_killed_writer_leaves_nothing_that_counts(folder, made, projection, scaled_points):
    """Killed with a row half written: rows that the index does not name are made again."""
    scans, root = made
    whole = (root / "a/grids.npy").read_bytes()
    index = json.loads((root / "a/index.json").read_text())
    del index["scans"]["0000000002"]
    (root / "a/index.json").write_text(json.dumps(index))
    (root / "a/grids.npy").write_bytes(whole[:-30])
    assert write_feature_grids(scans, scaled_points(), projection, GRID, root) == 1
    assert (root / "a/grids.npy").read_bytes() == whole


def test_two_writers_at_once_make_each_grid_once(tmp_path, made, projection, scaled_points):
    (scans, complete), root = made, tmp_path / "again"
    started = Event()

    class Slow(scaled_points):
        def forward(self, points):
            started.set()
            time.sleep(0.05)
            return super().forward(points)

    def write(extractor):
        return write_feature_grids(scans, extractor, projection, GRID, root)

    with ThreadPoolExecutor() as pool:
        first = pool.submit(write, Slow())
        started.wait()
        second = pool.submit(write, scaled_points())
        assert (first.result(), second.result()) == (5, 0)
    for name in FILES:
        assert (root / name).read_bytes() == (complete / name).read_bytes()


def test_drives_within_drives(tmp_path, make_scans, projection, scaled_points):
    make_scans(tmp_path / "s/seq", 2)
    make_scans(tmp_path / "s/seq/extra", 2, seed=1)
    scans = find_scans(tmp_path / "s")
    assert [scan.drive for scan in scans] == ["seq", "seq", "seq/extra", "seq/extra"]
    root = tmp_path / "grids"
    assert write_feature_grids(scans[2:], scaled_points(), projection, GRID, root) == 2
    assert write_feature_grids(scans, scaled_points(), projection, GRID, root) == 2
    FeatureGrids(root, scans, projection, GRID)


def test_a_disk_without_space_is_refused_before_the_first_grid(
    tmp_path, made, projection, scaled_points, monkeypatch
):
    scans, _ = made
    extractor = scaled_points()
    extractor.dim = 10**14
    # 5 grids of 2 x 4 cells, 1e14 wide, 2 bytes each.
    with pytest.raises(FeatureGridError, match=r"5 feature grids need 8000000\.0 GB, but .* free"):
        write_feature_grids(scans, extractor, projection, GRID, tmp_path / "again")
    assert extractor.calls == 0


def test_a_folder_that_cannot_be_written_is_named(tmp_path, made, projection, scaled_points):
    scans, complete = made
    (tmp_path / "file").touch()
    with pytest.raises(FeatureGridError, match=r"file/grids .*give a features_dir"):
        write_feature_grids(scans, scaled_points(), projection, GRID, tmp_path / "file/grids")
    (complete / ".lock").unlink()
    assert write_feature_grids(scans, scaled_points(), projection, GRID, complete) == 0
    assert not (complete / ".lock").exists()  # complete grids may lie on a read-only disk


@pytest.mark.parametrize("text", ["{", "{}", '{"settings": 3, "scans": {}}'])
def test_a_damaged_index_is_named(made, projection, scaled_points, text):
    scans, root = made
    (root / "a/index.json").write_text(text)
    with pytest.raises(FeatureGridError, match=r"a/index\.json is damaged"):
        FeatureGrids(root, scans, projection, GRID)


def test_bad_scan_and_bad_features_name_the_file(tmp_path, folder, projection, scaled_points):
    scans = find_scans(folder)
    with pytest.raises(FeatureGridError, match=r"a/0000000000\.bin.*NaN"):
        write_feature_grids(
            scans, scaled_points(gain=float("nan")), projection, GRID, tmp_path / "nan"
        )
    assert write_feature_grids(scans, scaled_points(), projection, GRID, tmp_path / "nan") == 5
    scans[1].path.write_bytes(b"123")
    with pytest.raises(ScanError, match=r"a/0000000001\.bin"):
        write_feature_grids(scans, scaled_points(), projection, GRID, tmp_path / "g", workers=1)


def test_large_features_stay_finite(tmp_path, folder, projection, scaled_points):
    scans = find_scans(folder)
    write_feature_grids(scans, scaled_points(gain=1e6), projection, GRID, tmp_path / "g")
    grids = FeatureGrids(tmp_path / "g", scans, projection, GRID)
    assert all(torch.isfinite(read(grids, scan)).all() for scan in scans)


def test_grids_travel_to_other_processes_without_their_maps(made, projection):
    scans, root = made
    grids = FeatureGrids(root, scans, projection, GRID)
    expected = read(grids, scans[0])
    data = pickle.dumps(grids)
    assert len(data) < 10_000
    copy = pickle.loads(data)  # noqa: S301 - made two lines above
    assert torch.equal(read(copy, scans[0]), expected)
    assert json.loads((root / "a/index.json").read_text())["scans"]["0000000000"] == 4800


def test_each_grid_belongs_to_its_scan(made, projection):
    scans, root = made
    grids = FeatureGrids(root, scans[::-1], projection, GRID)
    sums = {scan.name: read(grids, scan).sum().item() for scan in scans}
    assert len(set(sums.values())) == 5
