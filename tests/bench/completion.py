"""Errors of completions of held-out beams and sectors, beside interpolations and other candidates.

    python tests/bench/completion.py SIMULATED REAL --scans 200 30 --candidates 20 10

SIMULATED holds scans of drives that the weights were not trained on, such as those of
``r3dpa data simulate --drives 0000 0002``; REAL those of a real sensor. Of each scan the missing
beams or the missing sector (at another azimuth for each scan) are not read. Mean absolute errors
are over returns of the scan where completion and interpolation have one as well. Candidates that
were not chosen are measured on the first scans. Seconds are CPU time of one thread.

Writes ``notebooks/results/completion.json`` and prints its tables.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from r3dpa.data.scans import evenly, find_scans, read_scan
from r3dpa.editing import SceneEditor
from r3dpa.editing.gaps import blend_completion, interpolate_gaps
from r3dpa.editing.regions import dropped_beams, sector
from r3dpa.flow.solvers import ode_solver
from r3dpa.flow.times import batch_time, ode_times
from r3dpa.io import text_table

OUT = Path(__file__).resolve().parents[2] / "notebooks" / "results" / "completion.json"
INTERPOLATIONS = ("linear", "nearest", "inverse")
START, AB3_STEPS = 0.2, 4
FIT_STEPS, FIT_RATE = 6, 0.05


def gaps(projection, number):
    """Masks of what is missing, by name; sectors turn with the number of the scan."""
    beams = projection.sensor.beams
    masks = {f"beams by {n}": dropped_beams(projection, range(0, beams, n)) for n in (2, 4, 8)}
    first = (37 * number) % 360 - 180
    for width in (15, 30, 60):
        masks[f"sector {width}"] = sector(projection, first, first + width)
    return masks


class Candidates:
    """Completions that were not chosen, each ``(H, W)`` metres."""

    def __init__(self, editor):
        self.editor, self.generator = editor, editor.generator

    def noisy(self, latents):
        noise = self.generator.noise([0])
        return self.generator.interpolant.interpolate(latents, noise, batch_time(START, noise))

    def denoised_once(self, latents):
        x, time = self.noisy(latents), batch_time(START, latents)
        velocity = self.generator.sit.velocity(x, time)
        return self.generator.interpolant.denoise(velocity, x, time)

    def solved_by_ab3(self, latents):
        solve = ode_solver("ab3", self.generator.interpolant)
        return solve(self.generator.sit.velocity, self.noisy(latents), ode_times(AB3_STEPS, START))

    def fitted(self, latents, range_m, missing):
        """Latents after some steps of Adam on the error of the decoded known pixels."""
        codec = self.generator.geometry.codec.without_further()
        image = codec.to_image(range_m)
        known = (~missing).expand_as(image).clone()
        if codec.return_channel:
            known[:1] &= codec.returns_of(image)  # elsewhere the range is arbitrary
        with torch.enable_grad():
            fitted = latents.clone().requires_grad_()
            adam = torch.optim.Adam([fitted], lr=FIT_RATE)
            for _ in range(FIT_STEPS):
                raw = self.generator.latent_norm.denormalise(fitted)
                decoded = self.generator.vae.decode(raw)[0, : len(image)]
                error = (decoded - image).abs() * known
                adam.zero_grad()
                error.sum().backward()
                adam.step()
        return fitted.detach()

    def all(self, range_m, missing):
        latents = self.editor.encode(interpolate_gaps(range_m, missing))
        variants = {
            "encoded and decoded": latents,
            "denoised once": self.denoised_once(latents),
            "4 steps of AB3": self.solved_by_ab3(latents),
            f"{FIT_STEPS} steps of Adam": self.fitted(latents, range_m, missing),
        }
        images = {}
        for name, variant in variants.items():
            decoded = self.generator.decode(variant)[0]
            images[name] = torch.where(missing, decoded, range_m)
            images[f"{name}, blended"] = blend_completion(decoded, range_m, missing)
        return images


def measure(editor, scans, num_candidates):
    """Errors, shares of equal returns and CPU seconds by gap and method."""
    candidates, table = Candidates(editor), defaultdict(list)
    for number, scan in enumerate(tqdm(scans, unit="scan")):
        range_m = editor.pixels(read_scan(scan.path)).range_m
        for gap, missing in gaps(editor.generator.geometry.projection, number).items():
            images = {how: interpolate_gaps(range_m, missing, how) for how in INTERPOLATIONS}
            start = time.process_time()
            images["completed"] = editor.complete(range_m, missing).range_m[0]
            table[gap, "seconds"].append(time.process_time() - start)
            common = missing & (range_m > 0) & (images["completed"] > 0) & (images["linear"] > 0)
            if number < num_candidates:
                images |= candidates.all(range_m, missing)
            for name, image in images.items():
                both = common & (image > 0)
                error = (image - range_m)[both].abs().double().mean().item()
                same = ((image > 0) == (range_m > 0))[missing].double().mean().item()
                table[gap, name].append((error, same))
    return table


def summarise(table):
    """Means over the scans, and the paired difference to linear interpolation with its error."""
    summary = defaultdict(dict)
    for (gap, name), values in table.items():
        if name == "seconds":
            summary[gap]["cpu_seconds_per_scene"] = float(np.mean(values))
            continue
        errors = np.array(values)
        difference = errors[:, 0] - np.array(table[gap, "linear"])[: len(errors), 0]
        summary[gap][name] = {
            "scans": len(errors),
            "mae_m": float(np.nanmean(errors[:, 0])),
            "minus_linear_m": float(np.nanmean(difference)),
            "standard_error_m": float(np.nanstd(difference, ddof=1) / len(errors) ** 0.5),
            "same_returns": float(errors[:, 1].mean()),
        }
    return dict(summary)


def print_table(name, summary):
    """Mean errors, relative to linear interpolation on the same scans, and equal returns."""
    gap_names = list(summary)
    rows = []
    for method in summary[gap_names[0]]:
        if method == "cpu_seconds_per_scene":
            continue
        row = [method]
        for gap in gap_names:
            values = summary[gap][method]
            linear_m = values["mae_m"] - values["minus_linear_m"]
            relative = values["mae_m"] / linear_m
            row.append(f"{values['mae_m']:.3f} {relative:.3f} {values['same_returns']:.3f}")
        rows.append(row)
    columns = [f"{name}: error, relative, returns", *gap_names]
    print(text_table(rows, columns, "l" + "r" * len(gap_names), "plain"))  # noqa: T201


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("simulated", type=Path)
    parser.add_argument("real", type=Path)
    parser.add_argument("--scans", type=int, nargs=2, default=(200, 30))
    parser.add_argument("--candidates", type=int, nargs=2, default=(20, 10))
    parser.add_argument("--out", type=Path, default=OUT)
    given = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    editor = SceneEditor.from_checkpoint("r3dpa-s", device="cpu")
    results = {}
    sources = {"simulated": given.simulated, "real": given.real}
    counts = zip(sources.items(), given.scans, given.candidates, strict=True)
    for (name, source), num, num_candidates in counts:
        scans = evenly(find_scans(source), num)
        # Drives follow each other: the first scans would be of one of them.
        order = np.random.default_rng(0).permutation(len(scans))
        shuffled = [scans[place] for place in order]
        results[name] = summarise(measure(editor, shuffled, num_candidates))
        print_table(name, results[name])
    given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
