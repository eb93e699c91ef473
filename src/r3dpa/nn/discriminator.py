"""Patch discriminator of the VAE's adversarial loss."""

from __future__ import annotations

from torch import Tensor, nn

from r3dpa.nn.layers import SyncedBatchNorm2d


class PatchDiscriminator(nn.Module):
    """Convolutional discriminator of overlapping patches of a range image.

    4x4 convolutions, leaky ReLU 0.2, batch norm after all but the first and last convolution;
    ``num_layers`` of them have stride 2, two more stride 1. All sides are padded with zeros: unlike
    in the VAE, columns do not wrap. The defaults have 661,313 parameters and a receptive field of
    34 x 34 pixels.

    Source: Isola et al., "Image-to-image translation with conditional adversarial networks"
    (CVPR 2017), including the initialisation N(0, 0.02). State-dict keys are the official ones.

    Args:
        in_channels: Channels of the range image.
        channels: Width of the first layer; it doubles per layer, up to eight times.
        num_layers: Convolutions with stride 2, at least 1.
    """

    def __init__(self, in_channels: int = 1, channels: int = 64, num_layers: int = 2) -> None:
        super().__init__()
        if num_layers < 1:
            raise ValueError(f"num_layers must be at least 1, got {num_layers}")
        layers: list[nn.Module] = [nn.Conv2d(in_channels, channels, 4, 2, 1), nn.LeakyReLU(0.2)]
        width = channels
        for index in range(1, num_layers + 1):
            narrow, width = width, channels * min(2**index, 8)
            stride = 2 if index < num_layers else 1
            layers += [
                nn.Conv2d(narrow, width, 4, stride, 1, bias=False),
                SyncedBatchNorm2d(width),
                nn.LeakyReLU(0.2),
            ]
        layers.append(nn.Conv2d(width, 1, 4, 1, 1))
        self.least_size = 3 * 2**num_layers  # rows and columns of one patch
        self.main = nn.Sequential(*layers)
        self.main.apply(_initialise)

    def forward(self, image: Tensor) -> Tensor:
        """Logits ``(B, 1, H / 2^num_layers - 2, W / 2^num_layers - 2)``, positive for real patches.

        Args:
            image: ``(B, in_channels, H, W)`` encoded range.
        """
        return self.main(image)


def _initialise(module: nn.Module) -> None:
    if isinstance(module, nn.Conv2d):
        nn.init.normal_(module.weight, 0.0, 0.02)
        if module.bias is not None:
            nn.init.zeros_(module.bias)
    elif isinstance(module, nn.BatchNorm2d):
        nn.init.normal_(module.weight, 1.0, 0.02)
