"""Metrics: networks on one scan, JSD, MMD and sparse convolution."""

import math

import pytest
import torch
from torch.nn import functional as F

from r3dpa.metrics.functional_bev import BEVGrid, histogram_distance, minimum_matching
from r3dpa.metrics.networks.liploc import LIPLoc
from r3dpa.metrics.networks.minkowski import SPVCNN, MinkowskiNet
from r3dpa.metrics.networks.rangevit import RangeViT
from r3dpa.metrics.networks.sparse import SparseConv, Voxels, voxelize
from r3dpa.metrics.scene import PUBLISHED, EvaluationScene, through_sensor
from r3dpa.metrics.scene_features import lip_loc_space, range_vit_space, voxel_space

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


@pytest.mark.benchmark(min_rounds=3)
def bench_jsd_of_6_scenes_from_6(benchmark, scenes, alone):
    clouds = [scene.points for scene in scenes]
    parts = clouds[:6], clouds[6:]
    benchmark(lambda: histogram_distance(*(GRID.histogram(part) for part in parts)))


@pytest.mark.benchmark(min_rounds=3)
def bench_mmd_of_2_references_and_3_samples(benchmark, scenes, alone):
    cells = [GRID.cells(scene.points) for scene in scenes[:5]]
    benchmark(minimum_matching, cells[:2], cells[2:], GRID)


@pytest.mark.benchmark(min_rounds=3)
def bench_sparse_convolution(benchmark, points, alone):
    """Size 3, all voxels of a scan, with its map of neighbours."""
    voxels, _ = voxelize(points)
    place = Voxels.from_coordinates(F.pad(voxels, (0, 1)))[0]
    layer, values = SparseConv(16, 16, 3), torch.randn(len(place), 16)
    benchmark(layer, values, place.neighbors)
