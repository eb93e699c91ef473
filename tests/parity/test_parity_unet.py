"""UNet, latent norm and losses against ``unet.npz`` and ``unet_state_dicts.json``."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import pytest
import torch
from recorded_networks import count, our_name, training_pass, weights_of

from r3dpa.checkpoints import from_official, to_official
from r3dpa.flow import Interpolant
from r3dpa.losses import alignment_loss
from r3dpa.nn import LatentNorm, UNet

PATH = Interpolant("linear")
SIZES = {"UNet_lidm": {}, "UNet_small": {"channels": 160}}


@pytest.fixture(scope="module")
def case(load_case):
    return load_case("unet")


def build(case):
    config = case.config
    (feature_dim,) = config["z_dims"]
    reductions = [2**level for level in range(len(config["channel_mult"]))]
    assert config["use_ape"]
    unet = UNet(
        input_size=tuple(config["input_size"]),
        in_channels=config["in_channels"],
        channels=config["model_channels"],
        channel_multipliers=config["channel_mult"],
        num_res_blocks=config["num_res_blocks"],
        head_channels=config["num_head_channels"],
        feature_dim=feature_dim,
        projector_dim=config["projector_dim"],
        num_classes=config["num_classes"],
        attention_resolutions=[r for r in reductions if r in config["attention_resolutions"]],
    )
    weights = case.weights().items()
    unet.load_state_dict({our_name(k): v for k, v in weights if not k.startswith("bn.")})
    norm = LatentNorm(config["in_channels"], momentum=config.get("bn_momentum", 0.1))
    norm.load_state_dict(case.weights("w/bn."))
    return unet, norm


def outputs_of(case, unet, latents):
    outputs = training_pass(case, unet, latents, PATH)
    return outputs | {"proj_loss": outputs["proj_loss"].mean()}


def evaluation(case):
    unet, norm = build(case)
    outputs = outputs_of(case, unet, norm.normalise(case["in/x"]))
    return {f"out/eval/{key}": value for key, value in outputs.items()}


def statistics_seen(case, name, moved):
    """The running statistics that the recorder read.

    That of the shared file read the network it had copied for the training pass, whose statistics
    are bit for bit those before it; the batch statistics show in the outputs of the pass.
    """
    before = case[f"w/bn.{name}"]
    return before if torch.equal(case[f"out/train/bn.{name}"], before) else moved


def training(case):
    unet, norm = build(case)
    outputs = outputs_of(case, unet, norm.update(case["in/x"]))
    loss = outputs["denoising_loss"].mean() + 0.5 * outputs["proj_loss"]
    loss.backward()
    for name in case.weights("out/train/grad/"):
        outputs[f"grad/{name}"] = unet.get_parameter(our_name(name)).grad
    for name in ("running_mean", "running_var"):
        outputs[f"bn.{name}"] = statistics_seen(case, name, norm.get_buffer(name))
    return {f"out/train/{key}": value for key, value in outputs.items()}


def alignment_only(case):
    unet, norm = build(case)
    time = case["in/time_input"].flatten()
    noisy = PATH.interpolate(norm.normalise(case["in/x"]), case["in/noises"], time)
    features = unet.project_features(noisy, time, case["in/y"])
    return {"out/align_only/proj_loss": alignment_loss(features, case["in/zs"]).mean()}


def inference(case):
    unet, _ = build(case)
    velocity = unet.velocity(case["in/inference_x"], case["in/inference_t"], case["in/y"])
    return {"out/inference/v": velocity}


GROUPS = [evaluation, training, alignment_only, inference]


def test_unet_outputs(case, compare):
    compare(case, {key: value for group in GROUPS for key, value in group(case).items()})


@pytest.mark.parametrize("name", SIZES, ids=lambda name: f"unet-{name}")
def test_unet_official_checkpoints_come_and_go_key_by_key(official_listing, name):
    listing = official_listing("unet_state_dicts")
    weights = weights_of(listing[name]["state_dict"])
    args = argparse.Namespace(model=name, vae="h2p4d8", dataset_config="configs/kitti.yaml")
    official = {"model": weights, "ema": weights, "steps": 5, "args": args}
    checkpoint = from_official(official, Path("official.pt"))
    state = checkpoint.network("sit")
    with torch.device("meta"):
        unet = state.new()
    assert isinstance(unet, UNet)
    assert {key: state.arguments[key] for key in SIZES[name]} == SIZES[name]
    assert count(unet) == listing[name]["param_count_total"]
    projector = count(unet.projector)
    assert projector == listing[name]["param_count_projectors"]
    assert list(unet.grid_size) == listing["_notes"]["grid_for_h2p4d8"]
    assert checkpoint.geometry["grid_size"] == list(unet.grid_size)
    unet.load_state_dict(state.state_dict, strict=True, assign=True)
    for checkpoint_ in (checkpoint, dataclasses.replace(checkpoint, official_args={})):
        back = to_official(checkpoint_)
        assert back["args"].model == name
        assert set(back["model"]) == set(weights)
        for key, value in weights.items():
            assert torch.equal(back["ema"][key], value), key


def test_unet_of_another_size_comes_from_an_official_file(case, close):
    official = {"ema": case.weights("w/")}
    with pytest.raises(ValueError, match="head_channels"):
        from_official(official, Path("official.pt"))
    sit_args = {"head_channels": case.config["num_head_channels"]}
    checkpoint = from_official(official, Path("official.pt"), sit_args=sit_args)
    unet = checkpoint.network("ema").build()
    velocity = unet.velocity(case["in/inference_x"], case["in/inference_t"], case["in/y"])
    close(velocity.detach(), case["out/inference/v"])


def test_unet_attention_resolutions_are_inferred_from_an_official_file():
    unet = UNet((4, 16), 3, 32, (1, 2, 1), 1, 16, 5, 12, attention_resolutions=[2, 4])
    norm = LatentNorm(3)
    weights = {k.replace("projector.", "projectors.0."): v for k, v in unet.state_dict().items()}
    weights |= {f"bn.{key}": value for key, value in norm.state_dict().items()}
    checkpoint = from_official({"ema": weights}, Path("a.pt"), sit_args={"head_channels": 16})
    state = checkpoint.network("ema")
    assert list(state.arguments["attention_resolutions"]) == [2, 4]
    latents, time = torch.randn(2, 3, 4, 16), torch.rand(2)
    features = unet.project_features(latents, time)
    assert torch.equal(state.build().project_features(latents, time), features)
