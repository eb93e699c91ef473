"""Networks of recorded cases as ours, and weights of recorded listings."""

from __future__ import annotations

import torch

from r3dpa.losses import alignment_loss, flow_matching_loss
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT
from r3dpa.nn.vae import VAE


def scaled(atol):
    """Absolute tolerance of a comparison, times the largest value where that is above 1."""

    def tolerance(key, expected):
        largest = expected.abs().max().item() if expected.numel() else 0
        return {"atol": atol * max(1.0, largest), "rtol": 0}

    return tolerance


def with_outputs(modules, run):
    """Result of a call, and by name what some modules gave in it."""
    found = {}
    hooks = [
        module.register_forward_hook(lambda *given, name=name: found.update({name: given[-1]}))
        for name, module in modules.items()
    ]
    result = run()
    for hook in hooks:
        hook.remove()
    return result, found


def our_name(official: str) -> str:
    return official.replace("projectors.0.", "projector.")


def weights_of(shapes, first=0):
    """Tensors of the listed shapes, each of one value of its own and one element of memory."""
    return {
        key: torch.tensor(float(first + i)).expand(shape) if shape else torch.tensor(first + i)
        for i, (key, shape) in enumerate(shapes.items())
    }


def sit_of(config, **options):
    """Our network of the size that ``cases.json`` gives."""
    (feature_dim,) = config["z_dims"]
    same = ("in_channels", "patch_size", "hidden_size", "depth", "num_heads")
    same += ("projector_dim", "num_classes", "qk_norm")
    return SiT(
        input_size=tuple(config["input_size"]),
        alignment_depth=config["encoder_depth"],
        feature_dim=feature_dim,
        class_dropout=config["class_dropout_prob"] > 0,
        **{name: config[name] for name in same},
        **options,
    )


def build_sit(case, **options):
    sit = sit_of(case.config, **options)
    weights = case.weights().items()
    sit.load_state_dict({our_name(k): v for k, v in weights if not k.startswith("bn.")})
    return sit


def build_norm(case, **options):
    norm = LatentNorm(case.config["in_channels"], momentum=case.config["bn_momentum"], **options)
    norm.load_state_dict(case.weights("w/bn."))
    return norm


def vae_of(config):
    return VAE(
        in_channels=config["in_channels"],
        latent_channels=config["z_channels"],
        channels=config["ch"],
        channel_multipliers=config["ch_mult"],
        strides=config["strides"],
        num_res_blocks=config["num_res_blocks"],
        attention_levels=config["attn_levels"],
        legacy_upsample=True,
    )


def training_pass(case, network, latents, path):
    """Outputs of one pass over normalised latents, named as the official code does."""
    time, noise = case["in/time_input"].flatten(), case["in/noises"]
    output = network(path.interpolate(latents, noise, time), time, case["in/y"])
    return {
        "zs_tilde": output.features,
        "model_output": output.velocity,
        "denoising_loss": flow_matching_loss(output.velocity, path.target(latents, noise, time)),
        "proj_loss": alignment_loss(output.features, case["in/zs"]),
    }


def check(case, key, found, atol=1e-5):
    torch.testing.assert_close(
        torch.as_tensor(found).detach().double(),
        case[key].double(),
        **scaled(atol)(key, case[key]),
        msg=lambda text: f"{key}: {text}",
    )


def under(prefix, outputs):
    """The outputs under names that begin with a prefix, without their graph."""
    return {
        prefix + key: value.detach() if isinstance(value, torch.Tensor) else value
        for key, value in outputs.items()
    }


def count(network):
    return sum(parameter.numel() for parameter in network.parameters())
