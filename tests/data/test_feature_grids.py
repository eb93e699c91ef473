import os
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event

import numpy as np
import pytest
import torch

from lidarsim.scan_files import ScanError
from r3dpa.data import (
    FeatureGrids,
    StoreError,
    find_scans,
    pooled_grids,
    read_scan,
    write_feature_grids,
)
from r3dpa.data.datasets import PointDataset
from r3dpa.data.feature_grids import any_settings, plan
from r3dpa.geometry import LidarSensor, RingProjection, SphericalProjection, pool_cells

GRID = (2, 4)


@pytest.fixture
def folder(tmp_path, make_scans):
    make_scans(tmp_path / "scans/a", 3)
    make_scans(tmp_path / "scans/town/b", 2, seed=1)
    return tmp_path / "scans"


@pytest.fixture
def made(folder, tmp_path, projection, scaled_points):
    scans = find_scans(folder)
    write_feature_grids(scans, scaled_points(), projection, [GRID], tmp_path / "grids")
    return scans, tmp_path / "grids"


def cell_means(scan, projection, grid_size=GRID):
    """The grid of the extractor of the fixtures."""
    points = torch.from_numpy(read_scan(scan.path))
    return pool_cells(points[:, :3], points, projection, grid_size)[0]


def assert_grids(root, scans, projection, size=GRID):
    grids = FeatureGrids(root, scans, projection, size)
    for scan in scans:
        assert torch.equal(grids.read(scan), cell_means(scan, projection, size).half().float())


def test_grid_is_the_cell_mean_in_half_precision(made, projection, scaled_points):
    scans, root = made
    grids = FeatureGrids(root, scans, projection, GRID, scaled_points())
    assert grids.dim == 4
    assert grids.read(scans[0]).dtype == torch.float32
    assert_grids(root, scans, projection)


def test_workers_and_batches_give_the_same_files(
    tmp_path, made, projection, scaled_points, files_of
):
    """Scans are prepared in the loader processes."""

    class Counting(scaled_points):
        @staticmethod
        def prepare(points):
            return points, os.getpid()

        def point_features(self, prepared):
            processes.update(process for _, process in prepared)
            return super().point_features([points for points, _ in prepared])

    (scans, root), again, processes = made, tmp_path / "again", set()
    arguments = scans[::-1], Counting(), projection, [GRID], again
    assert write_feature_grids(*arguments, workers=2, batch_size=3) == 5
    assert files_of(again) == files_of(root)
    assert files_of(root).keys() == {
        f"2x4/{name}" for name in ("settings.json", "shard_00000.jsonl", "shard_00000.rows")
    }
    assert len(processes) == 2
    assert os.getpid() not in processes


def test_linear_last_step_is_taken_after_pooling(tmp_path, folder, projection, scaled_points):
    """And in float32, whatever the precision of the network."""

    class Lifted(scaled_points):
        def point_features(self, prepared):
            return [points[:, :3].bfloat16() for points in prepared]

        def lift(self, features):
            sizes.add(len(features))
            return features @ matrix

    sizes, matrix = set(), torch.arange(12.0).reshape(3, 4) / 7
    (sample, *_) = PointDataset(find_scans(folder), projection.sensor, Lifted.prepare)
    with torch.autocast("cpu", torch.bfloat16):
        grid = pooled_grids(Lifted(), [sample], projection, [GRID])[GRID][0]
    points = sample.points[:, :3]
    means, _ = pool_cells(points, points.bfloat16().float(), projection, GRID)
    assert sizes == {8}
    assert torch.allclose(grid, means @ matrix, rtol=1e-6, atol=1e-6)


def test_several_sizes_from_one_pass_equal_single_passes(
    tmp_path, folder, projection, scaled_points, files_of
):
    scans, sizes = find_scans(folder), [(2, 4), (8, 32), (1, 1)]
    extractor = scaled_points()
    together, single = tmp_path / "together", tmp_path / "single"
    assert write_feature_grids(scans, extractor, projection, sizes, together) == 5
    assert extractor.calls == 5
    for size in sizes:
        write_feature_grids(scans, scaled_points(), projection, [size], single)
        assert_grids(together, scans, projection, size)
    assert files_of(together) == files_of(single)


