"""A small network tells simulated from real scans: accuracy, and what it looks at.

    python tests/bench/tell_simulated_from_real.py REAL SIMULATED --out FOLDER

The network of ``scan_classifier.py`` sees range images (64 x 1024, 1 to 56 m, log range and
return mask). It is trained on all recordings of REAL but one and as many simulated scans of the
training drives, and tested on the recording left out and on scans of the validation drives, once
for each recording. Accuracy is the mean of both recalls: 0.5 is perfect simulation. "Without ..."
is the accuracy of the same networks on test images from which a part was removed. With
``--streets-only`` the network is trained on the upper half of the images, in which lost returns
are filled from above, so that neither the pattern of lost returns nor the shadow of the car tells.
About six minutes of one core.

Writes ``classifier.json``, and ``saliency_N.png`` with the gradient of the answer by the range.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from scan_classifier import two_sample_network
from street_fullness import height_above_ground, recordings, shorten
from torch import Tensor

from lidarsim.scan_files import read_scan
from r3dpa.data.scans import evenly, kitti360_scans
from r3dpa.geometry import LidarSensor, RangeCodec, SphericalProjection, range_image
from r3dpa.io import text_table
from r3dpa.viz import range_image_picture

PROJECTION = SphericalProjection(LidarSensor())
CODEC = RangeCodec("log2", return_channel=True)
STEPS, HALF_BATCH, LEARNING_RATE = 120, 8, 2e-3
NUM_SEEDS = 2
NUM_TEST_SCANS = 40
SMOOTH_PIXELS = 9  # of the saliency in the pictures
HEIGHTS_M = {"ground": (-np.inf, 0.3), "0.3-2 m": (0.3, 2.0), "above 2 m": (2.0, np.inf)}
FAR_M = 20.0
STREET_ROWS = 32


class Images(NamedTuple):
    """Range images ``(N, H, W)`` metres, -1 without a return, and heights above the ground."""

    range_m: Tensor
    height_m: Tensor

    def take(self, index):
        return Images(self.range_m[index], self.height_m[index])


def read_images(scans, streets_only):
    """Images of some scans."""
    ranges, heights = [], []
    for scan in scans:
        points = read_scan(scan.path)
        height_m = torch.from_numpy(height_above_ground(points)[:, None])
        range_m, height = range_image(torch.from_numpy(points[:, :3]), PROJECTION, height_m)
        ranges.append(range_m)
        heights.append(height[0])
    images = Images(torch.stack(ranges), torch.stack(heights))
    return keep_streets(images) if streets_only else images


def train(real_m, simulated_m, seed):
    """Network whose answer is above 0 for simulated images."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    network = two_sample_network()
    adam = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(adam, STEPS)
    target = torch.cat([torch.zeros(HALF_BATCH), torch.ones(HALF_BATCH)])
    for _ in range(STEPS):
        batch = []
        for images in (real_m, simulated_m):
            picked = torch.randperm(len(images), generator=generator)[:HALF_BATCH]
            shifts = torch.randint(images.shape[-1], (HALF_BATCH,), generator=generator)
            pairs = zip(images[picked], shifts.tolist(), strict=True)
            batch += [image.roll(shift, -1) for image, shift in pairs]
        logits = network(CODEC.to_image(torch.stack(batch)))[:, 0]
        adam.zero_grad()
        F.binary_cross_entropy_with_logits(logits, target).backward()
        adam.step()
        rates.step()
    return network.eval()


@torch.no_grad()
def recall(network, range_m, is_simulated):
    """Share of the images that the network knows."""
    answers = torch.cat([network(CODEC.to_image(part))[:, 0] for part in range_m.split(16)])
    return ((answers > 0) == is_simulated).double().mean().item()


def without_parts(images: Images) -> dict[str, Tensor]:
    """Images from which a part was removed, by name."""
    range_m, height_m = images
    hit = range_m > 0
    variants = {"whole": range_m}
    for name, (low, high) in HEIGHTS_M.items():
        part = hit & (height_m >= low) & (height_m < high)
        variants[f"without {name}"] = range_m.masked_fill(part, -1.0)
    variants[f"without beyond {FAR_M:g} m"] = range_m.masked_fill(range_m > FAR_M, -1.0)
    variants["return mask alone"] = torch.where(hit, 10.0, -1.0)
    variants["lost returns filled from the left"] = fill_lost(range_m, axis=-1)
    return variants


def last_returns(range_m, axis):
    """Place along an axis of the last return up to each pixel; 0 without one."""
    place = torch.arange(range_m.shape[axis])
    place = (place if axis == -1 else place[:, None]).expand_as(range_m)
    return torch.where(range_m > 0, place, 0).cummax(axis).values


def fill_lost(range_m, axis):
    """Images whose empty pixels take the range of the last return before them."""
    return range_m.gather(axis, last_returns(range_m, axis))


def keep_streets(images: Images) -> Images:
    """Upper half of the images, what was lost filled from above: without marks of the sensor."""
    last = last_returns(images.range_m, axis=-2)[:, :STREET_ROWS]
    return Images(images.range_m.gather(-2, last), images.height_m.gather(-2, last))


