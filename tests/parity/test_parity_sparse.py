"""Sparse networks against ``sparse_layers``, ``minkowskinet``, ``spvcnn``, and the voxels and
pooling of ``metrics``, which all derive from KITTI; and against ``sparse_unet_state_dicts.json``.
"""

from __future__ import annotations

import pytest
import torch
from recorded_networks import count, with_outputs

from r3dpa.features.official import load_strictly
from r3dpa.metrics.networks.minkowski import (
    SPVCNN,
    MinkowskiNet,
    Points,
    corners,
    official_name,
    scaled_widths,
    to_points,
    to_voxels,
)
from r3dpa.metrics.networks.sparse import SparseConv, Voxels, pool_voxels, voxelize

NETWORKS = {"minkowskinet": MinkowskiNet, "spvcnn": SPVCNN}
STAGES = [f"stage{i}" for i in range(1, 5)] + [f"up{i}" for i in range(1, 5)]


@pytest.fixture(scope="module")
def layers(load_case):
    return load_case("sparse_layers")


@pytest.fixture(scope="module")
def metrics(load_case):
    return load_case("metrics")


@pytest.fixture(scope="module", params=NETWORKS)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def case(load_case, name):
    return load_case(name)


@pytest.fixture(scope="module")
def network(case, name):
    config = case.config
    widths = scaled_widths(config["cr"], config["layer_num"])
    size = {"voxel_m": config["voxel_size"]} if name == "spvcnn" else {}
    network = NETWORKS[name](widths, config["input_dims"], config["num_class"], **size).eval()
    load_strictly(network, case.weights(), official_name)
    return network


def rows_of(voxels, coordinates):
    """Rows of recorded coordinates, all of which must be there."""
    own, rows = Voxels.from_coordinates(torch.cat([voxels.coordinates, coordinates.long()]))
    assert len(own) == len(voxels)
    return rows[len(voxels) :]


def layer(case, name):
    """A layer with the recorded weights."""
    kernel = case[f"w_layer/{name}.kernel"]
    size = {2: 1, 8: 2, 27: 3}[2 if kernel.ndim == 2 else len(kernel)]
    conv = SparseConv(*kernel.shape[-2:], size)
    conv.load_state_dict({"kernel": kernel})
    return conv


@torch.no_grad()
def test_sparse_layers(layers, close):
    """The recorded chain of layers, and one with a bias."""
    coordinates = layers["in/coords_xyzb"]
    voxels, rows = Voxels.from_coordinates(coordinates)
    assert len(voxels) == len(coordinates)
    features = torch.empty_like(layers["in/feats"]).index_copy(0, rows, layers["in/feats"])
    coarse = voxels.coarser
    chain = [
        ("k3", voxels, voxels.neighbors),
        ("down", coarse, voxels.to_coarser),
        ("k3_at_stride2", coarse, coarse.neighbors),
        ("up", voxels, voxels.to_coarser.transposed()),
        ("k1", voxels, None),
    ]

    def compare(name, result, at):
        expected = layers[f"out/layer_{name}_coords"]
        assert len(expected) == len(at) == len(result)
        assert [at.stride] * 3 == layers[f"out/layer_{name}_stride"].tolist()
        close(result[rows_of(at, expected)], layers[f"out/layer_{name}_feats"])

    biased = layer(layers, "k3_bias")(features, voxels.neighbors) + layers["w_layer/k3_bias.bias"]
    compare("k3_bias", biased, voxels)
    for name, at, kernel_map in chain:
        features = layer(layers, name)(features, kernel_map)
        compare(name, features, at)
    recorded = layers["out/layer_down_coords"]  # sorted by (batch, x, y, z), as ours
    assert coarse.coordinates.tolist() == recorded.tolist()


def test_sparse_layers_of_points(layers, close):
    coordinates, features = layers["in/coords_xyzb"].long(), layers["in/feats"]
    size = torch.tensor(layers.config["voxel_size"])
    points = Points(coordinates[:, :3].float() * size / size, coordinates[:, 3])
    voxels, _ = Voxels.from_coordinates(points.voxel_of(1))
    recorded = rows_of(voxels, layers["out/initial_voxelize_coords"])
    close(to_voxels(features, points, voxels)[recorded], layers["out/initial_voxelize_feats"])

    coarse = voxels.coarser
    order = rows_of(coarse, layers["out/layer_down_coords"])
    close(to_voxels(features, points, coarse)[order], layers["out/point_to_voxel_stride2"])
    at_voxels = torch.empty_like(layers["in/devox_voxel_feats_stride2"]).index_copy(
        0, order, layers["in/devox_voxel_feats_stride2"]
    )
    close(to_points(at_voxels, points, coarse), layers["out/devox_point_feats_stride2"])
    rows, weights = corners(points, coarse)
    expected = layers["out/devox_index_stride2"].long()
    assert torch.equal(rows, torch.where(expected < 0, len(coarse), order[expected.clamp(min=0)]))
    close(weights, layers["out/devox_weights_stride2"])


