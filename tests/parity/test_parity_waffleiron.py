"""WaffleIron and ScaLR against ``waffleiron.npz`` and ``scalr_wi48_768_state_dict.json``.

The golden numbers derive from KITTI and are not part of the repository: without a folder that has
them, only the listing is compared.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from recorded_networks import count

from r3dpa.features import (
    PointCloudBatch,
    ScaLR,
    ScanGrid,
    WaffleIron,
    collate_scans,
    prepare_scan,
)
from r3dpa.features.official import load_strictly
from r3dpa.features.scalr import official_name

# parity/README.md: tokens reach 69, float32 and float64 runs differ by 3.4e-5.
TOKENS = {"atol": 1e-4, "rtol": 0.0}


@pytest.fixture(scope="module")
def case(load_case):
    return load_case("waffleiron")


def grid_of(config, **intensity):
    minimum, maximum = config["fov"]
    cells = (*config["grid_shape"][0], config["grid_shape"][1][1])  # along x, y, z
    edges = [(high - low) / n for low, high, n in zip(minimum, maximum, cells, strict=True)]
    return ScanGrid(
        minimum_m=tuple(minimum),
        maximum_m=tuple(maximum),
        cell_m=edges[0] if len(set(edges)) == 1 else tuple(edges),
        voxel_m=config["voxel_size"],
        num_neighbors=config["num_neighbors"],
        **intensity,
    )


@pytest.fixture(scope="module")
def grid(case):
    mean, std = case.config["mean_intensity"], case.config["std_intensity"]
    return grid_of(case.config, intensity_mean=mean, intensity_std=std)


@pytest.fixture(scope="module")
def network(case, grid):
    config = case.config
    network = WaffleIron(config["nb_channels"], config["depth"], grid.cells, config["nb_class"])
    assert network.plane_sizes == [tuple(size) for size in config["grid_shape"]]
    load_strictly(network, case.weights(), official_name)
    return network.eval()


@pytest.fixture(scope="module")
def scans(case, grid):
    return [prepare_scan(case[f"in/cloud{index}"].numpy(), grid) for index in (0, 1)]


def recorded_batch(case, name):
    """The recorded, padded network input as a flat batch, and which columns are no padding."""
    occupied = case[f"out/{name}/occupied_cells"] > 0
    num_points = occupied.sum(dim=1)
    starts = num_points.cumsum(0) - num_points
    neighbors = case[f"out/{name}/neighbors_emb"].long() + starts[:, None, None]
    batch = PointCloudBatch(
        features=case[f"out/{name}/feat"].mT[occupied],
        neighbors=neighbors.mT[occupied][:, 1:],  # the first one is the point itself
        cells=case[f"out/{name}/cell_ind"].long().mT[occupied].T,
        num_points=num_points,
    )
    return batch, occupied


def test_prepared_points(case, grid, scans, close):
    """Which points are kept, in order; of a wide field of view those of the voxels alone."""
    cloud, scan, prepared = case["in/cloud0"], scans[0], case["out/prepared_features0"]
    assert torch.equal(cloud[scan.kept, :3], case["out/xyz_after_crop0"])
    assert len(scan.kept) == case["out/n_after_crop0"]
    close(cloud[:, :3], prepared[:, :3])
    close(scan.features, prepared[scan.kept, 3:])
    kept = prepare_scan(cloud.numpy(), widened(grid)).kept
    assert len(kept) == case["out/n_after_voxelize0"]


def widened(grid):
    """The same cells in a field of view of at least 256 m in all directions."""
    far = np.ceil(256.0 / np.broadcast_to(grid.cell_m, 3)) * grid.cell_m
    return replace(grid, minimum_m=tuple(-far), maximum_m=tuple(far))


def test_a_wider_field_of_view_holds_whole_cells_of_unequal_edges():
    grid = ScanGrid((-36.0, -30.0, -4.0), (36.0, 30.0, 4.0), cell_m=(0.6, 0.5, 0.8))
    assert widened(grid).cells == (854, 1024, 640)


@pytest.mark.parametrize("name", ["batch1", "batch2"])
def test_network_inputs(case, scans, close, name):
    expected, occupied = recorded_batch(case, name)
    actual = collate_scans(scans[: len(occupied)])
    assert torch.equal(actual.num_points, expected.num_points)
    assert torch.equal(actual.cells, expected.cells)
    close(actual.features, expected.features)
    xyz = expected.features[:, 1:4]
    distances = [(xyz[batch.neighbors] - xyz[:, None]).norm(dim=2) for batch in (actual, expected)]
    close(*distances)  # neighbours at equal distance may come in any order


def test_upsampling(case, scans, close):
    for index, scan in enumerate(scans):
        points, expected = case[f"in/cloud{index}"][:, :3], case[f"out/upsample{index}"].long()
        kept = points[scan.kept]
        close((kept[scan.upsample] - points).norm(dim=1), (kept[expected] - points).norm(dim=1))


@torch.no_grad()
def test_network(case, network, close):
    batch, _ = recorded_batch(case, "batch1")
    close(
        network.embedding(batch.features, batch.neighbors),
        case["out/eval/embed_tokens"][0].T,
        **TOKENS,
    )
    tokens = network(batch)
    close(tokens, case["out/eval/tokens"][0].T, **TOKENS)
    close(network.head(tokens), case["out/eval/head"][0].T, **TOKENS)


@torch.no_grad()
def test_network_of_two_scans(case, network, close):
    batch, occupied = recorded_batch(case, "batch2")
    assert batch.num_points.unique().numel() == 2
    close(network(batch), case["out/eval/tokens_batch2"].mT[occupied], **TOKENS)


def test_point_features(case, grid, tmp_path, close):
    """From a file as the distillation writes it to features of the original points."""
    wrapped = {f"module.{key}": value for key, value in case.weights().items()}
    torch.save({"model_point": wrapped, "epoch": 3}, tmp_path / "ckpt_last.pth")
    scalr = ScaLR.from_checkpoint(tmp_path / "ckpt_last.pth", grid)
    assert (scalr.dim, scalr.network.depth) == (case.config["nb_channels"], case.config["depth"])
    close(scalr(case["in/cloud0"]), case["out/eval/point_features0"])
    batch = scalr.point_features([scalr.prepare(case[f"in/cloud{index}"]) for index in (1, 0)])
    close(batch[1], case["out/eval/point_features0"])


def test_released_sizes(official_listing):
    listing = official_listing("scalr_wi48_768_state_dict")
    config = listing["config"]
    assert grid_of(config) == ScanGrid()  # the defaults are those of the release
    with torch.device("meta"):
        network = WaffleIron(head_dim=config["nb_class"])
        weights = {key: torch.empty(shape) for key, shape in listing["state_dict"].items()}
    load_strictly(network, weights, official_name)
    assert count(network) == listing["param_count"] == 60_222_996
    head = count(network.head)
    assert listing["param_count"] - head == listing["param_count_without_classif"]
