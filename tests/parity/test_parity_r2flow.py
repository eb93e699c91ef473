"""R2Flow against ``r2flow_*.npz``: networks with their time reversed, attention, flow, reflow."""

from __future__ import annotations

import copy

import pytest
import torch
from dopri5 import dopri5
from recorded_networks import count, scaled, weights_of, with_outputs

from r3dpa.baselines import ADMUNet, EfficientUNet
from r3dpa.baselines.diffusion import sample_errors
from r3dpa.baselines.hdit import HDiT
from r3dpa.baselines.neighbourhood import neighbourhood_attention
from r3dpa.baselines.r2flow import distilled_times
from r3dpa.baselines.readers import (
    from_r2flow,
    hdit_weights,
    image_geometry,
    reverse_time,
    unet_weights,
)
from r3dpa.baselines.reflow import clamp_to_sensor
from r3dpa.flow import Interpolant, sample_time
from r3dpa.flow.solvers import ab3, euler
from r3dpa.flow.times import ode_times
from r3dpa.geometry import ScanGeometry, unproject
from r3dpa.modules.settings import OptimizerConfig

PATH = Interpolant()

_SCALAR_TIME = 0.82  # 0 is noise


def hdit_of(config):
    same = (
        *("in_channels", "base_channels", "mlp_ratio", "mapping_depth", "depths", "num_heads"),
        "positional_embedding",
    )
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
    network.load_state_dict(hdit_weights(reverse_time(case.weights())))
    return case, network


def official(network, image, time):
    """Velocity at an official time, from noise to data."""
    return -network(image, 1 - time)


def outputs_of(case, network):
    names = [key.removeprefix("out/act/") for key in case.keys("out/act/")]
    modules = {name: network.get_submodule(name) for name in names}
    image = case["in/x"].requires_grad_()
    velocity, activations = with_outputs(modules, lambda: official(network, image, case["in/t"]))
    results = {f"out/act/{name}": value for name, value in activations.items()}
    scalar_time = torch.full((len(image),), _SCALAR_TIME)
    results |= {"out/y": velocity, "out/y_scalar_time": official(network, image, scalar_time)}
    results["out/n_parameters"] = count(network)
    return results, image, velocity


def gradients_of(network, loss, **options):
    loss.backward(**options)
    own = {name: p.grad for name, p in network.named_parameters()}
    found = reverse_time(own | dict(network.named_buffers()))
    network.zero_grad()
    return found


def test_hdit_outputs(hdit, compare):
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
    # Two heads of eight dimensions; 8 x 32 tokens have harmonics up to (4, 16).
    small = HDiT((8, 128), base_channels=16, depths=(1, 1), num_heads=(2, 2))
    rope = small.get_submodule("down_levels.level_0.0.residual_attn.rope")
    angles = rope(case["in/rope_coords"])
    results |= {
        "out/rope_theta": angles,
        "out/rope_rotated": rope.rotate(case["in/rope_x"], angles),
        "out/rope_freqs_h": rope.freqs_h,
        "out/rope_freqs_w": rope.freqs_w,
        "out/roll_max_err_1_4_32": roll_errors(network, case["in/x"], 1 - case["in/t"], (1, 4, 32)),
    }
    compare(case, results, tolerance=scaled(5e-5))


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
        network = copy.deepcopy(network)
        for weight in network.spatial_pe.parameters():
            weight.zero_()
        errors = roll_errors(network, case["in/x"], case["in/t"], (4, 32, 96))
    assert errors[0] > 0.1
    assert errors[1:].max() < 5e-5


@pytest.mark.parametrize("kind", [ADMUNet, EfficientUNet])
def test_unet(kind, baseline_case, compare):
    name = {ADMUNet: "r2flow_adm_unet", EfficientUNet: "r2flow_efficient_unet"}[kind]
    case = baseline_case(name)
    network = unet_of(kind, case)
    results = {
        "out/y": official(network, case["in/x"], case["in/t"]),
        "out/n_parameters": count(network),
    }
    if kind is ADMUNet:
        block = network.get_submodule("down_blocks.1")
        results["out/block_down_blocks.1"] = block(case["in/block_x"], case["in/block_temb"])
    compare(case, results, tolerance=scaled(2e-5))


