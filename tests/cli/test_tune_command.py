from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    read_checkpoint,
    save_checkpoint,
    weights_sha256,
)
from r3dpa.cli.tune import tune
from r3dpa.flow.tuned import TunedSolver
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn import VAE, LatentNorm, SiT

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=2.0, range_max_m=40.0)
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 8))
VAE_ARGS = {
    "latent_channels": 4,
    "channels": 32,
    "channel_multipliers": [1, 1, 1],
    "strides": [[2, 2], [2, 2]],
    "num_res_blocks": 1,
}
SIT_ARGS = {
    "input_size": [4, 16],
    "in_channels": 4,
    "hidden_size": 32,
    "depth": 2,
    "num_heads": 2,
    "alignment_depth": 1,
    "feature_dim": 8,
    "projector_dim": 8,
}


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    torch.manual_seed(0)
    sit, norm = SiT(**SIT_ARGS), LatentNorm(4)
    with torch.no_grad():
        for parameter in sit.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    norm.update(torch.randn(8, 4, 4, 16))
    networks = {
        "vae": NetworkState.of(VAE(**VAE_ARGS), VAE_ARGS),
        "ema": NetworkState.of(sit, SIT_ARGS),
        "ema_latent_norm": NetworkState.of(norm, {"channels": 4}),
    }
    path = tmp_path_factory.mktemp("tune") / "tiny.safetensors"
    content = Checkpoint(Path("tiny"), "joint", networks, step=30, geometry=GEOMETRY.to_dict())
    return save_checkpoint(content, path)


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
