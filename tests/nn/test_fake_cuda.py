"""Forward passes with fake CUDA tensors: no CPU tensor mixed in, no host synchronisation.

Works on a CPU build, without gradients. Sparse networks (MinkowskiNet, SPVCNN) are left out: the size
of their kernel maps depends on the data, which needs a synchronisation by nature. So are LIPLoc,
which checks its input for NaN, and GeometricFeatures, which list the occupied pixels.
"""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from r3dpa.geometry import LidarSensor
from r3dpa.nn import EMA, VAE, ImageVAE, LatentNorm, PatchDiscriminator, SiT, UNet
from r3dpa.nn.backbones import DINOv2, PointCloudBatch, RangeViT, WaffleIron

LATENTS = (2, 4, 4, 16)
HEAD = {"input_size": (4, 16), "in_channels": 4, "feature_dim": 12, "projector_dim": 24}


@pytest.fixture(autouse=True)
def fake_mode():
    with FakeTensorMode(), torch.no_grad():
        yield


def on_cuda(make):
    """The default device is that of the construction alone, else it would hide CPU tensors."""
    with torch.device("cuda"):
        return make()


def cuda(*shape):
    return torch.rand(shape, device="cuda")


def sit():
    return SiT(hidden_size=32, depth=2, num_heads=2, alignment_depth=1, qk_norm=True, **HEAD)


def unet():
    return UNet(
        channels=32, channel_multipliers=(1, 2), num_res_blocks=1, attention_resolutions=[2], **HEAD
    )


def assert_on_cuda(*results):
    for result in results:
        assert isinstance(result, FakeTensor)
        assert result.device.type == "cuda"


@pytest.mark.parametrize("make", [sit, unet])
def test_velocity_networks(make):
    network, latents, time = on_cuda(make), cuda(*LATENTS), cuda(2)
    aligned = network.aligned_pass(latents, time)
    table = network.modulations(cuda(5))
    assert_on_cuda(*network(latents, time), aligned.features, aligned.velocity())
    assert_on_cuda(network.project_features(latents, time), network.velocity_at(latents, table[:1]))
    assert_on_cuda(network.halve_().velocity(latents, time))


@pytest.mark.parametrize("legacy", [False, True])
def test_vae(legacy):
    vae = on_cuda(
        lambda: VAE(1, 4, 32, (1, 2), ((1, 2),), 1, attention_levels=(1,), legacy_upsample=legacy)
    )
    posterior = vae.encode(cuda(2, 1, 8, 32))
    latents = posterior.sample(cuda(*posterior.mean.shape))
    assert_on_cuda(vae.decode(latents), posterior.kl(), posterior.nll(latents))
    assert_on_cuda(vae.halve_decoder_().decode(latents))


def test_image_networks():
    vae = on_cuda(lambda: ImageVAE(channels=(8, 16), num_res_blocks=1, norm_groups=4))
    assert_on_cuda(vae.decode(vae.encode(cuda(1, 3, 16, 16)).mean))
    teacher = on_cuda(lambda: DINOv2(dim=32, depth=1, num_heads=2, grid_size=4))
    assert_on_cuda(teacher(cuda(2, 3, 20, 20), (2, 3)))


@pytest.mark.parametrize("training", [False, True])
def test_discriminator(training):
    network = on_cuda(lambda: PatchDiscriminator(channels=8)).train(training)
    assert_on_cuda(network(cuda(2, 1, 32, 64)))


@pytest.mark.parametrize("official", [False, True])
def test_latent_norm(official):
    norm = on_cuda(lambda: LatentNorm(4, legacy_inverse=official, replace_non_finite=official))
    latents = cuda(*LATENTS)
    assert_on_cuda(norm.update(latents), norm.normalise(latents), norm.denormalise(latents))
    assert_on_cuda(norm.running_var)


@pytest.mark.parametrize("buffers", ["copy", "decay"])
def test_ema_update(buffers):
    network, norm = on_cuda(sit), on_cuda(lambda: LatentNorm(4))
    ema = on_cuda(lambda: EMA(network, norm, buffers=buffers))
    ema.update(network, norm)
    assert_on_cuda(*ema.state_dict().values())


@pytest.mark.parametrize("training", [False, True])
def test_waffleiron(training):
    network = on_cuda(lambda: WaffleIron(16, 3, cells=(8, 8, 2), head_dim=5)).train(training)
    batch = PointCloudBatch(
        features=cuda(30, 5),
        neighbors=torch.zeros(30, 4, dtype=torch.long, device="cuda"),
        cells=torch.zeros(3, 30, dtype=torch.long, device="cuda"),
        num_points=torch.zeros(2, dtype=torch.long, device="cuda"),
    )
    tokens = network(batch)
    assert_on_cuda(tokens, network.head(tokens), network.mix(tokens, batch, cuda(30) > 0.5))


def test_rangevit():
    sensor = LidarSensor(beams=16, columns=64)
    network = on_cuda(lambda: RangeViT(sensor, 5, 24, 1, 3, 4, 6, 5, trained_size=(16, 32)))
    assert_on_cuda(network(cuda(2, 16, 64), cuda(2, 16, 64)))


class Synchronising(nn.Module):
    def forward(self, values):
        return values * 2 if values.sum() > 0 else values


class Mixing(nn.Module):
    def forward(self, values):
        return values + torch.ones(values.shape)


@pytest.mark.parametrize("module", [Synchronising(), Mixing()])
def test_both_faults_are_found(module):
    with pytest.raises(Exception, match=r"device|[Dd]ata.?[Dd]ependent|_local_scalar_dense"):
        module(cuda(2, 3))
