"""R2DM against numbers of its released code (kazuto1011/r2dm)."""

from __future__ import annotations

import copy
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from recorded_networks import check, count, scaled, with_outputs

from r3dpa.baselines.base import AveragedNetwork
from r3dpa.baselines.diffusion import (
    data_of,
    loss_weight,
    sample_errors,
    target_of,
    weighted_mean,
)
from r3dpa.baselines.diffusion_paths import DiffusionPath, forward_step, repaint
from r3dpa.baselines.efficient_unet import (
    EfficientUNet,
    Resample,
    conv3x3,
    encode_angles,
    hdl64e_angles,
    sinusoid,
)
from r3dpa.baselines.r2dm import R2DM, ema_decay_at
from r3dpa.baselines.readers import unet_weights
from r3dpa.checkpoints import read_checkpoint
from r3dpa.flow.sde import ancestral, ancestral_step

PREDICTIONS = ("eps", "v", "x_0")


def unet_of(case) -> EfficientUNet:
    network = EfficientUNet(**unet_arguments(case))
    network.load_state_dict(unet_weights(case.weights()))
    return network


@pytest.fixture(scope="module")
def unet_case(baseline_case):
    return baseline_case("r2dm_unet")


@pytest.fixture(scope="module")
def unet(unet_case):
    return unet_of(unet_case)


def gradient(network, official: str) -> torch.Tensor:
    """Gradient of the parameter of an official name."""
    (ours,) = unet_weights({official: torch.zeros(())})
    return network.get_parameter(ours).grad


def activations(network, image, time) -> dict[str, torch.Tensor]:
    """Output and the outputs of modules, by official names."""
    places = {
        "time_embedding": network.time_embedding,
        "in_conv": network.in_conv,
        "d_block4": network.down[3],
        "u_block4": network.up[0],
        "u_block1": network.up[3],
    }
    y, found = with_outputs(places, lambda: network(image, time))
    found["y"] = y
    found["time_embedding.0"] = sinusoid(time, network.base_channels)
    found["coords_encoding"] = encode_angles(
        network.coords, network.coords_encoding, network.resolution
    )
    return found


def test_r2dm_unet_forward_and_gradients(unet_case, unet, compare):
    case, network = unet_case, copy.deepcopy(unet)
    image = case["in/x"].requires_grad_()
    found = activations(network, image, case["in/log_snr"])
    loss = F.mse_loss(found["y"], case["in/target"])
    loss.backward()
    size = network.resolution
    angles = case["out/hdl64_ray_angles"]
    results = {"out/mse": loss, "out/grad/x": image.grad}
    results["out/y"] = found["y"]
    results["out/y_scalar_time"] = network(image, torch.tensor(0.35))
    for key in case.keys("out/act/"):
        results[key] = found[key.removeprefix("out/act/")]
    for key in case.keys("out/grad/"):
        if key != "out/grad/x":
            results[key] = gradient(network, key.removeprefix("out/grad/"))
    results["out/n_parameters"] = torch.tensor(count(network))
    results["out/hdl64_ray_angles"] = hdl64e_angles(size)
    for encoding in ("spherical_harmonics", "fourier_features"):
        results[f"out/enc_{encoding}"] = encode_angles(angles, encoding, size)
    for name, shape in {
        "down2": {"down": (2, 2)},
        "up2": {"up": (2, 2)},
        "down2_noring": {"down": (2, 2), "ring": False},
        "up2_noring": {"up": (2, 2), "ring": False},
        "down2_box": {"down": (2, 2), "window": (1, 1)},
        "up2_box": {"up": (2, 2), "window": (1, 1)},
        "down_1x2": {"down": (1, 2)},
    }.items():
        results[f"out/resample_{name}"] = Resample(**shape)(case["in/layer"])
    for name, ring in (("ring", True), ("noring", False)):
        layer = conv3x3(case["in/layer"].shape[1], len(case["w_conv3x3/weight"]), ring)
        layer.load_state_dict(case.weights("w_conv3x3/"))
        results[f"out/conv3x3_{name}"] = layer(case["in/layer"])
    probe = torch.tensor([1e-9, 3e-9])  # where a sine is its angle
    phases = encode_angles(probe[None, :, None, None], "fourier_features", size)[0, :, 0, 0]
    frequencies = case["out/enc_fourier_freqs"][:, :, 0, 0]
    torch.testing.assert_close(phases[: len(frequencies)], frequencies @ probe)
    without = EfficientUNet(**{**unet_arguments(case), "coords_encoding": None})
    state = network.state_dict()
    state["in_conv.weight"] = state["in_conv.weight"][:, : image.shape[1]]
    without.load_state_dict(state)
    errors = [roll_error(without, image, case["in/log_snr"], columns) for columns in (1, 4, 8)]
    assert errors[2] < 2e-5 < 1e-2 < min(errors[:2])
    results |= {key: case[key] for key in OF_NO_FUNCTION}
    compare(case, results, tolerance=scaled(2e-5))


