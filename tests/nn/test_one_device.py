"""Passes on a stand-in for a GPU: no CPU tensor is mixed in, no value is read by the host.

Left out are networks that need a synchronisation by nature: MinkowskiNet and SPVCNN, whose kernel
maps have sizes that depend on the data, LIPLoc, which checks its input for NaN, and
GeometricFeatures, which lists occupied pixels.
"""

from __future__ import annotations

import pytest
import torch
from one_device import OneDevice

from r3dpa.features import DINOv2, PointCloudBatch, WaffleIron
from r3dpa.geometry import LidarSensor
from r3dpa.metrics.networks import RangeViT
from r3dpa.nn import EMA, VAE, ImageVAE, LatentNorm, PatchDiscriminator, SiT, UNet

LATENTS = (2, 4, 4, 16)
HEAD = {"input_size": (4, 16), "in_channels": 4, "feature_dim": 12, "projector_dim": 24}


def on_device(make):
    """The default device is set for the construction alone: it would hide CPU tensors."""
    with torch.device("meta"):
        return make()


def values(*shape):
    return torch.rand(shape, device="meta")


@pytest.fixture(autouse=True)
def one_device():
    with OneDevice():
        yield


def sit():
    return SiT(hidden_size=32, depth=2, num_heads=2, alignment_depth=1, qk_norm=True, **HEAD)


def unet():
    return UNet(
        channels=32, channel_multipliers=(1, 2), num_res_blocks=1, attention_resolutions=[2], **HEAD
    )


def backward(*results):
    """Gradients of all results that have one, and their device."""
    assert {result.device.type for result in results} == {"meta"}
    for result in results:
        if result.requires_grad:
            result.float().sum().backward(retain_graph=True)


@pytest.mark.parametrize("make", [sit, unet])
def test_velocity_networks(make):
    network, latents, time = on_device(make), values(*LATENTS), values(2)
    features, finish = network.aligned_pass(latents, time)
    table = network.modulations(values(5))
    backward(*network(latents, time), features, finish())
    backward(network.project_features(latents, time), network.velocity_at(latents, table[:1]))
    backward(network.to_bfloat16_().velocity(latents, time))


@pytest.mark.parametrize("legacy", [False, True])
def test_vae_and_discriminator(legacy):
    vae = on_device(lambda: VAE(1, 4, 32, (1, 2), ((1, 2),), 1, (1,), legacy))
    posterior = vae.encode(values(2, 1, 8, 32))
    latents = posterior.sample(values(*posterior.mean.shape))
    backward(vae.decode(latents), posterior.kl())
    backward(vae.decoder_to_bfloat16_().decode(latents))
    discriminator = on_device(lambda: PatchDiscriminator(channels=8)).train(legacy)
    backward(discriminator(values(2, 1, 32, 64)))


def test_image_networks():
    vae = on_device(lambda: ImageVAE(channels=(8, 16), num_res_blocks=1, norm_groups=4))
    backward(vae.decode(vae.encode(values(1, 3, 16, 16)).mean))
    teacher = on_device(lambda: DINOv2(dim=32, depth=1, num_heads=2, grid_size=4))
    backward(teacher(values(2, 3, 20, 20), (2, 3)))


@pytest.mark.parametrize("official", [False, True])
def test_latent_norm(official):
    norm = on_device(lambda: LatentNorm(4, legacy_inverse=official, replace_non_finite=official))
    latents = values(*LATENTS)
    backward(norm.update(latents), norm.normalise(latents), norm.denormalise(latents))
    backward(norm.running_var)


@pytest.mark.parametrize("buffers", ["copy", "decay"])
def test_ema_update(buffers):
    network, norm = on_device(sit), on_device(lambda: LatentNorm(4))
    ema = on_device(lambda: EMA(network, norm, buffers=buffers))
    ema.update(network, norm)
    backward(*ema.state_dict().values())


@pytest.mark.parametrize("training", [False, True])
def test_waffleiron(training):
    network = on_device(lambda: WaffleIron(16, 3, cells=(8, 8, 2), head_dim=5)).train(training)
    batch = PointCloudBatch(
        features=values(30, 5),
        neighbors=torch.zeros(30, 4, dtype=torch.long, device="meta"),
        cells=torch.zeros(3, 30, dtype=torch.long, device="meta"),
        num_points=torch.zeros(2, dtype=torch.long, device="meta"),
    )
    tokens = network(batch)
    backward(tokens, network.head(tokens), network.mix(tokens, batch, values(30) > 0.5))


def test_rangevit():
    sensor = LidarSensor(beams=16, columns=64)
    network = on_device(lambda: RangeViT(sensor, 5, 24, 1, 3, 4, 6, 5, trained_size=(16, 32)))
    backward(network(values(2, 16, 64), values(2, 16, 64)))


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (lambda given: given * 2 if given.sum() > 0 else given, "meta tensors"),
        (lambda given: given + torch.ones(given.shape), "cpu and meta"),
    ],
)
def test_both_faults_are_found(fault, message):
    with pytest.raises((AssertionError, RuntimeError), match=message):
        fault(values(2, 3))
