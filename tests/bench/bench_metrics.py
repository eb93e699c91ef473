"""Metrics: networks on one scan; JSD, MMD and sparse convolution beside a plain way to them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import jensenshannon
from torch.nn import functional as F

from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)
from r3dpa.metrics.scene import PUBLISHED, EvaluationScene, through_sensor
from r3dpa.metrics.scene_features import lip_loc_space, range_vit_space, voxel_space
from r3dpa.nn.backbones.liploc import LIPLoc
from r3dpa.nn.backbones.minkowski import SPVCNN, MinkowskiNet
from r3dpa.nn.backbones.rangevit import RangeViT
from r3dpa.nn.backbones.sparse import SparseConv, Voxels, voxelize

pytestmark = pytest.mark.bench

GRID = BEVGrid(cell_m=PUBLISHED.voxel_m)
SPACES = {
    "MinkowskiNet": lambda: voxel_space(MinkowskiNet().eval(), PUBLISHED),
    "SPVCNN": lambda: voxel_space(SPVCNN().eval(), PUBLISHED),
    "RangeViT": lambda: range_vit_space(RangeViT().eval()),
    "LIP-Loc": lambda: lip_loc_space(LIPLoc().eval(), PUBLISHED),
}


@pytest.fixture(scope="module")
def scenes(points):
    """Twelve scenes as evaluations see them: a scan, turned about z by even steps."""
    found = []
    for index in range(12):
        angle = math.tau * index / 12
        turn = torch.tensor(
            [[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]]
        )
        moved = torch.cat([points[:, :2] @ turn, points[:, 2:3]], dim=1)
        found.append(through_sensor(EvaluationScene(str(index), moved), PUBLISHED))
    return found


@pytest.mark.benchmark(group="feature of one scan", min_rounds=3, warmup=True)
@pytest.mark.parametrize("name", SPACES)
def bench_network(benchmark, scenes, name, alone):
    """Random weights cost as much as trained ones."""
    torch.manual_seed(0)
    space = SPACES[name]()
    benchmark(lambda: space([scenes[0]]))


def dense_counts(clouds):
    """One image of all cells per cloud, as LiDM and R3DPA compare them."""
    total = np.zeros(GRID.shape)
    for cloud in clouds:
        image = np.zeros(GRID.shape, np.float32)
        cells = GRID.cells(cloud).numpy()
        image[cells // GRID.shape[1], cells % GRID.shape[1]] = 1
        total += image
    return total


@pytest.mark.benchmark(group="JSD of 6 scenes from 6", min_rounds=3)
class BenchHistograms:
    def bench_sparse_counts(self, benchmark, scenes, alone):
        clouds = [scene.points for scene in scenes]

        def distance():
            return histogram_distance(*(GRID.histogram(part) for part in (clouds[:6], clouds[6:])))

        dense = [dense_counts(part).ravel() for part in (clouds[:6], clouds[6:])]
        assert benchmark(distance).jsd_distance == pytest.approx(jensenshannon(*dense), abs=1e-9)

    def bench_dense_images(self, benchmark, scenes, alone):
        clouds = [scene.points for scene in scenes]
        benchmark(
            lambda: jensenshannon(*(dense_counts(p).ravel() for p in (clouds[:6], clouds[6:])))
        )


@pytest.mark.benchmark(group="MMD of 2 references, 3 samples", min_rounds=3)
class BenchMatching:
    @pytest.fixture
    def cells(self, scenes):
        return [GRID.cells(scene.points) for scene in scenes[:5]]

    def bench_distance_transforms(self, benchmark, cells, alone):
        benchmark(minimum_matching, cells[:2], cells[2:], GRID)

    def bench_all_cells_with_all(self, benchmark, cells, alone):
        places = [
            torch.stack([one // GRID.shape[1], one % GRID.shape[1], 0 * one], dim=1).double()
            for one in cells
        ]
        benchmark.pedantic(
            lambda: [min(chamfer_squared(a, b) for b in places[2:]) for a in places[:2]], rounds=1
        )


@pytest.mark.benchmark(group="convolution of size 3, 128 x 128 x 64 voxels", min_rounds=3)
class BenchConvolution:
    @pytest.fixture
    def case(self, points):
        """Voxels of the box around the occupied one next to the middle, a layer, features."""
        voxels, _ = voxelize(points)
        size = torch.tensor((128, 128, 64))
        away = (voxels - voxels.median(dim=0).values).abs().sum(dim=1)
        corner = voxels[away.argmin()] - size // 2
        inside = ((voxels >= corner) & (voxels < corner + size)).all(dim=1)
        place = Voxels.from_coordinates(F.pad(voxels[inside] - corner, (0, 1)))[0]
        torch.manual_seed(0)
        return place, SparseConv(16, 16, 3), torch.randn(len(place), 16)

    @staticmethod
    def dense(case):
        place, layer, values = case
        x, y, z = place.coordinates[:, :3].unbind(dim=1)
        image = torch.zeros(1, 16, 128, 128, 64)
        image[0, :, x, y, z] = values.T
        # The kernel has x fastest among its offsets, z slowest.
        weight = layer.kernel.view(3, 3, 3, 16, 16).permute(4, 3, 2, 1, 0).contiguous()
        return lambda: F.conv3d(image, weight, padding=1)[0, :, x, y, z].T

    def bench_sparse(self, benchmark, case, alone):
        place, layer, values = case
        found = benchmark(layer, values, place.neighbors)
        torch.testing.assert_close(found, self.dense(case)(), atol=1e-4, rtol=1e-4)

    def bench_sparse_with_its_map(self, benchmark, case, alone):
        place, layer, values = case
        benchmark(lambda: layer(values, Voxels(place.keys).neighbors))

    def bench_dense_conv3d(self, benchmark, case, alone):
        benchmark(self.dense(case))
