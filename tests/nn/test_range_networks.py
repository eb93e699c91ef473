import pytest
import torch

from r3dpa.geometry import LidarSensor
from r3dpa.nn.backbones.liploc import LIPLoc, wrapped_grey_levels
from r3dpa.nn.backbones.rangevit import RangeViT, range_channels
from r3dpa.nn.backbones.vit import TransformerTrunk

SENSOR = LidarSensor(beams=16, columns=64)
# Batches of other sizes are added up in another order; features are of size 1.
FLOAT32 = {"atol": 1e-5, "rtol": 0.0}


def randomise(network):
    """Random norms and positions too, so that no layer is close to doing nothing."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
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


def test_network_without_intensity_ignores_it():
    range_m, intensity = scans(2), torch.rand(2, 16, 64)
    network = rangevit()
    assert torch.equal(network(range_m, intensity), network(range_m))
    with_intensity = rangevit(in_channels=5)
    change = with_intensity(range_m, intensity) - with_intensity(range_m, 1 - intensity)
    assert change.abs().max() > 1e-3
    with pytest.raises(ValueError, match="reads the intensity"):
        with_intensity(range_m)


def test_bytes_wrap():
    """5.1 * 50.2 = 256.02 is black again; -5.1 is cut to -5, which is 251 modulo 256."""
    range_m = torch.tensor([-1.0, -0.1, 0.0, 0.19, 0.2, 50.1, 50.2, 56.0, 100.4])
    levels = wrapped_grey_levels(range_m)
    assert levels.dtype == torch.uint8
    assert levels.tolist() == [251, 0, 0, 0, 1, 255, 0, 285 - 256, 0]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"in_channels": 6}, "in_channels must be in 1..5, got 6"),
        ({"patch_size": (3, 8)}, "even numbers"),
        ({"trained_size": (16, 30)}, "do not divide"),
        ({"band_rows": 5}, "bands of 5 rows"),
        ({"num_heads": 5}, "num_heads must divide the width 24, got 5"),
    ],
)
def test_rangevit_refuses_sizes(settings, message):
    with pytest.raises(ValueError, match=message):
        rangevit(**settings)


def test_rangevit_refuses_images_of_another_size():
    for shape in ((16, 64), (2, 16, 32), (2, 1, 16, 64)):
        with pytest.raises(ValueError, match=r"range image.* must be .* got shape"):
            rangevit()(torch.ones(shape))
    with pytest.raises(ValueError, match=r"intensity must have the shape .*\(1, 16, 64\)"):
        range_channels(scans(1), SENSOR, torch.ones(16, 64))


def test_liploc_refuses_what_is_no_picture():
    network = small_liploc()
    with pytest.raises(ValueError, match=r"\(B, H, W\), got shape \(16, 64\)"):
        network(torch.ones(16, 64))
    with pytest.raises(ValueError, match=r"\(B, H, W\), got shape \(0, 16, 64\)"):
        network(torch.ones(0, 16, 64))
    with pytest.raises(ValueError, match="finite"):
        network(torch.full((1, 16, 64), float("nan")))
    with pytest.raises(ValueError, match="patches of 7"):
        LIPLoc(picture_side=32, patch_side=7)