#: Angles that nothing uses, and what is compared another way.
OF_NO_FUNCTION = {
    "out/polar_coords_default",
    "out/enc_fourier_freqs",
    "out/roll_max_err_without_coords_1_4_8",
}


def unet_arguments(case):
    return {key: value for key, value in case.config.items() if key != "seed"}


def roll_error(network, image, time, columns) -> float:
    moved = network(image.roll(columns, -1), time)
    return (moved - network(image, time).roll(columns, -1)).abs().max().item()


# Diffusion


@pytest.fixture(scope="module")
def diffusion(baseline_case, unet):
    """The case, its network, and noise as the draws of a case's array."""
    return baseline_case("r2dm_diffusion"), unet.eval()


def denoiser(network, path, kind="eps", clip=True):
    module = R2DM(network, kind, path.schedule, path.shift, clip)
    return lambda x, time: module.denoise(network, x, time)


def velocity_of(network, path, kind="eps"):
    denoise = denoiser(network, path, kind)
    return lambda x, time: path.velocity(denoise(x, time), x, time)


@pytest.mark.parametrize("schedule", ["cosine", "linear", "cosine_shifted"])
def test_r2dm_diffusion_schedules(diffusion, schedule):
    case, _ = diffusion
    shift = 2 * torch.tensor(32 / 64).log().item() if schedule == "cosine_shifted" else 0.0
    path = DiffusionPath(schedule=schedule.removesuffix("_shifted"), shift=shift)
    time = case["in/schedule_t"]
    alpha, sigma, *_ = path.coefficients(time)
    check(case, f"out/log_snr_{schedule}", path.log_snr(time))
    check(case, f"out/alpha_{schedule}", alpha)
    check(case, f"out/sigma_{schedule}", sigma)


@pytest.mark.parametrize("kind", PREDICTIONS)
@torch.no_grad()
def test_r2dm_diffusion_losses(diffusion, kind):
    case, network = diffusion
    path, time = DiffusionPath(), case["in/t"]
    data, noise, mask = case["in/x_0"], case["in/noise"], case["in/loss_mask"]
    log_snr = path.log_snr(time)
    alpha, sigma = (c.view(-1, 1, 1, 1) for c in path.coefficients(time)[:2])
    noisy = path.interpolate(data, noise, time)
    prediction, target = network(noisy, log_snr), target_of(kind, data, noise, alpha, sigma)
    weight = loss_weight(log_snr, kind)
    check(case, "out/x_t", noisy)
    check(case, "out/network_condition", log_snr)
    check(case, "out/prediction", prediction)
    check(case, f"out/target_{kind}", target)
    check(case, f"out/loss_weight_{kind}", weight)
    for norm in ("l2", "l1", "huber"):
        errors = sample_errors(prediction, target, norm)
        loss = weighted_mean(errors, weight, official=True)
        check(case, f"out/loss_{kind}_{norm}", loss)
    masked = sample_errors(prediction, target, mask=mask)
    check(case, f"out/loss_{kind}_l2_masked", weighted_mean(masked, weight, official=True))
    if kind == "eps":
        errors = sample_errors(prediction, target)
        check(case, "out/per_sample_mse", errors)
        plain = loss_weight(log_snr, kind, gamma=None)
        check(case, "out/loss_eps_l2_no_min_snr", weighted_mean(errors, plain, official=True))
        check(case, "out/loss_if_weighted_per_sample", weighted_mean(errors, weight))


