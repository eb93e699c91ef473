"""Whether edits do what is asked: objects in boxes, and scenes of two halves.

    python tests/bench/inpainting_success.py --ckpt r3dpa-s.safetensors --objects r3dpa-s.objects \
        --data conf/r3dpa_s_2/data.yaml --out edits.json

Inpainting: in held-out scans, a box of the size of the object on free ground in sight, 8 to 16 m
away, is made anew several times from the same noise: guided and moved into the box as by `r3dpa
edit inpaint --box3d`, guided by features alone, and unguided. ``first`` is of the first draw,
``most_like`` of the one that `r3dpa edit inpaint` puts first, ``mean`` of all, ``any`` of the best.
The box then holds such an object by class, if 5 of its points, and half of those above the ground,
are of the class by the teacher; by label, the same by the classes that the decoder draws; by size,
if those above the ground reach 0.6 to 1.2 of the height of the object, or of what the sensor sees
of it, and span at least 0.3 of its width and at most 1.2 of its length.
``unchanged``: share of scans whose pixels outside the mask are the same in all draws.

Mixing: scenes of two halves of scans; mean cosine of the teacher's cells of a half with its own and
the other source. A core takes 5, 4 and 3 s per draw of a box.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from r3dpa.cli.features import read_data
from r3dpa.data.datasets import points_at_pixels
from r3dpa.data.feature_grids import grid_of_points
from r3dpa.data.scans import evenly
from r3dpa.editing import EditSettings, SceneEditor, most_like_first
from r3dpa.editing.objects import ObjectLibrary
from r3dpa.editing.regions import box3d, box3d_front_m, in_box3d, sector_weights
from r3dpa.features import WaffleIronS2
from r3dpa.geometry import SEMANTIC_CLASSES, Pixels, classes_of, unproject, values_at_returns

NAMES = [semantic.name for semantic in SEMANTIC_CLASSES]
# Class; length, width and height in metres; what the object stands on.
OBJECTS = {
    "car": ("car", (4.2, 1.8, 1.5), ("road", "other ground")),
    "pedestrian": ("person", (0.7, 0.7, 1.75), ("sidewalk", "road")),
    "tree": ("vegetation", (3.0, 3.0, 5.0), ("terrain", "sidewalk", "other ground")),
    "pole": ("pole", (0.4, 0.4, 5.0), ("sidewalk", "terrain")),
}
STRENGTHS = {
    "guided": EditSettings.strength,
    "features_alone": EditSettings.strength,
    "unguided": 0.0,
}
GROUND_M, NEAREST_M, FARTHEST_M, TRIES = 0.25, 8.0, 16.0, 50


class Teacher:
    """Feature grids and classes of points by the teacher."""

    def __init__(self, dim, weights=None):
        self.extractor = WaffleIronS2(weights, dim)

    def classes(self, points):
        """Numbers of classes ``(P,)`` of points ``(P, 4)``."""
        return self.extractor.classes(points)

    @torch.no_grad()
    def grid(self, points, projection, grid_size):
        """Feature grid ``(N, F)`` of points ``(P, 4)``."""
        return grid_of_points(self.extractor, points, projection, grid_size)


def points_made(scene, scan, projection):
    """Points ``(P, 4)`` of an edit; a model without intensity leaves those of the scan."""
    intensity = scan.intensity if scene.intensity is None else scene.intensity
    return points_at_pixels(Pixels(scene.range_m, intensity), projection)


def free_box(pixels, projection, size, grounds, generator):
    """Centre of a box on free ground that nothing hides, and its mask; None if none is found."""
    points = unproject(pixels.range_m, projection)
    numbers = torch.tensor([NAMES.index(name) for name in grounds])
    near = (pixels.range_m > NEAREST_M) & (pixels.range_m < FARTHEST_M)
    candidates = points[near & torch.isin(pixels.classes, numbers)]
    if not len(candidates):
        return None
    for place in candidates[generator.integers(len(candidates), size=TRIES)].tolist():
        centre = (place[0], place[1], place[2] + size[2] / 2)
        mask = box3d(projection, centre, size)
        front = math.hypot(*place) - max(size[:2]) / 2
        hidden = mask & (pixels.range_m > 0) & (pixels.range_m < front)
        raised = (pixels.range_m > 0) & (points[..., 2] > place[2] + GROUND_M)
        occupied = in_box3d(points[raised], centre, size, ground_m=0)
        if not (hidden & raised).any() and not occupied.any():
            return centre, mask
    return None


def judge(points, matches, centre, size, top_deg):
    """Whether the points ``(P, 4)`` in a box, some of the class, hold it: by class, and by size."""
    floor = centre[2] - size[2] / 2
    chosen = in_box3d(points[:, :3], centre, size, ground_m=GROUND_M)
    if chosen.sum() < 5:
        return False, False
    by_class = (chosen & matches).sum() >= max(5, chosen.sum() / 2)
    seen = math.hypot(centre[0], centre[1]) * math.tan(math.radians(top_deg)) - floor
    height = (points[chosen, 2].max() - floor) / min(size[2], seen)
    spread = (points[chosen, :2].amax(dim=0) - points[chosen, :2].amin(dim=0)).max()
    by_size = 0.6 <= height <= 1.2 and 0.3 * size[1] <= spread <= 1.2 * max(size[:2])
    return bool(by_class), bool(by_size)


def inpainting(editors, scans, library, teacher, name, draws):
    """Shares of boxes that hold the object, by class, by size and by both, for each editor."""
    of_class, size, grounds = OBJECTS[name]
    generator = next(iter(editors.values())).generator
    projection, feature = generator.geometry.projection, library.feature(name)
    rows, top_deg = {how: [] for how in editors}, projection.sensor.inclination_max_deg
    for number, pixels in enumerate(scans):
        place = free_box(pixels, projection, size, grounds, np.random.default_rng(number))
        if place is None:
            continue
        centre, mask = place
        indices = range(draws * number, draws * (number + 1))
        for how, editor in editors.items():
            start = time.perf_counter()
            made = editor.inpaint(
                pixels,
                mask,
                indices,
                feature=None if how == "unguided" else feature,
                front_m=box3d_front_m(projection, centre, size) if how == "guided" else None,
            )
            seconds = (time.perf_counter() - start) / draws
            in_box = partial(in_box3d, centre_m=centre, size_m=size)
            made = most_like_first(
                made,
                mask,
                feature,
                teacher.extractor,
                generator.sit.grid_size,
                in_box,
                library.semantic_class(name),
            )
            found = []
            for scene in made:
                points = points_made(scene, pixels, projection)
                matches = teacher.classes(points) == NAMES.index(of_class)
                by = judge(points, matches, centre, size, top_deg)
                labels = values_at_returns(classes_of(scene.labels), scene.range_m, projection)
                decoded, _ = judge(points, labels == NAMES.index(of_class), centre, size, top_deg)
                found.append((*by, all(by), decoded))
            same = torch.equal(made.range_m[:, ~mask], pixels.range_m[~mask].expand(draws, -1))
            rows[how].append((found, made.draws.argmin().item(), same, seconds))
            sys.stderr.write(f"{name} {number} {how}: {found}\n")
    results = {"boxes": max(map(len, rows.values())), "draws": draws}
    return results | {how: summary(values) for how, values in rows.items() if values}


def summary(rows):
    """Shares over boxes, of what was found in each draw, and where the first draw stands."""
    heads = ("by_class", "by_size", "both", "by_label")
    drawn = np.array([found for found, *_ in rows], dtype=float)
    kinds = {
        "first": drawn[np.arange(len(rows)), [first for _, first, *_ in rows]],
        "most_like": drawn[:, 0],
        "mean": drawn.mean(axis=1),
        "any": drawn.max(axis=1),
    }
    shares = {
        kind: dict(zip(heads, values.mean(axis=0).tolist(), strict=True))
        for kind, values in kinds.items()
    }
    unchanged, seconds = np.mean([row[2:] for row in rows], axis=0).tolist()
    return {**shares, "unchanged": unchanged, "seconds": seconds}


def mean_cosine(mixed, grid, half):
    """Mean cosine of two feature grids ``(N, F)`` over the filled cells of a half."""
    return F.cosine_similarity(mixed, grid, dim=1)[half & grid.any(dim=1)].mean().item()


def mixing(editors, scans, teacher):
    """Mean cosines of the halves of mixed scenes with their own and the other source."""
    generator = next(iter(editors.values())).generator
    projection, size = generator.geometry.projection, generator.sit.grid_size
    weights = sector_weights([(0, 0), (180, 1)], size, 20.0)
    results = {}
    for how in editors.keys() - {"features_alone"}:
        rows, editor = [], editors[how]
        for number, pair in enumerate(zip(scans[::2], scans[1::2], strict=False)):
            grids = [teacher.grid(points_at_pixels(s, projection), projection, size) for s in pair]
            start = time.perf_counter()
            made = editor.mix(grids, weights, [number])
            seconds = time.perf_counter() - start
            points = points_made(made[0], pair[0], projection)
            mixed = teacher.grid(points, projection, size)
            for side, half in enumerate(weights > 0.99):
                cosines = [mean_cosine(mixed, grid, half) for grid in grids]
                rows.append((cosines[side], cosines[1 - side], seconds))
        means = np.mean(rows, axis=0).tolist()
        results[how] = dict(zip(("own", "other", "seconds"), means, strict=True))
    return {"scenes": len(scans) // 2, **results}


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--ckpt", required=True)
    parser.add_argument("--objects", type=Path, required=True, help="file of r3dpa data objects")
    parser.add_argument("--data", type=Path, required=True, help="data YAML of cached images")
    parser.add_argument("--teacher", type=Path, help="its weights; default: those of the package")
    parser.add_argument("--num", type=int, default=100, help="scans")
    parser.add_argument(
        "--draws", type=int, default=8, help="of each box, as of r3dpa edit inpaint"
    )
    parser.add_argument("--classes", nargs="+", default=list(OBJECTS), choices=OBJECTS)
    parser.add_argument("--ways", nargs="+", default=list(STRENGTHS), choices=STRENGTHS)
    parser.add_argument("--steps", type=int, default=EditSettings.steps)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    options = parser.parse_args(arguments)
    editors = {}
    for how in options.ways:
        settings = EditSettings(steps=options.steps, strength=STRENGTHS[how])
        editors[how] = SceneEditor.from_checkpoint(options.ckpt, settings, device="cpu")
    data = read_data(options.data)
    data.setup("fit")
    scans = [data.images.read(scan) for scan in evenly(data.val_set.scans, options.num)]
    library = ObjectLibrary.load(options.objects)
    teacher = Teacher(library.features.shape[1], options.teacher)
    results = {
        name: inpainting(editors, scans, library, teacher, name, options.draws)
        for name in options.classes
    }
    results["mixing"] = mixing(editors, scans, teacher)
    text = json.dumps({"steps": options.steps, **results}, indent=1)
    sys.stdout.write(text + "\n")
    if options.out is not None:
        options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
