from __future__ import annotations

import torch

from r3dpa.data.range_images import decode_pixels, encode_pixels
from r3dpa.geometry import NUM_CLASSES, Pixels


def test_codes_take_three_bytes_and_keep_hundredths_and_classes():
    numbers = torch.arange(101)
    pixels = Pixels(
        torch.full((1, 101), 55.9),
        numbers[None] / 100,
        (numbers % (NUM_CLASSES + 1) - 1)[None],
    )
    codes = encode_pixels(pixels, 56.0)
    assert codes.dtype == torch.uint8
    assert codes.shape == (3, 1, 101)
    found = decode_pixels(codes, 56.0)
    torch.testing.assert_close(found.intensity, pixels.intensity)
    assert torch.equal(found.classes, pixels.classes)


def test_ranges_are_kept_to_half_a_step():
    range_m = torch.cat([torch.linspace(1.0, 56.0, 5000), torch.tensor([-1.0])])[None]
    pixels = Pixels(range_m, torch.zeros_like(range_m), torch.full(range_m.shape, -1))
    found = decode_pixels(encode_pixels(pixels, 56.0), 56.0).range_m
    assert found[0, -1] == -1
    # log2(57) in 8190 steps: 1 + range is off by the factor 57^(1 / 16380) at most.
    error = (found - range_m).abs()[:, :-1]
    assert (error <= (1 + range_m[:, :-1]) * (57 ** (1 / 16380) - 1) + 1e-5).all()
    assert error[range_m[:, :-1] < 20].max() < 0.0053
