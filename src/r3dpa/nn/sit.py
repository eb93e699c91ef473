"""SiT, the flow transformer that predicts velocities and projected 3D features.

Letters: B batch, C latent channels, h x w latent size, N tokens, D token width, F feature width.
Module names follow the official state dict, except that the projection head is ``projector`` and
the latent batch norm is a network of its own (:class:`r3dpa.nn.latent_norm.LatentNorm`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, Self

import torch
import torch.nn.functional as F
from einops import rearrange
from einops.layers.torch import Rearrange
from torch import Tensor, nn

from r3dpa.nn.layers import (
    CircularConv2d,
    Mlp,
    SelfAttention,
    at_least_float32,
    named_layers,
    zeroed,
)
from r3dpa.nn.velocity_network import (
    MAX_PERIOD,
    TIME_WIDTH,
    Float32Linear,
    VelocityNetwork,
    time_frequencies,
)

_TOKEN_NORM_EPS = 1e-6
_TABLE_STD = 0.02


def sincos_position_embedding(
    width: int, grid_size: tuple[int, int], periodic_columns: bool = False
) -> Tensor:
    """Sine-cosine code ``(1, rows * columns, width)`` of positions on a token grid, row-major.

    The first half of the channels encodes the column, the second half the row; each half holds
    sines, then cosines, of ``position * 10000^(-k / (width / 4))``. Periodic columns have whole
    numbers of periods around the scan instead, so that the first is next to the last.
    """
    if width % 4:
        raise ValueError(f"position embedding needs a width divisible by 4, got {width}")
    rows, columns = grid_size
    exponents = torch.arange(width // 4, dtype=torch.float64) / (width // 4)
    frequencies = torch.exp(-math.log(MAX_PERIOD) * exponents)
    harmonics = 1.0 + torch.arange(width // 4, dtype=torch.float64) % max(1, columns // 2)

    def axis_code(positions: Tensor, frequencies: Tensor) -> Tensor:
        angles = positions.double()[:, None] * frequencies
        return torch.cat([angles.sin(), angles.cos()], dim=1)

    around = 2 * math.pi / columns * harmonics if periodic_columns else frequencies
    column_code = axis_code(torch.arange(columns).repeat(rows), around)
    row_code = axis_code(torch.arange(rows).repeat_interleave(columns), frequencies)
    return torch.cat([column_code, row_code], dim=1)[None].float()


class SiT(VelocityNetwork):
    """Scalable interpolant transformer with a feature projection head (REPA).

    Tokens are patches of the latents in row-major order. Each block is modulated by the embedding
    of time and class (adaLN-zero). After block ``alignment_depth`` a three-layer MLP projects the
    tokens to the width of the 3D features. SiT-B/2 is the default; SiT-XL/2 has ``hidden_size``
    1152, ``depth`` 28, ``num_heads`` 16 and ``alignment_depth`` 8.

    Source: SiT (Ma et al. 2024) with the alignment head of REPA (Yu et al. 2025), as used by
    R3DPA (ICRA 2026).

    Args:
        input_size: Latent rows and columns ``(h, w)``.
        in_channels: Latent channels C.
        patch_size: Side of a square patch, or rows and columns of one, in latent pixels.
        hidden_size: Token width D, a multiple of 4 and of ``num_heads``.
        depth: Number of transformer blocks.
        num_heads: Attention heads per block.
        mlp_ratio: Width of a block's MLP divided by ``hidden_size``.
        alignment_depth: Number of blocks before the projection head, counted from 1.
        feature_dim: Width F of the 3D features.
        projector_dim: Width of the projection head.
        num_classes: Rows of the class table.
        class_dropout: Add a last row to the class table for "no class", label ``num_classes``, as
            models trained with label dropout have.
        qk_norm: Layer-normalise queries and keys.
        learn_pos_embed: Train the position embedding, which is otherwise a fixed buffer.
        periodic_columns: Let the position embedding wrap around with the scan.
        projector: ``mlp`` of three layers, or one ``conv`` over the grid of tokens (iREPA, Singh
            et al. 2025), which takes neither ``projector_dim`` nor official weights.

    Example:
        >>> small = {"hidden_size": 32, "depth": 2, "num_heads": 2, "alignment_depth": 1}
        >>> sit = SiT((4, 8), in_channels=2, **small)
        >>> tuple(sit.velocity(torch.randn(3, 2, 4, 8), torch.tensor([0.0, 0.5, 1.0])).shape)
        (3, 2, 4, 8)
    """

    pos_embed: Tensor

    def __init__(
        self,
        input_size: tuple[int, int] = (16, 128),
        in_channels: int = 8,
        patch_size: int | tuple[int, int] = 2,
        hidden_size: int = 768,
        depth: int = 12,
        num_heads: int = 12,
        mlp_ratio: float = 4.0,
        alignment_depth: int = 4,
        feature_dim: int = 768,
        projector_dim: int = 2048,
        num_classes: int = 1,
        class_dropout: bool = False,
        qk_norm: bool = False,
        learn_pos_embed: bool = False,
        periodic_columns: bool = False,
        projector: Literal["mlp", "conv"] = "mlp",
    ) -> None:
        super().__init__()
        rows, columns = input_size
        patch = (patch_size, patch_size) if isinstance(patch_size, int) else tuple(patch_size)
        if rows % patch[0] or columns % patch[1]:
            raise ValueError(
                f"latents of {rows} x {columns} do not divide into patches of {patch_size}; "
                "choose a patch_size that divides both"
            )
        if hidden_size % num_heads:
            raise ValueError(
                f"hidden_size {hidden_size} is not a multiple of num_heads {num_heads}"
            )
        if not 1 <= alignment_depth <= depth:
            raise ValueError(
                f"alignment_depth must lie in 1..depth = 1..{depth}, got {alignment_depth}"
            )
        self.input_size = (rows, columns)
        self.in_channels = in_channels
        self.hidden_size = hidden_size
        self.patch = (patch[0], patch[1])
        self.grid_size = (rows // patch[0], columns // patch[1])
        self.alignment_depth = alignment_depth
        self.feature_dim = feature_dim
        self.num_classes = num_classes

        patches = nn.Conv2d(in_channels, hidden_size, self.patch, stride=self.patch)
        nn.init.xavier_uniform_(patches.weight.flatten(1))
        nn.init.zeros_(patches.get_parameter("bias"))
        to_tokens = Rearrange("B D row column -> B (row column) D")
        self.x_embedder = named_layers(proj=patches, tokens=to_tokens)
        self.t_embedder = TimeEmbedding(hidden_size)
        classes = nn.Embedding(num_classes + int(class_dropout), hidden_size)
        nn.init.normal_(classes.weight, std=_TABLE_STD)
        self.y_embedder = named_layers(embedding_table=classes)
        position = sincos_position_embedding(hidden_size, self.grid_size, periodic_columns)
        if learn_pos_embed:
            self.pos_embed = nn.Parameter(position)
        else:
            self.register_buffer("pos_embed", position)
        self.blocks = nn.ModuleList(
            SiTBlock(hidden_size, num_heads, mlp_ratio, qk_norm) for _ in range(depth)
        )
        if projector == "mlp":
            self.projector = nn.Sequential(
                _xavier_linear(hidden_size, projector_dim),
                nn.SiLU(),
                _xavier_linear(projector_dim, projector_dim),
                nn.SiLU(),
                _xavier_linear(projector_dim, feature_dim),
            )
        else:
            self.projector = nn.Sequential(
                Rearrange("B (row column) D -> B D row column", row=self.grid_size[0]),
                CircularConv2d(hidden_size, feature_dim, (3, 3)),
                Rearrange("B F row column -> B (row column) F"),
            )
        self.final_layer = _FinalLayer(hidden_size, math.prod(patch) * in_channels)

    def modulations(self, time: Tensor, labels: Tensor | None = None) -> Tensor:
        """Shifts, scales and gates ``(T, M)``: six vectors per block, then two for the output."""
        return modulations_of([*self.blocks, self.final_layer], self.conditioning(time, labels))

    def conditioning(self, time: Tensor, labels: Tensor | None) -> Tensor:
        """Embedding ``(T, D)`` of times and classes, in the dtype of the modulation layers."""
        labels = self._labels(time, labels)
        conditioning = self.t_embedder(time) + self.y_embedder(labels)
        return conditioning.to(self.final_layer.linear.weight.dtype)

    def embed(self, latents: Tensor) -> Tensor:
        """Tokens ``(B, N, D)`` of latents ``(B, C, h, w)``, with their positions."""
        return self.x_embedder(latents) + self.pos_embed

    def run_blocks(
        self, blocks: Iterable[nn.Module], tokens: Tensor, modulations: Tensor
    ) -> Tensor:
        """Tokens ``(B, N, D)`` after some blocks, whose modulations come first in ``(B, M)``."""
        width = 6 * self.hidden_size
        for index, block in enumerate(blocks):
            tokens = block(tokens, modulations[:, index * width : (index + 1) * width])
        return tokens

    def output(self, layer: nn.Module, tokens: Tensor, modulations: Tensor) -> Tensor:
        """Velocity ``(B, C, h, w)`` of an output layer, whose modulations come last."""
        return rearrange(
            layer(tokens, modulations[:, -2 * self.hidden_size :]),
            "B (row column) (p q C) -> B C (row p) (column q)",
            row=self.grid_size[0],
            p=self.patch[0],
            q=self.patch[1],
        )

    @property
    def input_layer(self) -> nn.Module:
        """The patch embedding."""
        return self.x_embedder

    @property
    def compiled_parts(self) -> list[nn.Module]:
        """The blocks, which share a graph."""
        return list(self.blocks)

    def to_bfloat16_(self) -> Self:
        """Cast the weights of attention and MLPs to bfloat16 in place, for sampling.

        Time embedding, modulations, the token stream between the blocks, statistics of the norms
        and the output layer stay float32.
        """
        for block in self.compiled_parts:
            block.get_submodule("attn").bfloat16()
            block.get_submodule("mlp").bfloat16()
        return self

    def _begin(self, latents: Tensor, modulations: Tensor) -> tuple[Tensor, ...]:
        first = self.blocks[: self.alignment_depth]
        return (self.run_blocks(first, self.embed(latents), modulations),)

    def _project(self, activations: Tensor) -> Tensor:
        return self.projector(activations)

    def _finish(self, activations: tuple[Tensor, ...], modulations: Tensor) -> Tensor:
        (tokens,) = activations
        later = modulations[:, 6 * self.hidden_size * self.alignment_depth :]
        tokens = self.run_blocks(self.blocks[self.alignment_depth :], tokens, later)
        return self.output(self.final_layer, tokens, modulations)

    def _first_modulations(self, time: Tensor, labels: Tensor | None) -> Tensor:
        first = self.blocks[: self.alignment_depth]
        return modulations_of(first, self.conditioning(time, labels))


def modulations_of(layers: Iterable[nn.Module], conditioning: Tensor) -> Tensor:
    """Modulations ``(T, M)`` of layers, next to each other, by the embedding ``(T, D)``."""
    rows = [layer.get_submodule("adaLN_modulation")(conditioning) for layer in layers]
    return torch.cat(rows, dim=1)


def _xavier_linear(in_features: int, out_features: int) -> nn.Linear:
    layer = nn.Linear(in_features, out_features)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class TimeEmbedding(nn.Module):
    """Embedding ``(T, D)`` of times ``(T,)``, in at least float32."""

    def __init__(self, hidden_size: int) -> None:
        super().__init__()
        first = Float32Linear(TIME_WIDTH, hidden_size)
        second = Float32Linear(hidden_size, hidden_size)
        for layer in (first, second):
            nn.init.normal_(layer.weight, std=_TABLE_STD)
            nn.init.zeros_(layer.bias)
        self.mlp = nn.Sequential(first, nn.SiLU(), second)

    def forward(self, time: Tensor) -> Tensor:
        """Embedding of times ``(T,)``."""
        return self.mlp(time_frequencies(at_least_float32(time)))


def _modulation(hidden_size: int, num_vectors: int) -> nn.Sequential:
    return nn.Sequential(nn.SiLU(), zeroed(nn.Linear(hidden_size, num_vectors * hidden_size)))


def _modulated_norm(tokens: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    width = tokens.shape[-1:]
    if len(shift) == 1:  # one modulation for all samples is the affine part of the norm
        weight, bias = (1 + scale[0]).to(tokens.dtype), shift[0].to(tokens.dtype)
        return F.layer_norm(tokens, width, weight, bias, _TOKEN_NORM_EPS)
    normalised = F.layer_norm(tokens, width, eps=_TOKEN_NORM_EPS)
    return normalised * (1 + scale[:, None]) + shift[:, None]


class SiTBlock(nn.Module):
    """Attention and MLP, each modulated before and gated after (adaLN-zero)."""

    def __init__(self, hidden_size: int, num_heads: int, mlp_ratio: float, qk_norm: bool) -> None:
        super().__init__()
        self.attn = SelfAttention(hidden_size, num_heads, qk_norm, _xavier_linear)
        self.mlp = Mlp(hidden_size, int(hidden_size * mlp_ratio), _xavier_linear, "tanh")
        self.adaLN_modulation = _modulation(hidden_size, 6)

    def forward(
        self, tokens: Tensor, modulation: Tensor, identity_attention: bool = False
    ) -> Tensor:
        """Tokens ``(B, N, D)`` after the block.

        Args:
            tokens: ``(B, N, D)``.
            modulation: ``(B, 6 D)`` or, for all samples, ``(1, 6 D)``.
            identity_attention: Let each token attend to itself alone.
        """
        shift_attn, scale_attn, gate_attn, shift_mlp, scale_mlp, gate_mlp = modulation.chunk(6, 1)
        dtype = self.mlp.fc1.weight.dtype  # bfloat16 after SiT.to_bfloat16_
        normed = _modulated_norm(tokens, shift_attn, scale_attn).to(dtype)
        tokens = tokens + gate_attn[:, None] * self.attn(normed, identity_attention)
        normed = _modulated_norm(tokens, shift_mlp, scale_mlp).to(dtype)
        return tokens + gate_mlp[:, None] * self.mlp(normed)


class _FinalLayer(nn.Module):
    def __init__(self, hidden_size: int, patch_values: int) -> None:
        super().__init__()
        self.linear = zeroed(nn.Linear(hidden_size, patch_values))
        self.adaLN_modulation = _modulation(hidden_size, 2)

    def forward(self, tokens: Tensor, modulation: Tensor) -> Tensor:
        shift, scale = modulation.chunk(2, dim=1)
        return self.linear(_modulated_norm(tokens, shift, scale))
