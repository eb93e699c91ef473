"""Guidance in ``r3dpa bench control``: strength, scenes after features, mixing, cost.

Letters: H beams, W columns, N tokens, F feature width.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from r3dpa.bench.control_report import Finding, Value, difference_of, mean_of, sheet_of
from r3dpa.bench.control_scans import Bench, T, cell_cosine, shown
from r3dpa.bench.hardware import flop_of, synchronise
from r3dpa.bench.timing import Ratio, compare, seconds
from r3dpa.editing import EditSettings, SceneEditor
from r3dpa.flow.guidance import AlignedVelocity, FeatureGuidance, FeatureTarget, aligned_velocity
from r3dpa.geometry.regions import mask_of_tokens, sector_weights
from r3dpa.metrics.bootstrap import Interval
from r3dpa.metrics.functional import wasserstein_1_of_values

__all__ = ["cost", "guided", "mix", "strength"]

_WINDOWS = ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0))
_STRENGTHS = (0.0, 0.1, 0.25, 0.5, 1.0)
_BLEND_DEG = 20.0
_MIX_COLUMNS = ("features, own", "features, other", "ranges (m), own", "ranges (m), other")


def strength(bench: Bench) -> Finding:
    """What strengths and windows do, on training drives."""
    views = bench.views("train", bench.settings.round_trips)
    targets = [bench.desk.target(view) for view in views]
    given = [bench.desk.again(view.range_m) for view in views]
    ranges = [view.range_m[view.range_m > 0] for view in views]
    asked = [(scale, _WINDOWS[0]) for scale in _STRENGTHS]
    asked += [(0.5, window) for window in _WINDOWS[1:]]
    rows = {}
    for scale, window in shown(asked, "strength"):
        edit = replace(bench.settings.edit, strength=scale, window=window)
        made, projected = _following(bench, edit, targets)
        again = [bench.desk.again(image) for image in made]
        apart = [
            wasserstein_1_of_values(image[image > 0], own)
            for image, own in zip(made, ranges, strict=True)
        ]
        rows[f"{scale:g} in {window[0]:g}..{window[1]:g}"] = {
            "cosine of projected features": mean_of(projected),
            "of features extracted again": mean_of(_cosines(again, given)),
            "earth mover's distance of ranges (m)": mean_of(apart),
            "pixels with a return": mean_of([_filled_share(image) for image in made]),
        }
    rows["the scans themselves"] = {
        "pixels with a return": mean_of([_filled_share(view.range_m) for view in views])
    }
    title = "Strength and window of the guidance (training drives)"
    return Finding(title, rows, [f"{len(views)} scenes, each after the features of one scan."])


def guided(bench: Bench) -> Finding:
    """Do scenes follow the features of a scan, by the network's own account and by another?"""
    views = bench.views("val", bench.settings.scenes)
    targets = [bench.desk.target(view) for view in views]
    given = [bench.desk.again(view.range_m) for view in views]
    made, projected, grids, again = {}, {}, {}, {}
    for name, edit in _edits(bench).items():
        made[name], projected[name] = _following(bench, edit, targets)
        grids[name] = [bench.desk.again(image) for image in made[name]]
        again[name] = _cosines(grids[name], given)
    rows: dict[str, dict[str, Value]] = {
        name: {
            "cosine of projected features": mean_of(projected[name]),
            "of features extracted again": mean_of(again[name]),
        }
        for name in made
    }
    rows["difference"] = {
        "cosine of projected features": difference_of(projected["guided"], projected["plain"]),
        "of features extracted again": difference_of(again["guided"], again["plain"]),
    }
    column = "of features extracted again"
    others, editor = _other(given), SceneEditor(bench.generator)
    rows["guided, against another scan"] = {column: mean_of(_cosines(grids["guided"], others))}
    behind = [bench.generator.decode(editor.encode(view.range_m[None]))[0] for view in views]
    rows["the scan behind encoder and decoder"] = {
        column: mean_of(_cosines([bench.desk.again(image.cpu()) for image in behind], given))
    }
    rows["another scan, as it is"] = {column: mean_of(_cosines(given, others))}
    sheet = sheet_of(
        ("scan whose features guide", [view.range_m for view in views]),
        ("guided", made["guided"]),
        ("same noise, without guidance", made["plain"]),
    )
    notes = [
        f"{len(views)} scenes, noise i after scan i of the validation drives.",
        "Projected: by the network at t = 0. Extracted again: from the points of both range "
        "images, intensity 0. Another scan is far away: what streets share. The scan behind "
        "encoder and decoder is the most that a decoded scene can reach.",
    ]
    return Finding("(a) Scenes after the features of a scan", rows, notes, sheet)


