from __future__ import annotations

import re

import pytest
from tiny_networks import tiny_checkpoint

from r3dpa.checkpoints import read_checkpoint, weights_sha256
from r3dpa.cli.tune import tune
from r3dpa.flow.tuned import TunedSolver
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=2.0, range_max_m=40.0)
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8))


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("tune") / "tiny.safetensors"
    return tiny_checkpoint(path, GEOMETRY, step=30)


def test_the_best_solver_is_saved_with_what_it_was_tuned_on(checkpoint, tmp_path):
    out = tmp_path / "solver.json"
    table = tune(
        checkpoint, out, steps=3, num=4, val=2, reference_steps=40, iterations=10, device="cpu"
    )
    solver = TunedSolver.load(out)
    card = solver.card
    assert solver.num_steps == 3
    assert card["step"] == 30
    average = read_checkpoint(checkpoint).network("ema")
    assert card["sit_sha256"] == weights_sha256(average.build().state_dict())
    assert card["trajectories"] == {"train": 4, "held_out": 2, "test": 2, "seed": 0}
    errors = {name: sets["held_out"]["mean"] for name, sets in card["errors"].items()}
    assert errors[card["solver"]] == min(errors.values())
    start = card["search"]["start"]
    assert errors["searched"] <= errors[start] < errors["euler"]
    assert set(re.findall(r"^(\S.*?)  ", table, re.MULTILINE)) >= set(errors)
    assert f"saved: {card['solver']} in {out}" in table


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num": 0}, "num must be at least 1, got 0"),
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"velocities": 1}, "velocities must be at least 2, got 1"),
        ({"reference_steps": 5}, "reference_steps must be even .*, got 5"),
    ],
)
def test_numbers_out_of_range_are_refused_before_anything_is_read(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        tune(tmp_path / "none.ckpt", tmp_path / "solver.json", **options)


def test_a_single_step_knows_a_single_velocity(checkpoint, tmp_path):
    few = {"num": 1, "val": 1, "reference_steps": 2, "iterations": 1, "device": "cpu"}
    tune(checkpoint, tmp_path / "solver.json", steps=1, velocities=1, **few)
    assert TunedSolver.load(tmp_path / "solver.json").num_steps == 1
