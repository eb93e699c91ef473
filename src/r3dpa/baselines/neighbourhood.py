"""Attention of every pixel to a window around it, in plain PyTorch.

Letters: B batch, H x W pixels, D width of a head.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor

from r3dpa.nn.layers import Size

_BLOCK = 32  # columns of a block of queries; wider ones waste products, narrower ones copies


def neighbourhood_attention(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    kernel_size: Size,
    dilation: Size = (1, 1),
    wrap_columns: bool = False,
) -> Tensor:
    """Attention of each pixel to the ``kernel_size`` pixels around it, with logits ``q . k``.

    The window keeps its size: at the border it is shifted inwards, so that the first row of an
    image attends with a kernel of 3 to the rows 0 to 2. With ``wrap_columns`` columns are
    neighbours across the seam instead; where the kernel is wider than the image, columns come more
    than once. Dilated windows take every ``dilation``-th pixel and shift among these.

    Blocks of queries in one row share their keys, and a mask limits each query to its window.

    Source: Neighborhood Attention Transformer (Hassani et al. 2023), windows of natten 0.17.1.

    Args:
        query: ``(B, H, W, heads, D)``.
        key: As ``query``.
        value: As ``query``.
        kernel_size: Odd rows and columns of a window.
        dilation: Steps between the rows and between the columns of a window.
        wrap_columns: Let columns wrap around; for a column dilation of 1.

    Returns:
        ``(B, H, W, heads, D)``.

    Raises:
        ValueError: If the kernel is even, larger than the image, or wraps with a dilation.
    """
    _check(query, kernel_size, dilation, wrap_columns)
    result = torch.empty_like(query)
    for row in range(dilation[0]):
        for column in range(dilation[1]):
            part = slice(None), slice(row, None, dilation[0]), slice(column, None, dilation[1])
            attended = _attend_without_dilation(
                query[part], key[part], value[part], kernel_size, wrap_columns
            )
            if dilation == (1, 1):
                return attended
            result[part] = attended
    return result


def _attend_without_dilation(
    query: Tensor, key: Tensor, value: Tensor, kernel: Size, wrap: bool
) -> Tensor:
    height, width = query.shape[1:3]
    device = query.device
    block = min(_BLOCK, query.shape[2])
    rows = _starts(torch.arange(height, device=device), kernel[0], height)
    rows = rows[:, None] + torch.arange(kernel[0], device=device)

    first = torch.arange(0, width, block, device=device)
    columns = first[:, None] + torch.arange(block, device=device)  # the last block may be too long
    span = block + kernel[1] - 1
    if wrap:
        start = columns - kernel[1] // 2
        shared = first[:, None] - kernel[1] // 2 + torch.arange(span, device=device)
    else:
        span = min(span, width)
        start = _starts(columns, kernel[1], width)
        shared = start[:, :1].clamp(max=width - span) + torch.arange(span, device=device)
    within = shared[:, None] - start[..., None]
    mask = ((within >= 0) & (within < kernel[1])).repeat(1, 1, kernel[0])

    def windows(values: Tensor) -> Tensor:
        values = rearrange(values, "B H W head D -> (B head) H W D")
        values = values.index_select(2, shared.flatten() % width)
        values = values.index_select(1, rows.flatten())
        return rearrange(
            values,
            "b (H row) (block span) D -> (b H) block (row span) D",
            row=kernel[0],
            span=span,
        )

    blocks = rearrange(query, "B H W head D -> (B head H) W D")
    blocks = F.pad(blocks, (0, 0, 0, columns.numel() - width)).unflatten(1, columns.shape)
    mixed = F.scaled_dot_product_attention(
        blocks, windows(key), windows(value), attn_mask=mask, scale=1.0
    )
    mixed = mixed.flatten(1, 2)[:, :width]
    return rearrange(mixed, "(B head H) W D -> B H W head D", B=len(query), H=height)


def _starts(index: Tensor, kernel: int, length: int) -> Tensor:
    """First pixel of the windows of the given pixels, along one axis."""
    return (index - kernel // 2).clamp(0, length - kernel)


def _check(query: Tensor, kernel_size: Size, dilation: Size, wrap: bool) -> None:
    if any(size % 2 == 0 for size in kernel_size):
        raise ValueError(f"kernel_size must be odd, got {kernel_size}")
    if wrap and dilation[1] != 1:
        raise ValueError(f"columns wrap with a dilation of 1 only, got {dilation[1]}")
    needed = kernel_size[0] * dilation[0], 1 if wrap else kernel_size[1] * dilation[1]
    if query.shape[1] < needed[0] or query.shape[2] < needed[1]:
        raise ValueError(
            f"windows of {kernel_size} with dilation {dilation} need {needed[0]} rows and "
            f"{needed[1]} columns, but the image has {query.shape[1]} and {query.shape[2]}"
        )