def test_a_size_is_completed_without_the_others_growing(
    tmp_path, folder, projection, scaled_points
):
    scans, root = find_scans(folder), tmp_path / "g"
    write_feature_grids(scans[:3], scaled_points(), projection, [GRID], root)
    todo = plan(scans, scaled_points(), projection, [GRID, (4, 4)], root)
    assert (list(todo.missing), todo.num_kept) == (scans, 0)
    assert todo.num_bytes == 2 * 8 * 4 * 2 + 5 * 16 * 4 * 2
    assert write_feature_grids(scans, scaled_points(), projection, [GRID, (4, 4)], root) == 5
    rows = {
        size: sum(p.stat().st_size for p in root.glob(f"{size}/*.rows")) for size in ("2x4", "4x4")
    }
    assert rows == {"2x4": 5 * 64, "4x4": 5 * 128}


def refused(made, projection, extractor, words):
    scans, root = made
    for attempt in (
        lambda: FeatureGrids(root, scans, projection, GRID, extractor),
        lambda: write_feature_grids(scans, extractor, projection, [GRID], root),
    ):
        with pytest.raises(StoreError) as caught:
            attempt()
        for word in [*words, "features_dir", "r3dpa data features --data"]:
            assert word in str(caught.value)


def test_other_sensor_and_projection_are_refused(made, sensor, scaled_points):
    other = SphericalProjection(LidarSensor(beams=8, columns=32, range_max_m=40.0))
    refused(made, other, scaled_points(), ["56.0", "40.0"])
    rings = RingProjection(sensor, tuple(float(-row) for row in range(8)))
    refused(made, rings, scaled_points(), ["'spherical'", "'rings'"])


def test_other_extractor_is_refused(made, projection, scaled_points):
    refused(made, projection, scaled_points(gain=3.0), ["'gain': 1.0", "'gain': 3.0"])
    other = scaled_points()
    other.name = "scalr"
    refused(made, projection, other, ["'scaled'", "'scalr'"])
    scans, root = made
    assert FeatureGrids(root, scans, projection, GRID).dim == 4  # any extractor, if none is named
    with pytest.raises(StoreError, match=r"'scaled'.*'scalr'"):
        write_feature_grids(scans, other, projection, [(4, 4)], root)  # one folder, one extractor


def test_other_grid_size_is_named_by_the_reader(made, projection, scaled_points):
    scans, root = made
    write_feature_grids(scans, scaled_points(), projection, [(1, 1)], root)
    with pytest.raises(StoreError) as caught:
        FeatureGrids(root, scans, projection, (4, 4))
    for words in ("grid_size [1, 1], [2, 4]", "grid_size [4, 4]", "r3dpa data features --data"):
        assert words in str(caught.value)


@pytest.mark.parametrize("lost_bytes", [16, 0])
def test_replaced_scan_is_noticed_and_made_again(lost_bytes, made, projection, scaled_points):
    scans, root = made
    points = read_scan(scans[1].path)[:, [1, 0, 2, 3]]  # with 0 by another one of its size
    scans[1].path.write_bytes(points.tobytes()[: points.nbytes - lost_bytes])
    with pytest.raises(StoreError, match=re.escape(str(scans[1].path)) + ".*replaced"):
        FeatureGrids(root, scans, projection, GRID).read(scans[1])
    assert write_feature_grids(scans, scaled_points(), projection, [GRID], root) == 1
    assert_grids(root, scans, projection)


@pytest.mark.parametrize("error", [RuntimeError, ScanError])
def test_an_error_keeps_what_was_made(tmp_path, made, projection, scaled_points, error):
    """At the last of five scans, an interruption or a damaged file."""
    (scans, _), root = made, tmp_path / "again"
    extractor, data = scaled_points(), scans[4].path.read_bytes()
    if error is RuntimeError:
        extractor.fail_after = 4
    else:
        scans[4].path.write_bytes(data[:-3])
    reason = "interrupted" if error is RuntimeError else re.escape(str(scans[4].path))
    with pytest.raises(error, match=reason):
        write_feature_grids(scans, extractor, projection, [GRID], root)
    FeatureGrids(root, scans[:4], projection, GRID)
    with pytest.raises(StoreError, match=r"no feature grids of .*\.bin.*r3dpa data features"):
        FeatureGrids(root, scans, projection, GRID)
    scans[4].path.write_bytes(data)
    assert write_feature_grids(scans, scaled_points(), projection, [GRID], root) == 1
    assert_grids(root, scans, projection)


