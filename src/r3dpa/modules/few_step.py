"""Few evaluations: average velocities of a trained flow, and a thin decoder for its latents."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self, cast

import torch
from torch import Tensor, nn

from r3dpa import losses
from r3dpa.checkpoints import Checkpoint, weights_sha256
from r3dpa.data.datasets import LidarBatch
from r3dpa.data.posterior_cache import fill_cache
from r3dpa.data.store import CachedTensors, ItemKey, tensor_cache
from r3dpa.flow import ab3, average_times, average_velocity_steps, ode_times
from r3dpa.flow.average_velocity import AVERAGE_STEPS, TIME_SHIFT
from r3dpa.flow.noise import random_generator
from r3dpa.flow.solvers import Velocity
from r3dpa.flow.times import per_sample
from r3dpa.modules.flow_matching import FlowMatching
from r3dpa.modules.settings import TimeSampling
from r3dpa.modules.stage import PathDraws, zero_loss
from r3dpa.nn import VAE, AverageVelocitySiT, ThinDecoder, VelocityNetwork
from r3dpa.nn.layers import num_processes
from r3dpa.scheduled_velocity import check_guidance, guided_velocity_at

_POINTS = 8  # of a trajectory after the noise, see average_times
_EVERY = 2  # AB3 steps between two points
_DECODED = 4  # every 4th latents are decoded: two decoders cost more than the SiT
# First and last point of each step that a sampler takes; as many of 1 step as of 2, 4 and 8.
_PAIRS = torch.tensor(
    [
        (first, first + length)
        for length in (_POINTS // num for num in AVERAGE_STEPS)
        for first in range(0, _POINTS, length)
        for _ in range(length)
    ]
)


@dataclass(frozen=True)
class _Noise:
    """Noise that a trajectory starts from, as an item of a cache."""

    index: int
    name: str
    path: Path
    cache_key: ItemKey


class FewStep(FlowMatching):
    """Average velocities of a frozen flow, learned from its own trajectories, and a thin decoder.

    The copied blocks of an :class:`r3dpa.nn.AverageVelocitySiT` learn the average velocity between
    points of AB3 trajectories of the flow, whose own weights stay as they are: one checkpoint
    samples with any solver. With ``guidance`` the trajectories are guided, so that few steps make
    the scenes of a guided flow without the cost of guidance. The trajectories are computed once,
    into the folder of the cached posteriors, and an interrupted run computes only the missing
    ones. The thin decoder learns the images that the VAE decodes from the latents of training
    scans.

    Steps from the noise, and the shortest ones, start from points of a trajectory. The others start
    from where a step before them leads, and learn to come back to it.

    Source: trajectory regression as in consistency mid-training (Hu et al. 2025); starts that the
    learner itself reaches: Ross et al., DAgger (AISTATS 2011); guided velocities: Meng et al., "On
    distillation of guided diffusion models" (CVPR 2023).

    Args:
        vae: Range-image autoencoder; fixed.
        sit: SiT with a copy of its last blocks. Training starts from the copy in ``init_from``, if
            it has one of as many blocks.
        thin_decoder: Decoder to distil; None trains none.
        trajectories: Number of trajectories, 16 velocities each in the precision of the steps.
        **kwargs: See :class:`FlowMatching`. ``init_from`` is a checkpoint of stage flow_matching,
            joint or few_step, whose averaged SiT is taken. Of the loss weights ``denoising``
            (average velocity) counts and, for the thin decoder, ``reconstruction``, ``returns``,
            ``intensity`` and ``classes``; times are uniform.
    """

    stage = "few_step"
    default_init = ("vae", "latent_norm", "sit")
    starts_from = "flow_matching, joint or few_step"

    def __init__(
        self,
        vae: VAE,
        sit: VelocityNetwork,
        thin_decoder: ThinDecoder | None = None,
        trajectories: int = 4096,
        **kwargs: Any,
    ) -> None:
        # Not by the type of the argument: a YAML file with AverageVelocitySiT, given after one with
        # SiT, would then lose the arguments of the SiT.
        if not isinstance(sit, AverageVelocitySiT):
            raise ValueError(
                "stage few_step trains a copy of the last blocks of the SiT: set "
                "--model.init_args.sit.class_path to r3dpa.nn.AverageVelocitySiT"
            )
        if trajectories < 1:
            raise ValueError(f"trajectories must be at least 1, got {trajectories}")
        super().__init__(vae, sit, **kwargs)
        if self.guidance is not None:
            check_guidance(self.guidance, sit)
        if thin_decoder is not None:
            _check_thin_decoder(thin_decoder, vae)
        self.thin_decoder = thin_decoder
        self.trajectories = trajectories
        self.time_sampling: TimeSampling = "uniform"
        self.sit.requires_grad_(False)
        sit.average.requires_grad_(True)
        self._cached: CachedTensors[_Noise] | None = None
        self.vae.eval()

    def train(self, mode: bool = True) -> Self:
        """Keep the VAE in evaluation mode: in training it decodes leaves otherwise."""
        super().train(mode)
        self.vae.eval()
        return self

    def previous_networks(self, before: Checkpoint) -> Checkpoint:
        """The averaged flow as the networks of this stage, with a copy of its last blocks."""
        trained = _average_weights(before.network("ema").state_dict)
        before = super().previous_networks(before)
        flow = before.network("ema")
        networks = dict(before.networks) | {"latent_norm": before.network("ema_latent_norm")}
        weights = cast(AverageVelocitySiT, self.sit).with_average(flow.state_dict)
        if trained.keys() == _average_weights(weights).keys():
            weights |= trained
        networks["sit"] = replace(flow, state_dict=weights)
        return replace(before, networks=networks)

    def on_fit_start(self) -> None:
        """Load the flow, and compute the missing trajectories."""
        super().on_fit_start()
        trainer = cast(Any, self.trainer)
        if trainer.fast_dev_run:
            return
        flow = {k: v for k, v in self.sit.state_dict().items() if not k.startswith("average.")}
        settings = {
            "sit": weights_sha256(flow),
            "seed": self.seed,
            "every": _EVERY,
            "precision": trainer.precision,
            "guidance": None if self.guidance is None else asdict(self.guidance),
        }
        shape = (_POINTS + 1, *self.latent_shape)
        root = Path(self.latents_dir or Path(trainer.default_root_dir) / "latents")
        cache = tensor_cache(root, "trajectory", settings, shape, "float16")
        names = [f"trajectory_{index:07d}" for index in range(self.trajectories)]
        items = [_Noise(i, name, cache.folder, (name, 0, 0)) for i, name in enumerate(names)]
        size = trainer.datamodule.batch_size

        def points(noises: list[_Noise]) -> Iterator[Tensor]:
            for first in range(0, len(noises), size):
                indices = [item.index for item in noises[first : first + size]]
                with trainer.precision_plugin.forward_context():
                    rows = self.solve(indices)
                yield rows

        self._cached = fill_cache(trainer, cache, items, points)

    def flow_velocity(self, sit: AverageVelocitySiT) -> Velocity:
        """Function ``(x (B, C, h, w), time (B,))`` to the velocity that trajectories follow."""
        guidance = self.guidance
        if guidance is None:
            return sit.velocity

        def guided(latents: Tensor, time: Tensor) -> Tensor:
            return guided_velocity_at(sit, latents, sit.modulations(time), guidance)

        return guided

    @torch.no_grad()
    def solve(self, indices: list[int]) -> Tensor:
        """Points ``(B, 9, C, h, w)`` of trajectories, at the times of 8 average steps."""
        generators = [random_generator([self.seed, 2, index], bits=32) for index in indices]
        noise = torch.stack([torch.randn(self.latent_shape, generator=g) for g in generators])
        points = [noise.to(self.device)]

        def keep(x: Tensor, time: float, index: int) -> Tensor:
            if index % _EVERY == 0:
                points.append(x)
            return x

        times = ode_times(_POINTS * _EVERY, shift=TIME_SHIFT)
        velocity = self.flow_velocity(cast(AverageVelocitySiT, self.sit))
        ab3(velocity, points[0], times, after_step=keep)
        return torch.stack(points, dim=1)

    def trainable(self) -> dict[str, nn.Module]:
        """The copied blocks of the SiT, and the thin decoder."""
        networks: dict[str, nn.Module] = {"sit": self.sit}
        return networks | ({} if self.thin_decoder is None else {"thin_decoder": self.thin_decoder})

    def draw_path(self, num_samples: int, number: int | None = None) -> PathDraws:
        """Draws of a step; ``noise`` are points of trajectories, which batches take in turn.

        ``time``, uniform in [0, 1), selects two of the points.
        """
        draws = super().draw_path(num_samples, number)
        number = self.batch_number if number is None else number
        world = self.trainer.world_size
        first = number * num_samples * world + self.global_rank
        indices = [(first + i * world) % self.trajectories for i in range(num_samples)]
        if self._cached is None:  # of a fast_dev_run
            points = self.solve(indices)
        else:
            items = self._cached.items
            points = torch.stack([self._cached.read(items[index]) for index in indices])
        return draws._replace(noise=points.to(draws.noise))

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on points of trajectories, and on range images or their posteriors."""
        latents, draws = self.draw_latents(batch)
        points = draws.noise
        pair = _PAIRS.to(points.device)[(draws.time * len(_PAIRS)).long()]
        time, target = average_times(_POINTS).to(draws.time)[pair].unbind(dim=1)
        each = torch.arange(len(pair), device=points.device)
        x, end = self._starts(points, pair), points[each, pair[:, 1]]
        average = (x - end) / per_sample(time - target, x)

        predicted = cast(AverageVelocitySiT, self.sit).average_velocity(x, time, target)
        error = losses.flow_matching_loss(predicted, average)
        parts = {"denoising": self.weights.denoising * error.mean()}
        return self.weigh_and_log(parts | self._decoder_losses(latents))

    @torch.no_grad()
    def _starts(self, points: Tensor, pair: Tensor) -> Tensor:
        """Latents ``(B, C, h, w)`` that a step from ``pair[:, 0]`` to ``pair[:, 1]`` starts from.

        Where a step as long before it leads, so that it learns to mend its errors. Steps from the
        noise and the shortest ones start from the trajectory, after a step of length 0.
        """
        first, length = pair[:, 0], pair[:, 1] - pair[:, 0]
        before = torch.where(length > 1, (first - length).clamp(min=0), first)
        x = points[torch.arange(len(points), device=points.device), before]
        time, target = average_times(_POINTS).to(points)[torch.stack([before, first])]
        slope = cast(AverageVelocitySiT, self.sit).average_velocity(x, time, target)
        # Older releases of torch keep the weights that autocast has cast here, without gradient.
        torch.clear_autocast_cache()
        return x + per_sample(target - time, x) * slope.to(x)

    def held_out_errors(
        self, reconstruction: Tensor, latents: Tensor, draws: PathDraws
    ) -> dict[str, Tensor | tuple[Tensor, Tensor]]:
        """Squared distance of 1 and 4 average steps from the end of AB3; errors of the decoder."""
        sit = cast(AverageVelocitySiT, (self.ema or self).sit)
        errors: dict[str, Tensor | tuple[Tensor, Tensor]] = {}
        end = ab3(self.flow_velocity(sit), draws.noise, ode_times(16, shift=TIME_SHIFT))
        for num in (1, 4):
            reached = average_velocity_steps(sit.average_velocity, draws.noise, average_times(num))
            errors[f"endpoint_{num}"] = losses.flow_matching_loss(reached, end)
        if self.thin_decoder is not None:
            errors |= self._thin_decoder_errors(reconstruction, self.thin_decoder.decode(latents))
        return errors

    def _thin_decoder_errors(
        self, reconstruction: Tensor, image: Tensor
    ) -> dict[str, Tensor | tuple[Tensor, Tensor]]:
        """Ranges and returns of the thin decoder beside the VAE's, as sums and counts ``(B,)``."""
        geometry = self.scan_geometry
        full, thin = (
            geometry.codec.ranges_of(each, geometry.projection.sensor)
            for each in (reconstruction, image)
        )
        both, either = (full > 0) & (thin > 0), (full > 0) | (thin > 0)
        num_both = both.flatten(1).sum(dim=1)
        error_m = torch.where(both, (full - thin).abs(), 0.0).flatten(1).sum(dim=1)
        return {
            "thin_range_error_m": (error_m, num_both),
            "thin_return_iou": (num_both, either.flatten(1).sum(dim=1)),
        }

    def _decoder_losses(self, latents: Tensor) -> dict[str, Tensor]:
        """Losses of the thin decoder on a quarter of the global batch, perhaps none of it here."""
        if self.thin_decoder is None:
            return {}
        world = num_processes()
        part = [z for i, z in enumerate(latents) if (self.global_rank + i * world) % _DECODED == 0]
        if not part:
            return {"reconstruction": zero_loss(self.thin_decoder)}
        with torch.no_grad():
            image = self.vae.decode(torch.stack(part))
        losses_of_part = self.reconstruction_losses(
            image, self.thin_decoder.predict(torch.stack(part))
        )
        num_decoded = math.ceil(world * len(latents) / _DECODED)  # of all processes
        weight = world * len(part) / num_decoded  # the mean over processes is one over the part
        return {name: weight * loss for name, loss in losses_of_part.items()}


def _average_weights(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights of the copied blocks alone."""
    return {key: value for key, value in weights.items() if key.startswith("average.")}


def _check_thin_decoder(thin_decoder: ThinDecoder, vae: VAE) -> None:
    """Refuse a thin decoder of other latents or images than the VAE has."""
    names = ("in_channels", "latent_channels", "stride", "modes", "least_scale")
    for name in (*names, "intensity", "num_classes"):
        expected, given = getattr(vae, name), getattr(thin_decoder, name)
        if given != expected:
            raise ValueError(f"model.thin_decoder: {name} is {given}, but {expected} of the VAE")
