"""From noise to scenes: solver over a network, denormalised latents, VAE decoder, range images."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, cast

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from r3dpa.checkpoints import Checkpoint, read_checkpoint
from r3dpa.flow.autoguidance import autoguided, check_scale, extrapolated, renormalised
from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.noise import scene_noise, scene_uniform
from r3dpa.flow.sampler import Quality, SamplerConfig
from r3dpa.flow.solvers import Velocity
from r3dpa.geometry import Pixels, ScanGeometry
from r3dpa.io import usable_device
from r3dpa.nn import VAE, LatentNorm, SiT, VelocityNetwork
from r3dpa.scenes import SceneBatch

_GRAPH_BATCH = 8  # up to this many scenes, starting kernels takes as long as running them


@dataclass(frozen=True)
class Autoguidance:
    """Guidance away from a weaker model, see :func:`r3dpa.flow.autoguided`.

    ``weak`` and ``latent_shift`` ``(C,)`` are on the device of the other networks; the latents of
    the weak model are ``latent_scale * latents + latent_shift``.
    """

    weak: VelocityNetwork
    scale: float
    interval: tuple[float, float] = (0.0, 1.0)
    latent_scale: float = 1.0
    latent_shift: Tensor = field(default_factory=lambda: torch.zeros(1))


class SceneGenerator:
    """Draws scenes from a velocity network and decodes them.

    The random numbers of a scene are a function of (seed, index) alone and are drawn on the CPU:
    up to rounding, a scene depends on neither batch size nor device. The modulations of a solver's
    times are computed once, so weights must not change after the first scene.

    Args:
        vae: Decoder of the latents, which may be a :class:`r3dpa.nn.ThinDecoder`.
        sit: Velocity network, averaged weights as a rule.
        latent_norm: Statistics of the latents the SiT was trained on.
        geometry: Projection and range encoding of the training data.
        sampler: Solver and steps.
        path: Interpolant that the SiT was trained on.
        precision: ``bf16`` runs copies of the networks with bfloat16 weights, see
            :meth:`VelocityNetwork.halve_` and :meth:`VAE.halve_decoder_`; state and solver stay
            float32.
        guidance_scale: Strength of the guidance away from the SiT without one attention map, see
            :meth:`r3dpa.nn.SiT.velocity_pair_at`; 1 for none. Default: that of the SiT, or 1 with
            autoguidance. Average velocities are never guided.
        autoguidance: Weak model and strength.
        batch_size: Pad smaller batches with zeros, so that the networks see a single shape.
        compile: Compile the networks: minutes before the first scene. Needs ``batch_size``. On a
            GPU batches of at most 8 scenes are replayed as CUDA graphs.

    Raises:
        ValueError: If the latent statistics were never fitted, ``batch_size`` is below 1,
            ``compile`` comes without it, a scale is below 1, or networks, geometry, guidance and
            sampler do not fit each other.
    """

    def __init__(
        self,
        vae: VAE,
        sit: VelocityNetwork,
        latent_norm: LatentNorm,
        geometry: ScanGeometry,
        sampler: SamplerConfig = SamplerConfig(),
        path: Literal["linear", "cosine"] = "linear",
        precision: Literal["fp32", "bf16"] = "fp32",
        *,
        guidance_scale: float | None = None,
        autoguidance: Autoguidance | None = None,
        batch_size: int | None = None,
        compile: bool = False,
    ) -> None:
        if not latent_norm.fitted:
            raise ValueError(
                "the latent statistics were never fitted, so latents cannot be denormalised; "
                "sample from a checkpoint of stage joint or flow_matching"
            )
        if batch_size is not None and batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        if compile and batch_size is None:
            raise ValueError("compiled networks have one shape: give SceneGenerator a batch_size")
        check_precision(precision)
        sensor = geometry.projection.sensor
        if vae.latent_size((sensor.beams, sensor.columns)) != tuple(sit.input_size):
            raise ValueError(
                f"the networks make images of {sit.input_size[0] * vae.stride[0]} x "
                f"{sit.input_size[1] * vae.stride[1]} pixels, but their geometry has "
                f"{sensor.beams} beams and {sensor.columns} columns"
            )
        _check_average(sampler, sit, autoguidance)
        self.vae, self.sit = vae.eval(), sit.eval()
        weak = None if autoguidance is None else autoguidance.weak.eval()
        if precision == "bf16":
            self.vae = copy.deepcopy(vae).halve_decoder_()
            self.sit = copy.deepcopy(sit).halve_()
            weak = copy.deepcopy(weak).halve_() if weak is not None else None
        if self.device.type == "cuda":  # its half-precision kernels expect this layout
            self.vae = copy.deepcopy(self.vae)
            self.vae.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.latent_norm, self.geometry = latent_norm.eval(), geometry
        self.sampler, self.interpolant = sampler, Interpolant(path)
        self.precision, self.batch_size = precision, batch_size
        graphs = compile and self.device.type == "cuda" and (batch_size or 0) <= _GRAPH_BATCH
        scale = _checked_scale(guidance_scale, sampler, sit, autoguidance)
        self._strong = _ScheduledNetwork(self.sit, compile, graphs, scale)
        self._weak = None if weak is None else _ScheduledNetwork(weak, compile, graphs)
        self._autoguidance = autoguidance
        self._decode = torch.compile(self.vae.decode, dynamic=False) if compile else self.vae.decode
        self._velocity = self._guided()
        self._scheduled: SamplerConfig | None = None

    @classmethod
    def from_checkpoint(
        cls,
        checkpoint: str | Path | Checkpoint,
        sampler: SamplerConfig | Quality = "good",
        *,
        weights: Literal["ema", "last"] = "ema",
        decoder: Literal["full", "thin"] | None = None,
        device: str = "auto",
        precision: Literal["fp32", "bf16"] = "fp32",
        guidance_scale: float | None = None,
        autoguidance: Autoguidance | None = None,
        batch_size: int | None = None,
        compile: bool = False,
    ) -> Self:
        """Rebuilds the networks of a checkpoint, on the path and geometry they were trained with.

        Args:
            checkpoint: File of stage joint or flow_matching in any layout, or its content; name of
                weights in this package, such as ``r3dpa-s``, or ``hf://owner/name``.
            sampler: Solver and steps, or a quality that selects them.
            weights: Averaged or last weights of the SiT.
            decoder: That of the VAE or the thin one of stage few_step; default: thin for the
                quality ``instant`` where the checkpoint has one, full otherwise.
            device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
            precision: As for the constructor, like all other arguments.
            guidance_scale: See the constructor.
            autoguidance: Weak model, on the same device.
            batch_size: See the constructor.
            compile: See the constructor.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it cannot be read, or a network, the latent statistics or the scan
                geometry is missing.
        """
        checkpoint = opened(checkpoint)
        if checkpoint.stage == "vae_alignment":
            raise ValueError(
                f"{checkpoint.path} is of stage vae_alignment, which trains no velocity; sample "
                "from a checkpoint of stage joint or flow_matching"
            )
        geometry = geometry_of(checkpoint)
        names = ("ema", "ema_latent_norm") if weights == "ema" else ("sit", "latent_norm")
        device = usable_device(device)
        has_thin = "thin_decoder" in checkpoint.networks
        thin = decoder == "thin" or (decoder is None and sampler == "instant" and has_thin)
        decoding = "thin_decoder" if thin else "vae"
        vae, sit, norm = (checkpoint.network(n).build().to(device) for n in (decoding, *names))
        if not (
            isinstance(vae, VAE)
            and isinstance(sit, VelocityNetwork)
            and isinstance(norm, LatentNorm)
        ):
            raise ValueError(
                f"{checkpoint.path} holds other classes than VAE, velocity network and LatentNorm"
            )
        return cls(
            vae,
            sit,
            norm,
            geometry,
            SamplerConfig.of_quality(sampler) if isinstance(sampler, str) else sampler,
            checkpoint.interpolant,
            precision,
            guidance_scale=guidance_scale,
            autoguidance=autoguidance,
            batch_size=batch_size,
            compile=compile,
        )

    from_pretrained = from_checkpoint  # names of `r3dpa models`

    @property
    def device(self) -> torch.device:
        """Device of the networks."""
        return next(self.sit.parameters()).device

    @property
    def guidance_scale(self) -> float:
        """Strength of the guidance of the SiT away from itself; 1 for none."""
        averages = self.sampler.solver == "average_velocity"
        return 1.0 if averages else self._strong.guidance_scale

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Channels, rows and columns of the latents."""
        return self.sit.in_channels, *self.sit.input_size

    def with_sampler(self, sampler: SamplerConfig) -> SceneGenerator:
        """The same networks, compiled where these are, with another solver; both may be used."""
        if not isinstance(sampler, SamplerConfig):
            raise ValueError(f"sampler must be a SamplerConfig, got {sampler!r}")
        _check_average(sampler, self.sit, self._autoguidance)
        other = copy.copy(self)
        other._strong, other._weak = copy.copy(self._strong), copy.copy(self._weak)
        other._velocity = other._guided()
        other.sampler, other._scheduled = sampler, None
        return other

    @torch.inference_mode()
    def prepare(self) -> None:
        """Does the set-up of the first scene; raises the errors of :meth:`SamplerConfig.solve`.

        Computes the modulations of all times of the solver: a run with velocities of 0 lists them.
        """
        if self._scheduled == self.sampler:
            return
        for network in self._networks:
            network.times, network.targets, network.table = [], [], None
        noise = torch.zeros(1, *self.latent_shape, device=self.device)
        self._solve(noise, iter(lambda: noise, None))
        for network in self._networks:
            network.fill_table()
        self._scheduled = self.sampler

    @torch.inference_mode()
    def generate(self, indices: int | Sequence[int], seed: int = 0) -> SceneBatch:
        """Draws one scene per index, asynchronously on a GPU.

        Args:
            indices: Numbers of the scenes, or how many: 4 for ``range(4)``; at most ``batch_size``.
            seed: Number of the collection.
        """
        indices = scene_indices(indices)
        size = self.batch_size or len(indices)
        if len(indices) > size:
            raise ValueError(f"batch_size is {size}, but {len(indices)} scenes are requested")
        self.prepare()
        for network in self._networks:
            network.calls = 0
        noise = scene_noise(self.latent_shape, indices, seed)
        draws = (filled(x, size).to(self.device) for x in noise)
        latents = self._solve(next(draws), draws)[: len(indices)]
        nfe, projection = sum(one.evaluations for one in self._networks), self.geometry.projection
        return SceneBatch.of(self.decode_pixels(latents, indices, seed), latents, nfe, projection)

    @torch.no_grad()
    def decode(
        self, latents: Tensor, indices: Sequence[int] | None = None, seed: int = 0
    ) -> Tensor:
        """Range images ``(B, H, W)``, metres, as in :class:`SceneBatch`, of normalised latents.

        See :meth:`decode_pixels`.
        """
        return self.decode_pixels(latents, indices, seed).range_m

    @torch.no_grad()
    def decode_pixels(
        self, latents: Tensor, indices: Sequence[int] | None = None, seed: int = 0
    ) -> Pixels:
        """Ranges of normalised latents, and intensities and classes where the VAE has them.

        Where images have a return channel, scenes with numbers ``indices`` of the collection
        ``seed`` lose single returns at random, see :meth:`r3dpa.geometry.RangeCodec.drop_returns`.
        """
        size = self.batch_size or len(latents)
        sensor, codec, parts = self.geometry.projection.sensor, self.geometry.codec, []
        for first in range(0, len(latents), size):
            part = self.latent_norm.denormalise(latents[first : first + size])
            image = self._decode(filled(part, size))[: len(part)].float()
            finite = image.flatten(1).isfinite().all(dim=1)
            if indices is not None and codec.return_channel:
                uniform = scene_uniform(image.shape[2:], indices[first : first + size], seed)
                image = codec.drop_returns(image, uniform.to(image.device))
            pixels = codec.pixels_of(image, sensor)
            range_m = torch.where(finite[:, None, None], pixels.range_m, torch.nan)
            parts.append(pixels._replace(range_m=range_m))
        joined: list[Any] = [
            None if own[0] is None else torch.cat(own) for own in zip(*parts, strict=True)
        ]
        return Pixels(*joined)

    def velocity(self, latents: Tensor, time: Tensor) -> Tensor:
        """Unguided velocity ``(B, C, h, w)`` at times ``(B,)``, in the dtype of the latents."""
        return self.sit.velocity(latents.float(), time.float()).to(latents.dtype)

    def noise(self, indices: Sequence[int], seed: int = 0) -> Tensor:
        """First noise ``(B, C, h, w)`` of scenes, on the device of the networks."""
        return next(scene_noise(self.latent_shape, indices, seed)).to(self.device)

    @property
    def _networks(self) -> list[_ScheduledNetwork]:
        return [self._strong, *([] if self._weak is None else [self._weak])]

    def _solve(self, noise: Tensor, draws: Iterator[Tensor]) -> Tensor:
        return self.sampler.solve(self._velocity, noise, draws, self.interpolant)

    def _guided(self) -> Velocity:
        """Velocity of the solver; made once, since ``renormalised`` reads the shift."""
        guidance = self._autoguidance
        if guidance is None or self._weak is None:
            return self._strong
        scale, shift = guidance.latent_scale, guidance.latent_shift
        weak = renormalised(self._weak, scale, shift, self.interpolant)
        return autoguided(self._strong, weak, guidance.scale, guidance.interval)


