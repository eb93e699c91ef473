"""A SiT evaluated once more without attention between the tokens in one of its blocks."""

from __future__ import annotations

import torch
from torch import Tensor

from r3dpa.nn.sit import SiT


def velocity_and_perturbed(
    sit: SiT, latents: Tensor, modulations: Tensor, block: int
) -> tuple[Tensor, Tensor]:
    """Velocity as usual, and with identity attention in one block, both ``(B, C, h, w)``.

    Identity attention: each token attends to itself alone. The blocks before that block are
    evaluated once, the later ones on both kinds of tokens.

    Source: perturbed-attention guidance (Ahn et al. 2024).

    Args:
        sit: Velocity network.
        latents: ``(B, C, h, w)`` noisy normalised latents.
        modulations: ``(B, M)``, or ``(1, M)`` for all samples, see :meth:`SiT.modulations`.
        block: Perturbed block, counted from 1.
    """
    index = block - 1
    width = 6 * sit.hidden_size  # of the modulations of a block, which follow each other
    block_modulations = modulations[:, index * width : block * width]
    later = modulations[:, block * width :]

    tokens = sit.run_blocks(sit.blocks[:index], sit.embed(latents), modulations)
    usual = sit.blocks[index](tokens, block_modulations)
    identity = sit.blocks[index](tokens, block_modulations, identity_attention=True)
    if len(later) > 1:  # one row for each sample, of which there are now twice as many
        later = later.repeat(2, 1)
    both = sit.run_blocks(sit.blocks[block:], torch.cat([usual, identity]), later)
    velocity, perturbed = sit.output(sit.final_layer, both, later).chunk(2)
    return velocity, perturbed
