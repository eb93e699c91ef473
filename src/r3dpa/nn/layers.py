"""Layers that several networks share; for range images, columns wrap around.

Letters: B batch, C channels, H x W image or latent size, N tokens, D token width.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar, cast

import torch
import torch.distributed as dist
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

Size = tuple[int, int]
_Layer = TypeVar("_Layer", bound=nn.Module)

# stride -> kernel and (left, right, top, bottom) pads of the official weights
_DOWNSAMPLE = {
    (1, 2): ((3, 3), (0, 1, 1, 1)),
    (1, 4): ((3, 5), (1, 1, 1, 1)),
    (2, 1): ((3, 3), (1, 1, 1, 1)),
    (2, 2): ((3, 3), (0, 1, 0, 1)),
}
# stride -> kernel after the interpolation
_UPSAMPLE = {(1, 2): (1, 5), (1, 4): (1, 7), (2, 1): (5, 1), (2, 2): (3, 3)}


def at_least_float32(values: Tensor) -> Tensor:
    """The tensor in float32, or unchanged in float64."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def no_autocast(device: torch.device) -> AbstractContextManager[Any]:
    """Disable autocast; do nothing on ``meta``, which has none."""
    if device.type == "meta":
        return nullcontext()
    return torch.autocast(device.type, enabled=False)


