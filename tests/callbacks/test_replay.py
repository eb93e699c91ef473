"""A saved batch runs again with the numbers of the step, and the layer at fault is named."""

import pytest
import torch
from tiny_stages import (
    ARGUMENTS,
    QUIET,
    NamedData,
    TinyData,
    constant_loss,
    guarded,
    infinite_image,
    stage_module,
    train,
)

from r3dpa.callbacks.bad_batches import read_bad_batch
from r3dpa.checkpoints import Checkpoint, NetworkState, convert, save_checkpoint
from r3dpa.cli.runs import replay
from r3dpa.modules import LossWeights
from r3dpa.nn import AverageVelocitySiT

pytestmark = QUIET


def save(module, path, geometry=None):
    networks = {}
    for name, arguments in ARGUMENTS.items():
        network = getattr(module, name, None)
        if network is not None:
            if isinstance(network, AverageVelocitySiT):
                arguments = arguments | {"average_blocks": len(network.average.blocks)}
            networks[name] = NetworkState.of(network, arguments)
    save_checkpoint(Checkpoint(path, module.stage, networks, geometry=geometry), path)
    return path


def skipped(folder, stage="joint", fault=constant_loss):
    """File of the batch of a training whose only step is broken."""
    train(guarded(stage, [0], fault), NamedData(1), default_root_dir=folder)
    (file,) = (folder / "bad_batches").iterdir()
    return file


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return skipped(tmp_path_factory.mktemp("joint"))


@pytest.mark.parametrize("stage", ["joint", "few_step"])
def test_the_losses_of_the_step_come_back(stage, tmp_path):
    """At the first step the weights are the initial ones; the fault itself is no part of them."""
    ckpt = save(stage_module(stage), tmp_path / "before.safetensors")
    text = replay(skipped(tmp_path, stage), ckpt)
    module = train(stage_module(stage), NamedData(1))
    total = float(torch.stack(list(module.parts[0].values())).sum())
    then, now = (line for line in text.splitlines() if line.startswith("losses "))
    assert then.endswith("loss inf")
    assert now.endswith(f"loss {total:.3g}")
    assert "layers whose output is not finite: 0, from finite inputs: none" in text
    assert "\nthese weights give finite values for this batch" in text


def test_the_perceptual_loss_has_the_geometry_of_the_weights(tmp_path):
    weights = LossWeights(vae_alignment=0.0, perceptual=0.01)
    module = guarded("vae_alignment", [0], constant_loss, weights=weights)
    train(module, NamedData(1), default_root_dir=tmp_path)
    (file,) = (tmp_path / "bad_batches").iterdir()
    ckpt = save(
        stage_module("vae_alignment"), tmp_path / "before.safetensors", TinyData.geometry.to_dict()
    )
    losses = replay(file, ckpt).split("losses now:")[1]
    assert "perceptual" in losses.splitlines()[0]


def test_the_decoder_gets_the_noise_of_the_step(tmp_path):
    weights = LossWeights(vae_alignment=0.0)
    options = {"weights": weights, "latent_noise": 1.0}
    module = guarded("vae_alignment", [0], constant_loss, **options)
    train(module, NamedData(1), default_root_dir=tmp_path)
    (file,) = (tmp_path / "bad_batches").iterdir()
    text = replay(file, save(stage_module("vae_alignment"), tmp_path / "before.safetensors"))
    module = train(stage_module("vae_alignment", **options), NamedData(1))
    total = float(torch.stack(list(module.parts[0].values())).sum())
    assert f"loss {total:.3g}" in text.split("losses now:")[1]
    without = stage_module("vae_alignment", weights=weights)
    train(without, NamedData(1))
    assert float(torch.stack(list(without.parts[0].values())).sum()) != pytest.approx(total)


def test_the_encoder_sees_what_it_saw_in_the_step(tmp_path):
    options = {"weights": LossWeights(vae_alignment=0.0), "further_dropout": 0.5}
    module = guarded("vae_alignment", [0], constant_loss, **options)
    train(module, NamedData(1), default_root_dir=tmp_path)
    (file,) = (tmp_path / "bad_batches").iterdir()
    saved = read_bad_batch(file)
    assert saved["further_dropout"] == 0.5
    assert torch.equal(saved["draws"].further, module.draw_path(2, 0).further)


def test_weights_without_a_network_of_the_step_are_named(file, tmp_path):
    ckpt = save(stage_module("joint"), tmp_path / "whole.safetensors")
    part = tmp_path / "part.safetensors"
    convert(ckpt, part, networks=["vae"])
    with pytest.raises(ValueError, match=r"part\.safetensors has no network sit, which the step"):
        replay(file, part)


def test_a_stage_of_another_package_is_named(file, tmp_path):
    saved = torch.load(file, weights_only=True) | {"stage": "mine"}
    torch.save(saved, tmp_path / "mine.pt")
    ckpt = save(stage_module("joint"), tmp_path / "before.safetensors")
    with pytest.raises(
        ValueError, match=r"mine\.pt is of stage mine, but only vae_alignment, joint"
    ):
        replay(tmp_path / "mine.pt", ckpt)


def test_a_broken_input_is_told_from_a_broken_layer(tmp_path):
    ckpt = save(stage_module("joint"), tmp_path / "before.safetensors")
    text = replay(skipped(tmp_path, fault=infinite_image), ckpt)
    assert "range_image: 1 of 256 values are not finite" in text
    assert text.endswith("finite inputs: none")


def test_the_layer_at_fault_is_named(file, tmp_path):
    """A bias that overflows: all later layers are as bad, but only this one had sound inputs."""
    module = stage_module("joint")
    module.sit.blocks[1].mlp.fc1.bias.data[0] = torch.inf
    text = replay(file, save(module, tmp_path / "broken.safetensors"))
    assert "sit.blocks.1.mlp.fc1.bias: 1 of" in text
    assert text.endswith("from finite inputs: sit.blocks.1.mlp.fc1")


def test_a_folder_is_answered_with_its_files(file, tmp_path):
    with pytest.raises(ValueError, match=rf"is a folder; give one of its files: {file.name}$"):
        replay(file.parent, tmp_path / "before.safetensors")
    with pytest.raises(ValueError, match="is a folder; it holds no saved batch"):
        replay(tmp_path, tmp_path / "before.safetensors")


def test_networks_of_another_size_are_refused(file, tmp_path):
    saved = torch.load(file, weights_only=True)
    saved["batch"]["feature_grid"] = torch.zeros(2, 8, 7)
    torch.save(saved, tmp_path / "other.pt")
    ckpt = save(stage_module("joint"), tmp_path / "before.safetensors")
    with pytest.raises(ValueError, match=r"other\.pt cannot be run with the networks of"):
        replay(tmp_path / "other.pt", ckpt)
