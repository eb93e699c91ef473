"""Scans per second from files to batches: reading, projecting, loaders, feature grids."""

import pytest
import torch

from r3dpa.data import FeatureGrids, LidarDataModule, kitti360_scans, read_scan, write_feature_grids
from r3dpa.features import GeometricFeatures
from r3dpa.geometry import LidarSensor, SphericalProjection, pool_cells, range_image

pytestmark = [pytest.mark.bench, pytest.mark.filterwarnings("ignore")]

PROJECTION, GRID_SIZE, DIM = SphericalProjection(LidarSensor()), (8, 64), 768


@pytest.fixture(scope="module")
def scans(data_root):
    return kitti360_scans(data_root, "train")


@pytest.fixture(scope="module")
def loaded(data_root, tmp_path_factory):
    """A set-up data module."""
    data = LidarDataModule(
        str(data_root),
        extractor=GeometricFeatures(DIM),
        features_dir=str(tmp_path_factory.mktemp("features")),
        batch_size=4,
        val_every=None,
    )
    data.prepare_data()
    data.setup("fit")
    return data


@pytest.mark.benchmark(group="one scan")
class BenchScan:
    def bench_read_bin(self, benchmark, scans, alone):
        benchmark(read_scan, scans[0].path)

    def bench_project(self, benchmark, points, alone):
        benchmark(range_image, points[:, :3].contiguous(), PROJECTION)

    def bench_sample(self, benchmark, loaded, alone):
        benchmark(lambda: loaded.train_set[0])


@pytest.mark.benchmark(group="loader, 8 scans", min_rounds=3)
@pytest.mark.parametrize("workers", [0, 2])
def bench_epoch(benchmark, loaded, workers, one_thread):
    loaded.num_workers = workers
    loader = loaded.train_dataloader()
    benchmark(lambda: sum(1 for _ in loader))


@pytest.mark.benchmark(group="feature grid of one scan, 768 wide", min_rounds=3)
def bench_pool_cells(benchmark, points, alone):
    values = torch.randn(len(points), DIM, generator=torch.Generator().manual_seed(0))
    benchmark(pool_cells, points[:, :3].contiguous(), values, PROJECTION, GRID_SIZE)


@pytest.mark.benchmark(group="read one feature grid")
def bench_store(benchmark, scans, tmp_path, alone):
    extractor = GeometricFeatures(DIM)
    write_feature_grids(scans, extractor, PROJECTION, [GRID_SIZE], tmp_path)
    store = FeatureGrids(tmp_path, scans, PROJECTION, GRID_SIZE, extractor)
    benchmark(lambda: store.read(scans[0]))
