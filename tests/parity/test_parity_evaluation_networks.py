"""Metric networks and distances of the baselines against recorded numbers, and their listings."""

from __future__ import annotations

import random
import tarfile

import pytest
import torch
import yaml
from recorded_networks import count, scaled, under, weights_of
from torch.nn.functional import adaptive_avg_pool2d

from r3dpa.geometry import (
    LidarSensor,
    RangeCodec,
    SphericalProjection,
    in_range,
    points_of,
    range_image,
)
from r3dpa.metrics.functional import frechet_distance_of, squared_mmd
from r3dpa.metrics.functional_bev import (
    BEVGrid,
    chamfer_squared,
    gaussian_kernel,
    histogram_distance,
    kernel_mmd,
    minimum_matching,
    point_histogram,
)
from r3dpa.metrics.networks.pointnet import PointNet
from r3dpa.metrics.networks.rangenet import RangeNet, banded, our_name, picked, picked_places
from r3dpa.metrics.networks.rangevit import range_channels

NETWORKS = ("rangenet21", "pointnet")
METRICS = ("r2flow_metrics", "lidm_metrics")


def range_net(case) -> dict:
    config = case.config
    weights = case.weights() | case.weights("w_head/")
    weights = {
        key.removeprefix("backbone.").removeprefix("decoder."): v for key, v in weights.items()
    }
    constants = {"mean": config["preprocess_mean"], "deviation": config["preprocess_std"]}
    network = RangeNet.from_weights(weights, **constants)
    image = case["in/image"]
    levels, features, standard = (
        network.encode(image),
        network.feature_map(image),
        network.normalise(image),
    )
    picks = case["out/subsample_indices_here"]
    return {
        "lidm_final_depth": banded(features),
        "lidm_final_sector": banded(features.transpose(2, 3)),
        "lidm_final_all": features.mean(dim=(2, 3)),
        "lidm_backbone_pooled": adaptive_avg_pool2d(levels[5], 1).flatten(1),
        "lidm_dec_0": features,
        "lidm_enc_5": levels[5],
        "lidm_enc_3_every4": levels[3][:, ::4],
        "r2flow_logits_every5": network(image)[:, ::5],
        "r2flow_postprocess_subsample": picked(features, len(picks)),
        "r2flow_postprocess_depth": banded(features),
        "r2flow_postprocess_angle": banded(features.transpose(2, 3)),
        "r2flow_postprocess_global": features.mean(dim=(2, 3)),
        "r2flow_preprocess": standard,
        "r2flow_penultimate_after_preprocess_depth": banded(network.feature_map(standard)),
        "frd_indices_32x64x1024": picked_places(32 * 64 * 1024),
        "subsample_indices_here": picked_places(features[0].numel(), len(picks)),
    }


def point_net(case) -> dict:
    network, points = PointNet(case.config["k"]), case["in/points"]
    network.load_state_dict(case.weights())
    feature = network(points)
    is_empty = (points == 0).all(dim=1)
    padded = torch.cat([points, torch.zeros(len(points), 3, 7)], dim=2)
    kept = torch.stack([cloud[:, ~empty] for cloud, empty in zip(points, is_empty, strict=True)])
    return {
        "feature": feature,
        "stn_transform": network.feat.stn(points),
        "feature_more_zero_points_diff": (network(padded) - feature).abs().max(),
        "feature_without_zero_points": network(kept),
    }


@pytest.fixture(scope="module", params=NETWORKS)
def network_case(request, baseline_case):
    compute = {"rangenet21": range_net, "pointnet": point_net}[request.param]
    return baseline_case(request.param), compute


def test_network(network_case, compare):
    case, compute = network_case
    compare(
        case,
        under("out/", compute(case)),
        tolerance=scaled(2e-5),
    )


def r2flow_metrics(case) -> dict:
    config = case.config
    sizes = (config["field_size"] / 2, config["bins"], config["min_depth"], config["max_depth"])
    counts = [point_histogram(case[key], *sizes) for key in case.keys("in/cloud_")]
    results = {}
    for index, histogram in enumerate(counts):
        cells = histogram.nonzero()
        results[f"hist_{index}_cells"] = cells
        results[f"hist_{index}_counts"] = histogram[tuple(cells.T)]
    points = torch.stack(counts).flatten(1)
    a, b = (part / part.sum(dim=1, keepdim=True) for part in (points[:3], points[3:]))
    feats1, feats2 = case["in/feats1"], case["in/feats2"]
    subsets = zip(
        feats2[case["in/squared_mmd_subsets_of_feats2"]],
        feats1[case["in/squared_mmd_subsets_of_feats1"]],
        strict=True,
    )
    order = list(range(len(case["out/bev_reference_permutation_20"])))
    random.Random(0).shuffle(order)
    return results | {
        "jsd": histogram_distance(points[:3].sum(dim=0), points[3:].sum(dim=0)).jsd_distance,
        "mmd": kernel_mmd(a, b, config["sigma"]),
        "mmd_self": kernel_mmd(a, a, config["sigma"]),
        "cdist_rbf": gaussian_kernel(a, b, config["sigma"]),
        "frechet": frechet_distance_of(feats1, feats2),
        "squared_mmd_numpy_seed123": torch.stack([squared_mmd(*pair) for pair in subsets]).mean(),
        "bev_reference_permutation_20": order,
    }


