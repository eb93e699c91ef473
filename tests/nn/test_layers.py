from __future__ import annotations

import copy
from itertools import product

import pytest
import torch
import torch.distributed as dist
import torch.nn.functional as F
from draws import drawn
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


@pytest.fixture
def process_group(tmp_path):
    """A process group of this process alone."""
    dist.init_process_group("gloo", f"file://{tmp_path}/rendezvous", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("group", [False, True], ids=["alone", "group"])
@pytest.mark.numerics("synchronised batch norm in one process")
def test_synced_batch_norm_in_one_process_is_batch_norm(group, dtype, request):
    if group:
        request.getfixturevalue("process_group")
    ours, plain = SyncedBatchNorm2d(3), nn.BatchNorm2d(3)
    assert list(ours.state_dict()) == list(plain.state_dict())
    for seed in range(3):
        image = drawn(seed, 2, 3, 4, 5).to(dtype)
        assert torch.equal(ours(image), plain(image))
    torch.testing.assert_close(ours.state_dict(), plain.state_dict(), atol=0, rtol=1e-6)
    ours.load_state_dict(plain.state_dict())
    assert torch.equal(ours.eval()(image), plain.eval()(image))
    if group:
        with pytest.raises((ValueError, RuntimeError), match="SyncBatchNorm expected input tensor"):
            nn.SyncBatchNorm(3)(image)


def test_half_precision_batch_norm_keeps_its_dtype():
    with torch.autocast("cpu", torch.bfloat16):
        image = F.conv2d(torch.randn(2, 1, 8, 8), torch.randn(3, 1, 3, 3))
        assert SyncedBatchNorm2d(3)(image).dtype == image.dtype == torch.bfloat16


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("value", [torch.inf, torch.nan])
@pytest.mark.numerics("batch norm on real and fake batches")
def test_a_broken_reconstruction_leaves_the_running_statistics_alone(value, dtype):
    ours, plain = SyncedBatchNorm2d(3), nn.BatchNorm2d(3)
    good, broken = drawn(0, 2, 3, 4, 6).to(dtype), drawn(1, 2, 3, 4, 6).to(dtype)
    broken[0, 1, 2, 3] = value
    for layer in (ours, plain):
        layer(good)
    before = copy.deepcopy(ours.state_dict())
    assert not ours(broken).isfinite().all()  # the loss tells, and the step is dropped
    torch.testing.assert_close(ours.state_dict(), before, atol=0, rtol=0)
    plain(broken)
    plain(good)
    assert not plain.running_var.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.numerics("group norm of a constant image")
def test_group_norm_of_any_constant_is_finite_both_ways(dtype):
    """A scan of no or of few returns is constant in every layer, but for as many pixels."""
    broken = 0
    for constant, returns in product((-1.0, 0.7, 3.3, 31.1, 300.7, 6e4), (0, 1, 15, 100)):
        image = torch.full((1, 32, 6, 20), constant, dtype=dtype)
        image.flatten(2)[..., :returns] *= 1.01
        values = image[0, 0].clone()
        image.requires_grad_()
        result = GroupNorm(32).to(dtype)(image)
        result.square().sum().backward()
        assert result.dtype == dtype
        assert result.isfinite().all()
        assert image.grad.isfinite().all()
        variance = values.square().mean() - values.mean().square()
        broken += not torch.rsqrt(variance + 1e-6).isfinite()
    assert broken
