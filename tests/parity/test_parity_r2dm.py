"""R2DM against numbers of its released code (kazuto1011/r2dm)."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.nn.functional as F

from r3dpa.baselines.efficient_unet import (
    EfficientUNet,
    Resample,
    conv3x3,
    encode_angles,
    hdl64e_angles,
    sinusoid,
)
from r3dpa.checkpoints.baselines import efficient_unet_weights

PREDICTIONS = ("eps", "v", "x_0")


def unet_of(case) -> EfficientUNet:
    network = EfficientUNet(**unet_arguments(case))
    network.load_state_dict(efficient_unet_weights(case.weights()))
    return network


@pytest.fixture(scope="module")
def unet_case(baseline_case):
    return baseline_case("r2dm_unet")


@pytest.fixture(scope="module")
def unet(unet_case):
    return unet_of(unet_case)


def gradient(network, official: str) -> torch.Tensor:
    """Gradient of the parameter of an official name."""
    (ours,) = efficient_unet_weights({official: torch.zeros(())})
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
    found = {}
    for name, module in places.items():
        module.register_forward_hook(lambda _, __, out, name=name: found.update({name: out}))
    found["y"] = network(image, time)
    found["time_embedding.0"] = sinusoid(time, network.base_channels)
    found["coords_encoding"] = encode_angles(
        network.coords, network.coords_encoding, network.resolution
    )
    return found


def test_r2dm_unet_forward_and_gradients(unet_case, unet):
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
    results["out/n_parameters"] = torch.tensor(sum(p.numel() for p in network.parameters()))
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
    compare_recorded(case, results, 2e-5, OF_NO_FUNCTION)


#: Angles that nothing uses, and what is compared another way.
OF_NO_FUNCTION = {
    "out/polar_coords_default",
    "out/enc_fourier_freqs",
    "out/roll_max_err_without_coords_1_4_8",
}


def compare_recorded(case, results, atol, left_out=frozenset()):
    """All recorded outputs but those left out, at a tolerance scaled as the README says."""
    assert set(results) == set(case.keys("out/")) - set(left_out)
    for key, found in results.items():
        want = case[key]
        torch.testing.assert_close(
            torch.as_tensor(found).detach().double(),
            want.double(),
            atol=atol(key) if callable(atol) else atol * size_of(want),
            rtol=0,
            msg=lambda text, key=key: f"{key}: {text}",
        )


def unet_arguments(case):
    return {key: value for key, value in case.config.items() if key != "seed"}


def roll_error(network, image, time, columns) -> float:
    moved = network(image.roll(columns, -1), time)
    return (moved - network(image, time).roll(columns, -1)).abs().max().item()


def size_of(want) -> float:
    """Scale of the README's tolerances: the largest value where that exceeds 1."""
    return max(1.0, want.abs().max().item()) if want.numel() else 1.0