def opened(checkpoint: str | Path | Checkpoint) -> Checkpoint:
    """Content of a checkpoint that may be given as its file or name."""
    return checkpoint if isinstance(checkpoint, Checkpoint) else read_checkpoint(checkpoint)


def geometry_of(checkpoint: Checkpoint) -> ScanGeometry:
    """Projection and range encoding of a checkpoint; ``ValueError`` if it records none."""
    if checkpoint.geometry is None:
        raise ValueError(
            f"{checkpoint.path} does not record which sensor it was trained for; convert it from "
            "its official file with `r3dpa convert --encoding linear` (or log2)"
        )
    return ScanGeometry.from_dict(dict(checkpoint.geometry))


def check_precision(precision: str) -> None:
    """Refuses a precision that no generator has."""
    if precision not in ("fp32", "bf16"):
        raise ValueError(f"unknown precision {precision!r}; choose from fp32, bf16")


def _check_average(
    sampler: SamplerConfig, sit: VelocityNetwork, autoguidance: Autoguidance | None
) -> None:
    average = getattr(sit, "average", None)
    if sampler.solver == "average_velocity" and (average is None or autoguidance is not None):
        raise ValueError(
            "solver average_velocity needs a network that predicts average velocities, from a "
            "checkpoint of stage few_step, and no autoguidance: drop autoguidance, or take another "
            "solver or quality"
        )