def saliency(network, range_m):
    """Absolute gradient ``(H, W)`` of the answer by the encoded range, smoothed."""
    image = CODEC.to_image(range_m[None]).requires_grad_()
    network(image).sum().backward()
    steep = image.grad[0, :1].abs() * (range_m > 0)
    return F.avg_pool2d(steep, SMOOTH_PIXELS, 1, SMOOTH_PIXELS // 2)[0].numpy()


def saliency_figure(network, range_m, title):
    """Range image above its saliency."""
    figure = Figure(figsize=(20, 5.4), layout="constrained")
    above, below = figure.subplots(2, 1)
    above.imshow(range_image_picture(range_m, PROJECTION.sensor), aspect="auto")
    above.set_title(title)
    below.imshow(range_image_picture(range_m, PROJECTION.sensor), aspect="auto", alpha=0.35)
    steep = saliency(network, range_m)
    limit = np.quantile(steep, 0.995)
    strength = np.clip(steep / limit, 0, 1)
    below.imshow(steep, cmap="inferno", vmax=limit, aspect="auto", alpha=strength)
    below.set_title("gradient of the answer by log range")
    return figure


def saliency_by_height(network, images):
    """Mean gradient of the pixels of each height, as a multiple of the mean of all pixels."""
    sums = dict.fromkeys(HEIGHTS_M, 0.0)
    counts = dict.fromkeys(HEIGHTS_M, 0)
    for range_m, height_m in zip(*images, strict=True):
        image = CODEC.to_image(range_m[None]).requires_grad_()
        network(image).sum().backward()
        steep = image.grad[0, 0].abs()
        for name, (low, high) in HEIGHTS_M.items():
            part = (range_m > 0) & (height_m >= low) & (height_m < high)
            sums[name] += steep[part].sum().item()
            counts[name] += int(part.sum())
    mean = sum(sums.values()) / sum(counts.values())
    return {name: sums[name] / max(counts[name], 1) / mean for name in HEIGHTS_M}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("real", type=Path)
    parser.add_argument("simulated", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--streets-only", action="store_true", help="rows 0-31, nothing lost")
    arguments = parser.parse_args()
    streets_only = arguments.streets_only
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)

    real = {
        shorten(name): read_images(scans, streets_only)
        for name, scans in recordings(arguments.real, by_drive=True).items()
    }
    num_real = sum(len(images.range_m) for images in real.values())
    training = read_images(
        evenly(kitti360_scans(arguments.simulated, "train"), num_real), streets_only
    )
    test = read_images(
        evenly(kitti360_scans(arguments.simulated, "val"), NUM_TEST_SCANS), streets_only
    )
    simulated_parts = without_parts(test)

    results, pictures = {}, 0
    for split, (left_out, held_out) in enumerate(real.items()):
        others = torch.cat([images.range_m for name, images in real.items() if name != left_out])
        real_parts = without_parts(held_out)
        recalls = []
        for seed in range(NUM_SEEDS):
            order = torch.randperm(num_real, generator=torch.Generator().manual_seed(seed))
            network = train(others, training.range_m[order[: len(others)]], seed)
            recalls.append(
                {
                    name: (
                        recall(network, real_parts[name], False),
                        recall(network, simulated_parts[name], True),
                    )
                    for name in real_parts
                }
            )
        by_part = {name: np.mean([one[name] for one in recalls], axis=0) for name in real_parts}
        results[left_out] = {
            "num_real_test_scans": len(held_out.range_m),
            "recall_real": by_part["whole"][0],
            "recall_simulated": by_part["whole"][1],
            "accuracy_by_seed": [float(np.mean(one["whole"])) for one in recalls],
            "accuracy": {name: float(pair.mean()) for name, pair in by_part.items()},
            "saliency_by_height_simulated": saliency_by_height(network, test.take(slice(0, 10))),
            "saliency_by_height_real": saliency_by_height(network, held_out),
        }
        shown = {"simulated": test.range_m[split * 9]}
        if split == 0:
            shown["real"] = held_out.range_m[0]
        for kind, range_m in shown.items():
            pictures += 1
            title = f"{kind} test scan; trained without {left_out}"
            figure = saliency_figure(network, range_m, title)
            figure.savefig(arguments.out / f"saliency_{pictures}.png", dpi=70)

    results = json.loads(json.dumps(results, default=float))
    (arguments.out / "classifier.json").write_text(json.dumps(results, indent=1) + "\n")
    parts = list(without_parts(test))
    rows = [[part, *[f"{one['accuracy'][part]:.3f}" for one in results.values()]] for part in parts]
    for row, part in zip(rows, parts, strict=True):
        row.append(f"{np.mean([one['accuracy'][part] for one in results.values()]):.3f}")
    heads = ["accuracy, tested on", *results, "mean"]
    sys.stdout.write(text_table(rows, heads, style="pipe") + "\n")


if __name__ == "__main__":
    main()
