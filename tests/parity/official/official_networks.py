"""Networks with the same weights on both sides, and what their samplers are off by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from official_imports import OfficialCode
from official_runs import official_sit, official_vae
from torch import Tensor

from r3dpa.checkpoints import Checkpoint, NetworkState, read_checkpoint, to_official
from r3dpa.flow import Velocity, heun, ode_solver, ode_times
from r3dpa.generation import SamplerConfig, Solver, scene_random
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry
from r3dpa.nn import VAE, LatentNorm, PatchDiscriminator, SiT

__all__ = [
    "Pair",
    "at_times",
    "equal_error",
    "noise_of",
    "random_networks",
    "relative",
    "sits",
    "trained_networks",
    "vaes",
]

_SOLVERS: tuple[Solver, ...] = ("ab2", "ab3")  # tried for equal error, each with all shifts
_SHIFTS = (1.0, 1.5, 2.0, 3.0)
_FEWEST_EXACT = 40
_CERTIFIED = 0.1  # of the smallest error that is reported


class Pair(NamedTuple):
    """One network, official and ours, with the same weights, not for training."""

    theirs: Any
    ours: Any


def random_networks(sit: dict[str, Any], vae: dict[str, Any]) -> Checkpoint:
    """Networks for official range images whose layers are all random, none of them zero.

    Args:
        sit: Arguments of the SiT beside those of SiT-B/2.
        vae: Arguments of the VAE beside those of h2p4d8.

    Returns:
        All networks that a checkpoint of the joint stage has.
    """
    vae = {**vae, "legacy_upsample": True}
    norm: dict[str, Any] = {"channels": 8, "legacy_inverse": True}
    network, statistics = SiT(**sit), LatentNorm(**norm)
    with torch.no_grad():
        for name, parameter in network.named_parameters():
            if parameter.dim() == 2 and not parameter.any():
                parameter.normal_(std=0.5 * parameter.shape[1] ** -0.5)
            elif name == "final_layer.linear.bias":
                parameter.normal_()
        statistics.num_batches_tracked.fill_(1)  # as if they were fitted
    states = {
        "vae": NetworkState.of(VAE(**vae), vae),
        "discriminator": NetworkState.of(PatchDiscriminator(), {}),
    }
    for sit_name, norm_name in (("sit", "latent_norm"), ("ema", "ema_latent_norm")):
        states[sit_name] = NetworkState.of(network, sit)
        states[norm_name] = NetworkState.of(statistics, norm)
    rows, columns = network.input_size
    sensor = LidarSensor(beams=4 * rows, columns=8 * columns)  # the strides of h2p4d8
    geometry = {
        "projection": {"kind": "spherical", "sensor": asdict(sensor)},
        "codec": asdict(RangeCodec()),
        "grid_size": list(network.grid_size),
    }
    return Checkpoint(Path("random"), "joint", states, geometry=geometry)


def trained_networks(path: Path) -> Checkpoint:
    """Networks of a checkpoint, but with the interpolation and the latent inverse of the official.

    Raises:
        ValueError: If it does not hold the networks of a joint stage, or range images of another
            sensor or encoding than the official scripts know.
    """
    found = read_checkpoint(path)
    states = {name: found.network(name) for name in ("vae", "discriminator", "sit", "ema")}
    states["vae"] = _with(states["vae"], legacy_upsample=True)
    for name in ("latent_norm", "ema_latent_norm"):
        states[name] = _with(found.network(name), legacy_inverse=True)
    if found.geometry is None:
        raise ValueError(f"{path} does not say which range images it was trained on")
    geometry = ScanGeometry.from_dict(dict(found.geometry))
    sensor = geometry.projection.sensor
    official = replace(LidarSensor(), beams=sensor.beams, columns=sensor.columns)
    if sensor != official or geometry.codec != RangeCodec():
        raise ValueError(
            f"{path} was trained on {sensor} and {geometry.codec}, the official scripts know only "
            f"{official} and {RangeCodec()}; take networks of such scans, or leave --ckpt out"
        )
    return replace(found, networks=states)


def _with(state: NetworkState, **arguments: Any) -> NetworkState:
    return NetworkState(state.class_path, {**state.init_args, **arguments}, state.state_dict)


def sits(code: OfficialCode, networks: Checkpoint) -> Pair:
    """The averaged SiT on both sides."""
    theirs = official_sit(code, networks)
    theirs.load_state_dict(to_official(networks)["ema"])
    return Pair(theirs.eval(), networks.network("ema").build().eval())


def vaes(code: OfficialCode, networks: Checkpoint) -> Pair:
    """The VAE on both sides."""
    theirs = official_vae(code, networks)
    theirs.load_state_dict(to_official(networks)["vae"])
    return Pair(theirs.eval(), networks.network("vae").build().eval())


def at_times(sit: SiT, times: Tensor) -> Velocity:
    """Velocity whose k-th call is at the k-th time, with modulations computed here at once."""
    with torch.inference_mode():
        rows = iter(sit.modulations(times.float()).split(1))

    @torch.inference_mode()
    def velocity(latents: Tensor, time: Tensor) -> Tensor:
        return sit.velocity_at(latents.float(), next(rows))

    return velocity


def noise_of(networks: Checkpoint, num: int, seed: int) -> Tensor:
    """``(num, C, h, w)``: what the SiT of a :class:`SceneGenerator` meets first for a seed."""
    sit = networks.network("ema").arguments
    shape = (sit["in_channels"], *sit["input_size"])
    return torch.stack([torch.randn(shape, generator=scene_random(seed, i)) for i in range(num)])


def relative(values: Tensor, reference: Tensor) -> float:
    """Root mean square of the difference over that of the reference."""
    difference = values.double() - reference.double()
    return (difference.square().mean() / reference.double().square().mean()).sqrt().item()


def equal_error(
    theirs: Callable[[Tensor, int], Tensor], sit: SiT, steps: int, num: int = 2
) -> tuple[SamplerConfig, list[str]]:
    """The fewest steps of AB2 or AB3, over some shifts, that are as near to the exact solution.

    Args:
        theirs: The official Euler sampler: noise ``(B, C, h, w)`` and steps to latents.
        sit: Our network with the same weights.
        steps: Official steps.
        num: Samples.

    Returns:
        Sampler, and lines that tell the errors and how exact the reference is.
    """
    noise = torch.randn(num, sit.in_channels, *sit.input_size)

    @torch.inference_mode()
    def velocity(latents: Tensor, time: Tensor) -> Tensor:
        return sit.velocity(latents.float(), time.float())

    fine = max(2 * steps, _FEWEST_EXACT)
    exact = heun(velocity, noise.double(), ode_times(fine))
    half_as_fine = relative(heun(velocity, noise.double(), ode_times(fine // 2)), exact)
    allowed = relative(theirs(noise, steps), exact)
    tried = [number for number in range(2, steps) if number < 12 or number % 2 == 0]
    for number in [*tried, steps]:
        errors = {
            SamplerConfig(solver, number, shift=shift): relative(
                ode_solver(solver)(velocity, noise, ode_times(number, shift=shift)), exact
            )
            for solver in _SOLVERS
            for shift in _SHIFTS
        }
        best = min(errors, key=lambda sampler: errors[sampler])
        if errors[best] <= allowed:
            break
    certified = "certified" if half_as_fine < _CERTIFIED * errors[best] else "NOT CERTIFIED"
    return best, [
        f"latent error (RMS over RMS of the exact solution): official {steps} Euler steps "
        f"{allowed:.2e}; {best.solver} {number} steps, shift {best.shift:g} {errors[best]:.2e}",
        f"exact solution: Heun {fine}, {half_as_fine:.1e} from Heun {fine // 2}: {certified}",
    ]
