"""R2Flow against ``r2flow_*.npz``: networks with their time reversed, attention, flow, reflow."""

from __future__ import annotations

import pytest
import torch

from r3dpa.baselines.hdit import HDiT, _RotaryEmbedding
from r3dpa.baselines.neighbourhood import neighbourhood_attention
from r3dpa.baselines.official_r2flow import time_reversed

_SCALAR_TIME = 0.82  # 0 is noise


def relative(atol):
    """An absolute tolerance, times the largest value where that is above 1."""
    return lambda key, expected: {"atol": atol * max(1, expected.abs().max().item()), "rtol": 0}


def hdit_of(config):
    same = ("in_channels", "base_channels", "mlp_ratio", "mapping_depth", "depths", "num_heads")
    return HDiT(
        resolution=tuple(config["resolution"]),
        time_channels=config["time_embed_channels"],
        patch_size=tuple(config["patch_size"]),
        window_size=tuple(config["window_size"]),
        **{name: config[name] for name in same},
    )


@pytest.fixture(scope="module")
def hdit(baseline_case):
    """Case and network; its weights are translated."""
    case = baseline_case("r2flow_hdit")
    network = hdit_of(case.config)
    network.load_state_dict(time_reversed(case.weights()))
    return case, network


def official(network, image, time):
    """Velocity at an official time, from noise to data."""
    return -network(image, 1 - time)


def recorded_outputs(modules, names):
    outputs, handles = {}, []
    for name in names:
        handles.append(
            modules[name].register_forward_hook(
                lambda module, inputs, output, name=name: outputs.__setitem__(name, output.detach())
            )
        )
    return outputs, handles


def outputs_of(case, network):
    names = [key.removeprefix("out/act/") for key in case.keys("out/act/")]
    activations, handles = recorded_outputs(dict(network.named_modules()), names)
    image = case["in/x"].requires_grad_()
    velocity = official(network, image, case["in/t"])
    for handle in handles:
        handle.remove()
    results = {f"out/act/{name}": value for name, value in activations.items()}
    scalar_time = torch.full((len(image),), _SCALAR_TIME)
    results |= {"out/y": velocity, "out/y_scalar_time": official(network, image, scalar_time)}
    results["out/n_parameters"] = sum(p.numel() for p in network.parameters())
    return results, image, velocity


def gradients_of(network, loss):
    loss.backward()
    own = {name: p.grad for name, p in network.named_parameters()}
    found = time_reversed(own | dict(network.named_buffers()))
    network.zero_grad()
    return found


def test_hdit(hdit, compare):
    case, network = hdit
    results, image, velocity = outputs_of(case, network)
    loss = (velocity - case["in/target"]).square().mean()
    gradients = gradients_of(network, loss)
    results["out/mse"] = loss
    for key in case.weights("out/grad/"):
        results[f"out/grad/{key}"] = image.grad if key == "x" else gradients[key]
    query, key, value = (case[f"in/na_{name}"] for name in "qkv")
    for name, kernel, dilation in [
        ("k3x9", (3, 9), (1, 1)),
        ("k3x3", (3, 3), (1, 1)),
        ("k5x5", (5, 5), (1, 2)),
        ("k1x3_d2", (1, 3), (1, 3)),
    ]:
        results[f"out/na_{name}"] = neighbourhood_attention(query, key, value, kernel, dilation)
    heads, harmonics = 2, (4, 16)
    rope = _RotaryEmbedding(case["in/rope_x"].shape[-1], heads, harmonics)
    angles = rope(case["in/rope_coords"])
    results |= {
        "out/rope_theta": angles,
        "out/rope_rotated": rope.rotate(case["in/rope_x"], angles),
        "out/rope_freqs_h": rope.freqs_h,
        "out/rope_freqs_w": rope.freqs_w,
        "out/roll_max_err_1_4_32": roll_errors(network, case["in/x"], 1 - case["in/t"], (1, 4, 32)),
    }
    compare(case, results, tolerance=relative(5e-5))


@torch.no_grad()
def roll_errors(network, image, time, steps):
    velocity = network(image, time)
    turned = [network(image.roll(step, -1), time).roll(-step, -1) for step in steps]
    return torch.stack([(velocity - other).abs().max() for other in turned])


def test_hdit_constants_are_those_of_the_official_network(hdit):
    case, _ = hdit
    fresh = hdit_of(case.config).state_dict()
    for key, value in case.weights().items():
        if "rope" in key or key == "coords":
            torch.testing.assert_close(fresh[key], value, atol=1e-6, rtol=0)


def test_hdit_commutes_with_rotations_by_whole_tokens_of_the_last_level(hdit):
    case, network = hdit
    with torch.no_grad():
        kept = network.spatial_pe.embedding.clone()
        network.spatial_pe.embedding.zero_()
        errors = roll_errors(network, case["in/x"], case["in/t"], (4, 32, 96))
        network.spatial_pe.embedding.copy_(kept)
    assert errors[0] > 0.1
    assert errors[1:].max() < 5e-5


def test_hdit_listing_loads_strictly(baseline_listing):
    listing = baseline_listing("r2flow_state_dicts")["hdit"]
    with torch.device("meta"):
        network = HDiT()
    shapes = {key: list(value.shape) for key, value in network.state_dict().items()}
    assert shapes == listing["state_dict"]
    assert sum(p.numel() for p in network.parameters()) == listing["param_count"] == 80_908_420
    assert [name for name, _ in network.named_buffers()] == listing["buffers"]
