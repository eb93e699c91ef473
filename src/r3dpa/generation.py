"""From noise to scenes: solver over a network, denormalised latents, VAE decoder, range images."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from r3dpa.checkpoints import Checkpoint, read_checkpoint
from r3dpa.flow.autoguidance import (
    PerturbedAttention,
    autoguided,
    check_scale,
    renormalised,
    renormalised_times,
)
from r3dpa.flow.interpolant import Interpolant
from r3dpa.flow.noise import scene_noise, scene_normal, scene_uniform
from r3dpa.flow.sampler import Quality, SamplerConfig
from r3dpa.flow.solvers import Velocity
from r3dpa.geometry import Pixels, ScanGeometry
from r3dpa.io import usable_device
from r3dpa.nn import VAE, AverageVelocitySiT, LatentNorm, VelocityNetwork
from r3dpa.scenes import SceneBatch
from r3dpa.scheduled_velocity import Autoguidance, ScheduledVelocity

_RANGE_NOISE_M = 0.01  # of one surface in the scans that r3dpa-s has learned
_GRAPH_BATCH = 8  # up to this many scenes, starting kernels takes as long as running them


class SceneGenerator:
    """Draws scenes from a velocity network and decodes them.

    The random numbers of a scene are a function of (seed, index) alone and are drawn on the CPU:
    up to rounding, a scene depends on neither batch size nor device; a few pixels at outlines may
    be decoded to the other side of their edge. The modulations of a solver's
    times are computed once, so weights must not change after the first scene.

    Args:
        vae: Decoder of the latents, which may be a :class:`r3dpa.nn.ThinDecoder`.
        sit: Velocity network, averaged weights as a rule.
        latent_norm: Statistics of the latents the SiT was trained on.
        geometry: Projection and range encoding of the training data.
        sampler: Solver and steps.
        path: Interpolant that the SiT was trained on.
        precision: ``bf16`` runs copies of the networks with bfloat16 weights, see
            :meth:`VelocityNetwork.to_bfloat16_` and :meth:`VAE.decoder_to_bfloat16_`; state and
            solver stay float32.
        guidance: Block and strength of perturbed-attention guidance, for a SiT. Average velocities
            are never guided, though their training may have been.
        autoguidance: Weak model and strength.
        batch_size: Pad smaller batches with zeros, so that the networks see a single shape.
        compile: Compile the networks: minutes before the first scene. Needs ``batch_size``. On a
            GPU batches of at most 8 scenes are replayed as CUDA graphs.

    Raises:
        ValueError: If the latent statistics were never fitted, ``batch_size`` is below 1,
            ``compile`` comes without it, or networks, geometry, guidance and sampler do not fit
            each other.

    Example:
        >>> generator = SceneGenerator.from_pretrained(
        ...     "r3dpa-s", SamplerConfig("average_velocity", steps=1), device="cpu"
        ... )
        >>> scenes = generator.generate(1)
        >>> tuple(scenes.range_m.shape), scenes.points(0).shape[1]
        ((1, 64, 1024), 3)
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
        guidance: PerturbedAttention | None = None,
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
            self.vae = copy.deepcopy(vae).decoder_to_bfloat16_()
            self.sit = copy.deepcopy(sit).to_bfloat16_()
            weak = copy.deepcopy(weak).to_bfloat16_() if weak is not None else None
        self.latent_norm, self.geometry = latent_norm.eval(), geometry
        self.sampler, self.interpolant = sampler, Interpolant(path)
        self.precision, self.batch_size, self.compiled = precision, batch_size, compile
        self._use_channels_last_on_gpu()
        graphs = compile and self.device.type == "cuda" and (batch_size or 0) <= _GRAPH_BATCH
        if guidance is not None and guidance.scale == 1:
            guidance = None
        self._strong = ScheduledVelocity(self.sit, compile, graphs, guidance)
        self._weak = None if weak is None else ScheduledVelocity(weak, compile, graphs)
        self._autoguidance = autoguidance
        self._decode = torch.compile(self.vae.decode, dynamic=False) if compile else self.vae.decode
        self._velocity: Velocity = self._strong
        self._prepared: tuple[SamplerConfig, torch.device] | None = None

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
        """Rebuild the networks of a checkpoint, on the path and geometry they were trained with.

        Args:
            checkpoint: File of stage joint or flow_matching in any layout, or its content; name of
                weights in this package, such as ``r3dpa-s``, or ``hf://owner/name``.
            sampler: Solver and steps, or a quality that selects them.
            weights: Averaged or last weights of the SiT.
            decoder: Decoder of the VAE, or the thin one of stage few_step; default: thin for the
                quality ``instant`` where the checkpoint has one, full otherwise.
            device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
            precision: See the constructor.
            guidance_scale: Strength of perturbed-attention guidance, 1 for none. Default: as the
                checkpoint records, or 1 with autoguidance.
            autoguidance: Weak model, on the same device.
            batch_size: See the constructor.
            compile: See the constructor.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it cannot be read, or a network, the latent statistics or the scan
                geometry is missing.
        """
        _check_choice("weights", weights, ("ema", "last"))
        _check_choice("decoder", decoder, ("full", "thin", None))
        checkpoint = open_checkpoint(checkpoint)
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
        if isinstance(sampler, str):
            sampler = SamplerConfig.of_quality(sampler)
        guidance = None
        if guidance_scale is not None or autoguidance is None:
            guidance = recorded_guidance(checkpoint, guidance_scale)
        if guidance_scale not in (None, 1) and sampler.solver == "average_velocity":
            raise ValueError(
                f"average velocities are never guided: drop guidance_scale {guidance_scale:g}, or "
                "take another solver or quality"
            )
        return cls(
            vae,
            sit,
            norm,
            geometry,
            sampler,
            checkpoint.interpolant,
            precision,
            guidance=guidance,
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
        """Strength of perturbed-attention guidance; 1 for none."""
        guidance = self._strong.guidance
        if guidance is None or self.sampler.solver == "average_velocity":
            return 1.0
        return guidance.scale

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Channels, rows and columns of the latents."""
        return self.sit.in_channels, *self.sit.input_size

    def __repr__(self) -> str:
        sensor, sampler = self.geometry.projection.sensor, self.sampler
        return (
            f"SceneGenerator({sensor.beams} x {sensor.columns} pixels, {sampler.solver} with "
            f"{sampler.steps} steps, guidance_scale {self.guidance_scale:g}, {self.precision}, "
            f"{self.device})"
        )

    def to(self, device: str | torch.device) -> Self:
        """Move the networks, and return the generator itself."""
        if self.compiled:
            raise ValueError(
                "compiled networks cannot move: build the generator on the other device"
            )
        device = usable_device(str(device))
        for network in (self.vae, self.sit, self.latent_norm):
            network.to(device)
        if self._weak is not None:
            self._weak.sit.to(device)
        self._use_channels_last_on_gpu()
        self._decode = self.vae.decode
        return self

    def with_sampler(self, sampler: SamplerConfig) -> SceneGenerator:
        """Return a generator of another solver that shares the networks and their compiled code.

        Both generators stay usable.
        """
        if not isinstance(sampler, SamplerConfig):
            raise ValueError(f"sampler must be a SamplerConfig, got {sampler!r}")
        _check_average(sampler, self.sit, self._autoguidance)
        other = copy.copy(self)
        # Their schedules differ; evaluation stays bound to the originals, to share compiled code.
        other._strong, other._weak = copy.copy(self._strong), copy.copy(self._weak)
        other.sampler, other._prepared = sampler, None
        return other

    @torch.no_grad()
    def prepare(self) -> None:
        """Precompute the modulations of all times of the solver, which the first scene needs.

        Raises:
            ValueError: If the times of the sampler are out of range.
        """
        if self._prepared == (self.sampler, self.device):
            return
        times = self.sampler.times().float()
        target = None
        if self.sampler.solver == "average_velocity":
            target = torch.cat([times[1:], torch.zeros(1)]).to(self.device)
        self._strong.schedule(times.to(self.device), target)
        self._velocity = self._strong
        guide = self._autoguidance
        if guide is not None and self._weak is not None:
            scale, shift = guide.latent_scale, guide.latent_shift.to(self.device)
            first, last = guide.interval
            guided = times[(times >= first) & (times <= last) & (guide.scale != 1)]
            weak_times = renormalised_times(guided.to(self.device), scale, shift, self.interpolant)
            self._weak.schedule(weak_times)
            weak = renormalised(self._weak, scale, shift, self.interpolant)
            self._velocity = autoguided(self._strong, weak, guide.scale, guide.interval)
        self._prepared = (self.sampler, self.device)

    @torch.no_grad()
    def generate(
        self, indices: int | Sequence[int], seed: int = 0, *, progress: bool = False
    ) -> SceneBatch:
        """Draw one scene per index, asynchronously on a GPU.

        Args:
            indices: Numbers of the scenes, or how many: 4 for ``range(4)``; at most ``batch_size``.
            seed: Number of the collection.
            progress: Show a bar of the solver's steps.
        """
        indices = scene_indices(indices)
        size = self.batch_size or len(indices)
        if len(indices) > size:
            raise ValueError(f"batch_size is {size}, but {len(indices)} scenes are requested")
        self.prepare()
        networks = [self._strong] if self._weak is None else [self._strong, self._weak]
        for network in networks:
            network.restart()
        noise = scene_noise(self.latent_shape, indices, seed)
        draws = (pad_batch(x, size).to(self.device) for x in noise)
        with tqdm(total=self._strong.num_times, desc="sampling", disable=not progress) as bar:

            def velocity(*inputs: Tensor) -> Tensor:
                bar.update()
                return self._velocity(*inputs)

            latents = self.sampler.solve(velocity, next(draws), draws, self.interpolant)
        latents = latents[: len(indices)]
        pixels = self.decode_pixels(latents, indices, seed)
        nfe = sum(network.evaluations for network in networks)
        return SceneBatch.of(pixels, latents, nfe, self.geometry.projection)

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

        Scenes with numbers ``indices`` of the collection ``seed`` get back what a VAE does not
        encode: where images have a return channel, they lose single returns at random, see
        :meth:`r3dpa.geometry.RangeCodec.drop_returns`, and where the decoder smooths ranges along
        rings (two modes), they have range noise of 1 cm, as scans have.

        Raises:
            ValueError: If the latents do not have the shape of the VAE's latents, or the indices
                are not one per scene.
        """
        if latents.ndim != 4 or latents.shape[1:] != self.latent_shape:
            sizes = ", ".join(map(str, self.latent_shape))
            raise ValueError(f"latents must have shape (B, {sizes}), got {tuple(latents.shape)}")
        if indices is not None and len(indices) != len(latents):
            raise ValueError(f"{len(latents)} scenes need as many indices, got {len(indices)}")
        if not len(latents):
            raise ValueError("there are no latents to decode: give latents of one scene or more")
        size = self.batch_size or len(latents)
        sensor, codec, parts = self.geometry.projection.sensor, self.geometry.codec, []
        for first in range(0, len(latents), size):
            part = self.latent_norm.denormalise(latents[first : first + size].float())
            image = self._decode(pad_batch(part, size))[: len(part)].float()
            finite = image.flatten(1).isfinite().all(dim=1)
            numbers = None if indices is None else indices[first : first + size]
            if numbers is not None and codec.return_channel:
                uniform = scene_uniform(image.shape[2:], numbers, seed)
                image = codec.drop_returns(image, uniform.to(image.device))
            pixels = codec.pixels_of(image, sensor)
            range_m = pixels.range_m
            if numbers is not None and self.vae.modes == 2:
                range_m = self._with_noise(range_m, numbers, seed)
            range_m = torch.where(finite[:, None, None], range_m, torch.nan)
            parts.append(pixels._replace(range_m=range_m))
        joined: list[Any] = [
            None if values[0] is None else torch.cat(values) for values in zip(*parts, strict=True)
        ]
        return Pixels(*joined)

    def _with_noise(self, range_m: Tensor, indices: Sequence[int], seed: int) -> Tensor:
        """Ranges ``(B, H, W)`` with the noise of a sensor, but not beyond its limits."""
        sensor = self.geometry.projection.sensor
        noise = scene_normal(range_m.shape[1:], indices, seed).to(range_m)
        noisy = range_m + _RANGE_NOISE_M * noise
        inside = (noisy > sensor.range_min_m) & (noisy < sensor.range_max_m)
        return torch.where(inside, noisy, range_m)

    def velocity(self, latents: Tensor, time: Tensor) -> Tensor:
        """Unguided velocity ``(B, C, h, w)`` at times ``(B,)``, in the dtype of the latents."""
        return self.sit.velocity(latents.float(), time.float()).to(latents.dtype)

    def noise(self, indices: Sequence[int], seed: int = 0) -> Tensor:
        """First noise ``(B, C, h, w)`` of scenes, on the device of the networks."""
        return next(scene_noise(self.latent_shape, indices, seed)).to(self.device)

    def _use_channels_last_on_gpu(self) -> None:
        """Give a copy of the decoder the layout that half-precision kernels of a GPU expect."""
        if self.device.type == "cuda":
            self.vae = copy.deepcopy(self.vae)
            self.vae.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def open_checkpoint(checkpoint: str | Path | Checkpoint) -> Checkpoint:
    """Content of a checkpoint that may be given as its file or name."""
    return checkpoint if isinstance(checkpoint, Checkpoint) else read_checkpoint(checkpoint)


def geometry_of(checkpoint: Checkpoint) -> ScanGeometry:
    """Projection and range encoding of a checkpoint.

    Raises:
        ValueError: If it records none.
    """
    if checkpoint.geometry is None:
        raise ValueError(
            f"{checkpoint.path} does not record which sensor it was trained for; convert it from "
            "its official file with `r3dpa convert --encoding linear` (or log2)"
        )
    return ScanGeometry.from_dict(dict(checkpoint.geometry))


def _check_choice(name: str, value: str | None, choices: tuple[str | None, ...]) -> None:
    if value not in choices:
        names = ", ".join(str(choice) for choice in choices)
        raise ValueError(f"unknown {name} {value!r}; choose from {names}")


def check_precision(precision: str) -> None:
    """Refuse a precision that no generator has."""
    _check_choice("precision", precision, ("fp32", "bf16"))


def recorded_guidance(
    checkpoint: Checkpoint, scale: float | None = None
) -> PerturbedAttention | None:
    """Perturbed-attention guidance that a checkpoint records, at its strength or at another.

    Raises:
        ValueError: If a strength above 1 is given, but the checkpoint names no block.
    """
    recorded = checkpoint.sampling.get("perturbed_attention")
    if recorded is None:
        if scale is not None and scale != 1:
            check_scale(scale)
            raise ValueError(
                f"guidance_scale {scale:g} needs a checkpoint that records perturbed_attention, "
                "such as r3dpa-s, or a weaker model (autoguidance)"
            )
        return None
    return PerturbedAttention(recorded["block"], recorded["scale"] if scale is None else scale)


def _check_average(
    sampler: SamplerConfig, sit: VelocityNetwork, autoguidance: Autoguidance | None
) -> None:
    if sampler.solver != "average_velocity":
        return
    if not isinstance(sit, AverageVelocitySiT) or autoguidance is not None:
        raise ValueError(
            "solver average_velocity needs a network that predicts average velocities, from a "
            "checkpoint of stage few_step, and no autoguidance: drop autoguidance, or take another "
            "solver or quality"
        )


def pad_batch(values: Tensor, size: int) -> Tensor:
    """``(B, C, h, w)`` with zeros up to ``size`` samples."""
    return F.pad(values, (0, 0, 0, 0, 0, 0, 0, size - len(values)))


def scene_indices(indices: int | Sequence[int]) -> Sequence[int]:
    """Numbers of scenes; a single number n stands for 0 to n - 1.

    Raises:
        ValueError: If there is none, or one is no whole number of 0 or greater.
    """
    if isinstance(indices, Tensor | np.ndarray):
        indices = indices.tolist()
    if isinstance(indices, int | np.integer) and not isinstance(indices, bool):
        numbers: Sequence[int] = range(int(indices))
    elif isinstance(indices, Sequence) and not isinstance(indices, str):
        numbers = indices
    else:
        raise ValueError(f"give a number of scenes or their indices, got {indices!r}")
    if len(numbers) == 0:
        raise ValueError("no scene is requested: give a number of at least 1, or indices")
    for number in numbers:
        if not isinstance(number, int | np.integer) or number < 0:
            raise ValueError(
                f"indices of scenes must be whole numbers, 0 or greater, got {number!r}"
            )
    return numbers
