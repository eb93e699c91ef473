"""Distances of feature sets and clouds against ``metrics.npz`` (KITTI-derived: skips without)."""

from __future__ import annotations

import pytest
import torch

from r3dpa.metrics.functional import frechet_distance, frechet_distance_of
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    histogram_distance,
    minimum_matching,
)


@pytest.fixture(scope="module")
def case(load_case):
    return load_case("metrics")


def grid_of(case, cell_m=None):
    window = case.config["DATA_CONFIG"]
    assert window["x"] == window["y"] == [-window["x"][1], window["x"][1]]
    return BEVGrid(window["x"][1], cell_m or case.config["VOXEL_SIZE"])


def clouds(case, which):
    count = len(case.keys(f"in/{which}_"))
    return [case[f"in/{which}_{index}"] for index in range(count)]


def gaussian(case, name, side):
    return case[f"in/frechet_{name}_mu{side}"], case[f"in/frechet_{name}_sigma{side}"]


def test_frechet(case, close):
    """The official root of a singular product is known to 1e-3 only (parity/README.md)."""
    features = frechet_distance_of(case["in/frechet_feats_x"], case["in/frechet_feats_y"])
    close(features, case["out/frechet_feats"], atol=0, rtol=1e-6)
    for kind, rtol in (("regular", 1e-6), ("singular", 1e-3)):
        actual = frechet_distance(*gaussian(case, kind, 1), *gaussian(case, kind, 2))
        close(actual, case[f"out/frechet_{kind}"], atol=0, rtol=rtol)
    same = gaussian(case, "regular", 1)
    close(frechet_distance(*same, *same), case["out/frechet_self"], atol=1e-8, rtol=0)
    mean, covariance = gaussian(case, "singular", 1)
    point = (mean, torch.zeros_like(covariance))
    actual = frechet_distance(*point, *gaussian(case, "singular", 2))
    close(actual, case["out/frechet_zero_sigma1"], atol=0, rtol=1e-6)


@pytest.mark.parametrize("which", ["ref", "smp"])
def test_histogram(case, which):
    grid = grid_of(case)
    assert [grid.side] * 2 == case["out/bev_shape"].tolist()
    counts = grid.histogram(clouds(case, which))
    x, y = case[f"out/bev_hist_{which}_cells"].long()
    expected = torch.zeros(grid.side, grid.side, dtype=torch.int64)
    expected[x, y] = case[f"out/bev_hist_{which}_counts"].long()
    assert torch.equal(counts, expected)


@pytest.mark.parametrize(("suffix", "cell_m"), [("", None), ("_voxel0.5", 0.5)])
def test_histogram_distances(case, close, suffix, cell_m):
    grid = grid_of(case, cell_m)
    result = histogram_distance(*(grid.histogram(clouds(case, which)) for which in ("ref", "smp")))
    close(result.jsd_distance, case[f"out/jsd{suffix}"])
    close(result.l1, case[f"out/tv{suffix}"])
    if suffix:
        close(result.jsd_divergence, case[f"out/jsd{suffix}_squared_is_divergence"])


def test_occupied_cells(case):
    """Indices of the cells, which the official code stores divided by the number of cells."""
    grid = grid_of(case)
    for key in case.keys("out/voxelized_"):
        which = key.removeprefix("out/voxelized_")
        cells = grid.cells(case[f"in/{which}"])
        indices = torch.stack([cells // grid.side, cells % grid.side], dim=1)
        scaled = indices.double() / grid.side
        assert torch.equal(scaled.float(), case[key])


def test_matching(case, close):
    grid = grid_of(case)
    references, samples = ([grid.cells(c) for c in clouds(case, w)] for w in ("ref", "smp"))
    pairs = [
        [minimum_matching([x], [y], grid).squared_normalised.mean().item() for y in samples]
        for x in references
    ]
    close(torch.tensor(pairs), case["out/chamfer_ref_x_smp"], atol=0, rtol=1e-5)
    matching = minimum_matching(references, samples, grid)
    close(matching.squared_normalised.mean().item(), case["out/mmd"], atol=0, rtol=1e-5)


def test_chamfer_of_points(case, close):
    close(chamfer_squared(case["in/cd3_x"], case["in/cd3_y"]), case["out/cd3"], atol=0, rtol=1e-5)