def _checked_scale(
    given: float | None,
    sampler: SamplerConfig,
    sit: VelocityNetwork,
    autoguidance: Autoguidance | None,
) -> float:
    usual = 1.0 if autoguidance else sit.guidance_scale
    scale = usual if given is None else given
    check_scale(scale)
    if scale != 1 and not sit.guidance_block:
        raise ValueError(
            f"guidance_scale {scale:g} needs a network with guidance_block, such as that of "
            "r3dpa-s, or a weaker model (autoguidance)"
        )
    if given not in (None, 1) and sampler.solver == "average_velocity":
        raise ValueError(
            f"average velocities are never guided: drop guidance_scale {scale:g}, or take another "
            "solver or quality"
        )
    return scale


class _ScheduledNetwork:
    """A network as the velocity function of a solver.

    All samples of a call have the same time. A trial run records the times; afterwards the k-th
    call takes row k of their modulations, so that no value of a time is read back from a GPU.

    Attributes:
        times: Those of the trial run, each ``(1,)``.
        targets: Target times of average velocities, likewise.
        table: ``(T, M)`` their modulations, after the trial run.
        calls: Velocities since it was set to 0.
    """

    def __init__(
        self, sit: VelocityNetwork, compile: bool, graphs: bool, guidance_scale: float = 1.0
    ) -> None:
        self.sit, self.guidance_scale = sit, guidance_scale
        self.times: list[Tensor] = []
        self.targets: list[Tensor] = []
        self.table: Tensor | None = None
        self.calls = 0
        self._graphs = graphs
        mode = "reduce-overhead" if graphs else None
        parts = self._networks if compile else []
        self._compiled = [torch.compile(part, dynamic=False, mode=mode) for part in parts]

    @property
    def _networks(self) -> list[Callable[[Tensor, Tensor], Tensor]]:
        average = [self.sit.average_velocity_at] if isinstance(self.sit, SiT) else []
        return [self.sit.velocity_at if self.guidance_scale == 1 else self._guided, *average]

    @property
    def evaluations(self) -> int:
        """Network evaluations since ``calls`` was set to 0, two of each guided velocity."""
        guided = self.guidance_scale != 1 and not self.targets
        return self.calls * (2 if guided else 1)

    def _guided(self, latents: Tensor, modulations: Tensor) -> Tensor:
        pair = cast(SiT, self.sit).velocity_pair_at(latents, modulations)
        return extrapolated(*pair, self.guidance_scale)

    def fill_table(self) -> None:
        """Ends the trial run."""
        if self.targets:
            sit = cast(SiT, self.sit)
            self.table = sit.modulations(torch.cat(self.times), target=torch.cat(self.targets))
        elif self.times:  # a weak model may be unused
            self.table = self.sit.modulations(torch.cat(self.times))

    def __call__(self, latents: Tensor, time: Tensor, target: Tensor | None = None) -> Tensor:
        """Velocity ``(B, C, h, w)`` float32 at a time ``(B,)`` that all samples share.

        With a target time, the average velocity until then.
        """
        if self.table is None:
            self.times.append(time[:1])
            self.targets += [] if target is None else [target[:1]]
            return torch.zeros_like(latents)
        row = self.table[self.calls : self.calls + 1]
        self.calls += 1
        velocity = (self._compiled or self._networks)[target is not None](latents, row)
        return velocity.clone() if self._graphs else velocity  # a replay writes to one place


def filled(values: Tensor, size: int) -> Tensor:
    """``(B, C, h, w)`` with zeros up to ``size`` samples."""
    return F.pad(values, (0, 0, 0, 0, 0, 0, 0, size - len(values)))


def scene_indices(indices: int | Sequence[int]) -> Sequence[int]:
    """Numbers of scenes; a number stands for that many from 0 on. ``ValueError`` for none."""
    if isinstance(indices, bool | str | float):
        raise ValueError(f"give a number of scenes or their indices, got {indices!r}")
    numbers = range(int(indices)) if isinstance(indices, int | np.integer) else indices
    if len(numbers) == 0:
        raise ValueError("no scene is asked for: give a number of at least 1, or their indices")
    return numbers