def zeroed(layer: _Layer) -> _Layer:
    """The layer with all parameters set to 0, so that its block starts as its shortcut."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def named_layers(**layers: nn.Module) -> nn.Sequential:
    """Sequential layers with the names that an official state dict gives them."""
    return nn.Sequential(OrderedDict(layers))


class CircularConv2d(nn.Conv2d):
    """Convolution with circular padding of columns and zero padding of rows.

    The default padding keeps the size; an even kernel then reaches further right and down than
    left and up. ``pads`` are ``(left, right, top, bottom)`` pixels, ``top <= bottom``. With a
    ``dilation`` the taps of the kernel lie that many pixels apart.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: Size,
        stride: Size = (1, 1),
        pads: tuple[int, int, int, int] | None = None,
        dilation: Size = (1, 1),
    ) -> None:
        if pads is None:
            rows, columns = kernel_size[0] - 1, kernel_size[1] - 1  # between first and last tap
            rows, columns = rows * dilation[0], columns * dilation[1]
            pads = (columns // 2, (columns + 1) // 2, rows // 2, (rows + 1) // 2)
        left, right, top, bottom = pads
        padding = (top, 0)
        super().__init__(in_channels, out_channels, kernel_size, stride, padding, dilation)
        self.column_pads = (left, right, 0, 0)
        self.extra_row_pads = (0, 0, 0, bottom - top)

    def forward(self, image: Tensor) -> Tensor:
        """Convolution of ``(B, C, H, W)``."""
        if any(self.column_pads):
            image = F.pad(image, self.column_pads, mode="circular")
        if any(self.extra_row_pads):
            image = F.pad(image, self.extra_row_pads)
        return super().forward(image)


class Float32CircularConv2d(CircularConv2d):
    """:class:`CircularConv2d` in at least float32, also under autocast.

    For the layer that outputs a range image: in bfloat16 a range of 50 m would be off by 0.1 m.
    """

    def forward(self, image: Tensor) -> Tensor:
        """Convolution of ``(B, C, H, W)``."""
        with no_autocast(image.device):
            return super().forward(image.to(at_least_float32(self.weight).dtype))


def downsample(channels: int, stride: Size) -> nn.Sequential:
    """Strided convolution of LiDM, by ``stride`` (1, 2), (1, 4), (2, 1) or (2, 2)."""
    kernel_size, pads = _DOWNSAMPLE[_supported(stride)]
    return named_layers(conv=CircularConv2d(channels, channels, kernel_size, stride, pads))


class Upsample(nn.Module):
    """Bilinear interpolation and a convolution, by ``stride`` (1, 2), (1, 4), (2, 1) or (2, 2).

    Columns are padded circularly before the interpolation (corners not aligned) and cropped
    afterwards, so that rotating the input by one column rotates the output by ``stride`` columns.
    LiDM and R3DPA interpolate with aligned corners and without wrapping, which breaks the symmetry
    by an error as large as the signal; their weights need ``legacy``.
    """

    def __init__(self, channels: int, stride: Size, legacy: bool = False) -> None:
        super().__init__()
        self.stride = _supported(stride)
        self.legacy = legacy
        self.conv = CircularConv2d(channels, channels, _UPSAMPLE[self.stride])

    def forward(self, image: Tensor) -> Tensor:
        """``(B, C, H, W)`` to ``(B, C, H * stride rows, W * stride columns)``."""
        rows, columns = image.shape[-2] * self.stride[0], image.shape[-1] * self.stride[1]
        if self.legacy:
            image = F.interpolate(image, (rows, columns), mode="bilinear", align_corners=True)
        else:
            border = self.stride[1]
            image = F.pad(image, (1, 1, 0, 0), mode="circular")
            image = F.interpolate(image, (rows, columns + 2 * border), mode="bilinear")
            image = image[..., border:-border]
        return self.conv(image)


def _supported(stride: Size) -> Size:
    if stride not in _UPSAMPLE:
        raise ValueError(f"stride (rows, columns) must be one of {list(_UPSAMPLE)}, got {stride}")
    return stride


class GroupNorm(nn.GroupNorm):
    """Group norm with 32 groups and statistics in at least float32."""

    def __init__(self, channels: int, eps: float = 1e-6) -> None:
        if channels % 32:
            raise ValueError(f"channels must be a multiple of 32 (norm groups), got {channels}")
        super().__init__(32, channels, eps=eps)

    def forward(self, image: Tensor) -> Tensor:
        """Normalised ``(B, C, H, W)`` in the dtype of the input."""
        if image.is_cpu:  # its kernel keeps float32 statistics and reads half as much memory
            return super().forward(image).to(image.dtype)
        values = at_least_float32(image)
        weight, bias = self.weight.to(values.dtype), self.bias.to(values.dtype)
        return F.group_norm(values, self.num_groups, weight, bias, self.eps).to(image.dtype)


class ResBlock(nn.Module):
    """Two convolutions, each after group norm and swish, around a shortcut."""

    def __init__(self, in_channels: int, out_channels: int, kernel_size: Size = (3, 3)) -> None:
        super().__init__()
        self.norm1 = GroupNorm(in_channels)
        self.conv1 = CircularConv2d(in_channels, out_channels, kernel_size)
        self.norm2 = GroupNorm(out_channels)
        self.conv2 = CircularConv2d(out_channels, out_channels, kernel_size)
        same = in_channels == out_channels
        self.nin_shortcut = nn.Identity() if same else nn.Conv2d(in_channels, out_channels, 1)

    def forward(self, image: Tensor) -> Tensor:
        """``(B, in_channels, H, W)`` to ``(B, out_channels, H, W)``."""
        hidden = self.conv1(F.silu(self.norm1(image)))
        hidden = self.conv2(F.silu(self.norm2(hidden)))
        return self.nin_shortcut(image) + hidden


class AttentionBlock(nn.Module):
    """Single-head attention between all pixels, added to the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = GroupNorm(channels)
        self.q = nn.Conv2d(channels, channels, 1)
        self.k = nn.Conv2d(channels, channels, 1)
        self.v = nn.Conv2d(channels, channels, 1)
        self.proj_out = nn.Conv2d(channels, channels, 1)

    def forward(self, image: Tensor) -> Tensor:
        """``(B, C, H, W)`` to the same shape."""
        hidden = self.norm(image)
        query, key, value = (
            rearrange(layer(hidden), "b c h w -> b 1 (h w) c") for layer in (self.q, self.k, self.v)
        )
        hidden = F.scaled_dot_product_attention(query, key, value)
        hidden = rearrange(hidden, "b 1 (h w) c -> b c h w", h=image.shape[-2])
        return image + self.proj_out(hidden)


class SelfAttention(nn.Module):
    """Multi-head attention between the tokens of each sample.

    Args:
        width: Token width D.
        num_heads: Heads, a divisor of ``width``.
        qk_norm: Layer norm on queries and keys.
        linear: Builds the linear layers from input and output width.
    """

    def __init__(
        self,
        width: int,
        num_heads: int,
        qk_norm: bool = False,
        linear: Callable[[int, int], nn.Linear] = nn.Linear,
    ) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.qkv = linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // num_heads) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(width // num_heads) if qk_norm else nn.Identity()
        self.proj = linear(width, width)

    def forward(self, tokens: Tensor, identity_attention: bool = False) -> Tensor:
        """``(B, N, D)`` to the same shape; with identity attention each token sees itself alone."""
        if identity_attention:
            return self.proj(self.qkv(tokens).chunk(3, dim=-1)[2])
        query, key, value = rearrange(
            self.qkv(tokens), "B N (three head d) -> three B head N d", three=3, head=self.num_heads
        )
        # Layer norm returns float32 under autocast; attention needs one dtype.
        query, key = self.q_norm(query).to(value.dtype), self.k_norm(key).to(value.dtype)
        attended = F.scaled_dot_product_attention(query, key, value)
        return self.proj(rearrange(attended, "B head N d -> B N (head d)"))


class Mlp(nn.Module):
    """Two linear layers around a GELU, exact or its ``tanh`` approximation."""

    def __init__(
        self,
        width: int,
        hidden: int,
        linear: Callable[[int, int], nn.Linear] = nn.Linear,
        approximate: str = "none",
    ) -> None:
        super().__init__()
        self.fc1 = linear(width, hidden)
        self.fc2 = linear(hidden, width)
        self.approximate = approximate

    def forward(self, tokens: Tensor) -> Tensor:
        """``(B, N, D)`` to the same shape."""
        return self.fc2(F.gelu(self.fc1(tokens), approximate=self.approximate))


class SyncedBatchNorm2d(nn.BatchNorm2d):
    """Batch norm whose training statistics cover the batches of all processes.

    With one process it equals ``nn.BatchNorm2d`` bitwise; the state-dict keys are the same. Unlike
    ``nn.SyncBatchNorm`` it also runs on a CPU (gloo), and batch sizes may differ between
    processes. The variance takes two passes around the global mean, in float32. Gradients come from
    the sum of the losses of all processes. A batch with non-finite statistics leaves the running
    statistics unchanged.
    """

    running_mean: Tensor
    running_var: Tensor
    num_batches_tracked: Tensor

    def forward(self, image: Tensor) -> Tensor:
        """Normalised ``(B, C, H, W)``."""
        if not self.training:
            return super().forward(image)
        moved = self.running_mean.clone(), self.running_var.clone()
        momentum = cast(float, self.momentum)
        if num_processes() > 1:
            mean, variance, count = _global_moments(image)
            unbiased = variance * (count / (count - 1))
            for running, value in zip(moved, (mean, unbiased), strict=True):
                running.lerp_(value.detach(), momentum)
            scale = torch.rsqrt(variance + self.eps) * self.weight
            centred = at_least_float32(image) - mean.view(-1, 1, 1)
            result = (centred * scale.view(-1, 1, 1) + self.bias.view(-1, 1, 1)).to(image.dtype)
        else:
            result = F.batch_norm(image, *moved, self.weight, self.bias, True, momentum, self.eps)
        usable = torch.stack(moved).isfinite().all()
        for running, value in zip((self.running_mean, self.running_var), moved, strict=True):
            running.copy_(torch.where(usable, value, running))
        self.num_batches_tracked += usable
        return result


def num_processes() -> int:
    """Number of processes that train together."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def sum_over_processes(values: Tensor) -> Tensor:
    """Elementwise sum over all processes, differentiable; every process must call it."""
    if num_processes() == 1:
        return values
    from torch.distributed.nn.functional import all_reduce  # absent where dist is not available

    return all_reduce(values)


def _global_moments(image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and biased variance ``(C,)`` and values per channel, over all processes."""
    values = at_least_float32(image)
    count = values.new_tensor([values.numel() / values.shape[1]])
    sums = sum_over_processes(torch.cat([values.sum(dim=(0, 2, 3)), count]))
    count = sums[-1]
    mean = sums[:-1] / count
    squares = (values - mean.view(-1, 1, 1)).square().sum(dim=(0, 2, 3))
    return mean, sum_over_processes(squares) / count, count