def test_r2dm_diffusion_training_gradients(diffusion):
    case, network = diffusion
    module = R2DM(copy.deepcopy(network))
    data, time = case["in/x_0"], case["in/t"]
    errors = module.errors(module.network, data, time, case["in/noise"])
    weights = loss_weight(module.interpolant.log_snr(time), "eps")
    loss = weighted_mean(errors, weights, official=True)
    loss.backward()
    check(case, "out/train/loss", loss)
    for key in case.keys("out/train/grad/"):
        found = gradient(module.network, key.removeprefix("out/train/grad/"))
        check(case, key, found)
    norms = [p.grad for p in module.network.parameters()]
    check(case, "out/train/grad_norm", torch.nn.utils.get_total_norm(norms))


@pytest.mark.parametrize("kind", PREDICTIONS)
@torch.no_grad()
def test_r2dm_diffusion_single_steps(diffusion, kind):
    case, network = diffusion
    path, x = DiffusionPath(), case["in/step_x_t"]
    here, there, draw = case["in/step_t"], case["in/step_s"], case["in/step_noise"]

    def step(eta, clip=True):
        data = denoiser(network, path, kind, clip)(x, here)
        return ancestral_step(data, x, here, there, draw, eta=eta, interpolant=path)

    check(case, f"out/step_ddpm_{kind}", step(1.0), 1e-4)
    check(case, f"out/step_ddim_{kind}", step(0.0), 1e-4)
    if kind == "eps":
        check(case, "out/step_ddim_eps_eta0.6", step(0.6), 1e-4)
        check(case, "out/step_ddpm_eps_noclip", step(1.0, clip=False), 1e-4)
        moved = forward_step(case["in/x_0"], there, here, draw, path)
        check(case, "out/q_step", moved, 1e-4)


def mostly_equal(found, want):
    """The README's tolerance where float noise grows 1800 times at t = 1."""
    error = (found.double() - want.double()).abs()
    assert error.max() < 1e-2
    assert (error > 1e-4).double().mean() <= 0.05


class RoundedSigma(DiffusionPath):
    """Sigma as the DDIM step of the released code rounds it.

    There ``1 - alpha^2`` cancels: in float32 the last sigma is a tenth off, which moves one value
    in twenty by more than 1e-4.
    """

    def coefficients(self, time):
        path = super().coefficients(time)
        return path._replace(sigma=(1 - path.alpha.square()).sqrt())


def states_of(solve, network, path, kind, draws, steps, eta):
    """States of a sampler, by running its first k steps for each k."""
    times = torch.linspace(1, 0, steps + 1, dtype=torch.float64)
    velocity = velocity_of(network, path, kind)
    states = [draws[0]]
    for step, end in enumerate(range(1, steps + 1)):
        rest = draws[1 + step : 2 + step]
        pair = times[step : end + 1]
        states.append(solve(velocity, states[-1], pair, rest, eta=eta, interpolant=path))
    return torch.stack(states)


