"""Networks of the paper's sizes on one scene: VAE layouts, SiT, sampling, feature networks."""

from importlib import import_module
from pathlib import Path

import pytest
import torch
import yaml

from r3dpa.bench.measure import flop_of
from r3dpa.features import feature_source
from r3dpa.flow.guidance import FeatureGuidance, FeatureTarget
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.nn import LatentNorm, SiT

pytestmark = [pytest.mark.bench, pytest.mark.benchmark(min_rounds=3, warmup=True)]

CONF = Path(__file__).resolve().parents[2] / "conf" / "net"
LAYOUTS = ("h2p4d8", "h1p4d4", "h16d4", "h16p2d16")


def vae_of(name):
    config = yaml.safe_load((CONF / f"vae_{name}.yaml").read_text())
    module, _, kind = config["class_path"].rpartition(".")
    torch.manual_seed(0)
    return getattr(import_module(module), kind)(**config.get("init_args", {})).eval()


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.benchmark(group="VAE decode, 64 x 1024")
def bench_decode(benchmark, layout, precision, alone):
    vae = vae_of(layout)
    latents = torch.randn(1, vae.latent_channels, *vae.latent_size((64, 1024)))
    benchmark.extra_info["GFLOP"] = round(flop_of(lambda: vae.decode(latents)) / 1e9, 1)
    if precision == "bf16":
        vae.decoder_to_bfloat16_()
    benchmark(vae.decode, latents)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.benchmark(group="VAE encode, 64 x 1024")
def bench_encode(benchmark, layout, alone):
    vae, image = vae_of(layout), torch.rand(1, 1, 64, 1024) * 2 - 1
    benchmark.extra_info["GFLOP"] = round(flop_of(lambda: vae.encode(image)) / 1e9, 1)
    benchmark(lambda: vae.encode(image).mean)


@pytest.fixture(scope="module")
def sit():
    torch.manual_seed(0)
    return SiT().eval().requires_grad_(False)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.benchmark(group="one scene, AB2 with 4 steps")
def bench_scene(benchmark, sit, precision, alone):
    norm = LatentNorm(8)
    norm.num_batches_tracked.fill_(1)
    geometry = ScanGeometry(SphericalProjection(LidarSensor()), RangeCodec(), sit.grid_size)
    sampler = SamplerConfig("ab2", 4, shift=2.0)
    generator = SceneGenerator(vae_of("h2p4d8"), sit, norm, geometry, sampler, precision=precision)
    benchmark(generator.generate, [0])


@pytest.mark.benchmark(group="velocity of SiT-B/2")
class BenchGuidance:
    @pytest.fixture
    def ways(self, sit):
        """Plain velocity, and guided by features."""
        target = FeatureTarget(torch.randn(1, 512, sit.feature_dim))
        options = {"scale": 0.5, "relative": True}
        guided = FeatureGuidance(sit.velocity, sit.aligned_pass, target, **options)
        return {"plain": sit.velocity, "guided": guided}

    @pytest.mark.parametrize("way", ["plain", "guided"])
    def bench_velocity(self, benchmark, sit, ways, way, one_thread):
        x, time = torch.randn(1, 8, 16, 128), torch.tensor([0.5])
        with torch.no_grad():
            benchmark.extra_info["GFLOP"] = round(flop_of(lambda: ways[way](x, time)) / 1e9, 1)
            benchmark(ways[way], x, time)


@pytest.mark.benchmark(group="point features of one scan")
@pytest.mark.parametrize("name", ["geometric", "waffleiron-s"])
def bench_point_features(benchmark, points, name, alone):
    benchmark.pedantic(feature_source(name), (points,), rounds=1, warmup_rounds=0)
