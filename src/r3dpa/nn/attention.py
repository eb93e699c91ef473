"""Attention between tokens, as all transformers of this package have it.

Letters: B batch, N tokens, D token width.
"""

from __future__ import annotations

from collections.abc import Callable

import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn


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

    def forward(self, tokens: Tensor) -> Tensor:
        """Attend within each sample of ``(B, N, D)``."""
        query, key, value = rearrange(
            self.qkv(tokens), "B N (three head d) -> three B head N d", three=3, head=self.num_heads
        )
        # Layer norm answers in float32 under autocast; attention wants one dtype.
        query, key = self.q_norm(query).to(value.dtype), self.k_norm(key).to(value.dtype)
        mixed = F.scaled_dot_product_attention(query, key, value)
        return self.proj(rearrange(mixed, "B head N d -> B N (head d)"))
