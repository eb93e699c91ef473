"""A UNet for the batches of ``tiny_stages``."""

from __future__ import annotations

from tiny_stages import FEATURE_DIM

from r3dpa.nn import UNet

SIZES = {"in_channels": 4, "channels": 32, "channel_multipliers": [1, 2], "num_res_blocks": 1}


def tiny_unet():
    return UNet(**SIZES, input_size=(4, 8), feature_dim=FEATURE_DIM, projector_dim=8)
