"""Scenes beside held-out scans of cached images: realism, a classifier, and what is memorised.

    python tests/bench/scene_scores.py --scenes runs/scenes runs/control \
        --data conf/r3dpa_s_2/data.yaml --num 2000 --compared 500 --out scores.json

For folders of ``r3dpa sample``; notebook 08 shows the result. Held-out scans are split in two, in
turn: the reference, and a set that gives each measure its floor. Training scans, of other drives,
show what a model that knows these alone can reach.

- realism: measures within 3 times the distance between parts of the reference, of those judged;
- classifier: accuracy of a small network on scenes and reference, 0.5 by chance;
- flying: share of returns between their neighbours, far from both;
- nearest: median distance to the nearest training scan, see ``r3dpa.metrics.nearest_images``: of
  held-out scans if nothing is memorised, less otherwise.

``--compared`` scenes of each set count for realism and classifier. 0.1 s per scene and set.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from scan_classifier import classifier_accuracy

from lidarsim.realism import realism_table
from lidarsim.scan_statistics import ScanStatistics, scan_statistics
from r3dpa.cli.features import read_data
from r3dpa.data.scans import evenly
from r3dpa.geometry import RingProjection, points_of
from r3dpa.metrics.nearest import nearest_images
from r3dpa.metrics.reconstruction import flying_pixels

PARTS, BATCH = 4, 256


def statistics_of(images, projection):
    """Statistics of images ``(N, H, W)`` in four parts, which stand for drives."""
    inclinations_deg = projection.ray_angles(False)[0].rad2deg().tolist()
    rings = RingProjection(projection.sensor, inclinations_deg)
    drives = defaultdict(ScanStatistics)
    for number, image in enumerate(images):
        points = points_of(image, rings).numpy()
        cloud = np.hstack([points, np.zeros((len(points), 1), np.float32)])  # no intensity
        drives[str(number * PARTS // len(images))] += scan_statistics(cloud)
    return drives


def images_of(data, scans):
    """Range images ``(N, H, W)`` of scans."""
    return torch.stack([data.images.read(scan).range_m for scan in scans])


def training_images(data):
    """Batches ``(B, H, W)`` of the training scans."""
    scans = data.train_set.scans
    for first in range(0, len(scans), BATCH):
        yield images_of(data, scans[first : first + BATCH])


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", type=Path, nargs="+", required=True)
    parser.add_argument("--data", type=Path, required=True, help="data YAML of cached images")
    parser.add_argument("--num", type=int, default=2000, help="scenes of each set")
    parser.add_argument("--compared", type=int, default=500)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    data = read_data(options.data)
    data.setup("fit")
    scans = evenly(data.val_set.scans, 2 * options.num)
    reference = images_of(data, scans[::2])
    sets = {"held-out scans": images_of(data, scans[1::2])}
    for folder in options.scenes:
        sets[folder.name] = torch.from_numpy(np.load(folder / "range_m.npy")[: options.num])
    sets["training scans"] = images_of(data, evenly(data.train_set.scans, options.num))
    distances = nearest_images(torch.cat(list(sets.values())), training_images(data)).distance
    apart = distances.split([len(images) for images in sets.values()])
    few = torch.stack(evenly(list(reference), options.compared))
    of_reference = statistics_of(few, data.projection)
    results = {}
    for (name, images), nearest in zip(sets.items(), apart, strict=True):
        own = torch.stack(evenly(list(images), options.compared))
        table = realism_table(statistics_of(own, data.projection), of_reference)
        judged = [row.within for row in table.rows if row.within is not None]
        accuracy = classifier_accuracy(few, own)
        results[name] = {
            "scenes": len(images),
            "realism": [sum(judged), len(judged)],
            "beyond": {row.name: row.ratio for row in table.misses},
            "classifier": accuracy.value,
            "classifier_error": accuracy.standard_error,
            "flying": (flying_pixels(images).sum() / (images > 0).sum()).item(),
            "nearest": nearest.median().item(),
        }
    text = json.dumps({"compared": len(few), "sets": results}, indent=1)
    sys.stdout.write(text + "\n")
    if options.out is not None:
        options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
