import json
import math

import pytest
import torch

from r3dpa.cli.features import read_data
from r3dpa.geometry import EMPTY_RANGE_M, LidarSensor, RangeCodec

CODECS = [RangeCodec(), RangeCodec(scale=80.0), RangeCodec("log2"), RangeCodec("log2", scale=6.5)]
WIDE = LidarSensor(range_min_m=0.01, range_max_m=1000.0)


def test_encoded_ranges_by_hand():
    # 28 m is half of 56 m; 2^2.92 - 1 m is half of the 5.84 octaves above 1 m.
    assert RangeCodec().encode(torch.tensor([0.0, 28.0, 56.0, 90.0])).tolist() == [-1, 0, 1, 1]
    half_m = 2**2.92 - 1 - 1e-4
    assert RangeCodec("log2").encode(torch.tensor(half_m)).item() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("codec", CODECS, ids=str)
def test_encoded_ranges_come_back(codec):
    range_m = torch.linspace(0.02, 55.9, 5000, dtype=torch.float64)
    decoded = codec.decode(codec.encode(range_m), WIDE)
    assert decoded.dtype == torch.float32
    # One float32 step of the image near 1 is worth scale * 3e-8 = 2e-6 m (twice that for log2).
    torch.testing.assert_close(decoded.double(), range_m, atol=1e-5, rtol=0)


@pytest.mark.parametrize("codec", CODECS, ids=str)
def test_empty_pixels_and_wild_outputs_are_empty(codec):
    range_m = torch.tensor([EMPTY_RANGE_M, 0.0, 10.0])
    image = codec.encode(range_m)
    assert image[0] == image[1] == codec.encode(torch.tensor(0.0))
    assert image.min() >= -1
    assert codec.valid_mask(image).tolist() == [False, False, True]
    assert codec.decode(image, LidarSensor())[:2].tolist() == [EMPTY_RANGE_M] * 2
    below, above = codec.encode(torch.tensor([1 / 255 - 3e-4, 1 / 255 + 3e-4]))  # one grey level
    assert below < codec.threshold < above
    wild = torch.tensor([-5.0, -1.0, -1.2, 1.5, math.nan, math.inf, -math.inf])
    assert (codec.decode(wild, LidarSensor()) == EMPTY_RANGE_M).all()


def test_decoded_ranges_outside_the_exclusive_limits_are_empty():
    sensor = LidarSensor(range_min_m=2.0, range_max_m=20.0)
    codec = RangeCodec(scale=32.0)  # powers of two: 2 m and 20 m are exact
    image = codec.encode(torch.tensor([1.5, 2.0, 2.5, 19.0, 20.0, 21.0]))
    assert codec.decode(image, sensor).tolist() == [-1, -1, 2.5, 19, -1, -1]


def test_threshold_holds_where_the_sensor_has_no_lower_limit():
    image = RangeCodec().encode(torch.tensor([0.001, 0.5]))
    assert RangeCodec().to_range(image)[0] > 0
    decoded = RangeCodec().decode(image, LidarSensor(range_min_m=0.0))
    assert decoded.tolist() == [EMPTY_RANGE_M, pytest.approx(0.5)]


def test_half_precision_images_decode_in_float32_with_a_gradient():
    image = torch.tensor([0.25], dtype=torch.bfloat16, requires_grad=True)
    range_m = RangeCodec().decode(image, LidarSensor())
    assert range_m.tolist() == [35.0]
    range_m.sum().backward()
    assert image.grad.tolist() == [28.0]


def test_unknown_encodings_and_scales_are_refused():
    with pytest.raises(ValueError, match="'log10'"):
        RangeCodec("log10")
    with pytest.raises(ValueError, match="-1"):
        RangeCodec(scale=-1.0)


@pytest.mark.numerics
def test_log_inverse_is_exact():
    """Leaving the 1e-4 m of the encoding out of its inverse moves every range by as much."""
    range_m = torch.linspace(1.1, 55.9, 5000, dtype=torch.float64)
    image = RangeCodec("log2").encode(range_m)
    naive = 2 ** ((image.double() + 1) / 2 * 5.84) - 1
    assert (naive - range_m).abs().max() > 5e-5
    exact = RangeCodec("log2").decode(image, LidarSensor())
    assert (exact - range_m).abs().max() < 1e-5
    legacy = RangeCodec("log2", legacy_inverse=True).decode(image, LidarSensor())
    torch.testing.assert_close(legacy.double(), naive, atol=1e-5, rtol=0)


@pytest.mark.numerics
def test_log_of_a_missing_return():
    """The logarithm of an unclamped negative range is NaN and survives clipping."""
    missing = torch.tensor([EMPTY_RANGE_M, -2.0])
    naive = (2 * torch.log2(missing + 1 + 1e-4) / 5.84 - 1).clamp(-1, 1)
    assert naive[1].isnan()
    assert naive[0] != (2 * torch.log2(torch.tensor(1 + 1e-4)) / 5.84 - 1)
    image = RangeCodec("log2").encode(missing)
    assert image.tolist() == [RangeCodec("log2").encode(torch.tensor(0.0)).item()] * 2
    assert not RangeCodec("log2").valid_mask(image).any()


@pytest.mark.numerics
@pytest.mark.parametrize("codec", CODECS, ids=str)
def test_empty_image_decodes_to_no_point(codec):
    """An image close to -1 is a ring of points at the sensor if only its range is computed."""
    noise = torch.rand(64, 1024, generator=torch.Generator().manual_seed(0))
    image = codec.encode(torch.full((64, 1024), EMPTY_RANGE_M)) + 1e-4 * noise
    naive = codec.to_range(image) > 0
    assert naive.any()
    assert (codec.decode(image, LidarSensor()) == EMPTY_RANGE_M).all()


def test_an_encoding_named_alone_in_yaml_has_its_own_scale(tmp_path):
    path = tmp_path / "data.yaml"
    settings = {"scans": str(tmp_path), "codec": {"encoding": "log2"}}
    module = {"class_path": "r3dpa.data.LidarDataModule", "init_args": settings}
    path.write_text(json.dumps({"data": module}))
    assert read_data(path).codec == RangeCodec("log2") == RangeCodec("log2", 5.84)
    assert RangeCodec("log2").encode(torch.tensor(56.0)).item() > 0.99
    assert RangeCodec("log2", 56.0) != RangeCodec("log2")