@torch.no_grad()
def test_network(case, network, close):
    """Every stage, the features of the voxels, and the feature of each cloud."""
    modules = [network.stem[1], *network.encoder, *network.decoder]
    stages = dict(zip(["stem", *STAGES], modules, strict=True))
    coordinates, features = case["in/coords_xyzb"], case["in/feats"]
    actual, seen = with_outputs(stages, lambda: network(coordinates, features))

    level, _ = Voxels.from_coordinates(coordinates)
    levels = [level]
    for _ in network.encoder:
        levels.append(levels[-1].coarser)
    for name, at in zip(["stem", *STAGES], levels + levels[-2::-1], strict=True):
        expected = case[f"out/{name}_feats"]
        result = seen[name].relu()  # the stem is rectified behind its norm
        close(result[rows_of(at, case[f"out/{name}_coords"])], expected)

    logit_coordinates = torch.cat(
        [case["out/logit_coords"].round().long(), case["out/logit_batch"].long()[:, None]], dim=1
    )
    order = Voxels.from_coordinates(logit_coordinates)[1].argsort()
    own = Voxels.from_coordinates(coordinates)[1]
    close(actual, case["out/logits"][order][own])
    close(pool_voxels(actual, coordinates, 2), case["out/metric_feature"])
    alone = coordinates[:, 3] == 0
    single = network(coordinates[alone], features[alone])
    close(single.mean(dim=0), case["out/single_cloud_logits_mean"])
    close(single, actual[alone])


def test_spvcnn_coordinates(load_case):
    """The way through metres in float32 moves points by the recorded amounts, bit by bit."""
    case = load_case("spvcnn")
    points = SPVCNN(voxel_m=case.config["voxel_size"])._points(case["in/coords_xyzb"])
    assert torch.equal(points.xyz, case["out/logit_coords"])


def test_from_checkpoint(case, name, tmp_path, close):
    torch.save({"state_dict": case.weights(), "epoch": 3}, tmp_path / "model.ckpt")
    network = NETWORKS[name].from_checkpoint(tmp_path / "model.ckpt").eval()
    assert network.widths == scaled_widths(case.config["cr"], case.config["layer_num"])
    with torch.no_grad():
        features = network(case["in/coords_xyzb"], case["in/feats"])
    close(pool_voxels(features, case["in/coords_xyzb"], 2), case["out/metric_feature"])


@pytest.mark.parametrize("kind", ["voxel", "voxel_dense"])
def test_metrics_voxels(metrics, kind):
    low, high = metrics.config["DATASET_CONFIG"]["depth_range"]
    points, voxel_m = metrics[f"in/{kind}_points"], metrics.config["VOXEL_SIZE"]
    coordinates, features = voxelize(points, voxel_m, range_min_m=low, range_max_m=high)
    assert coordinates.tolist() == metrics[f"out/{kind}_coords"].tolist()
    assert torch.equal(features, metrics[f"out/{kind}_feats"])


def test_metrics_pooling(metrics, close):
    coordinates = torch.cat([metrics["in/agg_coords"], metrics["in/agg_batch"][:, None]], dim=1)
    expected = metrics["out/agg_depth"]
    voxel_m = metrics.config["VOXEL_SIZE"]
    close(pool_voxels(metrics["in/agg_logits"], coordinates, len(expected), voxel_m), expected)


@pytest.mark.parametrize("rate", ["0.5", "1.0"])
def test_released_sizes(official_listing, name, rate):
    listing = official_listing("sparse_unet_state_dicts")[f"{name}_cr{rate}"]
    widths = scaled_widths(listing["cr"], listing["layer_num"])
    assert list(widths) == listing["channels"]
    with torch.device("meta"):
        network = NETWORKS[name](widths)
        weights = {key: torch.empty(shape) for key, shape in listing["state_dict"].items()}
    load_strictly(network, weights, official_name)
    assert count(network) == listing["param_count"]
    assert widths[-1] * 16 == listing["metric_feature_dim"]
    if rate == "0.5":
        assert NETWORKS[name]().widths == widths  # the defaults are those of the metric
