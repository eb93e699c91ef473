"""The VAE against ``vae.npz`` (official weights load as they are)."""

from __future__ import annotations

import pytest
import torch
from recorded_networks import vae_of

from r3dpa.nn.layers import Upsample, downsample
from r3dpa.nn.vae import Posterior


@pytest.fixture(scope="module")
def case(load_case):
    return load_case("vae")


@pytest.fixture
def vae(case):
    assert case.config["in_channels"] == case.config["out_ch"]
    vae = vae_of(case.config)
    vae.load_state_dict(case.weights())
    return vae


@torch.no_grad()
def encoding(case, vae):
    posterior = vae.encode(case["in/x"])
    encoder = vae.encoder(case["in/x"])
    normal = torch.distributions.Normal(posterior.mean, posterior.std)
    return {
        "out/encoder": encoder,
        "out/moments": vae.quant_conv(encoder),
        "out/mean": posterior.mean,
        "out/logvar": posterior.logvar,
        "out/std": posterior.std,
        "out/kl": posterior.kl(),
        "out/nll_of_z": -normal.log_prob(case["in/z"]).flatten(1).sum(dim=1),
        "out/z_sampled": posterior.sample(case["in/posterior_noise"]),
    }


@torch.no_grad()
def decoding(case, vae):
    latents = vae.encode(case["in/x"]).sample(case["in/posterior_noise"])
    return {"out/decode": vae.decode(case["in/z"]), "out/recon": vae.decode(latents)}


@torch.no_grad()
def rotation(case, vae):
    image, latents, stride = case["in/x"], case["in/z"], vae.stride[1]
    encoded = vae.encode(image.roll(stride, -1)).mean
    decoded = vae.decode(latents.roll(1, -1))
    return {
        "out/horizontal_stride": stride,
        "out/encode_mean_of_input_rolled_by_stride": encoded,
        "out/decode_of_z_rolled_by_1": decoded,
        "out/enc_roll_max_err": (encoded - vae.encode(image).mean.roll(1, -1)).abs().max(),
        "out/dec_roll_max_err": (decoded - vae.decode(latents).roll(stride, -1)).abs().max(),
    }


def gradients(case, vae):
    image = case["in/x"]
    posterior = vae.encode(image)
    reconstruction = vae.decode(posterior.sample(case["in/posterior_noise"]))
    loss = (reconstruction - image).abs().mean() + 0.01 * posterior.kl().mean()
    loss.backward()
    prefix = "out/grad/"
    recorded = [key.removeprefix(prefix) for key in case.keys(prefix)]
    outputs = {prefix + name: vae.get_parameter(name).grad for name in recorded}
    return outputs | {"out/loss_l1_plus_0.01kl": loss.detach()}


def clamp(case, vae):
    posterior = Posterior(case["in/clamp_params"])
    return {
        "out/clamp_logvar": posterior.logvar,
        "out/clamp_std": posterior.std,
        "out/clamp_kl": posterior.kl(),
    }


@torch.no_grad()
def strided_layers(case, vae):
    outputs = {}
    for key in case.keys("in/layer_"):
        image, name = case[key], key.removeprefix("in/layer_")
        stride = tuple(int(size) for size in name.split("x"))
        down = downsample(image.shape[1], stride)
        down.load_state_dict(case.weights(f"w_down_{name}/"))
        up = Upsample(image.shape[1], stride, legacy=True)
        up.load_state_dict(case.weights(f"w_up_{name}/"))
        outputs |= {f"out/down_{name}": down(image), f"out/up_{name}": up(image)}
    return outputs


GROUPS = [encoding, decoding, rotation, gradients, clamp, strided_layers]


def test_vae_outputs(case, vae, compare):
    compare(case, {key: value for group in GROUPS for key, value in group(case, vae).items()})
