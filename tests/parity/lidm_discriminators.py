"""Discriminators ``v1`` and ``v2`` of LiDM, with which some of its losses were recorded."""

from __future__ import annotations

import torch
from torch import nn

from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.layers import CircularConv2d


class LiDARDiscriminator(PatchDiscriminator):
    """Version 1, whose rows keep their number, or the wide version 2; columns wrap."""

    def __init__(self, in_channels, channels, num_layers, wide):
        super().__init__(in_channels, channels, num_layers)
        layers = []
        for layer in self.main:
            if isinstance(layer, nn.Conv2d):
                first = not layers
                stride = (1, 2) if first or not wide else (2, 2)
                stride = stride if layer.stride == (2, 2) else (1, 1)
                layer = _ring(layer, stride)
                if first and wide:
                    layers += [layer, nn.LeakyReLU(0.2)]
                    layer = _ring(nn.Conv2d(channels, channels, 4), (1, 2))
            layers.append(layer)
        self.main = nn.Sequential(*layers)


def _ring(layer, stride):
    pads = (1, 2, 1, 2)
    ring = CircularConv2d(layer.in_channels, layer.out_channels, (4, 4), stride, pads)
    ring.bias = None if layer.bias is None else nn.Parameter(torch.zeros(layer.out_channels))
    return ring
