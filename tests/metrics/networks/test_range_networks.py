import math

import pytest
import torch

from r3dpa.features.dinov2 import TransformerTrunk
from r3dpa.geometry import LidarSensor
from r3dpa.metrics.networks.liploc import LIPLoc, wrapped_grey_levels, wrapped_picture
from r3dpa.metrics.networks.rangevit import RangeViT, range_channels

SENSOR = LidarSensor(beams=16, columns=64)
# Batches of other sizes are added up in another order; features are of size 1.
FLOAT32 = {"atol": 1e-5, "rtol": 0.0}


def randomise(network):
    """Random norms and positions too, so that no layer is close to doing nothing."""
    generator = torch.Generator().manual_seed(0)
    for name, value in network.state_dict().items():
        if value.is_floating_point() and not name.startswith("image_"):
            values = torch.randn(value.shape, generator=generator)
            if name.endswith("running_var"):
                value.copy_(0.5 + values.abs())
            elif name.endswith("weight") and value.ndim == 1:
                value.copy_(1 + 0.3 * values)
            else:
                value.copy_(values * (value[0].numel() ** -0.5 if value.ndim > 1 else 0.3))
    return network


def rangevit(**settings):
    sizes = {"width": 24, "depth": 2, "num_heads": 3, "stem_channels": 4, "skip_channels": 6}
    sizes |= {"decoder_channels": 5, "trained_size": (16, 32)} | settings
    return randomise(RangeViT(SENSOR, **sizes))


def small_liploc():
    return randomise(LIPLoc(picture_side=32, patch_side=8, width=24, depth=2, num_heads=3))


def scans(count, seed=1):
    """Range images with a quarter of empty pixels."""
    generator = torch.Generator().manual_seed(seed)
    shape = (count, SENSOR.beams, SENSOR.columns)
    range_m = 2.0 + 50.0 * torch.rand(shape, generator=generator)
    return torch.where(torch.rand(shape, generator=generator) < 0.25, -1.0, range_m)


def test_points_lie_on_the_corners_of_their_pixels():
    """Row 0 starts at 3 degrees, column 0 at the back, column W / 4 on the left."""
    range_m = torch.full((1, 16, 64), 10.0)
    distance, x, y, z = range_channels(range_m, SENSOR)[0]
    up, flat = 10 * math.sin(math.radians(3)), 10 * math.cos(math.radians(3))
    assert (distance == 10.0).all()
    assert z[0].tolist() == pytest.approx([up] * 64, rel=1e-6)
    assert (x[0, 0].item(), x[0, 32].item()) == pytest.approx((-flat, flat), rel=1e-6)
    assert (y[0, 16].item(), y[0, 48].item()) == pytest.approx((flat, -flat), rel=1e-6)
    assert z[8, 0].item() == pytest.approx(10 * math.sin(math.radians(3 - 28 / 2)), rel=1e-6)


def test_pixels_out_of_range_have_no_point():
    """Both limits, 1 and 56 m, are out of range; what the pixel holds is left as it is."""
    values = [-1.0, 0.0, 0.5, 1.0, 1.001, 55.999, 56.0, 80.0]
    range_m = torch.full((1, 16, 64), 10.0)
    range_m[0, 3, :8] = torch.tensor(values)
    distance, *xyz = range_channels(range_m, SENSOR)[0, :, 3, :8]
    assert distance.tolist() == pytest.approx(values)
    no_point = [all(value == -1.0 for value in point) for point in zip(*xyz, strict=True)]
    assert no_point == [True, True, True, True, False, False, True, True]


def test_positions_are_resized_bilinearly_between_cell_centres():
    """Blocks are left out: the trunk is then the sum of patches and positions."""
    trunk = TransformerTrunk(1, 0, 1, (1, 2), 1e-6)
    trunk.pos_embed.data[0, :, 0] = torch.tensor([7.0, 0.0, 4.0])
    doubled = trunk(torch.zeros(1, 1, 1, 4))[0, :, 0]
    assert doubled.tolist() == [7.0, 0.0, 1.0, 3.0, 4.0]
    same = trunk(torch.full((1, 1, 1, 2), 10.0))[0, :, 0]
    assert same.tolist() == [7.0, 10.0, 14.0]


def test_features_are_means_of_bands_channel_by_channel(monkeypatch):
    network = rangevit()
    rows = torch.arange(16.0)[:, None].expand(16, 64)
    map_ = torch.stack([rows, 100 + rows])[None]
    monkeypatch.setattr(network, "feature_map", lambda range_m, intensity: map_)
    assert network(scans(1)).tolist() == [[3.5, 11.5, 103.5, 111.5]]
    assert (network.dim, rangevit(band_rows=4).dim) == (5 * 2, 5 * 4)


