"""What a teacher could add to r3dpa-s: features that its tokens do not hold yet, and their worth.

    python tests/bench/teacher_gap.py FIT TEST --extractors waffleiron-s weights.safetensors \
        --cache FOLDER --out gap.json

FIT and TEST are folders of labelled scans of different drives (``r3dpa data simulate``).

- Gap: one minus the explained variance, on TEST, of a ridge regression from the tokens of one
  block of an unaligned SiT to a target in each cell of its grid, averaged over flow times and, with
  equal weights, over the components of the target: the shares of the classes among the points of
  a cell (what a perfect teacher of classes knows), or mean point features of an extractor. RARE
  (2026) finds that the benefit of alignment grows with it.
- Classes: explained variance of the class shares from the features of the cell instead.
- Probe: mean IoU over the classes of TEST of a linear classifier of single points.

Latents, features and class shares are kept in the cache, by the hash of the extractor's weights.
Extractors are names of ``r3dpa.features.SOURCES`` or weights files of ``WaffleIronS``.
About 1 s per scan and extractor on one core.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from lidarsim.scan_files import read_scan
from r3dpa.data.labels import read_labels
from r3dpa.data.scans import evenly, find_scans
from r3dpa.features import SOURCES, WaffleIronS, feature_source
from r3dpa.generation import SceneGenerator
from r3dpa.geometry import classes_of, in_range, pool_cells
from r3dpa.geometry.semantics import NUM_CLASSES, SEMANTIC_CLASSES
from r3dpa.io import text_table
from r3dpa.scene_vae import SceneVAE

TIMES = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
PENALTY = 1e-3  # of standardised inputs, per row
PROBE_SCANS, PROBE_POINTS = 60, 2000  # to fit; points of each scan, also to test
PROBE_STEPS = 100
NAMES = [semantic.name for semantic in SEMANTIC_CLASSES]


def ridge(inputs, targets, penalty=PENALTY):
    """Function that predicts targets ``(N, T)`` from inputs ``(N, D)``.

    Inputs are standardised, targets centred; ``penalty`` times the squared weights is added to the
    mean squared error.
    """
    centre, scale = inputs.mean(dim=0), inputs.std(dim=0, correction=0).clamp_min(1e-6)
    mean = targets.mean(dim=0)
    standardised = (inputs - centre) / scale
    gram = standardised.T @ standardised / len(inputs)
    gram += penalty * torch.eye(len(gram), dtype=gram.dtype)
    weights = torch.linalg.solve(gram, standardised.T @ (targets - mean) / len(inputs))
    return lambda values: (values - centre) / scale @ weights + mean


def explained_variance(predicted, targets):
    """Share of the variance of each target ``(N, T)`` that predictions explain; NaN for constants.

    It is negative where the mean of the targets predicts better.
    """
    spread = targets.var(dim=0, correction=0)
    return 1 - (predicted - targets).square().mean(dim=0) / spread.where(spread > 0, torch.nan)


def mean_iou(predicted, classes):
    """Mean IoU over the classes that occur, and the IoU of all classes, NaN where absent."""
    pairs = torch.bincount(classes * NUM_CLASSES + predicted, minlength=NUM_CLASSES**2)
    counts = pairs.reshape(NUM_CLASSES, NUM_CLASSES).double()
    both = counts.diag()
    iou = both / (counts.sum(dim=0) + counts.sum(dim=1) - both)
    iou[counts.sum(dim=1) == 0] = torch.nan
    return iou.nanmean().item(), iou


def fit_probe(features, classes):
    """Linear classifier of points, by logistic regression."""
    probe = nn.Linear(features.shape[1], NUM_CLASSES)
    nn.init.zeros_(probe.weight)
    nn.init.zeros_(probe.bias)
    features = features * features.shape[1] ** 0.5  # of unit norm
    optimizer = torch.optim.LBFGS(
        probe.parameters(), max_iter=PROBE_STEPS, line_search_fn="strong_wolfe"
    )

    def loss():
        optimizer.zero_grad()
        value = F.cross_entropy(probe(features), classes)
        value.backward()
        return value

    optimizer.step(loss)
    return lambda values: probe(values * values.shape[1] ** 0.5).argmax(dim=1)


def describe_scan(scan, extractor, projection, grid_size, seed):
    """Mean features of the cells, and features of some labelled points with their classes."""
    points = torch.from_numpy(read_scan(scan.path))
    classes = classes_of(torch.from_numpy(read_labels(scan.path, len(points)) & 0xFFFF))
    features = extractor.point_features([extractor.prepare(points)])[0]
    cells, _ = pool_cells(points[:, :3], features, projection, grid_size)
    labelled = torch.nonzero((classes >= 0) & in_range(points[:, :3], projection.sensor))[:, 0]
    order = np.random.default_rng(seed).permutation(len(labelled))[:PROBE_POINTS]
    chosen = labelled[order]
    return cells.half(), features[chosen].half(), classes[chosen]


def class_shares(scan, projection, grid_size):
    """Share of each class in each cell ``(N, 15)``, and how many points it has."""
    points = torch.from_numpy(read_scan(scan.path))
    classes = classes_of(torch.from_numpy(read_labels(scan.path, len(points)) & 0xFFFF))
    return pool_cells(
        points[:, :3], F.one_hot(classes + 1, NUM_CLASSES + 1)[:, 1:].float(), projection, grid_size
    )


def cached(folder, key, make):
    """Tensors that ``make()`` returned for this key, now or in an earlier run."""
    path = folder / f"{hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]}.pt"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        torch.save(make(), path)
    return torch.load(path, weights_only=True)


@torch.no_grad()
def tokens_at(sit, block, latents, time):
    """Tokens ``(B * N, D)`` behind one block of noisy latents."""
    kept = []
    handle = sit.blocks[block - 1].register_forward_hook(lambda *args: kept.append(args[2]))
    generator = torch.Generator().manual_seed(0)
    for batch in latents.split(16):
        noise = torch.randn(batch.shape, generator=generator)
        sit.velocity((1 - time) * batch + time * noise, torch.full((len(batch),), time))
    handle.remove()
    return torch.cat(kept).flatten(0, 1)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("fit", type=Path)
    parser.add_argument("test", type=Path)
    parser.add_argument("--extractors", nargs="*", default=["waffleiron-s"])
    parser.add_argument("--model", default="r3dpa-s")
    parser.add_argument("--block", type=int, default=3)
    parser.add_argument("--scans", type=int, nargs=2, default=(300, 150), help="fit and test")
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)

    generator = SceneGenerator.from_checkpoint(options.model, device="cpu")
    vae = SceneVAE.from_checkpoint(options.model, device="cpu")
    sit, projection = generator.sit, vae.geometry.projection
    splits = [
        evenly(find_scans(folder), count)
        for folder, count in zip((options.fit, options.test), options.scans, strict=True)
    ]
    scans = [scan for split in splits for scan in split]
    names = [[str(scan.path), *map(str, scan.cache_key)] for scan in scans]
    num_fit = len(splits[0])

    def of_latents():
        return torch.cat([vae.encode(read_scan(scan.path)) for scan in scans])

    def of_classes():
        pairs = [class_shares(scan, projection, sit.grid_size) for scan in scans]
        return [torch.cat(parts) for parts in zip(*pairs, strict=True)]

    latents = cached(options.cache, ["latents", options.model, names], of_latents)
    shares, counts = cached(options.cache, ["classes", sit.grid_size, names], of_classes)
    filled = counts > 0
    is_fit = torch.arange(len(counts)) < num_fit * len(counts) // len(scans)
    fit, test = filled & is_fit, filled & ~is_fit
    targets, results = {"class shares": shares}, {}
    for name in options.extractors:
        extractor = feature_source(name) if name in SOURCES else WaffleIronS(Path(name))

        def of_extractor(extractor=extractor):
            rows = [
                describe_scan(scan, extractor, projection, sit.grid_size, seed)
                for seed, scan in enumerate(scans)
            ]
            return [list(parts) for parts in zip(*rows, strict=True)]

        key = ["features", extractor.settings, sit.grid_size, names]
        cells, points, classes = cached(options.cache, key, of_extractor)
        targets[name] = torch.cat(cells).float()
        used = evenly(range(num_fit), PROBE_SCANS)
        probe = fit_probe(
            torch.cat([points[i] for i in used]).float(), torch.cat([classes[i] for i in used])
        )
        score, each = mean_iou(
            probe(torch.cat(points[num_fit:]).float()), torch.cat(classes[num_fit:])
        )
        results[name] = {
            "probe_mean_iou": score,
            "probe_iou": dict(zip(NAMES, each.tolist(), strict=True)),
        }
        read = ridge(targets[name][fit], shares[fit])(targets[name][test])
        told = explained_variance(read, shares[test])
        results[name]["classes"] = dict(zip(NAMES, told.tolist(), strict=True))
        results[name]["classes_mean"] = told.nanmean().item()

    explained = {name: {} for name in targets}
    for time in TIMES:
        tokens = tokens_at(sit, options.block, generator.latent_norm.normalise(latents), time)
        for name, values in targets.items():
            predicted = ridge(tokens[fit], values[fit])(tokens[test])
            explained[name][time] = explained_variance(predicted, values[test])
    for name, by_time in explained.items():
        means = {str(time): values.nanmean().item() for time, values in by_time.items()}
        results.setdefault(name, {})["explained"] = means
        results[name]["gap"] = 1 - float(np.mean(list(means.values())))
    results["class shares"]["explained_by_class"] = {
        str(time): dict(zip(NAMES, values.tolist(), strict=True))
        for time, values in explained["class shares"].items()
    }
    write(results, options)


def write(results, options):
    """Print the tables, and write the JSON."""
    rows = []
    for name, result in results.items():
        scores = [result.get(key) for key in ("gap", "classes_mean", "probe_mean_iou")]
        values = [*result["explained"].values(), *scores]
        rows.append([name, *("" if value is None else f"{value:.3f}" for value in values)])
    heads = ["target", *(f"t {time:g}" for time in TIMES), "gap", "classes", "probe IoU"]
    by_class = results["class shares"]["explained_by_class"]
    more = [[name, *(f"{by_class[str(time)][name]:.3f}" for time in TIMES)] for name in NAMES]
    tables = [text_table(rows, heads, "l" + "r" * (len(heads) - 1), "plain")]
    tables.append(text_table(more, heads[: len(TIMES) + 1], "l" + "r" * len(TIMES), "plain"))
    sys.stdout.write("\n\n".join(tables) + "\n")
    if options.out is not None:
        about = {"model": options.model, "block": options.block, "scans": list(options.scans)}
        options.out.write_text(json.dumps({**about, "targets": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