def unet_of(kind, case):
    config = {key: value for key, value in case.config.items() if key not in ("seed", "ring")}
    assert case.config["ring"]
    network = kind(**config)
    network.load_state_dict(unet_weights(reverse_time(case.weights())))
    return network


SIZES = {
    "hdit": ("nat_hdit", 128, (3, 3, 3, 3), (1, 2, 4, 8)),
    "efficient_unet_base": ("efficient_unet", 64, (3, 3, 3, 3), (1, 2, 4, 8)),
    "efficient_unet_large": ("efficient_unet", 128, (2, 4, 8, 8), (1, 2, 4, 8)),
    "adm_unet_base": ("adm_unet", 64, (3, 3, 3, 3), (1, 2, 4, 8)),
    "adm_unet_large": ("adm_unet", 128, (3, 3, 3, 3), (1, 2, 3, 4)),
}


@pytest.mark.parametrize("name", SIZES)
def test_released_layouts_are_read_strictly(name, baseline_listing, tmp_path):
    listing = baseline_listing("r2flow_state_dicts")
    architecture, channels, blocks, multiplier = SIZES[name]
    options = copy.deepcopy(listing["checkpoint"]["cfg_defaults_from_source"])
    options["model"] |= {
        "architecture": architecture,
        "base_channels": channels,
        "num_residual_blocks": blocks,
        "channel_multiplier": multiplier,
    }
    if name != "hdit":
        options["model"] |= {"attn_num_heads": 8, "coords_encoding": "fourier_features"}
    options["finetuning"]["k_distil"] = 4
    state = weights_of(listing[name]["state_dict"])
    for key, value in state.items():
        if key.endswith(".scale") and value.dim() == 0:
            state[key] = torch.tensor(0.5).sqrt()
    content = {"cfg": options, "weights": state, "num_images": 2_560_000, "optimizer": {}}
    checkpoint = from_r2flow(content, tmp_path / "r2flow-kitti360-2rf.pth")
    assert (checkpoint.stage, checkpoint.step) == ("r2flow", 320_000)
    assert checkpoint.settings == {"num_steps": 4}
    with torch.device("meta"):
        network = checkpoint.network("ema_network").new()
    assert count(network) == listing[name]["param_count"]
    name = next(iter(content["weights"]))
    del content["weights"][name]
    with pytest.raises((ValueError, KeyError), match=name):
        from_r2flow(content, tmp_path / "broken.pth")


def test_flow_outputs(hdit, baseline_case, close):
    case, network = baseline_case("r2flow_flow"), hdit[1]
    geometry = ScanGeometry.from_dict(image_geometry(network.coords, "log_depth"))
    results = training_of(case, network)
    results |= sampling_of(case, network)
    results |= reflow_of(case, network, geometry)
    results |= times_of(case)
    steps_between = {"out/u_shaped_before_mirror"}  # they become out/timesteps_u_shaped
    assert set(results) == set(case.keys("out/")) - steps_between
    for key, found in results.items():
        of_solver = "euler" in key or "reflow" in key
        atol = 1e-3 if "tol1e-5" in key else 1e-4 if of_solver else 1e-5
        expected = case[key]
        try:
            close(found, expected, **scaled(atol)(key, expected.double()))
        except AssertionError as error:
            raise AssertionError(f"{key}: {error}") from None