def mix(bench: Bench) -> Finding:
    """Is each half like its own source, and not like the other?"""
    views = bench.views("val", bench.settings.scenes)
    targets = [bench.desk.target(view) for view in views]
    given = [bench.desk.again(view.range_m) for view in views]
    grid_size = bench.generator.sit.grid_size
    weights = sector_weights([(0.0, 0), (180.0, 1)], grid_size, _BLEND_DEG)
    halves = [share == 1 for share in weights]  # seams belong to neither
    size = views[0].range_m.shape
    pixels = [mask_of_tokens(half, grid_size, (size[0], size[1])) for half in halves]
    pairs = list(zip(range(len(views)), _other(range(len(views))), strict=True))
    columns: dict[str, dict[str, list[float]]] = {}
    images: dict[str, list[Tensor]] = {}
    for name, edit in _edits(bench).items():
        editor = SceneEditor(bench.generator, edit, 1)
        own = columns.setdefault(name, {key: [] for key in _MIX_COLUMNS})
        images[name] = []
        for case in shown(range(len(views)), f"mix, {name}"):
            pair = pairs[case]
            made = editor.mix([targets[i] for i in pair], weights, [case], bench.settings.seed)
            images[name].append(made.range_m[0])
            again = bench.desk.again(made.range_m[0])
            found: dict[str, list[float]] = {key: [] for key in _MIX_COLUMNS}
            for half, (tokens, region) in enumerate(zip(halves, pixels, strict=True)):
                for kind, source in (("own", pair[half]), ("other", pair[1 - half])):
                    found[f"features, {kind}"].append(1 - cell_cosine(again, given[source], tokens))
                    found[f"ranges (m), {kind}"].append(
                        _ranges_apart(made.range_m[0], views[source].range_m, region)
                    )
            for key, values in found.items():
                own[key].append(sum(values) / len(values))
    rows: dict[str, dict[str, Value]] = {
        name: {key: mean_of(values) for key, values in own.items()} for name, own in columns.items()
    }
    rows["guided - plain"] = {
        key: difference_of(columns["guided"][key], columns["plain"][key]) for key in _MIX_COLUMNS
    }
    for name, own in columns.items():
        rows[f"{name}: own - other"] = {
            f"{what}, own": difference_of(own[f"{what}, own"], own[f"{what}, other"])
            for what in ("features", "ranges (m)")
        }
    sheet = sheet_of(
        ("source of the left half", [view.range_m for view in views]),
        ("source of the right half", [view.range_m for view in _other(views)]),
        ("mix", images["guided"]),
    )
    notes = [
        f"{len(views)} pairs: each scan on the left, one far away on the right, {_BLEND_DEG:g} "
        "degrees of seam, which count for no half.",
        "Features: 1 - cosine, extracted again. Ranges: earth mover's distance of a half's "
        "ranges. Other: the same half of the other source.",
    ]
    return Finding("(b) Mixing: distance of each half from its sources", rows, notes, sheet)


