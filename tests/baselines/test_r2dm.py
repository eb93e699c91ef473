"""What R2DM records for sampling, and the decay of its average."""

from __future__ import annotations

import pytest

from r3dpa.baselines.efficient_unet import EfficientUNet
from r3dpa.baselines.r2dm import R2DM, ema_decay_at


def network():
    return EfficientUNet(
        in_channels=2,
        resolution=(16, 64),
        base_channels=8,
        channel_multiplier=(1, 1, 1, 2),
        num_residual_blocks=(1, 1, 1, 1),
        gn_num_groups=4,
        attn_num_heads=2,
    )


def test_settings_rebuild_the_path_of_the_training():
    module = R2DM(network(), prediction="v", schedule="cosine", shift=1.5, clip=False)
    again = R2DM(network(), **module.settings())
    assert again.interpolant == module.interpolant
    assert again.interpolant.shift == 1.5
    assert (again.prediction, again.clip) == ("v", False)


@pytest.mark.parametrize(
    ("step", "decay"),
    [(0, 0.0), (90, 0.0), (95, 1.0), (100, 0.0), (110, 1 - 11 ** (-2 / 3)), (10**6, 0.995)],
)
def test_the_average_is_a_copy_up_to_and_with_its_start(step, decay):
    """Every tenth step counts, and the average starts after step 100."""
    assert ema_decay_at(step, decay=0.995, every=10, after=100) == pytest.approx(decay)
