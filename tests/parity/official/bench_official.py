"""The official code beside ours with the same weights: equal results first, then paired times.

``R3DPA_OFFICIAL_REPO=<checkout> pytest tests/parity/official -m bench``. The ratios are official
time over ours.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
import torch
from official_code import Overlay, load_official
from official_networks import at_times, noise_of, random_networks, relative, sits, vaes
from official_scripts import (
    replaced,
    save_for_official,
    train_official,
    train_ours,
    write_official_scenes,
)
from torch.nn import functional as F

from r3dpa.bench.measure import compare, timed
from r3dpa.data import write_bin
from r3dpa.flow import euler, euler_maruyama, ode_times, sde_times
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import ScanGeometry, points_of

pytestmark = pytest.mark.bench

SIT = {"hidden_size": 128, "depth": 4, "num_heads": 4, "alignment_depth": 2}
VAE = {"channels": 32}
STEPS, ROUNDS = 50, 5


@pytest.fixture(scope="module")
def code():
    return load_official(Path(os.environ["R3DPA_OFFICIAL_REPO"]))


@pytest.fixture
def networks():
    torch.manual_seed(0)
    return random_networks(SIT, VAE)


def told(benchmark, theirs, ours):
    """Ratios of official time over ours, with their intervals."""
    found = benchmark.pedantic(compare, ({"official": theirs, **ours}, ROUNDS), rounds=1)
    for name in ours:
        ratio = found.over_first(name)
        text = f"{1 / ratio.value:.2f} ({1 / ratio.high:.2f}..{1 / ratio.low:.2f})"
        benchmark.extra_info[f"official / {name}"] = text
    benchmark.extra_info["official again"] = str(found.repeat)


@pytest.mark.parametrize("kind", ["Euler", "Euler-Maruyama"])
def bench_sampler(benchmark, code, networks, kind, one_thread):
    nets, samplers = sits(code, networks), code["samplers"]
    half = networks.network("ema").build().eval()
    half.to_bfloat16_()
    noise = torch.randn(4, nets.ours.in_channels, *nets.ours.input_size)
    draws = torch.randn(STEPS - 1, *noise.shape, dtype=torch.float64)
    labels = torch.zeros(4, dtype=torch.long)

    def theirs():
        rest = iter(draws)
        sampler = samplers.euler_sampler
        if kind == "Euler-Maruyama":
            sampler = samplers.euler_maruyama_sampler
        with replaced(samplers, torch=Overlay(torch, randn_like=lambda values: next(rest))):
            return sampler(nets.theirs, noise, labels, num_steps=STEPS, path_type="linear")

    def ours(sit):
        if kind == "Euler":
            times = ode_times(STEPS)
            return euler(at_times(sit, times[:-1]), noise, times)
        times = sde_times(STEPS)
        return euler_maruyama(at_times(sit, times[:-1]), noise, times, draws, last="mean")

    assert relative(ours(nets.ours), theirs()) < 1e-4
    cases = {"fp32": timed(lambda: ours(nets.ours)), "bf16": timed(lambda: ours(half))}
    told(benchmark, timed(theirs), cases)


def bench_decode(benchmark, code, one_thread):
    networks = random_networks(SIT, {})
    nets, half = vaes(code, networks), networks.network("vae").build().eval()
    half.decoder_to_bfloat16_()
    latents = torch.randn(1, 8, 16, 128)
    with torch.inference_mode():
        assert relative(nets.ours.decode(latents), nets.theirs.decode(latents).sample) < 1e-4
        cases = {"fp32": nets.ours, "bf16": half}
        told(
            benchmark,
            timed(lambda: nets.theirs.decode(latents)),
            {name: timed(lambda vae=vae: vae.decode(latents)) for name, vae in cases.items()},
        )


def bench_scenes_to_disk(benchmark, code, networks, tmp_path, one_thread):
    """Ten scenes from noise to the last byte, at equal evaluations."""
    save_for_official(code, networks, tmp_path / "experiment")
    geometry = ScanGeometry.from_dict(networks.geometry)
    nets = [networks.network(name).build() for name in ("vae", "ema", "ema_latent_norm")]

    def theirs(noise=None):
        with tempfile.TemporaryDirectory(dir=tmp_path) as out:
            return write_official_scenes(
                code, networks, tmp_path / "experiment", Path(out), 10, 5, STEPS, noise
            )

    def ours(precision):
        sampler = SamplerConfig("euler", STEPS)
        generator = SceneGenerator(*nets, geometry, sampler, precision=precision)
        with tempfile.TemporaryDirectory(dir=tmp_path) as out:
            ranges = [generator.generate(part, 0).range_m for part in (range(5), range(5, 10))]
            for index, range_m in enumerate(torch.cat(ranges)):
                points = points_of(range_m, geometry.projection)
                write_bin(Path(out) / f"{index}.bin", points)
        return torch.cat(ranges)

    range_m, reference_m = ours("fp32"), torch.from_numpy(theirs(noise_of(networks, 10, 0)))
    both = (range_m > 0) & (reference_m > 1) & (reference_m < 56)
    assert (range_m - reference_m)[both].square().mean().sqrt() < 5e-3
    cases = {name: timed(lambda name=name: ours(name)) for name in ("fp32", "bf16")}
    told(benchmark, timed(theirs), cases)


def bench_joint_step(benchmark, code, tmp_path, one_thread):
    """The second step: the moments of the optimisers are made in the first."""
    networks = random_networks({**SIT, "learn_pos_embed": True}, VAE)
    image, noise = torch.rand(1, 1, 64, 1024) * 2 - 1, torch.randn(2, 1, 8, 16, 128)
    features = F.normalize(torch.randn(1, 512, 768), dim=-1)
    given = (networks, image, features, (noise[0], torch.rand(1), noise[1]), 2)

    told(
        benchmark,
        lambda: train_official(code, *given, tmp_path).seconds[-1],
        {"fp32": lambda: train_ours(*given).seconds[-1]},
    )