def training_of(case, network):
    data, noise, time = case["in/x_1_data"], case["in/x_0_noise"], 1 - case["in/t"]
    noisy = PATH.interpolate(data, noise, time)
    velocity, target = network(noisy, time), PATH.target(data, noise, time)
    results = {"out/x_t": noisy, "out/u_t": -target, "out/v_t": -velocity}
    results["out/x_t_sigma0.1"] = noisy + 0.1 * case["in/sigma_eps"]  # their other flows
    for norm in ("l2", "l1", "smooth_l1", "pseudo_huber"):
        ours = {"smooth_l1": "huber"}.get(norm, norm)
        loss = sample_errors(velocity, target, ours).mean()
        results[f"out/loss_{norm}"] = loss
        if f"out/grad_{norm}/norm" in case:
            gradients = gradients_of(network, loss, retain_graph=True)
            own = [gradients[name] for name, _ in network.named_parameters()]
            for key in case.weights(f"out/grad_{norm}/"):
                value = torch.nn.utils.get_total_norm(own) if key == "norm" else gradients[key]
                results[f"out/grad_{norm}/{key}"] = value
    return results


@torch.no_grad()
def sampling_of(case, network):
    states = [case["in/z_0"]]

    def keep(x, time, index):
        states.append(x)
        return x

    results = {
        f"out/euler_{steps}": euler(network, case["in/z_0"], ode_times(steps)) for steps in (1, 2)
    }
    results["out/euler_4"] = euler(network, case["in/z_0"], ode_times(4), after_step=keep)
    results["out/euler_4_states"] = torch.stack(states)
    first = case["in/z_0"][:1]
    time = torch.empty(1)
    solved, calls = dopri5(lambda x, now: -network(x, time.fill_(1 - now)), first, 1e-5)
    converged = ab3(network, first, ode_times(50))
    assert (converged - solved).square().mean().sqrt() < 2e-3
    results |= {"out/dopri5_tol1e-5": solved, "out/dopri5_nfe": calls}
    return results


@torch.no_grad()
def reflow_of(case, network, geometry):
    shape = (network.in_channels, *network.resolution)
    draws = [torch.Generator().manual_seed(seed) for seed in case["in/reflow_seeds"].tolist()]
    noise = torch.stack([torch.randn(shape, generator=draw) for draw in draws])
    data = euler(network, noise, ode_times(4))
    sensor = geometry.projection.sensor
    pairs = clamp_to_sensor(data, geometry)
    range_m = geometry.codec.ranges_of(pairs, sensor).clamp(min=0)
    results = {
        "out/reflow_x_0_cpu": noise,
        "out/reflow_x_1_raw": data,
        "out/reflow_saved_depth": range_m[:, None],
        "out/reflow_saved_xyz": unproject(range_m, geometry.projection, True).movedim(-1, 1),
        "out/reflow_saved_reflectance": (pairs[:, 1:] + 1) / 2,
        "out/reflow_x_1_training": pairs,
    }
    for steps in (1, 2, 4):
        time = distilled_times(case["in/distill_u"], steps)
        noisy, target = PATH.interpolate(pairs, noise, time), PATH.target(pairs, noise, time)
        loss = sample_errors(network(noisy, time), target, "pseudo_huber").mean()
        results |= {f"out/distill_t_{steps}": 1 - time, f"out/distill_x_t_{steps}": noisy}
        results[f"out/distill_loss_{steps}"] = loss
    return results


def times_of(case):
    names = {"uniform": "uniform", "u_shaped": "u_shaped", "logit_normal": "lognormal"}
    results = {}
    for name, kind in names.items():
        torch.manual_seed(case.config["timestep_seed"])
        results[f"out/timesteps_{name}"] = sample_time(8, kind)
    # Their first step has a rate of 0: ours at step n is theirs at n + 1.
    schedule = OptimizerConfig(lr=1.0, warmup_steps=9, cosine=True)
    rates = [schedule.rate(step - 1, 99) for step in case["out/lr_factor_steps"].tolist()]
    results["out/lr_factor"] = torch.tensor(rates, dtype=torch.float64)
    results["out/lr_factor_steps"] = case["out/lr_factor_steps"]
    return results
