"""RangeViT and LIP-Loc against their golden numbers and state-dict listings.

The golden numbers derive from KITTI and are not part of the repository: without a folder that has
them, only the listings are compared.
"""

from __future__ import annotations

import pytest
import torch
from recorded_networks import count

from r3dpa.features.official import key_renamer, load_strictly
from r3dpa.geometry import LidarSensor
from r3dpa.metrics.networks import liploc, rangevit
from r3dpa.metrics.networks.liploc import LIPLoc, wrapped_grey_levels, wrapped_picture
from r3dpa.metrics.networks.rangevit import RangeViT, range_channels

STATISTICS = ("running_mean", "running_var", "num_batches_tracked")  # no parameters
PREFIX = "encoder_lidar.model."  # of LIP-Loc's lidar encoder in the released file


def empty(shapes):
    return {name: torch.empty(shape, device="meta") for name, shape in shapes.items()}


@pytest.fixture(scope="module")
def rangevit_case(load_case):
    return load_case("rangevit")


@pytest.fixture(scope="module")
def sensor(rangevit_case):
    projection = rangevit_case.config["proj"]
    return LidarSensor(*projection["size"], *projection["fov"], *projection["depth_range"])


@pytest.fixture(scope="module")
def network(rangevit_case, sensor):
    config = rangevit_case.config
    assert config["patch_size"] == config["patch_stride"]
    assert (config["conv_stem"], config["decoder"]) == ("ConvStem", "up_conv")
    band_rows, columns = config["pool"]
    assert columns == sensor.columns
    network = RangeViT(
        sensor,
        in_channels=config["inch"],
        width=config["d_model"],
        depth=config["n_layers"],
        num_heads=config["n_heads"],
        stem_channels=config["base"],
        skip_channels=config["Dh"],
        decoder_channels=config["d_dec"],
        trained_size=tuple(config["image_size"]),
        patch_size=tuple(config["patch_size"]),
        band_rows=band_rows,
    )
    rangevit.load_official(network, rangevit_case.weights())
    return network


@pytest.fixture(scope="module")
def images(rangevit_case):
    return rangevit_case["in/range_and_intensity"][:, None]  # range, intensity of one scan


def sampled(image):
    """Every 9th row and 37th column, as recorded."""
    return image[..., ::9, ::37]


def test_rangevit_layers(rangevit_case, network, images, close):
    image = range_channels(images[0], network.sensor, images[1])
    image = (image - rangevit_case["w/image_mean"]) / rangevit_case["w/image_std"]
    skip = network.stem(image[:, : network.in_channels])
    close(skip.mean(dim=(2, 3)), rangevit_case["out/skip_mean"])
    tokens = network.norm(network.encoder(network.embed(skip)))
    close(tokens[:, ::53], rangevit_case["out/encoder_tokens_sub"])
    close(sampled(network.feature_map(*images)), rangevit_case["out/features_2d_sub"])


def test_rangevit_feature(rangevit_case, network, images, tmp_path, close):
    """Of the network itself, and of one that is made from a file as the authors release it."""
    expected = rangevit_case["out/frid_feature"]
    assert expected.shape[1] == network.dim
    close(network(*images), expected)
    classifier = {"rangevit.kpclassifier.head.bias": torch.zeros(3)}
    path = tmp_path / "model.ckpt"
    torch.save({"state_dict": rangevit_case.weights() | classifier, "epoch": 3}, path)
    loaded = RangeViT.from_checkpoint(
        path,
        network.sensor,
        num_heads=rangevit_case.config["n_heads"],
        trained_size=tuple(rangevit_case.config["image_size"]),
        patch_size=network.patch_size,
    )
    close(loaded.feature_map(*images), network.feature_map(*images))


@pytest.mark.parametrize("name", ["rangevit_wo_i", "rangevit_w_i"])
def test_rangevit_released_sizes(official_listing, name):
    listing = official_listing("rangevit_state_dicts")[name]
    config, shapes = listing["assumed_config"], listing["state_dict"]
    with torch.device("meta"):
        network = RangeViT(LidarSensor(), config["in_channels"])
    rangevit.load_official(network, empty(shapes))
    classifier = sum(
        torch.empty(shape, device="meta").numel()
        for key, shape in shapes.items()
        if ".kpclassifier." in key and not key.endswith(STATISTICS)
    )
    own = count(network)
    assert own + classifier == listing["param_count"]
    assert network.dim == listing["feature_dim"]
    assert [network.sensor.beams, network.sensor.columns] == config["original_image_size"]


@pytest.fixture(scope="module")
def pictures(load_case):
    return load_case("liploc_preprocess")


def test_liploc_preprocess_bytes(pictures):
    assert pictures.config["scale"] == liploc.GREY_LEVELS_PER_M
    levels = wrapped_grey_levels(pictures["in/cast_values"])
    assert torch.equal(levels, pictures["out/cast_values_uint8"])
    assert torch.equal(wrapped_grey_levels(pictures["in/depth"]), pictures["out/uint8_image"])


def test_liploc_preprocess_picture(pictures, close):
    size = tuple(pictures.config["size"])
    picture = wrapped_picture(pictures["in/depth"][None], size)[0]
    assert picture.shape == (3, *size)
    close(picture[:, ::16, ::16], pictures["out/normalised_sub"])
    close(picture.mean(dim=(1, 2)), pictures["out/normalised_mean"])
    close(picture.std(dim=(1, 2)), pictures["out/normalised_std"])
    # Recorded in half precision before it was normalised with the constants of red.
    resized = pictures["out/resized_channel0_antialias"].float()
    close(picture[0] * 0.229 + 0.485, resized, atol=1e-3)
    jagged = pictures["out/resized_channel0_no_antialias_sub"]
    assert not torch.allclose(picture[0, ::16, ::16] * 0.229 + 0.485, jagged, atol=1e-2)


def test_liploc_encoder_feature(load_case, pictures, tmp_path, close):
    case = load_case("liploc_encoder")
    config, weights = case.config, case.weights()
    assert (config["num_classes"], config["global_pool"]) == (0, "avg")
    sizes = ("img_size", "patch_size", "embed_dim", "depth", "num_heads")
    network = LIPLoc(*(config[size] for size in sizes))
    load_strictly(network, weights, key_renamer(liploc._NAMES))
    range_m = pictures["in/depth"][None]
    close(network(range_m), case["out/feature"])
    # As the authors release it: the whole model, of which the rest has no part in the features.
    whole = {PREFIX + name: value for name, value in weights.items()}
    whole["encoder_camera.model.cls_token"] = torch.zeros(1, 1, 5)
    torch.save({"state_dict": whole}, tmp_path / "model.ckpt")
    loaded = LIPLoc.from_checkpoint(tmp_path / "model.ckpt", num_heads=config["num_heads"])
    close(loaded(range_m), case["out/feature"])


def test_liploc_encoder_released_sizes(official_listing):
    listing = official_listing("liploc_state_dict")["liploc_encoder_vit_small_patch16_224"]
    assert listing["prefix_in_checkpoint"] == PREFIX
    with torch.device("meta"):
        network = LIPLoc()
    weights = empty(listing["state_dict"])
    load_strictly(network, weights, key_renamer(liploc._NAMES))
    assert count(network) == listing["param_count"]
    assert network.dim == listing["feature_dim"]
