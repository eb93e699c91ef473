"""Reconstructions by the VAE of a checkpoint: ranges, edges, missing returns, classes, intensity.

    python tests/bench/reconstruction_quality.py --ckpt r3dpa-s --data conf/r3dpa_s_2/data.yaml \
        --real FOLDER --num 2000 --out quality.json

Of held-out scans of a data YAML and, with ``--real``, of the scans of a folder, with the classes of
label files beside them. Figures are from ``ReconstructionQuality`` and ``LabelQuality``, each over
all pixels; ``intensity_spread`` is the mean absolute difference of intensities from their median,
the error of a constant. About 0.2 s of a core per scan.
"""

from __future__ import annotations

import argparse
import json
import sys
from itertools import islice
from pathlib import Path

import torch
from label_quality import LabelQuality

from lidarsim.scan_files import read_scan
from r3dpa.cli.features import read_data
from r3dpa.data.labels import find_labels
from r3dpa.data.scans import evenly, find_scans
from r3dpa.geometry import Pixels, project_pixels
from r3dpa.io import text_table
from r3dpa.metrics.reconstruction import ReconstructionQuality
from r3dpa.scene_vae import SceneVAE

BATCH_SIZE = 8


def held_out_pixels(data, num):
    """Pixels of held-out scans, evenly spread."""
    data.setup("fit")
    for scan in evenly(data.val_set.scans, num):
        yield file_pixels(scan, data.projection) if data.images is None else data.images.read(scan)


def file_pixels(scan, projection):
    """Pixels of a scan file, with classes if a label file lies beside it."""
    points = torch.from_numpy(read_scan(scan.path))
    labels = find_labels(scan.path, len(points))
    labels = None if labels is None else torch.from_numpy(labels & 0xFFFF)
    return project_pixels(points, projection, labels)


@torch.no_grad()
def reconstruct(vae, pixels):
    """Pixels ``(B, H, W)`` of scans, a list of ``(H, W)``, and of their reconstructions."""
    images = torch.stack([vae.geometry.codec.to_image(*each) for each in pixels])
    decoded = vae.vae.decode(vae.vae.encode(images).mean).float()
    channels = zip(*pixels, strict=True)
    scans = Pixels(*(None if parts[0] is None else torch.stack(parts) for parts in channels))
    return scans, vae.geometry.codec.pixels_of(decoded, vae.geometry.projection.sensor)


def quality(vae, pixels):
    """Figures of reconstructed scans by name; ``pixels`` yields ``(H, W)`` of each scan."""
    ranges, labels, intensities, num_scans = ReconstructionQuality(), LabelQuality(), [], 0
    pixels = iter(pixels)
    while batch := list(islice(pixels, BATCH_SIZE)):
        scans, reconstructed = reconstruct(vae, batch)
        ranges.update(scans.range_m, reconstructed.range_m)
        labels.update(scans, reconstructed)
        if reconstructed.intensity is not None and scans.intensity is not None:
            both = (scans.range_m > 0) & (reconstructed.range_m > 0)
            intensities.append(scans.intensity[both])
        num_scans += len(scans.range_m)
    figures = {"scans": num_scans, **ranges.compute(), **labels.compute()}
    if intensities:
        values = torch.cat(intensities)
        figures["intensity_spread"] = (values - values.median()).abs().double().mean().item()
    return figures


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--ckpt", default="r3dpa-s")
    parser.add_argument("--data", type=Path, required=True, help="data YAML with held-out scans")
    parser.add_argument("--real", type=Path, help="folder of real scans")
    parser.add_argument("--num", type=int, default=2000, help="held-out scans")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    vae = SceneVAE.from_checkpoint(options.ckpt, "cpu")
    results = {
        "held-out scans": quality(vae, held_out_pixels(read_data(options.data), options.num))
    }
    if options.real is not None:
        scans = find_scans(options.real)
        projection = vae.geometry.projection
        results["real scans"] = quality(vae, (file_pixels(scan, projection) for scan in scans))
    names = list(dict.fromkeys(name for figures in results.values() for name in figures))
    rows = [
        [name, *(f"{figures[name]:.4g}" if name in figures else "" for figures in results.values())]
        for name in names
    ]
    sys.stdout.write(text_table(rows, ["", *results], "l" + "r" * len(results), "plain") + "\n")
    if options.out is not None:
        about = {"weights": str(options.ckpt), "data": str(options.data)}
        options.out.write_text(json.dumps({**about, "reconstruction": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