@pytest.mark.parametrize(
    ("name", "kind", "eta"),
    [
        ("ddpm_v", "v", 1.0),
        ("ddpm", "eps", 1.0),
        ("ddim", "eps", 0.0),
        ("ddim_eta0.5", "eps", 0.5),
    ],
)
def test_r2dm_diffusion_samplers(diffusion, name, kind, eta):
    case, network = diffusion
    path = DiffusionPath() if eta == 1 else RoundedSigma()
    draws = case["in/sample4_draws"]
    times = torch.linspace(1, 0, len(draws), dtype=torch.float64)
    velocity = velocity_of(network, path, kind)
    found = ancestral(velocity, draws[0], times, draws[1:], eta=eta, interpolant=path)
    if kind == "v":
        check(case, f"out/sample4_{name}", found, 1e-4)
    else:
        mostly_equal(found, case[f"out/sample4_{name}"])
    if name == "ddpm":
        states = states_of(ancestral, network, path, kind, draws, len(draws) - 1, eta)
        assert torch.equal(states[-1], found)
        mostly_equal(states, case["out/sample4_ddpm_states"])


def test_r2dm_diffusion_repaint(diffusion):
    case, network = diffusion
    path = DiffusionPath()
    velocity = velocity_of(network, path)
    for key in case.keys("out/repaint_T"):
        name = key.removeprefix("out/repaint_")
        steps, resamplings, jump = (int(part[1:]) for part in name.split("_"))
        draws = iter(case[f"in/repaint_draws_{name}"])
        known, mask = case["in/repaint_known"], case["in/repaint_mask"]
        found = repaint(velocity, known, mask, draws, path, steps, resamplings, jump)
        assert next(draws, None) is None  # the number of draws is that of the official code
        mostly_equal(found, case[key])
        count = 1 + (steps - 1) * resamplings + 1
        assert case[f"out/repaint_n_states_{name}"] == count


@torch.no_grad()
def test_r2dm_diffusion_discrete(diffusion):
    case, network = diffusion
    steps = case.config["num_training_steps_discrete"]
    for schedule in ("linear", "cosine", "sigmoid"):
        beta = betas(schedule, steps)
        check(case, f"out/discrete100_beta_{schedule}", beta.float())
        kept = (1 - beta).cumprod(0)
        check(case, f"out/discrete100_alpha_bar_{schedule}", kept.float())
    kept = (1 - betas("linear", steps)).cumprod(0)
    path, number = Discrete(kept), case["in/discrete_steps"]
    data, noise = case["in/x_0"], case["in/noise"]
    noisy = path.interpolate(data, noise, number + 1.0)
    prediction = network(noisy, number.float())
    weight = loss_weight(torch.logit(kept[number]).float(), "eps")
    errors = sample_errors(prediction, noise)
    loss = weighted_mean(errors, weight, official=True)
    check(case, "out/discrete_loss_eps", loss)
    x, draw = case["in/step_x_t"], case["in/step_noise"]
    draw = draw * (number > 0).view(-1, 1, 1, 1)
    alpha, sigma = (c.view(-1, 1, 1, 1) for c in path.coefficients(number + 1.0)[:2])
    clean = data_of(network(x, number.float()), "eps", x, alpha, sigma).clamp(-1, 1)
    for name, eta in (("ddpm", 1.0), ("ddim", 0.0)):
        found = ancestral_step(
            clean, x, number + 1.0, number + 0.0, draw, eta=eta, interpolant=path
        )
        check(case, f"out/discrete_step_{name}", found, 1e-4)


def betas(schedule, steps):
    """Variances ``(steps,)`` of the discrete schedules, of which none was released."""
    if schedule == "linear":
        return torch.linspace(0.1 / steps, 20 / steps, steps, dtype=torch.float64)
    time = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    if schedule == "cosine":
        signal = torch.cos((time + 0.008) / 1.008 * torch.pi / 2).square()
    else:
        signal = torch.sigmoid(torch.tensor(3.0)) - torch.sigmoid(6 * time - 3)
    return (1 - signal[1:] / signal[:-1]).clamp(0, 0.999)


class Discrete(DiffusionPath):
    """The 100 levels of a table, at times 1 to 100; 0 is data."""

    def __init__(self, kept):
        super().__init__()
        object.__setattr__(self, "kept", torch.cat([torch.ones(1), kept.float()]))

    def coefficients(self, time):
        kept = self.kept[time.long()]
        return kept.sqrt(), (1 - kept).sqrt(), kept * 0, kept * 0