def test_patch_is_the_mean_over_one_pixel_more_than_its_size():
    """Patches of 2 x 8 average 3 x 9 pixels, of which zeros beyond the border are part."""
    network = rangevit(skip_channels=1, width=3)
    network.embedding.weight.data.fill_(1.0)
    network.embedding.bias.data.zero_()
    patches = network.embed(torch.ones(1, 1, 16, 64))[0, 0]
    assert patches.shape == (8, 8)
    assert patches[1:, 1:].unique().tolist() == pytest.approx([1.0])
    assert patches[0, 1:].unique().tolist() == pytest.approx([2 / 3])
    assert patches[1:, 0].unique().tolist() == pytest.approx([5 / 9])
    assert patches[0, 0].item() == pytest.approx(2 / 3 * 5 / 9)


def test_scans_of_a_batch_do_not_see_each_other():
    range_m = scans(3)
    for network in (rangevit(), small_liploc()):
        # A metric inside of a module in training is switched to training mode with it.
        network.train()
        together = network(range_m)
        assert not network.training
        assert together.shape == (3, network.dim)
        assert (together[0] - together[1]).abs().max() > 1e-3
        for index in range(3):
            alone = network(range_m[index : index + 1])[0]
            torch.testing.assert_close(alone, together[index], **FLOAT32)


def test_intensity_counts_where_the_network_reads_it():
    range_m, intensity = scans(2), torch.rand(2, 16, 64)
    network = rangevit(in_channels=5)
    change = network(range_m, intensity) - network(range_m, 1 - intensity)
    assert change.abs().max() > 1e-3
    with pytest.raises(ValueError, match="reads the intensity"):
        network(range_m)


def test_bytes_wrap():
    """5.1 * 50.2 = 256.02 is black again; -5.1 is cut to -5, which is 251 modulo 256."""
    range_m = torch.tensor([-1.0, -0.1, 0.0, 0.19, 0.2, 50.1, 50.2, 56.0, 100.4])
    levels = wrapped_grey_levels(range_m)
    assert levels.dtype == torch.uint8
    assert levels.tolist() == [251, 0, 0, 0, 1, 255, 0, 285 - 256, 0]


def test_picture_is_antialiased_and_normalised():
    """Halving: triangle of 4 pixels with weights 1 3 3 1, where bilinear alone takes 1 1."""
    range_m = torch.zeros(2, 2, 16)
    range_m[:, :, 7] = 50.0  # white, 255 levels
    pictures = wrapped_picture(range_m, (2, 8))
    assert pictures.shape == (2, 3, 2, 8)
    for colour, (mean, std) in enumerate([(0.485, 0.229), (0.456, 0.224), (0.406, 0.225)]):
        row = pictures[1, colour, 0] * std + mean
        assert row.tolist() == pytest.approx([0, 0, 0, 3 / 8, 1 / 8, 0, 0, 0], abs=1e-6)


def test_feature_is_the_mean_of_the_patch_tokens_normalised():
    """Without blocks a token is its patch plus its position; the class token has no part."""
    network = LIPLoc(picture_side=4, patch_side=2, width=2, depth=0, num_heads=1)
    network.embedding.weight.data.zero_()
    network.embedding.bias.data.copy_(torch.tensor([1.0, 2.0]))
    network.encoder.cls_token.data.fill_(1e3)
    positions = torch.tensor([[1e3, -1e3], [4.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    network.encoder.pos_embed.data.copy_(positions[None])
    network.norm.weight.data.copy_(torch.tensor([1.0, 10.0]))
    # Mean (1 + 4 / 4, 2) has no variance: all of it is the bias of the norm.
    network.norm.bias.data.copy_(torch.tensor([0.5, 0.25]))
    assert network(torch.full((1, 3, 5), 10.0))[0].tolist() == [0.5, 0.25]
    network.encoder.pos_embed.data[0, 2, 0] = 8.0  # mean (4, 2): normalised to 1, -1
    feature = network(torch.full((1, 3, 5), 10.0))[0]
    assert feature.tolist() == pytest.approx([1.5, -9.75], rel=1e-5)


def test_sizes_that_do_not_divide_are_refused():
    for build, message in (
        (lambda: rangevit(trained_size=(16, 30)), "do not divide"),
        (lambda: rangevit(band_rows=5), "bands of 5 rows"),
        (lambda: LIPLoc(picture_side=32, patch_side=7), "patches of 7"),
    ):
        with pytest.raises(ValueError, match=message):
            build()
