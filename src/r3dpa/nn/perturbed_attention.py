"""A SiT evaluated once more without attention between the tokens in one of its blocks."""

from __future__ import annotations

import torch
from torch import Tensor

from r3dpa.nn.sit import SiT


def velocity_and_perturbed(
    sit: SiT, latents: Tensor, modulations: Tensor, block: int
) -> tuple[Tensor, Tensor]:
    """Velocity of the network, and with identity attention, both ``(B, C, h, w)``.

    In the second each token attends to itself alone in one block. The blocks before it are
    evaluated once, those behind it on both.

    Source: perturbed-attention guidance (Ahn et al. 2024).

    Args:
        sit: Velocity network.
        latents: ``(B, C, h, w)`` noisy normalised latents.
        modulations: ``(B, M)`` or ``(1, M)``, see :meth:`SiT.modulations`.
        block: Perturbed block, counted from 1.
    """
    before, width = block - 1, 6 * sit.hidden_size
    perturbed_block, later_blocks = sit.blocks[before], sit.blocks[block:]
    tokens = sit.run_blocks(sit.blocks[:before], sit.embed(latents), modulations)
    row = modulations[:, before * width : block * width]
    later = modulations[:, block * width :]
    both = torch.cat(
        [perturbed_block(tokens, row), perturbed_block(tokens, row, identity_attention=True)]
    )
    if len(later) > 1:  # one row per sample
        later = later.repeat(2, 1)
    both = sit.run_blocks(later_blocks, both, later)
    velocity, perturbed = sit.output(sit.final_layer, both, later).chunk(2)
    return velocity, perturbed
