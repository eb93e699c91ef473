"""What a classifier sees in scenes: where, and in which part of the images.

    python tests/bench/classifier_saliency.py --scenes runs/scenes --data conf/r3dpa_s_2/data.yaml \
        --num 500 --out saliency.json --picture saliency.png

The classifier is that of scene_scores.py: scenes of ``r3dpa sample`` against held-out scans. It is
trained again on parts of the images, to see what tells scenes apart without the rest:

- returns: which pixels have a return; all ranges are 10 m;
- ranges: gaps along a ring take the range of the return before them;
- layout: the same, averaged over blocks of 4 x 8 pixels;
- texture: the same without that average, what lies within a block.

The picture shows the first five scenes that the classifier has not learned from, and below each the
evidence of its cells: yellow speaks for a scene, dark for a scan. Two minutes of a core.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from scan_classifier import accuracy_of, evidence_of, train_classifier
from scene_scores import images_of

from r3dpa.cli.features import read_data
from r3dpa.data.scans import evenly
from r3dpa.viz import palette_image, range_image_picture

BLOCK = 4, 8
RANGE_M = 10.0
SHOWN = 5


def returns_alone(range_m):
    """Images ``(N, H, W)`` in metres whose returns all have one range."""
    return torch.where(range_m > 0, RANGE_M, -1.0)


def without_gaps(range_m):
    """Images whose missing returns take the range of the last return before them in the ring.

    Ranges are at least 1 m, which is what a ring without any return gets.
    """
    columns = torch.arange(range_m.shape[-1])
    last = torch.where(range_m > 0, columns, -1).cummax(dim=-1).values
    before_all = last.amax(dim=-1, keepdim=True).clamp(min=0)
    return range_m.gather(-1, torch.where(last < 0, before_all, last)).clamp(min=1.0)


def layout(range_m):
    """Ranges without gaps, geometric mean of each block."""
    return _block_means(without_gaps(range_m).log()).exp()


def texture(range_m):
    """Ranges without gaps as multiples of the geometric mean of their block, times 10 m."""
    logs = without_gaps(range_m).log()
    return RANGE_M * (logs - _block_means(logs)).exp()


PARTS = {
    "whole": lambda range_m: range_m,
    "returns": returns_alone,
    "ranges": without_gaps,
    "layout": layout,
    "texture": texture,
}


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", type=Path, required=True, help="folder of r3dpa sample")
    parser.add_argument("--data", type=Path, required=True, help="data YAML of cached images")
    parser.add_argument("--num", type=int, default=500, help="scenes, and held-out scans")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--picture", type=Path, help="PNG file to write")
    options = parser.parse_args(arguments)
    data = read_data(options.data)
    data.setup("fit")
    scans = images_of(data, evenly(data.val_set.scans, options.num))
    scenes = torch.from_numpy(np.load(options.scenes / "range_m.npy")[: options.num])
    trained = {name: train_classifier(of(scans), of(scenes)) for name, of in PARTS.items()}
    results = {name: accuracy_of(each)._asdict() for name, each in trained.items()}
    network, held_out, unseen = trained["whole"]
    evidence = evidence_of(network, unseen)
    of_scans = evidence_of(network, held_out)
    rows = {"scans": of_scans.mean((0, 2)).tolist(), "scenes": evidence.mean((0, 2)).tolist()}
    if options.picture is not None:
        figure = _figure(unseen[:SHOWN], evidence, data.projection.sensor)
        palette_image(figure).save(options.picture, optimize=True)
    report = {"scenes": len(scenes), "scans": len(scans), "accuracy": results, "evidence": rows}
    text = json.dumps(report, indent=1)
    sys.stdout.write(text + "\n")
    if options.out is not None:
        options.out.write_text(text + "\n")


def _block_means(values):
    pooled = F.avg_pool2d(values[:, None], BLOCK)
    return F.interpolate(pooled, scale_factor=BLOCK, mode="nearest")[:, 0]


def _figure(range_m, evidence, sensor):
    limit = evidence.abs().quantile(0.99).item()
    figure = Figure(figsize=(16, 3.2 * len(range_m)), layout="constrained", dpi=90)
    rows = figure.subplots(2 * len(range_m), 1)
    for number, image in enumerate(range_m):
        above, below = rows[2 * number : 2 * number + 2]
        above.imshow(range_image_picture(image, sensor), aspect="auto")
        below.imshow(evidence[number], aspect="auto", vmin=-limit, vmax=limit, cmap="inferno")
        above.set_ylabel(str(number), rotation=0, ha="right")
    for axes in rows:
        axes.set(xticks=[], yticks=[])
    return figure


if __name__ == "__main__":
    main()
