"""Edits of scans with an unconditional model: inpaint, mix, complete, vary, interpolate.

Scans are given as :data:`r3dpa.scenes.ScanLike`, masks as bool NumPy arrays or tensors; results
hold tensors on the CPU. Arguments outside the ranges that the docstrings state raise a ValueError.
Letters: B scenes, S sources, H beams, W columns, C latent channels, h x w latent size, N tokens,
F feature width.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal, Self

import numpy as np
import torch
from torch import Tensor

from r3dpa.checkpoints import Checkpoint
from r3dpa.editing.gaps import (
    blend_completion,
    median_draw,
    range_error_m,
)
from r3dpa.editing.latents import Trajectory, invert, noise_inside_mask, restore_outside_mask, slerp
from r3dpa.editing.pixel_batches import batch_of, concatenate, interpolated, paste
from r3dpa.editing.placement import correct_data, is_corrected, move_behind
from r3dpa.editing.regions import check_mask, mask_of_tokens, token_mask
from r3dpa.editing.settings import EditSettings, check_start
from r3dpa.flow.guidance import FeatureGuidance, FeatureTarget
from r3dpa.flow.noise import scene_noise
from r3dpa.flow.solvers import AfterStep, Velocity, evaluations, ode_solver, unchanged
from r3dpa.flow.times import batch_time
from r3dpa.generation import SamplerConfig, SceneGenerator, scene_indices
from r3dpa.geometry import Pixels, labels_of
from r3dpa.scenes import (
    ScanLike,
    SceneBatch,
    clamp_intensities,
    map_pixels,
    scan_pixels,
    with_unknown_intensity,
)

COMPLETION_START = 0.2  #: time of the noise that completions start from
_COMPLETION_DRAWS = 3  # their median has a smaller error than one draw


@dataclass(frozen=True, eq=False, repr=False)
class EditResult(SceneBatch):
    """Edited scenes, on the CPU; ``nfe`` includes the evaluations of an inversion.

    Attributes:
        vae_error_m: Mean absolute range error of the scans after encoder and decoder alone; None
            where it is not measured.
        round_trip_m: Mean absolute range error of inversion and back without an edit, relative to
            the reconstruction; the edit adds at most this to ``vae_error_m``. None without
            inversion.
        cosine: ``(B,)`` mean cosine between projected features of the latents and the features
            that guided them; None without features.
        draws: ``(B,)`` int64 number of each result among the draws, where they were ordered by
            :func:`r3dpa.editing.most_like_first`; else None.
        likeness: ``(B,)`` that they were ordered by, in [-1, 1]; else None.
        points_inside: ``(B,)`` int64 points in the box of an object, where one was given for that
            order; else None.
        points_of_class: ``(B,)`` int64 of them that the feature source takes for the object; None
            without a source that knows classes.
    """

    vae_error_m: float | None = None
    round_trip_m: float | None = None
    cosine: Tensor | None = None
    draws: Tensor | None = None
    likeness: Tensor | None = None
    points_inside: Tensor | None = None
    points_of_class: Tensor | None = None


class SceneEditor:
    """Edits scans with the networks of a generator.

    The random numbers of a scene are a function of (seed, index) alone, as in the generator, whose
    solver and guidance scale are not used. Where images have a return channel, inpainted parts,
    mixtures and variations lose single returns at random, as generated scenes do; completions do
    not. Results have the intensity and labels that the VAE has.

    Args:
        generator: Networks and geometry; float32. Their weights stop requiring gradients, since
            guided edits would store activations for them.
        settings: Solver and guidance.
        batch_size: Number of scenes per batch.

    Example:
        >>> editor = SceneEditor.from_checkpoint("r3dpa-s")  # doctest: +SKIP
        >>> editor.vary("scan.bin", 4, start=0.3).save("variations")  # doctest: +SKIP
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

    def __repr__(self) -> str:
        sensor, settings = self.generator.geometry.projection.sensor, self.settings
        return (
            f"SceneEditor({sensor.beams} x {sensor.columns} pixels, {settings.solver}, "
            f"{settings.steps} steps, {self.generator.device})"
        )

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
        """Rebuild the networks of a checkpoint, see :meth:`SceneGenerator.from_checkpoint`."""
        generator = SceneGenerator.from_checkpoint(
            checkpoint, SamplerConfig(), weights=weights, device=device
        )
        return cls(generator, settings, batch_size)

    from_pretrained = from_checkpoint  # names of `r3dpa models`

    @torch.no_grad()
    def encode(self, scan: ScanLike) -> Tensor:
        """Return the normalised latents ``(B, C, h, w)``, means of the VAE.

        Args:
            scan: One scan, or range images ``(B, H, W)`` in metres. VAEs that encode the intensity
                need scans with one in [0, 1].
        """
        if isinstance(scan, Tensor | np.ndarray) and scan.ndim == 3:
            return self._encode(concatenate([batch_of(self.pixels(image)) for image in scan]))
        return self._encode(batch_of(self.pixels(scan)))

    def pixels(self, scan: ScanLike) -> Pixels:
        """Pixels ``(H, W)`` of a scan in the projection of the model, on the CPU."""
        geometry = self.generator.geometry
        # Also where the encoder does not see intensities: results have them beside generated ones.
        return clamp_intensities(scan_pixels(scan, geometry.projection), geometry.codec)

    @torch.no_grad()
    def inpaint(
        self,
        scan: ScanLike,
        pixel_mask: Tensor | np.ndarray,
        indices: int | Sequence[int],
        seed: int = 0,
        *,
        feature: Tensor | None = None,
        front_m: Tensor | None = None,
        start: float = 1.0,
        dilation: int = 0,
    ) -> EditResult:
        """Generate the inside of a mask anew, guided towards an object.

        The scan is inverted, the tokens that the mask touches get fresh noise, and on the way back
        all others are restored after every step. Pixels outside the mask keep the scan's values.
        Features hardly say how far away an object is: where it has a box, what the steps draw in
        front of the box is moved into it.

        Source: R3DPA (ICRA 2026), object inpainting; there the other tokens are not restored.

        Args:
            scan: The scan to change.
            pixel_mask: ``(H, W)`` bool, True where the scan is to change; neither empty nor full,
                in tokens too.
            indices: Numbers of the results, or how many.
            seed: Seed of the results; each depends on (seed, number) alone.
            feature: ``(F,)`` feature of the object. Default: no guidance.
            front_m: ``(H, W)`` range of the near side of the object's box in metres, 0 outside,
                see :func:`r3dpa.editing.regions.box3d_front_m`. Default: the object has no box.
            start: Time that the way back starts from, in (0, 1]; below 1 part of the content stays.
            dilation: Rings of tokens around the mask that are generated anew as well.
        """
        width = self._sit.feature_dim
        if feature is not None and not (feature.shape == (width,) and feature.isfinite().all()):
            raise ValueError(
                f"feature must be ({width},) finite numbers, as the features of the model, got "
                f"shape {tuple(feature.shape)} with {int((~feature.isfinite()).sum())} not finite"
            )
        times, pixels = self.settings.times(start), self.pixels(scan)
        pixel_mask = self._checked_mask(pixel_mask, "mask")
        tokens = token_mask(pixel_mask, self._sit.grid_size, dilation=dilation)
        tokens = tokens.to(self.generator.device)
        edited = mask_of_tokens(tokens, self._sit.grid_size, self._sit.input_size)[None, None]
        latents = self._encode(batch_of(pixels))
        trajectory = self._inverted(latents, times)

        def solve(noise: Tensor) -> tuple[Tensor, FeatureGuidance | None]:
            way = trajectory._replace(states=trajectory.states.expand(-1, len(noise), -1, -1, -1))
            guidance = None
            if feature is not None:
                target = feature.to(noise).expand(len(noise), tokens.numel(), -1)
                guidance = self._guidance(FeatureTarget(target, tokens.expand(len(noise), -1)))
            state = noise_inside_mask(way, edited, noise, self.generator.interpolant)
            velocity = guidance or self._sit.velocity
            restore, place = restore_outside_mask(way, edited), self._placed(front_m)

            def after_step(x: Tensor, time: float, index: int) -> Tensor:
                return restore(place(x, time, index), time, index)

            return self._solve(velocity, state, times, after_step), guidance

        edits, cosine = self._in_batches(indices, seed, solve)
        pasted = paste(self._decoded(edits, indices, seed), pixels, pixel_mask)
        errors = self._errors(pixels.range_m[None], latents, trajectory)
        nfe = 2 * self._nfe
        if front_m is not None:
            nfe += sum(map(is_corrected, times[1:].tolist()))
        return self._result(pasted, edits, nfe, *errors, cosine)

    @torch.no_grad()
    def mix(
        self,
        features: Sequence[Tensor | np.ndarray],
        token_weights: Tensor | np.ndarray,
        indices: int | Sequence[int],
        seed: int = 0,
    ) -> EditResult:
        """Draw scenes from noise that follow the stitched features of several scans.

        Source: R3DPA (ICRA 2026), scene mixing.

        Args:
            features: S feature grids ``(N, F)``; zero in cells without points.
            token_weights: ``(S, N)``, see :func:`r3dpa.editing.regions.sector_weights`.
            indices: Numbers of the results, or how many.
            seed: Seed of the results; each depends on (seed, number) alone.
        """
        times = self.settings.times(1.0)
        grids = [torch.as_tensor(grid)[None] for grid in features]
        stitched = FeatureTarget.stitched(grids, torch.as_tensor(token_weights)).features

        def solve(noise: Tensor) -> tuple[Tensor, FeatureGuidance]:
            guidance = self._guidance(FeatureTarget(stitched.to(noise).expand(len(noise), -1, -1)))
            return self._solve(guidance, noise, times), guidance

        scenes, cosine = self._in_batches(indices, seed, solve)
        decoded = self._decoded(scenes, indices, seed)
        return self._result(decoded, scenes, self._nfe, cosine=cosine)

    @torch.no_grad()
    def complete(
        self,
        scan: ScanLike,
        missing: Tensor | np.ndarray,
        indices: int | Sequence[int] = 1,
        seed: int = 0,
        *,
        start: float = COMPLETION_START,
    ) -> EditResult:
        """Fill missing pixels of a scan: a sector, beams, or any others.

        The scan with its gaps interpolated is encoded, carried to the time ``start`` with fresh
        noise, and denoised in one evaluation, three times (SDEdit, Meng et al. 2022, with a single
        step). The median of the decoded images says where returns are, and takes part in their
        range where interpolation is uncertain, see
        :func:`r3dpa.editing.gaps.blend_completion`. Other pixels keep the scan's values. The aim
        is a small error; to make up a large part, use :meth:`inpaint`.

        Args:
            scan: The scan to complete.
            missing: ``(H, W)`` bool, neither empty nor full; the scan is not read there.
            indices: Numbers of the results, or how many; they differ little.
            seed: Seed of the results; each depends on (seed, number) alone.
            start: Time of the noise, in (0, 1]; larger values rely less on the interpolation.
        """
        missing = self._checked_mask(missing, "mask of what is missing")
        check_start(start)
        pixels = self.pixels(scan)
        latents = self._encode(batch_of(interpolated(pixels, missing)))
        path, shape = self.generator.interpolant, self.generator.latent_shape
        completed, means = [], []
        for index in scene_indices(indices):
            draws = islice(scene_noise(shape, [index], seed), _COMPLETION_DRAWS)
            noise = torch.cat(list(draws)).to(latents)
            time = batch_time(start, noise)
            noisy = path.interpolate(latents.expand_as(noise), noise, time)
            denoised = path.denoise(self._sit.velocity(noisy, time), noisy, time)
            generated = median_draw(self._decoded(denoised))
            range_m = blend_completion(generated.range_m, pixels.range_m, missing)
            blended = batch_of(generated._replace(range_m=range_m))
            completed.append(paste(blended, pixels, missing))
            means.append(denoised.mean(dim=0))
        return self._result(concatenate(completed), torch.stack(means), _COMPLETION_DRAWS)

    @torch.no_grad()
    def vary(
        self, scan: ScanLike, indices: int | Sequence[int], seed: int = 0, *, start: float = 0.5
    ) -> EditResult:
        """Generate scenes like a scan: part of the way to noise, and back.

        Source: SDEdit (Meng et al. 2022).

        Args:
            scan: The scan to vary.
            indices: Numbers of the results, or how many.
            seed: Seed of the results; each depends on (seed, number) alone.
            start: Time of the noise, in (0, 1]; larger values keep less of the scan.
        """
        times, pixels = self.settings.times(start), self.pixels(scan)
        latents = self._encode(batch_of(pixels))

        def solve(noise: Tensor) -> tuple[Tensor, None]:
            time = batch_time(start, noise)
            state = self.generator.interpolant.interpolate(latents.expand_as(noise), noise, time)
            return self._solve(self._sit.velocity, state, times), None

        variations, _ = self._in_batches(indices, seed, solve)
        error, _ = self._errors(pixels.range_m[None], latents)
        decoded = self._decoded(variations, indices, seed)
        return self._result(decoded, variations, self._nfe, error)

    @torch.no_grad()
    def interpolate(self, first: ScanLike, second: ScanLike, frames: int) -> EditResult:
        """Generate scenes between two scans, on the arc between their noises.

        Args:
            first: Scan of the first frame, which is its round trip.
            second: Scan of the last frame.
            frames: Number of frames, at least 2.
        """
        if frames < 2:
            raise ValueError(f"frames must be at least 2, the two scans; got {frames}")
        times = self.settings.times(1.0)
        ends = concatenate([batch_of(self.pixels(scan)) for scan in (first, second)])
        latents = self._encode(ends)
        trajectory = self._inverted(latents, times)
        first_noise, second_noise = trajectory.states[0].split(1)
        noises = [slerp(first_noise, second_noise, k / (frames - 1)) for k in range(frames)]
        batches = torch.cat(noises).split(self.batch_size)
        scenes = torch.cat([self._solve(self._sit.velocity, noise, times) for noise in batches])
        errors = self._errors(ends.range_m, latents, trajectory)
        return self._result(self._decoded(scenes), scenes, 2 * self._nfe, *errors)

    def _checked_mask(self, mask: Tensor | np.ndarray, what: str) -> Tensor:
        """Mask of the pixels of an image; refuses one of another shape."""
        mask, sensor = torch.as_tensor(mask), self.generator.geometry.projection.sensor
        if mask.shape != (sensor.beams, sensor.columns):
            raise ValueError(
                f"{what}: must have the shape ({sensor.beams}, {sensor.columns}) of the range "
                f"image, got {tuple(mask.shape)}"
            )
        return check_mask(mask, what)

    def _placed(self, front_m: Tensor | None) -> AfterStep:
        """Solver hook that moves what is drawn in front of a box into it."""
        if front_m is None:
            return unchanged
        self._checked_mask(front_m > 0, "range of the near side")
        near_side_m = front_m.to(self.generator.device)

        def correct(latents: Tensor) -> Tensor:
            pixels = self.generator.decode_pixels(latents)
            moved = pixels._replace(range_m=move_behind(pixels.range_m, near_side_m))
            if moved.range_m.equal(pixels.range_m):
                return latents
            # A difference of two encodings, in which the error of the VAE does not count.
            return latents + (self._encode(moved) - self._encode(pixels))

        return correct_data(self._sit.velocity, correct, self.generator.interpolant)

    def _encode(self, pixels: Pixels) -> Tensor:
        """Normalised latents of pixels ``(B, H, W)``."""
        codec, vae = self.generator.geometry.codec, self.generator.vae
        pixels = map_pixels(lambda values: values.to(self.generator.device), pixels)
        codec = vae.codec_of_input(codec)
        image = codec.to_image(*with_unknown_intensity(pixels, codec))
        return self.generator.latent_norm.normalise(vae.encode(image).mean)

    def _result(
        self,
        pixels: Pixels,
        latents: Tensor,
        nfe: int,
        vae_error_m: float | None = None,
        round_trip_m: float | None = None,
        cosine: Tensor | None = None,
    ) -> EditResult:
        return EditResult(
            pixels.range_m,
            latents.cpu(),
            nfe,
            self.generator.geometry.projection,
            pixels.intensity,
            None if pixels.classes is None else labels_of(pixels.classes),
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

    def _in_batches(
        self,
        indices: int | Sequence[int],
        seed: int,
        solve: Callable[[Tensor], tuple[Tensor, FeatureGuidance | None]],
    ) -> tuple[Tensor, Tensor | None]:
        """Latents that ``solve`` makes of the noise of each scene, and their cosines if guided."""
        numbers, shape = scene_indices(indices), self.generator.latent_shape
        parts, cosines = [], []
        for first in range(0, len(numbers), self.batch_size):
            batch = numbers[first : first + self.batch_size]
            noise = next(scene_noise(shape, batch, seed)).to(self.generator.device)
            latents, guidance = solve(noise)
            parts.append(latents)
            if guidance is not None:
                if guidance.num_dropped:
                    warnings.warn(
                        f"{guidance.num_dropped} gradients of the guidance were not finite and "
                        "left out",
                        stacklevel=2,
                    )
                cosines.append(-guidance.energy(latents, batch_time(0.0, latents)).cpu())
        return torch.cat(parts), torch.cat(cosines) if cosines else None

    def _decoded(
        self, latents: Tensor, indices: int | Sequence[int] | None = None, seed: int = 0
    ) -> Pixels:
        """Pixels ``(B, H, W)`` on the CPU; scenes with indices lose single returns."""
        numbers = None if indices is None else scene_indices(indices)
        parts = []
        for first in range(0, len(latents), self.batch_size):
            batch = slice(first, first + self.batch_size)
            batch_numbers = None if numbers is None else numbers[batch]
            pixels = self.generator.decode_pixels(latents[batch], batch_numbers, seed)
            parts.append(map_pixels(Tensor.cpu, pixels))
        return concatenate(parts)

    def _errors(
        self, range_m: Tensor, latents: Tensor, trajectory: Trajectory | None = None
    ) -> tuple[float, float | None]:
        """Errors of the VAE, and of inversion and back, in metres."""
        reconstructed = self._decoded(latents).range_m
        error = range_error_m(reconstructed, range_m)
        if trajectory is None:
            return error, None
        back = self._solve(self._sit.velocity, trajectory.states[0], trajectory.times)
        return error, range_error_m(self._decoded(back).range_m, reconstructed)
