"""Edits in ``r3dpa bench control``: inpainting, completion, inversion.

Letters: H beams, W columns.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from r3dpa.bench.control_report import (
    Finding,
    Value,
    difference_of,
    mean_of,
    share_of,
    sheet_of,
)
from r3dpa.bench.control_scans import (
    CAR,
    Bench,
    ClassProbe,
    Place,
    View,
    free_place,
    points_inside,
    shown,
)
from r3dpa.editing import SceneEditor
from r3dpa.flow.editing import invert
from r3dpa.flow.solvers import evaluations, ode_solver, steps_for
from r3dpa.flow.times import ode_times
from r3dpa.geometry.gaps import filled, range_error_m
from r3dpa.geometry.regions import dropped_beams
from r3dpa.viz import EditRow

__all__ = ["complete", "inpaint", "round_trip"]

_SOLVERS = ("euler", "heun", "midpoint", "ab2", "ab3")


def inpaint(bench: Bench) -> Finding:
    """Is there a car in the box, and is the rest untouched?"""
    desk, settings = bench.desk, bench.settings
    probe = desk.fit_probe(bench.scans("train", settings.probe_scans))
    generator = torch.Generator().manual_seed(settings.seed)
    cases: list[tuple[View, Place]] = []
    # Not every scan has such a place: twice as many are looked at.
    for view in bench.views("val", 2 * settings.cases):
        place = free_place(view, generator, desk.generator)
        if place is not None:
            cases.append((view, place))
        if len(cases) == settings.cases:
            break
    if len(cases) < 2:
        raise ValueError("fewer than two validation scans have room for a car within view")
    editor = SceneEditor(desk.generator, settings.edit, 1)
    ways: dict[str, Tensor | None] = {"guided": bench.car, "plain": None}
    inside: dict[str, list[float]] = {name: [] for name in ways}
    cars: dict[str, list[float]] = {name: [] for name in ways}
    pixels: dict[str, list[float]] = {name: [] for name in ways}
    images: dict[str, list[Tensor]] = {name: [] for name in ways}
    changed = 0.0
    for case, (view, place) in enumerate(shown(cases, "inpaint")):
        for name, feature in ways.items():
            made = editor.inpaint(
                view.range_m, place.pixels, [case], settings.seed, feature=feature
            ).range_m[0]
            images[name].append(made)
            changed = max(changed, (made - view.range_m)[~place.pixels].abs().max().item())
            points, is_car = desk.classes(made, probe)
            within = points_inside(points, place.centre_m)
            inside[name].append(float(within.sum()))
            cars[name].append(float((within & is_car).sum()))
            row, column = desk.generator.geometry.projection.pixel_of(points)
            pixels[name].append(float((is_car & place.pixels[row, column]).sum()))
    sizes = [float(place.pixels.sum()) for _, place in cases]
    rows: dict[str, dict[str, Value]] = {
        name: {
            "points in the box": mean_of(inside[name]),
            "called car, of these": share_of(cars[name], inside[name]),
            "called car in the box, of pixels of the mask": share_of(cars[name], sizes),
            "called car anywhere in the mask, of its pixels": share_of(pixels[name], sizes),
        }
        for name in ways
    }
    rows["difference"] = {
        "points in the box": difference_of(inside["guided"], inside["plain"]),
        "called car in the box, of pixels of the mask": share_of(
            _minus(cars["guided"], cars["plain"]), sizes
        ),
        "called car anywhere in the mask, of its pixels": share_of(
            _minus(pixels["guided"], pixels["plain"]), sizes
        ),
    }
    hit, real, alarm, rest = _probe_test(bench, probe)
    notes = [
        f"{len(cases)} places of a car's size, free and in view, one scan and one noise each; "
        f"masks have {min(sizes):g} to {max(sizes):g} pixels. Points in the box are 0.25 to "
        "1.55 m above the road; the scans themselves have none there.",
        f"Largest change of a pixel outside the mask: {changed:g} m.",
        f"Linear probe, fitted on {settings.probe_scans} training scans as range images: finds "
        f"{hit:.0%} of {real} points on cars of validation scans, and calls {alarm:.2%} of "
        f"{rest} other points a car.",
    ]
    masks = [EditRow("", view.range_m, place.pixels.long().numpy()) for view, place in cases]
    sheet = sheet_of(
        ("scan and mask", masks),
        ("guided to a car", images["guided"]),
        ("without guidance", images["plain"]),
    )
    names = ("kept", "generated anew")
    return Finding("(c) A car into a free place", rows, notes, sheet, names)


def complete(bench: Bench) -> Finding:
    """Are held-out beams better than interpolated ones?"""
    settings = bench.settings
    views = bench.views("val", settings.cases)
    projection = bench.generator.geometry.projection
    beams = projection.sensor.beams
    missing = dropped_beams(projection, beams // 2)
    editor = SceneEditor(bench.generator, settings.edit, 1)
    errors: dict[str, list[float]] = {}
    same: dict[str, list[float]] = {}
    made = []
    for case, view in enumerate(shown(views, "complete")):
        one = editor.complete(
            view.range_m, missing, [case], settings.seed, start=settings.complete_start
        ).range_m[0]
        made.append(one)
        ways = {
            "completed": one,
            "nearest beam": filled(view.range_m, missing, "nearest"),
            "bilinear": filled(view.range_m, missing, "linear"),
            "linear in 1 / range": filled(view.range_m, missing, "inverse"),
        }
        # Only where all have a return, so that none is better for leaving hard pixels out.
        common = missing.clone()
        for image in ways.values():
            common &= image > 0
        for name, image in ways.items():
            errors.setdefault(name, []).append(range_error_m(image, view.range_m, common))
            agree = ((image > 0) == (view.range_m > 0))[missing].double().mean().item()
            same.setdefault(name, []).append(agree)
    rows: dict[str, dict[str, Value]] = {}
    for name in errors:
        rows[name] = {
            "range MAE (m)": mean_of(errors[name]),
            "return or none told right": mean_of(same[name]),
        }
        if name != "completed":
            rows[name]["completed minus this (m)"] = difference_of(
                errors["completed"], errors[name]
            )
    notes = [
        f"{len(views)} validation scans, {beams // 2} of {beams} beams kept, from time "
        f"{settings.complete_start:g} in {settings.edit.steps} steps. With whole beams missing "
        "bilinear is linear between the beams above and below.",
        "MAE on held-out beams where the scan and all methods have a return.",
    ]
    known = [EditRow("", torch.where(missing, -1.0, view.range_m)) for view in views]
    sheet = sheet_of(
        ("scan", [view.range_m for view in views]), ("known", known), ("completed", made)
    )
    return Finding(f"(d) {beams} beams from {beams // 2}", rows, notes, sheet)


@torch.no_grad()
def round_trip(bench: Bench) -> Finding:
    """What is lost from data to noise and back, for the evaluations of one way."""
    generator = bench.generator
    editor = SceneEditor(generator, bench.settings.edit)
    views = bench.views("val", bench.settings.round_trips)
    scans = torch.stack([view.range_m for view in views])
    latents = editor.encode(scans)
    plain = _errors_of(bench, latents, scans)
    cases = [(solver, nfe) for solver in _SOLVERS for nfe in bench.settings.nfe]
    rows: dict[str, dict[str, Value]] = {}
    for solver, nfe in shown(cases, "round trip"):
        steps = steps_for(solver, nfe)
        times = ode_times(steps, shift=bench.settings.edit.shift)
        noise = invert(
            generator.sit.velocity, latents, times, solver, interpolant=generator.interpolant
        ).states[0]
        back = ode_solver(solver, generator.interpolant)(generator.sit.velocity, noise, times)
        rmse = (back - latents).square().flatten(1).mean(dim=1).sqrt()
        lengths = noise.square().flatten(1).mean(dim=1).sqrt()
        rows[f"{solver}, {evaluations(solver, steps)} NFE"] = {
            "RMSE of latents": mean_of(rmse.tolist()),
            "range MAE beyond the VAE's (m)": difference_of(_errors_of(bench, back, scans), plain),
            "deviation of the noise": mean_of(lengths.tolist()),
        }
    notes = [
        f"{len(views)} validation scans; NFE of one way. The VAE alone: "
        f"{mean_of(plain).value:.3f} m. Noise of deviation 1 is what the model knows."
    ]
    return Finding("(e) From data to noise and back", rows, notes)


def _errors_of(bench: Bench, latents: Tensor, scans: Tensor) -> list[float]:
    made = bench.generator.decode(latents).cpu()
    return [range_error_m(one, scan) for one, scan in zip(made, scans, strict=True)]


def _probe_test(bench: Bench, probe: ClassProbe) -> tuple[float, int, float, int]:
    """Share of car points found and how many there are; of others that are called car."""
    scans = bench.scans("val", bench.settings.probe_scans)
    hits = real = alarms = rest = 0
    for scan in scans:
        _, own = bench.desk.labelled(scan, CAR)
        told = bench.desk.classes(bench.desk.read(scan).range_m, probe)[1]
        hits, real = hits + int((told & own).sum()), real + int(own.sum())
        alarms, rest = alarms + int((told & ~own).sum()), rest + int((~own).sum())
    return hits / max(real, 1), real, alarms / max(rest, 1), rest


def _minus(first: Sequence[float], second: Sequence[float]) -> list[float]:
    return [a - b for a, b in zip(first, second, strict=True)]
