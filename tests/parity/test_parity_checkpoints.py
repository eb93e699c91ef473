"""Official state-dict listings: strict into our networks and back, key by key, without loss."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import pytest
import torch
from recorded_networks import count, weights_of

from r3dpa.checkpoints import (
    NetworkState,
    convert,
    from_official,
    read_checkpoint,
    to_official,
    transfer_rgb,
)
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT

PATH = Path("official.pt")


def args_of(sit):
    config = sit["config"]
    return argparse.Namespace(
        model=sit["constructor"],
        encoder_depth=config["encoder_depth"],
        cfg_prob=config["class_dropout_prob"],
        num_classes=config["num_classes"],
        bn_momentum=config["bn_momentum"],
        qk_norm=config["qk_norm"],
    )


def assert_same(actual, expected):
    assert set(actual) == set(expected)
    for key, value in expected.items():
        assert actual[key].dtype == value.dtype, key
        assert torch.equal(actual[key], value), key


def through_our_networks(checkpoint):
    """The checkpoint after its weights were loaded into networks, without copying them."""
    networks = {}
    for name, state in checkpoint.networks.items():
        with torch.device("meta"):
            network = state.new()
        network.load_state_dict(state.state_dict, strict=True, assign=True)
        networks[name] = type(state)(state.class_path, state.init_args, network.state_dict())
    return type(checkpoint)(**{**vars(checkpoint), "networks": networks})


def assert_defaults(state, *names):
    """The arguments are those of our class without any."""
    defaults = NetworkState(state.class_path, {}, {}).arguments
    for name in names:
        assert state.arguments[name] == defaults[name], name


def test_sit_state_dicts(official_listing):
    sits = official_listing("sit_state_dicts")
    for name, sit in sits.items():
        config, kitti = sit["config"], not isinstance(sit["config"]["input_size"], int)
        args = args_of(sit)
        if kitti:
            args.vae = name.rpartition("_")[2]
        official = {
            "model": weights_of(sit["state_dict"]),
            "ema": weights_of(sit["state_dict"], first=1000),
            "steps": 12,
            "args": args,
        }
        checkpoint = from_official(official, PATH)
        built = checkpoint.network("sit").init_args
        side = config["input_size"]
        assert built["input_size"] == (side if kitti else [side, side]), name
        assert built["alignment_depth"] == config["encoder_depth"], name
        assert built["class_dropout"] == (config["class_dropout_prob"] > 0), name
        assert [built["feature_dim"]] == config["z_dims"], name
        if sit["constructor"] == "SiT-B/2":
            assert_defaults(checkpoint.network("sit"), "hidden_size", "depth", "num_heads")
        with torch.device("meta"):
            network = checkpoint.network("sit").new()
        assert count(network) == sit["param_count_trainable"], name
        total = count(network) + network.pos_embed.numel()
        assert total == sit["param_count_total"], name
        assert count(network.projector) == sit["param_count_projectors"], name
        back = to_official(through_our_networks(checkpoint))
        assert set(back) == set(official), name
        assert_same(back["model"], official["model"])
        assert_same(back["ema"], official["ema"])
        assert (back["steps"], back["args"]) == (12, args)


def test_vae_state_dicts(official_listing):
    for name, vae in official_listing("vae_state_dicts").items():
        official = weights_of(vae["state_dict"])
        checkpoint = from_official({"vae": official}, PATH)
        with torch.device("meta"):
            network = checkpoint.network("vae").new()
        channels, *size = vae["latent_shape_for_64x1024"]
        assert network.latent_channels == channels, name
        assert list(network.latent_size((64, 1024))) == size, name
        for part in ("encoder", "decoder"):
            assert count(getattr(network, part)) == vae[f"param_count_{part}"], name
        assert count(network) == vae["param_count_total"], name
        if name == "h2p4d8":
            arguments = set(checkpoint.network("vae").arguments) - {"legacy_upsample"}
            assert_defaults(checkpoint.network("vae"), *arguments)
        back = to_official(through_our_networks(checkpoint))
        assert_same(back["vae"], official)
        assert vars(back["args"])["vae"] == name


def test_discriminator_state_dict(official_listing):
    listing = official_listing("discriminator_state_dict")
    official = weights_of(listing["state_dict"])
    checkpoint = from_official({"discriminator": official}, PATH)
    state = checkpoint.network("discriminator")
    assert_defaults(state, *state.arguments)
    parameters = [v for k, v in official.items() if "running_" not in k and v.dim()]
    assert sum(value.numel() for value in parameters) == listing["param_count"]
    assert_same(to_official(through_our_networks(checkpoint))["discriminator"], official)


def test_joint_step_through_our_files(load_case, official_listing, tmp_path):
    """Real recorded values through every file format, bit for bit, also of odd sizes."""
    case = load_case("joint_step")
    config = case.config["sit"]
    args = argparse.Namespace(
        encoder_depth=config["encoder_depth"],
        num_classes=config["num_classes"],
        bn_momentum=config["bn_momentum"],
    )
    official = {
        "model": case.weights("w/sit."),
        "ema": case.weights("w/ema."),
        "vae": case.weights("w/vae."),
        "discriminator": case.weights("w/discriminator."),
        "steps": 1,
        "args": args,
    }
    optimisers = {key: {"state": {}} for key in ("opt", "opt_vae", "opt_disc")}
    saved = official_listing("checkpoint_layout")["train_repae_saved_keys"]
    assert set(saved) == set(official | optimisers)
    torch.save(official | optimisers, tmp_path / "in.pt")
    sit_args = {"num_heads": config["num_heads"], "input_size": config["input_size"]}
    convert(tmp_path / "in.pt", tmp_path / "ours.safetensors", sit_args=sit_args)
    convert(tmp_path / "ours.safetensors", tmp_path / "out.pt", "official")
    with torch.serialization.safe_globals([argparse.Namespace]):
        back = torch.load(tmp_path / "out.pt", weights_only=True)
    assert set(back) - {"r3dpa"} == set(official)
    for key in ("model", "ema", "vae", "discriminator"):
        assert_same(back[key], official[key])
    assert (back["steps"], back["args"]) == (1, args)
    ours = read_checkpoint(tmp_path / "ours.safetensors")
    assert set(ours.left_out) == set(optimisers)
    sit = ours.network("ema").build()
    assert torch.equal(sit.projector[0].weight, official["ema"]["projectors.0.0.weight"])
    norm = ours.network("ema_latent_norm").build()
    assert torch.equal(norm.running_var, official["ema"]["bn.running_var"])


def test_rgb_transfer_of_the_imagenet_variants(official_listing):
    sits = official_listing("sit_state_dicts")
    rules = official_listing("checkpoint_layout")["rgb_transfer_in_tuning_stage"]
    kitti = next(s for n, s in sits.items() if "kitti" in n and s["constructor"] == "SiT-B/2")
    config = kitti["config"]
    of_imagenet = {n: s for n, s in sits.items() if "imagenet" in n and "SiT-B/2" in n}
    for (name, rgb), keep_projector in itertools.product(of_imagenet.items(), (False, True)):
        source = weights_of(rgb["state_dict"], first=1)
        checkpoint = from_official({"model": source, "args": args_of(rgb)}, PATH)
        with torch.device("meta"):
            sit = SiT(
                input_size=tuple(config["input_size"]),
                in_channels=config["in_channels"],
                alignment_depth=config["encoder_depth"],
            )
        sit.to_empty(device="cpu").bfloat16()
        for parameter in (*sit.parameters(), *sit.buffers()):
            parameter.data.zero_()
        norm = LatentNorm(config["in_channels"])
        report = transfer_rgb(checkpoint, sit, norm, keep_projector=keep_projector)

        fresh = [
            *rules["dropped_if_in_channels_differ"],
            rules["dropped_if_token_count_differs"][0],
        ]
        fresh += [] if keep_projector else rules["dropped_unless_train_vae_only"]
        stems = tuple(key.removesuffix("*") for key in fresh)
        for key, value in sit.state_dict().items():
            official = key.replace("projector.", "projectors.0.", 1)
            if official in source and not official.startswith(stems):
                expected = source[official].flatten()[0].bfloat16()
                assert value.flatten()[0] == expected, (name, key)
            else:
                assert not value.any(), (name, key)
        assert torch.equal(norm.running_var, torch.ones(config["in_channels"]))

        results = {row.group: row.result for row in report}
        cut = rgb["config"]["class_dropout_prob"] > 0
        expected = {
            "x_embedder": "fresh",
            "final_layer.linear": "fresh",
            "latent_norm": "fresh",
            "pos_embed": "resized",  # computed for the grid here
            "projector": "kept" if keep_projector else "fresh",
            "y_embedder": "truncated" if cut else "kept",
        }
        assert results == dict.fromkeys(results, "kept") | expected
        assert sum(row.num_tensors for row in report) == len(kitti["state_dict"])


@pytest.mark.parametrize(
    ("key", "shape"),
    [
        ("blocks.3.attn.proj.bias", None),
        ("projectors.1.0.bias", [4]),
        ("blocks.3.attn.proj.bias", [5]),
    ],
)
def test_a_listing_that_differs_by_one_key_is_refused(official_listing, key, shape):
    sit = next(iter(official_listing("sit_state_dicts").values()))
    changed = sit["state_dict"] | {key: shape}
    shapes = {name: size for name, size in changed.items() if size is not None}
    args = args_of(sit)
    args.vae = "h2p4d8"
    with pytest.raises(ValueError, match=key):
        from_official({"model": weights_of(shapes), "args": args}, PATH)
