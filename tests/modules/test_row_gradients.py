"""Who is trained, who is frozen and who receives alignment gradients, in each row of the paper.

Class, loss weights and starts are those that ``conf/ablation`` gives the stage; the networks are
tiny, and so is the UNet.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
import torch
from resolved_fits import resolved
from tiny_stages import QUIET, group_of, stage_module, tiny_sit, train
from tiny_unet import tiny_unet

from r3dpa.ablation import make_plan
from r3dpa.modules import LossWeights

pytestmark = QUIET
TABLES = Path(__file__).resolve().parents[2] / "conf" / "ablation"

VAE_ALONE = {"vae", "discriminator"}
ALIGNED_VAE = VAE_ALONE | {"sit.projector", "sit.x_embedder"}
# What is trained in each stage on scans, and what the alignment loss reaches of it.
EXPECTED = {
    ("table_2", "scratch"): [(VAE_ALONE, set()), ({"sit"}, set())],
    ("table_2", "rgb"): [(VAE_ALONE, set()), ({"sit"}, set())],
    ("table_2", "aligned"): [(ALIGNED_VAE, {"vae", "sit"}), ({"sit"}, set())],
    ("table_3", "none"): [(ALIGNED_VAE, {"vae", "sit"}), ({"sit"}, set())],
    ("table_3", "vanilla"): [(ALIGNED_VAE, {"vae", "sit"}), ({"sit"}, {"sit"})],
    ("table_3", "joint"): [(ALIGNED_VAE, {"vae", "sit"}), ({*VAE_ALONE, "sit"}, {"vae", "sit"})],
    ("table_4", "unet"): [({*VAE_ALONE, "sit"}, {"vae", "sit"})],
    ("table_4", "sit"): [({*VAE_ALONE, "sit"}, {"vae", "sit"})],
}
STARTS = {  # networks that the last stage takes from the stage before; from the RGB model
    ("table_2", "scratch"): (["vae", "latent_norm"], False),
    ("table_2", "rgb"): (["vae", "latent_norm"], True),
    ("table_2", "aligned"): (["vae", "sit", "latent_norm"], False),
    ("table_3", "none"): (["vae", "sit", "latent_norm"], False),
    ("table_3", "vanilla"): (["vae", "sit", "latent_norm"], False),
    ("table_3", "joint"): (None, False),  # all four, the default of the joint stage
    ("table_4", "unet"): (None, False),
    ("table_4", "sit"): (None, False),
}


@pytest.fixture(scope="module")
def rows():
    """Stages on scans of each row but those of table I, which are other generators."""
    scale, names = TABLES / "scale" / "paper.yaml", ("table_2", "table_3", "table_4")
    plans = [make_plan(TABLES / name, scale, (0,), Path(), resolved) for name in names]
    return {
        (table.name, row.key): [stage for stage in row.stages[0] if stage.on_scans]
        for plan in plans
        for table in plan.tables
        for row in table.rows
    }


def starts(stage):
    """Settings that name weights which the stage starts from."""
    given = stage.config["model"]["init_args"]
    return [name for name in ("init_from", "rgb_weights") if given.get(name) is not None]


def tiny_networks_of(stage):
    """What :func:`changes` trains in place of the networks of a stage."""
    model = stage.config["model"]
    kind = {"VAEAlignment": "vae_alignment", "JointAlignment": "joint"}
    name = kind.get(model["class_path"].rpartition(".")[2], "flow_matching")
    given = model["init_args"].get("weights", {})
    weights = LossWeights(**{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()})
    is_unet = model["init_args"]["sit"]["class_path"].endswith("UNet")
    return name, tiny_unet if is_unet else tiny_sit, weights


@cache
def changes(name, sit, weights):
    """Names of the parameters that move in a step, and of those that an alignment loss reaches.

    Several rows share a stage.
    """
    module = stage_module(name, sit, weights=weights)
    module.separates_losses = True
    before = {name: value.clone() for name, value in module.named_parameters()}
    train(module)
    moved = {
        name
        for name, value in module.named_parameters()
        if not torch.equal(value, before[name]) and not name.startswith("ema.")
    }
    reached = {
        name.split(".")[0]
        for part, found in module.reached[0].items()
        if part.endswith("_alignment")
        for name in found
    }
    return moved, reached


def test_every_row_of_the_tables_is_tested_here(rows):
    assert set(EXPECTED) == set(STARTS) == set(rows)


@pytest.mark.parametrize("row", EXPECTED, ids="/".join)
def test_a_row_starts_from_its_weights(row, rows):
    *_, last = rows[row]
    networks, rgb = STARTS[row]
    assert last.config["model"]["init_args"].get("init_networks") == networks
    assert ("rgb_weights" in starts(last)) == rgb
    assert ("init_from" in starts(last)) == (len(rows[row]) == 2)
    if EXPECTED[row][0][0] == ALIGNED_VAE:
        assert starts(rows[row][0]) == ["rgb_weights"]


@pytest.mark.parametrize("row", EXPECTED, ids="/".join)
def test_a_row_trains_and_aligns_its_networks(row, rows):
    for stage, (trained, aligned) in zip(rows[row], EXPECTED[row], strict=True):
        moved, reached = changes(*tiny_networks_of(stage))
        parts = {name if name in trained else name.split(".")[0] for name in map(group_of, moved)}
        assert parts == trained, stage.name
        assert reached == aligned, stage.name
