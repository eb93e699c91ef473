"""A kept batch runs again with the numbers of the step, and the layer at fault is named."""

import dataclasses

import pytest
import torch
from tiny_stages import (
    ARGUMENTS,
    QUIET,
    SENSOR,
    NamedData,
    constant_loss,
    guarded,
    infinite_image,
    stage_module,
    train,
)

from r3dpa.callbacks.bad_batches import BadBatch
from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.cli.runs import replay

pytestmark = QUIET


def save(module, path):
    networks = {}
    for name, arguments in ARGUMENTS.items():
        network = getattr(module, name, None)
        if network is not None:
            if name == "sit" and network.average is not None:
                arguments = arguments | {"average_blocks": len(network.average.blocks)}
            networks[name] = NetworkState.of(network, arguments)
    save_checkpoint(Checkpoint(path, module.stage, networks), path)
    return path


def skipped(folder, stage="joint", fault=constant_loss):
    """File of the batch of a training whose only step is broken."""
    train(guarded(stage, [0], fault), NamedData(1), default_root_dir=folder)
    (file,) = (folder / "bad_batches").iterdir()
    return file


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return skipped(tmp_path_factory.mktemp("joint"))


def rows(text):
    return {line.split("  ")[0]: line.split()[-1] for line in text.splitlines() if "  " in line}


@pytest.mark.parametrize("stage", ["joint", "few_step"])
def test_the_losses_of_the_step_come_back(stage, tmp_path):
    """At the first step the weights are the initial ones; the fault itself is no part of them."""
    ckpt = save(stage_module(stage), tmp_path / "before.safetensors")
    file = skipped(tmp_path, stage)
    kept = BadBatch.read(file)
    text = replay(file, ckpt)
    assert SENSOR.beams == kept.tensors["range_image"].shape[2]
    module = train(stage_module(stage), NamedData(1))
    total = float(torch.stack(list(module.parts[0].values())).sum())
    table = rows(text)
    assert table["recorded"] == "inf"
    assert table["all scans"] == f"{total:.4g}"
    assert {"drive/0a", "drive/0b"} <= table.keys()
    assert table["drive/0a"] != table["drive/0b"]
    assert text.count(" is not finite: 0 of ") == 2


def test_a_broken_input_is_told_from_a_broken_layer(tmp_path):
    ckpt = save(stage_module("joint"), tmp_path / "before.safetensors")
    text = replay(skipped(tmp_path, fault=infinite_image), ckpt)
    assert "input range_image: 1 of 256 values are not finite" in text
    assert rows(text)["drive/0a"] == "nan"
    assert rows(text)["drive/0b"] != "nan"  # alone, it is sound
    assert text.endswith("finite inputs into others: none")


def test_the_layer_at_fault_is_named(file, tmp_path):
    """A bias that overflows: all later layers are as bad, but only this one had sound inputs."""
    module = stage_module("joint")
    module.sit.blocks[1].mlp.fc1.bias.data[0] = torch.inf
    text = replay(file, save(module, tmp_path / "broken.safetensors"))
    assert "weight sit.blocks.1.mlp.fc1.bias: 1 of" in text
    assert "into others: sit.blocks.1.mlp.fc1" in text
    (line,) = [line for line in text.splitlines() if "output is not finite" in line]
    assert line.endswith(", the first sit.blocks.1.mlp.fc1")


def test_networks_of_another_size_are_refused(file, tmp_path):
    kept = BadBatch.read(file)
    wide = {**kept.tensors, "feature_grid": torch.zeros(2, 8, 7)}
    other = dataclasses.replace(kept, tensors=wide, about=kept.about | {"step": 1}).save(
        tmp_path / "other"
    )
    ckpt = save(stage_module("joint"), tmp_path / "before.safetensors")
    with pytest.raises(ValueError, match=r"step_0000001.*cannot be run with the networks of"):
        replay(other, ckpt)


@pytest.mark.parametrize(("precision", "said"), [("16-true", True), ("bf16-mixed", False)])
def test_a_precision_that_is_not_repeated_is_said(precision, said, file, tmp_path):
    kept = BadBatch.read(file)
    kept = dataclasses.replace(kept, about=kept.about | {"precision": precision, "step": 1})
    text = replay(
        kept.save(tmp_path / "other"), save(stage_module("joint"), tmp_path / "before.safetensors")
    )
    assert (f"{precision} is not repeated: run in float32" in text) == said
