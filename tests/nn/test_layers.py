from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from r3dpa.nn.layers import AttentionBlock, GroupNorm, SyncedBatchNorm2d, Upsample, downsample


@pytest.mark.parametrize("stride", [(1, 2), (1, 4), (2, 1), (2, 2)])
def test_resampling_changes_the_size_and_commutes_with_rotation(stride):
    small, large = torch.randn(2, 4, 4, 8), torch.randn(2, 4, 4 * stride[0], 8 * stride[1])
    down, up = downsample(4, stride), Upsample(4, stride)
    assert down(large).shape == small.shape
    assert up(small).shape == large.shape
    columns = 3 * stride[1]
    torch.testing.assert_close(down(large.roll(columns, -1)), down(large).roll(3, -1))
    torch.testing.assert_close(up(small.roll(3, -1)), up(small).roll(columns, -1))


def test_upsample_interpolates_between_the_last_and_the_first_column():
    layer = Upsample(1, (1, 2))
    nn.init.zeros_(layer.conv.weight)
    nn.init.zeros_(layer.conv.bias)
    layer.conv.weight.data[..., 2] = 1.0  # middle tap: the interpolation alone remains
    image = torch.tensor([0.0, 4.0, 8.0, 16.0]).view(1, 1, 1, 4)
    # New pixel centres lie a quarter of an old pixel beside the old centres.
    expected = torch.tensor([4.0, 1.0, 3.0, 5.0, 7.0, 10.0, 14.0, 12.0]).view(1, 1, 1, 8)
    torch.testing.assert_close(layer(image), expected)


@pytest.mark.numerics
def test_group_norm_of_half_precision_images_has_float32_statistics():
    image = 300 * torch.randn(1, 32, 8, 8)
    expected = GroupNorm(32)(image)
    actual = GroupNorm(32).half()(image.half())
    torch.testing.assert_close(actual.float(), expected, atol=5e-3, rtol=0)
    assert actual.dtype == torch.float16
    naive_variance = image.half().square().flatten(2).mean(-1)
    assert naive_variance.isinf().any()


@pytest.mark.numerics
def test_attention_with_large_queries_survives_half_precision():
    block, image = AttentionBlock(512), torch.randn(1, 512, 4, 4)
    for layer in (block.q, block.k):
        layer.weight.data = 12 * torch.eye(512)[..., None, None]
    expected = block(image)
    actual = block.half()(image.half()).float()
    torch.testing.assert_close(actual, expected, atol=0.01 * expected.abs().max().item(), rtol=0)
    query = block.q(block.norm(image.half())).flatten(2)
    assert (query.transpose(1, 2) @ query).isinf().any()  # scaled after the product


def test_synced_batch_norm_in_one_process_is_batch_norm():
    ours, plain = SyncedBatchNorm2d(3), nn.BatchNorm2d(3)
    assert list(ours.state_dict()) == list(plain.state_dict())
    for _ in range(3):
        image = torch.randn(2, 3, 4, 5)
        assert torch.equal(ours(image), plain(image))
    torch.testing.assert_close(ours.state_dict(), plain.state_dict(), atol=0, rtol=1e-6)
    ours.load_state_dict(plain.state_dict())
    assert torch.equal(ours.eval()(image), plain.eval()(image))


def test_half_precision_batch_norm_keeps_its_dtype():
    with torch.autocast("cpu", torch.bfloat16):
        image = F.conv2d(torch.randn(2, 1, 8, 8), torch.randn(3, 1, 3, 3))
        assert SyncedBatchNorm2d(3)(image).dtype == image.dtype == torch.bfloat16