def test_two_jobs_at_once_make_each_grid_once(
    tmp_path, made, projection, scaled_points, files_of, until_logged
):
    (scans, complete), root = made, tmp_path / "again"
    started = Event()

    class Slow(scaled_points):
        def point_features(self, prepared):
            started.set()
            until_logged("waiting for another process that makes feature grids in")
            return super().point_features(prepared)

    def write(extractor):
        return write_feature_grids(scans, extractor, projection, [GRID], root)

    with ThreadPoolExecutor() as pool:
        first = pool.submit(write, Slow())
        started.wait()
        second = pool.submit(write, scaled_points())
        assert (first.result(), second.result()) == (5, 0)
    assert files_of(root) == files_of(complete)


def test_a_folder_that_cannot_be_written_is_named(tmp_path, made, projection, scaled_points):
    scans, complete = made
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"file/grids .*give a folder"):
        write_feature_grids(scans, scaled_points(), projection, [GRID], tmp_path / "file/grids")
    assert write_feature_grids(scans, scaled_points(), projection, [GRID], complete) == 0
    assert not (complete / ".lock").exists()  # complete grids may lie on a read-only disk


@pytest.mark.parametrize("gain", [float("nan"), float("inf")])
def test_features_that_are_not_finite_name_the_scan(made, projection, scaled_points, gain):
    scans, root = made
    with pytest.raises(StoreError, match=r"a/0000000000\.bin.*scaled gave NaN"):
        write_feature_grids(scans, scaled_points(gain), projection, [GRID], root.with_name("new"))


@pytest.mark.parametrize(
    ("sizes", "message"), [([], "grid_sizes is empty"), ([GRID, (3, 4)], "3 x 4 cells does not")]
)
def test_grid_sizes_that_do_not_divide_the_image_are_refused(
    tmp_path, folder, projection, scaled_points, sizes, message
):
    with pytest.raises(ValueError, match=message):
        write_feature_grids(find_scans(folder), scaled_points(), projection, sizes, tmp_path / "g")


@pytest.mark.parametrize(
    "text", ["{", "{}", "3", '{"grid_size": 3}', '{"grid_size": [2, 4], "dim": 4}', None]
)
def test_damaged_settings_are_named(made, projection, text):
    scans, root = made
    path = root / "2x4/settings.json"
    path.write_text(text or path.read_text().replace("4", "8"))
    with pytest.raises(StoreError, match=r"2x4/settings\.json is damaged .*r3dpa data features"):
        FeatureGrids(root, scans, projection, GRID)


def test_other_settings_are_refused_when_writing(made, projection, scaled_points):
    scans, root = made
    new = replace(scans[0], frame="new")

    def planned(scans, size=GRID, precision="bf16-mixed"):
        return len(plan(scans, scaled_points(), projection, [size], root, precision).missing)

    words = "precision 32-true, but precision bf16-mixed.*features_dir .*r3dpa data features"
    with pytest.raises(StoreError, match=words):
        planned([*scans, new])
    assert planned(scans) == 0  # complete grids serve any precision
    assert planned(scans, (4, 4)) == 5  # another size may be made otherwise
    assert any_settings(root).extractor["name"] == "scaled"
    with pytest.raises(StoreError, match=r"no feature grids in .*r3dpa data features"):
        any_settings(root / "nothing")


def test_grids_of_scans_with_named_columns(tmp_path, projection, scaled_points):
    rows = np.random.default_rng(0).uniform(0.1, 0.9, (2, 400, 5)).astype("<f4")
    (tmp_path / "scans").mkdir()
    for number, scan in enumerate(rows * [30, 30, 1, 1, 1]):
        scan.astype("<f4").tofile(tmp_path / "scans" / f"{number}.bin")
    scans = find_scans(tmp_path / "scans", ("x", "y", "z", "intensity", "ring"))
    write_feature_grids(scans, scaled_points(), projection, [GRID], tmp_path / "grids")
    grids = FeatureGrids(tmp_path / "grids", scans, projection, GRID, scaled_points())
    assert grids.read(scans[0]).any()
