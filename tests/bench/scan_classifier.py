"""Two-sample test by a classifier: accuracy of a small network on scans and generated scenes."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.geometry import RangeCodec
from r3dpa.nn.layers import CircularConv2d

_WIDTHS = (16, 32, 64, 64)
_SHARE_OF_TRAINING = 0.7
_CODEC = RangeCodec("log2", return_channel=True)


class Accuracy(NamedTuple):
    """Share of held-out images classified correctly, 0.5 by chance, and its standard error."""

    value: float
    standard_error: float


class Trained(NamedTuple):
    """A trained network of two_sample_network(), and the images that it has not seen."""

    network: nn.Sequential
    real_m: Tensor
    generated_m: Tensor


def classifier_accuracy(
    real_m: Tensor, generated_m: Tensor, *, epochs: int = 8, batch_size: int = 16, seed: int = 0
) -> Accuracy:
    """Return the held-out accuracy of a small network trained to separate two sets of images.

    A perfect generator leaves 0.5. Arguments and errors are of train_classifier().
    """
    trained = train_classifier(real_m, generated_m, epochs=epochs, batch_size=batch_size, seed=seed)
    return accuracy_of(trained)


def accuracy_of(trained: Trained, batch_size: int = 16) -> Accuracy:
    """Return the accuracy of a trained network on the images that it has not seen."""
    with torch.no_grad():
        right = [
            (trained.network(_CODEC.to_image(part))[:, 0] > 0) == bool(label)
            for label, images in enumerate((trained.real_m, trained.generated_m))
            for part in images.split(batch_size)
        ]
    correct = torch.cat(right).double()
    value = correct.mean().item()
    return Accuracy(value, (value * (1 - value) / len(correct)) ** 0.5)


def train_classifier(
    real_m: Tensor, generated_m: Tensor, *, epochs: int = 8, batch_size: int = 16, seed: int = 0
) -> Trained:
    """Train a small network to separate scans from generated scenes.

    Four strided convolutions whose columns wrap around, a global mean and a linear layer, on log
    range and return mask. 70 % of each set are for training, where scenes are rotated at random.

    Source: Lopez-Paz and Oquab, "Revisiting classifier two-sample tests" (ICLR 2017).

    Args:
        real_m: ``(N, H, W)`` metres, -1 without a return.
        generated_m: The other set; both are cut to the size of the smaller one.
        epochs: Passes over the training images.
        batch_size: Images per step, half of each set.
        seed: Seed of split, weights and order.

    Raises:
        ValueError: If the images differ in size, or a set has fewer than four.
    """
    if real_m.shape[1:] != generated_m.shape[1:]:
        sizes = f"{tuple(real_m.shape[1:])} and {tuple(generated_m.shape[1:])}"
        raise ValueError(f"scans and scenes must have one size, got {sizes}")
    count = min(len(real_m), len(generated_m))
    if count < 4:
        raise ValueError(f"a classifier needs at least 4 scans and 4 scenes, got {count}")
    generator = torch.Generator().manual_seed(seed)
    cut = round(_SHARE_OF_TRAINING * count)
    half = min(batch_size // 2, cut)
    train, held_out = [], []
    for images in (real_m, generated_m):
        order = torch.randperm(len(images), generator=generator)[:count]
        train.append(images[order[:cut]])
        held_out.append(images[order[cut:]])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = two_sample_network()
    adam = torch.optim.AdamW(network.parameters(), lr=2e-3)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(adam, epochs * max(1, cut // half))
    target = torch.cat([torch.zeros(half), torch.ones(half)])
    for _ in range(epochs):
        orders = [torch.randperm(cut, generator=generator) for _ in train]
        for first in range(0, cut - half + 1, half):
            picked = [
                images[order[first : first + half]]
                for images, order in zip(train, orders, strict=True)
            ]
            shift = int(torch.randint(real_m.shape[-1], (), generator=generator))
            logits = network(_CODEC.to_image(torch.cat(picked).roll(shift, -1)))[:, 0]
            adam.zero_grad()
            F.binary_cross_entropy_with_logits(logits, target).backward()
            adam.step()
            rates.step()
    return Trained(network, *held_out)


def evidence_of(network: nn.Sequential, images_m: Tensor) -> Tensor:
    """Return ``(B, h, w)``: how much each cell says "generated", before the mean over the image.

    The network ends in a mean over cells and a linear layer, so its logit is the mean of this map:
    a class activation map that leaves nothing out (Zhou et al., CVPR 2016).

    Args:
        network: Of train_classifier().
        images_m: ``(B, H, W)`` metres, -1 without a return.
    """
    *convolutions, _, _, readout = network
    with torch.no_grad():
        cells = nn.Sequential(*convolutions)(_CODEC.to_image(images_m))
        return readout(cells.movedim(1, -1))[..., 0]


def two_sample_network() -> nn.Sequential:
    """Build the network, random: images ``(B, 2, H, W)`` of range and return to ``(B, 1)`` logits.

    Columns wrap around.
    """
    layers: list[nn.Module] = []
    before = _CODEC.channels
    for width in _WIDTHS:
        layers += [
            CircularConv2d(before, width, (3, 3), (2, 2), pads=(0, 1, 0, 1)),
            nn.GroupNorm(8, width),
            nn.SiLU(),
        ]
        before = width
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(before, 1))
