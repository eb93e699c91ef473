from __future__ import annotations

import pytest
import torch

from r3dpa.nn.discriminator import PatchDiscriminator


def test_each_logit_belongs_to_one_patch():
    for num_layers in (1, 2, 3):
        logits = PatchDiscriminator(1, 4, num_layers)(torch.randn(2, 1, 32, 64))
        assert logits.shape == (2, 1, 32 // 2**num_layers - 2, 64 // 2**num_layers - 2)
    with pytest.raises(ValueError, match="at least 1, got 0"):
        PatchDiscriminator(num_layers=0)


def test_patch_of_the_default_depth_has_34_pixels():
    network = PatchDiscriminator(channels=4).eval()
    image = torch.randn(1, 1, 64, 96, requires_grad=True)
    network(image)[0, 0, 7, 11].backward()
    rows, columns = image.grad[0, 0].nonzero(as_tuple=True)
    assert rows.max() - rows.min() + 1 == 34
    assert columns.max() - columns.min() + 1 == 34


def test_fresh_weights_follow_pix2pix():
    torch.manual_seed(0)
    network = PatchDiscriminator()
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d):
            # Five standard errors of a standard deviation from n draws, 0.02 / sqrt(2 n).
            tolerance = 5 * 0.02 / (2 * module.weight.numel()) ** 0.5
            assert abs(module.weight.std().item() - 0.02) < tolerance
        elif isinstance(module, torch.nn.BatchNorm2d):
            assert abs(module.weight.mean().item() - 1.0) < 0.02