def test_r2dm_diffusion_every_array_is_compared(diffusion, unet_case):
    """So that a new array of the case is not overlooked."""
    case, _ = diffusion
    text = Path(__file__).read_text()
    stems = ("schedule", "sample4", "repaint", "discrete", "step", "train", "loss", "target")
    stems += ("log_snr", "alpha", "sigma")
    rest = [key for key in case.keys("out/") if not key[4:].startswith(stems)]
    unnamed = [key for key in rest if f'"{key}"' not in text]
    assert not unnamed
    count = sum("scale" not in key for key in unet_case.keys("w/"))
    assert case["out/state_dict_key_count"] > count  # its constants are no weights here


def test_ema_outputs(baseline_case):
    case = baseline_case("ema")
    config = case.config
    network = torch.nn.Linear(*case["in/initial_weight"].shape[::-1], bias=False)
    network.weight.data.copy_(case["in/initial_weight"])
    network.register_buffer("seen", torch.zeros(case["out/ema_buffer"].shape[1:]))
    beta, after = config["beta"], config["update_after_step"]
    average = AveragedNetwork(
        network, lambda step: ema_decay_at(step, beta, config["update_every"], after)
    )
    for step, weight in enumerate(case["in/online_weights"]):
        network.weight.data.copy_(weight)
        network.seen.fill_(step)
        decay = ema_decay_at(step, beta, 1, after)
        assert decay == pytest.approx(case["out/decay"][step].item(), abs=1e-6)
        average.update(network, step)
        expected = case["out/ema_weights"][step]
        torch.testing.assert_close(average.network.weight, expected, atol=1e-6, rtol=0)
        torch.testing.assert_close(average.network.seen, case["out/ema_buffer"][step])


def official_checkpoint(listing, path):
    """A file in the layout of the released one, with weights of the listed shapes."""
    weights = {key: torch.zeros(shape) for key, shape in listing["state_dict"].items()}
    for key in weights:
        if key.endswith(".scale"):
            weights[key].fill_(0.5**0.5)
    rows, columns = weights["model.coords"].shape[2:]
    weights["model.coords"] = hdl64e_angles((rows, columns))
    cfg = {
        "data": {
            "depth_format": "log_depth",
            "train_depth": True,
            "train_reflectance": True,
            "resolution": (rows, columns),
        },
        "model": {
            "architecture": "efficient_unet",
            "base_channels": 64,
            "temb_channels": None,
            "channel_multiplier": (1, 2, 4, 8),
            "num_residual_blocks": (3, 3, 3, 3),
            "gn_num_groups": 8,
            "gn_eps": 1e-6,
            "attn_num_heads": 8,
            "coords_encoding": "fourier_features",
            "dropout": 0.0,
        },
        "diffusion": {
            "prediction_type": "eps",
            "noise_schedule": "cosine",
            "timestep_type": "continuous",
        },
    }
    content = {"cfg": cfg, "weights": weights, "ema_weights": weights, "global_step": 300_000}
    torch.save(content | {"optimizer": {}, "lr_scheduler": {}}, path)
    return path


def test_r2dm_released_layout_loads_strictly(baseline_listing, tmp_path):
    listing = baseline_listing("r2dm_state_dicts")["config_h"]
    path = official_checkpoint(listing, tmp_path / "r2dm-h-kitti360-300k.pth")
    checkpoint = read_checkpoint(path)
    with torch.device("meta"):
        network = checkpoint.network("ema_network").new()
    assert count(network) == listing["param_count"] == 31_099_650
    assert (checkpoint.stage, checkpoint.step) == ("r2dm", 300_000)
    codec = checkpoint.geometry["codec"]
    assert codec["encoding"] == "log2"
    assert checkpoint.geometry["projection"]["kind"] == "spherical"