def cost(bench: Bench) -> Finding:
    """FLOP and time of a guided evaluation against a plain one."""
    generator, sit = bench.generator, bench.generator.sit
    rows: dict[str, dict[str, Value]] = {}
    notes = []
    for batch in (1, 8):
        cases = _evaluations(bench, batch)
        flop = {name: flop_of(run) for name, run in cases.items()}
        times = compare(
            {name: seconds(_synchronised(run, generator.device)) for name, run in cases.items()},
            bench.settings.rounds,
        )
        for name in cases:
            rows[f"{name}, batch {batch}"] = {
                "GFLOP": flop[name] / 1e9,
                "FLOP over plain": flop[name] / flop["plain"],
                "ms": times.ms[name].median,
                "time over plain": _ratio(times.over_first[name]) if name != "plain" else 1.0,
            }
        again = times.repeat
        verdict = "" if times.sound else ": the machine was too busy, claim nothing of 5 %"
        notes.append(
            f"Batch {batch}: plain over itself {again.value:.3f} ({again.low:.3f}.."
            f"{again.high:.3f}), {bench.settings.rounds} rounds in turn{verdict}."
        )
    depth = getattr(sit, "alignment_depth", None)
    if depth is not None:
        notes.append(f"Features are taken after block {depth}.")
    return Finding("Cost of a guided evaluation", rows, notes)


def _evaluations(bench: Bench, batch: int) -> dict[str, Callable[[], object]]:
    sit, device = bench.generator.sit, bench.generator.device
    random = torch.Generator().manual_seed(0)
    x = torch.randn(batch, sit.in_channels, *sit.input_size, generator=random).to(device)
    time = torch.full((batch,), 0.5, device=device)
    tokens = math.prod(sit.grid_size)
    features = torch.randn(batch, tokens, sit.feature_dim, generator=random).to(device)

    def guided(aligned: AlignedVelocity) -> Callable[[], object]:
        guidance = FeatureGuidance(
            sit.velocity, aligned, [FeatureTarget(features)], scale=0.5, relative=True
        )

        def run() -> Tensor:
            guidance.history.clear()
            return guidance(x, time)

        return torch.no_grad()(run)

    return {
        "plain": torch.no_grad()(lambda: sit.velocity(x, time)),
        "guided": guided(sit.aligned_pass),
        "guided, features apart": guided(aligned_velocity(sit.velocity, sit.project_features)),
    }


def _edits(bench: Bench) -> dict[str, EditSettings]:
    edit = bench.settings.edit
    return {"guided": edit, "plain": replace(edit, strength=0.0)}


def _following(
    bench: Bench, edit: EditSettings, targets: Sequence[Tensor]
) -> tuple[list[Tensor], list[float]]:
    """Range images after the features of each scan, and cosines of projected features."""
    editor = SceneEditor(bench.generator, edit, 1)
    images, cosines = [], []
    for index, target in enumerate(shown(targets, f"strength {edit.strength:g}")):
        everywhere = torch.ones(1, len(target))
        made = editor.mix([target], everywhere, [index], bench.settings.seed)
        assert made.cosine is not None
        images.append(made.range_m[0])
        cosines.append(made.cosine.item())
    return images, cosines


def _cosines(first: Sequence[Tensor], second: Sequence[Tensor]) -> list[float]:
    return [cell_cosine(a, b) for a, b in zip(first, second, strict=True)]


def _filled_share(range_m: Tensor) -> float:
    return (range_m > 0).double().mean().item()


def _ranges_apart(made: Tensor, given: Tensor, region: Tensor) -> float:
    """Earth mover's distance of the ranges in a region; NaN where one has none."""
    own, other = made[region & (made > 0)], given[region & (given > 0)]
    return wasserstein_1_of_values(own, other) if len(own) and len(other) else math.nan


def _other(items: Sequence[T]) -> list[T]:
    """For each item one half the list away: of scans in order, another street or far down it."""
    half = len(items) // 2
    return [*items[half:], *items[:half]]


def _ratio(ratio: Ratio) -> Interval:
    return Interval(ratio.value, ratio.low, ratio.high)


def _synchronised(run: Callable[[], object], device: torch.device) -> Callable[[], object]:
    def timed() -> None:
        run()
        synchronise(device)

    return timed
