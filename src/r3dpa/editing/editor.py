"""Edits of scans with an unconditional model: inpaint, mix, complete, vary, interpolate.

Arguments outside the ranges that the docstrings state are a ``ValueError``.
Letters: B scenes, S sources, H beams, W columns, C latent channels, h x w latent size, N tokens,
F feature width.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Self

import torch
from torch import Tensor

from r3dpa.checkpoints import Checkpoint
from r3dpa.editing.gaps import filled, range_error_m, refined
from r3dpa.editing.latents import Trajectory, invert, kept, renoised, spherical_mean
from r3dpa.editing.regions import check_mask, mask_of_tokens, token_mask
from r3dpa.flow.guidance import FeatureGuidance, FeatureTarget
from r3dpa.flow.noise import scene_noise
from r3dpa.flow.solvers import ODE_SOLVERS, AfterStep, Velocity, evaluations, ode_solver, unchanged
from r3dpa.flow.times import batch_time, check_interval, ode_times
from r3dpa.generation import SamplerConfig, SceneBatch, SceneGenerator, scene_indices

_FIT_STEPS, _FIT_RATE = 3, 0.05  # of Adam, at each time of a completion
_FIT_SMOOTH = 0.01  # of encoded range: errors below count by their square
_FIT_EPS = 0.1  # of the gradient's length: less would make steps of the rounding of small ones


@dataclass(frozen=True)
class EditSettings:
    """Settings of the inversion of latents to noise and back.

    Args:
        solver: A key of :data:`r3dpa.flow.ODE_SOLVERS`. Midpoint steps have by far the smallest
            round-trip error per evaluation.
        steps: Solver steps of a whole way.
        shift: Finer steps near noise (above 1) or data (below 1).
        strength: Length of the guidance term in velocities, in [0, 1]; 0 for none.
        window: First and last time that is guided; 0 data, 1 noise.
    """

    solver: str = "midpoint"
    steps: int = 32
    shift: float = 1.0
    strength: float = 0.5
    window: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        if self.solver not in ODE_SOLVERS:
            raise ValueError(
                f"edits need a solver that runs both ways, one of {', '.join(ODE_SOLVERS)}; got "
                f"{self.solver!r}"
            )
        self.times(1.0)
        if not 0 <= self.strength <= 1:
            raise ValueError(f"strength must lie in 0..1, got {self.strength:g}; 0.5 is strong")
        check_interval(self.window, "window")

    def times(self, start: float) -> Tensor:
        """Times from ``start`` in (0, 1] to the data."""
        if not 0 < start <= 1:
            raise ValueError(f"start must be a time above 0 (scan) up to 1 (noise), got {start:g}")
        return ode_times(self.steps, start, shift=self.shift)


@dataclass(frozen=True, eq=False)
class EditResult(SceneBatch):
    """Edited scenes, on the CPU; ``nfe`` includes the evaluations of an inversion.

    Attributes:
        vae_error_m: Mean absolute range error of the scans after encoder and decoder alone; None
            where no scan is encoded.
        round_trip_m: Mean absolute range error of inversion and back without an edit, relative to
            the same; at most this is added to ``vae_error_m``. None without inversion.
        cosine: ``(B,)`` mean cosine between projected features of the latents and the features
            that guided them; None without features.
    """

    vae_error_m: float | None = None
    round_trip_m: float | None = None
    cosine: Tensor | None = None


class SceneEditor:
    """Edits scans with the networks of a generator.

    The random numbers of a scene are a function of (seed, index) alone, as in the generator. The
    solver and the guidance scale of the generator are not used. Where images have a return channel,
    inpainted parts, mixtures and variations lose single returns at random, as its scenes do;
    completions do not.

    Args:
        generator: Networks and geometry; float32. Their weights no longer require gradients, which
            guided edits would store activations for.
        settings: Solver and guidance.
        batch_size: Scenes made together.
    """

    def __init__(
        self,
        generator: SceneGenerator,
        settings: EditSettings = EditSettings(),
        batch_size: int = 8,
    ) -> None:
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}")
        if generator.precision != "fp32":
            raise ValueError(f"edits need networks in fp32, got {generator.precision}")
        self.generator, self.settings, self.batch_size = generator, settings, batch_size
        self._sit = generator.sit
        self._nfe = evaluations(settings.solver, settings.steps)
        for network in (generator.sit, generator.vae):
            network.requires_grad_(False)

    @classmethod
    def from_checkpoint(
        cls,
        checkpoint: str | Path | Checkpoint,
        settings: EditSettings = EditSettings(),
        *,
        weights: Literal["ema", "last"] = "ema",
        device: str = "auto",
        batch_size: int = 8,
    ) -> Self:
        """Rebuilds the networks of a checkpoint, see :meth:`SceneGenerator.from_checkpoint`."""
        generator = SceneGenerator.from_checkpoint(
            checkpoint, SamplerConfig(), weights=weights, device=device
        )
        return cls(generator, settings, batch_size)

    from_pretrained = from_checkpoint  # names of `r3dpa models`

    @torch.no_grad()
    def encode(self, range_m: Tensor) -> Tensor:
        """Normalised latents ``(B, C, h, w)`` of range images ``(B, H, W)``, means of the VAE."""
        image = self.generator.geometry.codec.to_image(range_m.to(self.generator.device))
        return self.generator.latent_norm.normalise(self.generator.vae.encode(image).mean)

    @torch.no_grad()
    def inpaint(
        self,
        range_m: Tensor,
        pixel_mask: Tensor,
        indices: int | Sequence[int],
        seed: int = 0,
        *,
        feature: Tensor | None = None,
        start: float = 1.0,
        dilation: int = 0,
    ) -> EditResult:
        """Generate the inside of a mask anew, guided towards an object.

        The scan is inverted, the tokens that the mask touches get fresh noise, and on the way back
        all others are restored after every step. Pixels outside the mask are those of the scan.

        Source: R3DPA (ICRA 2026), object inpainting; there the other tokens are not put back.

        Args:
            range_m: ``(H, W)`` metres, -1 without a return.
            pixel_mask: ``(H, W)`` bool, True where the scan is to change; neither empty nor full,
                in tokens too.
            indices: Numbers of the results, or how many.
            seed: Number of their collection.
            feature: ``(F,)`` feature of the object. Default: no guidance.
            start: Time that the way back starts from, in (0, 1]; below 1 part of the content stays.
            dilation: Rings of tokens around those of the mask that are generated anew too.
        """
        times = self.settings.times(start)
        check_mask(pixel_mask, "mask")
        tokens = token_mask(pixel_mask, self._sit.grid_size, dilation=dilation)
        tokens = tokens.to(self.generator.device)
        edited = mask_of_tokens(tokens, self._sit.grid_size, self._sit.input_size)[None, None]
        latents = self.encode(range_m[None])
        trajectory = self._inverted(latents, times)

        def solve(noise: Tensor) -> tuple[Tensor, FeatureGuidance | None]:
            own = trajectory._replace(states=trajectory.states.expand(-1, len(noise), -1, -1, -1))
            guidance = None
            if feature is not None:
                target = feature.to(noise).expand(len(noise), tokens.numel(), -1)
                guidance = self._guidance(FeatureTarget(target, tokens.expand(len(noise), -1)))
            state = renoised(own, edited, noise, self.generator.interpolant)
            velocity = guidance or self._sit.velocity
            return self._solve(velocity, state, times, kept(own, edited)), guidance

        made, cosine = self._each(indices, seed, solve)
        pasted = torch.where(pixel_mask, self._decoded(made, indices, seed), range_m)
        errors = self._errors(range_m[None], latents, trajectory)
        return self._result(pasted, made, 2 * self._nfe, *errors, cosine)

    @torch.no_grad()
    def mix(
        self,
        features: Sequence[Tensor],
        token_weights: Tensor,
        indices: int | Sequence[int],
        seed: int = 0,
    ) -> EditResult:
        """Draw scenes from noise that follow the stitched features of several scans.

        Source: R3DPA (ICRA 2026), scene mixing.

        Args:
            features: S feature grids ``(N, F)``; zero in cells without points.
            token_weights: ``(S, N)``, see :func:`r3dpa.editing.regions.sector_weights`.
            indices: Numbers of the results, or how many.
            seed: Number of their collection.
        """
        times = self.settings.times(1.0)
        stitched = FeatureTarget.stitched([grid[None] for grid in features], token_weights).features

        def solve(noise: Tensor) -> tuple[Tensor, FeatureGuidance]:
            guidance = self._guidance(FeatureTarget(stitched.to(noise).expand(len(noise), -1, -1)))
            return self._solve(guidance, noise, times), guidance

        made, cosine = self._each(indices, seed, solve)
        return self._result(self._decoded(made, indices, seed), made, self._nfe, cosine=cosine)

    @torch.no_grad()
    def complete(
        self,
        range_m: Tensor,
        missing: Tensor,
        indices: int | Sequence[int],
        seed: int = 0,
        *,
        start: float = 0.3,
    ) -> EditResult:
        """Fill missing pixels of a scan: a sector, beams, or any others.

        Plug-and-play with the flow as denoiser, in latents: the encoder sees the scan with its
        gaps interpolated; then, at every time t from ``start`` down, the latents x get

        1. some steps of Adam on the absolute error, smoothed at 0, of the decoded known pixels,
        2. fresh noise and the expected data, ``x <- D((1 - t) x + t noise, t)``.

        The decoded image is adjusted to known beams nearby, see
        :func:`r3dpa.editing.gaps.refined`. Known pixels are those of the scan. Tokens cannot be
        restored as in :meth:`inpaint`: with missing beams none is known, and the encoder would
        spread empty pixels over all latents.

        Source: PnP-Flow (Martin et al. 2025), alg. 3, with the data term behind the decoder.

        Args:
            range_m: ``(H, W)`` metres, -1 without a return.
            missing: ``(H, W)`` bool, neither empty nor full; the scan is not read there.
            indices: Numbers of the results, or how many.
            seed: Number of their collection.
            start: First time, in (0, 1]; 1 discards the interpolation, which only large gaps need.
        """
        check_mask(missing, "mask of what is missing")
        times = self.settings.times(start).tolist()
        guess = filled(range_m, missing)
        latents = self.encode(guess[None])
        image = self.generator.geometry.codec.to_image(range_m).to(latents)
        known = (~missing & self.generator.geometry.codec.informative(image)).to(latents)

        def solve(noise: Tensor, draws: Iterator[Tensor]) -> Tensor:
            x = latents.expand(len(noise), -1, -1, -1)
            for now in times[:-1]:
                x = self._fitted(x, image, known)
                time = batch_time(now, x)
                noisy = self.generator.interpolant.interpolate(x, noise, time)
                velocity = self._sit.velocity(noisy, time)
                x = self.generator.interpolant.denoise(velocity, noisy, time)
                noise = next(draws)
            return self._fitted(x, image, known)

        parts = []
        # One by one: fitting enlarges the rounding of another batch size.
        for index in scene_indices(indices):
            draws = self._draws([index], seed)
            parts.append(solve(next(draws), draws))
        made = torch.cat(parts)
        completed = torch.stack([refined(one, range_m, missing) for one in self._decoded(made)])
        errors = self._errors(range_m[None], self.encode(range_m[None]), None)
        pasted = torch.where(missing, completed, range_m)
        return self._result(pasted, made, len(times) - 1, errors[0])

    @torch.no_grad()
    def vary(
        self, range_m: Tensor, indices: int | Sequence[int], seed: int = 0, *, start: float = 0.5
    ) -> EditResult:
        """Other scenes like a scan: part of the way to noise, and back.

        Source: SDEdit (Meng et al. 2022).

        Args:
            range_m: ``(H, W)`` metres, -1 without a return.
            indices: Numbers of the results, or how many.
            seed: Number of their collection.
            start: Time of the noise, in (0, 1]; larger values keep less of the scan.
        """
        times, latents = self.settings.times(start), self.encode(range_m[None])

        def solve(noise: Tensor) -> tuple[Tensor, None]:
            time = batch_time(start, noise)
            state = self.generator.interpolant.interpolate(latents.expand_as(noise), noise, time)
            return self._solve(self._sit.velocity, state, times), None

        made, _ = self._each(indices, seed, solve)
        error = self._errors(range_m[None], latents, None)[0]
        return self._result(self._decoded(made, indices, seed), made, self._nfe, error)

    @torch.no_grad()
    def interpolate(self, first_m: Tensor, second_m: Tensor, frames: int) -> EditResult:
        """Scenes between two scans, on the arc between their noises.

        Args:
            first_m: ``(H, W)`` metres, -1 without a return; the first frame is its round trip.
            second_m: Likewise, the last frame.
            frames: How many, at least 2.
        """
        if frames < 2:
            raise ValueError(f"frames must be at least 2, the two scans; got {frames}")
        times, scans = self.settings.times(1.0), torch.stack([first_m, second_m])
        latents = self.encode(scans)
        trajectory = self._inverted(latents, times)
        first, second = trajectory.states[0].split(1)
        noises = [spherical_mean(first, second, k / (frames - 1)) for k in range(frames)]
        batches = torch.cat(noises).split(self.batch_size)
        made = torch.cat([self._solve(self._sit.velocity, noise, times) for noise in batches])
        errors = self._errors(scans, latents, trajectory)
        return self._result(self._decoded(made), made, 2 * self._nfe, *errors)

    def _result(
        self,
        range_m: Tensor,
        latents: Tensor,
        nfe: int,
        vae_error_m: float | None = None,
        round_trip_m: float | None = None,
        cosine: Tensor | None = None,
    ) -> EditResult:
        projection = self.generator.geometry.projection
        return EditResult(
            range_m,
            latents.cpu(),
            nfe,
            projection,
            vae_error_m=vae_error_m,
            round_trip_m=round_trip_m,
            cosine=cosine,
        )

    def _inverted(self, latents: Tensor, times: Tensor) -> Trajectory:
        path = self.generator.interpolant
        solver = self.settings.solver
        return invert(self._sit.velocity, latents, times, solver, interpolant=path)

    def _solve(
        self, velocity: Velocity, state: Tensor, times: Tensor, after_step: AfterStep = unchanged
    ) -> Tensor:
        path = self.generator.interpolant
        return ode_solver(self.settings.solver, path, after_step)(velocity, state, times)

    def _guidance(self, target: FeatureTarget) -> FeatureGuidance:
        return FeatureGuidance(
            self._sit.velocity,
            self._sit.aligned_pass,
            target,
            scale=self.settings.strength,
            relative=True,
            interval=self.settings.window,
        )

    def _draws(self, indices: Sequence[int], seed: int) -> Iterator[Tensor]:
        """Noise after noise ``(B, C, h, w)`` for scenes, drawn on the CPU."""
        return (
            x.to(self.generator.device)
            for x in scene_noise(self.generator.latent_shape, indices, seed)
        )

    def _each(
        self,
        indices: int | Sequence[int],
        seed: int,
        solve: Callable[[Tensor], tuple[Tensor, FeatureGuidance | None]],
    ) -> tuple[Tensor, Tensor | None]:
        """Latents of scenes, made of their noise in batches, and their cosines if guided."""
        numbers, size = scene_indices(indices), self.batch_size
        parts, cosines = [], []
        for first in range(0, len(numbers), size):
            made, guidance = solve(next(self._draws(numbers[first : first + size], seed)))
            parts.append(made)
            if guidance is not None:
                cosines.append(-guidance.energy(made, batch_time(0.0, made)).cpu())
        return torch.cat(parts), torch.cat(cosines) if cosines else None

    def _decoded(
        self, latents: Tensor, indices: int | Sequence[int] | None = None, seed: int = 0
    ) -> Tensor:
        """Range images ``(B, H, W)`` on the CPU; numbered scenes lose single returns."""
        numbers, size = None if indices is None else scene_indices(indices), self.batch_size
        parts = []
        for first in range(0, len(latents), size):
            own = None if numbers is None else numbers[first : first + size]
            parts.append(self.generator.decode(latents[first : first + size], own, seed).cpu())
        return torch.cat(parts)

    def _fitted(self, latents: Tensor, image: Tensor, known: Tensor) -> Tensor:
        """Latents a few steps nearer to an image ``(C, H, W)`` where it is known."""
        vae, norm = self.generator.vae, self.generator.latent_norm
        with torch.enable_grad():
            fitted = latents.detach().clone().requires_grad_()
            adam = torch.optim.Adam([fitted], lr=_FIT_RATE, eps=_FIT_EPS)
            for _ in range(_FIT_STEPS):
                error = (vae.decode(norm.denormalise(fitted)) - image).square()
                error = (error + _FIT_SMOOTH**2).sqrt() * known  # a plain norm has a kink at 0
                (gradient,) = torch.autograd.grad(error.sum(), fitted)
                length = gradient.square().mean(dim=(1, 2, 3), keepdim=True).sqrt()
                fitted.grad = gradient / length.clamp(min=torch.finfo(length.dtype).tiny)
                adam.step()
        return fitted.detach()

    def _errors(
        self, range_m: Tensor, latents: Tensor, trajectory: Trajectory | None
    ) -> tuple[float, float | None]:
        """Errors of the VAE, and of inversion and back, in metres."""
        plain = self._decoded(latents)
        error = range_error_m(plain, range_m)
        if trajectory is None:
            return error, None
        back = self._solve(self._sit.velocity, trajectory.states[0], trajectory.times)
        return error, range_error_m(self._decoded(back), plain)