def lidm_metrics(case) -> dict:
    sets = {kind: [case[key] for key in case.keys(f"in/{kind}_")] for kind in ("ref", "smp")}
    fine, coarse = (BEVGrid(cell_m=case.config[f"voxel_{name}"]) for name in ("jsd", "mmd"))
    counts = {kind: fine.histogram(clouds) for kind, clouds in sets.items()}
    results = {"bev_sum_shape": torch.tensor([fine.side, fine.side])}
    cells = {}
    for kind, clouds in sets.items():
        found = counts[kind].nonzero()
        results[f"bev_sum_{kind}_cells"] = found
        results[f"bev_sum_{kind}_counts"] = counts[kind][tuple(found.T)]
        cells[kind] = [coarse.cells(cloud) for cloud in clouds]
        for index, own in enumerate(cells[kind]):
            pair = torch.stack([own // coarse.side, own % coarse.side], dim=1)
            results[f"bev_bin_{kind}_{index}"] = pair / coarse.side
    pairs = [
        [minimum_matching([real], [made], coarse).squared_normalised for made in cells["smp"]]
        for real in cells["ref"]
    ]
    matched = minimum_matching(cells["ref"], cells["smp"], coarse).squared_normalised
    return (
        results
        | images_of(case)
        | {
            "jsd": histogram_distance(counts["ref"], counts["smp"]).jsd_distance,
            "chamfer_ref_x_smp": torch.tensor(pairs),
            "mmd": matched.mean(),
            "cd3": chamfer_squared(sets["ref"][0], sets["smp"][0]),
        }
    )


def images_of(case) -> dict:
    config, points = case.config["projection"], case["in/points"]
    assert config["log_scale"]
    sensor = LidarSensor(*config["size"], *config["fov"], *config["depth_range"])
    codec = RangeCodec("log2", config["depth_scale"], legacy_inverse=True)
    projection = SphericalProjection(sensor, legacy_seam=True)
    range_m, _ = range_image(points, projection)
    image = codec.to_image(range_m)
    back_m = codec.ranges_of(image, sensor)
    return {
        "range": range_m,
        "image": image,
        "mask": torch.where(codec.valid_mask(image), 1, -1),
        "depth_thresh": codec.threshold,
        "back_to_points": points_of(back_m, projection, corner=True),
        "range2xyz": range_channels(back_m[None], sensor)[0, 1:],
        "preprocess_range": range_channels(range_m[None], sensor)[0],
        "preprocess_pcd": points[in_range(points, sensor)],
    }


@pytest.mark.parametrize("name", METRICS)
def test_metrics(name, baseline_case, compare):
    case = baseline_case(name)
    results = {"r2flow_metrics": r2flow_metrics, "lidm_metrics": lidm_metrics}[name](case)

    def tolerance(key, expected):
        if key in ("out/frechet", "out/mmd", "out/squared_mmd_numpy_seed123"):
            return {"atol": 0, "rtol": 1e-5}
        return scaled(1e-6)(key, expected)

    compare(case, under("out/", results), tolerance=tolerance)


@pytest.mark.parametrize("layers", ["53_frd", "21_frid"])
def test_listings_load_under_both_names(layers, baseline_listing):
    listing = baseline_listing("evaluation_backbone_state_dicts")
    ours = listing[f"rangenet{layers}_r2flow_names"]
    official = (
        listing.get(f"rangenet{layers}_official_names") or listing["rangenet53_official_names"]
    )
    assert {name: our_name(name) for name in official["translation"]} == official["translation"]
    assert all(our_name(name) == name for name in ours["state_dict"])
    weights = weights_of(ours["state_dict"])
    backwards = {ours: theirs for theirs, ours in official["translation"].items()}
    theirs = {backwards[name]: value for name, value in weights.items()}
    for named in (weights, theirs):
        network = RangeNet.from_weights(named)
        assert count(network) == ours["param_count"]
        assert torch.equal(network.get_parameter("dec1.conv.0.bias"), weights["dec1.conv.0.bias"])
    with pytest.raises(ValueError, match=r"1 missing.*enc5.conv.0.weight"):
        RangeNet.from_weights({k: v for k, v in theirs.items() if k != "enc5.conv.weight"})


def test_listing_of_pointnet(baseline_listing):
    listing = baseline_listing("evaluation_backbone_state_dicts")["pointnet_fpd"]
    with torch.device("meta"):
        network = PointNet()
    shapes = {key: list(value.shape) for key, value in network.state_dict().items()}
    assert shapes == listing["state_dict"]
    assert network.dim == listing["feature_width"]
    assert count(network) == listing["param_count"]


def test_archives_and_folders_are_read(tmp_path, baseline_case):
    case = baseline_case("rangenet21")
    parts = {
        "backbone": case.weights("w/backbone."),
        "segmentation_decoder": case.weights("w/decoder."),
        "segmentation_head": case.weights("w_head/"),
    }
    folder = tmp_path / "darknet21"
    folder.mkdir()
    for name, weights in parts.items():
        torch.save(weights, folder / name)
    sensor = {"img_means": [1.0, 2.0, 3.0, 4.0, 5.0], "img_stds": [2.0] * 5}
    (folder / "arch_cfg.yaml").write_text(yaml.safe_dump({"dataset": {"sensor": sensor}}))
    with tarfile.open(tmp_path / "darknet21.tar.gz", "w:gz", compresslevel=1) as archive:
        archive.add(folder, "darknet21")
    for path in (folder, tmp_path / "darknet21.tar.gz"):
        network = RangeNet.from_checkpoint(path)
        image = torch.full((1, network.in_channels, 2, 32), 3.0)
        assert network.normalise(image)[0, :, 0, 0].tolist()[:4] == [1.0, 0.5, 0.0, -0.5]
        assert torch.equal(
            network.get_parameter("head.1.bias"), parts["segmentation_head"]["1.bias"]
        )
    (tmp_path / "other.pt").write_bytes(b"")
    with pytest.raises(ValueError, match=r"other\.pt: is damaged.*tar\.gz of the release"):
        RangeNet.from_checkpoint(tmp_path / "other.pt")
