"""What the three training modules share: draws, step losses, optimiser, clipping, EMA, logging."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, Literal, NamedTuple, cast

import lightning as L
import numpy as np
import torch
from lightning.pytorch.utilities import rank_zero_info, rank_zero_warn
from torch import Tensor, nn

from r3dpa import __version__, losses
from r3dpa.checkpoints import (
    leaks_labels,
    load_into,
    read_checkpoint,
    source_commit,
    transfer_rgb,
)
from r3dpa.data.augmentation import Augmentation
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.datasets import LidarBatch
from r3dpa.flow import Interpolant, sample_time
from r3dpa.geometry import ScanGeometry
from r3dpa.modules.settings import LossWeights, OptimizerConfig
from r3dpa.nn import EMA, VAE, LatentNorm, PatchDiscriminator, Posterior, SiT

__all__ = ["GenerativeModule", "PathDraws", "frozen"]


class PathDraws(NamedTuple):
    """Random numbers of one training step.

    ``posterior_noise`` and ``noise`` are ``(B, C, h, w)`` standard normal, ``time`` is ``(B,)``.
    """

    posterior_noise: Tensor
    time: Tensor
    noise: Tensor


@contextmanager
def frozen(*networks: nn.Module) -> Iterator[None]:
    """Records the forward pass inside without gradients to the networks' own parameters.

    Gradients still flow through the networks to their inputs.
    """
    parameters = [p for network in networks for p in network.parameters() if p.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)


def _nothing_of(network: nn.Module) -> Tensor:
    """A loss of exactly 0 that gives each trained parameter a gradient of 0.

    Nothing is computed for it: it is the sum of no element of each parameter.
    """
    empty = [p.flatten()[:0].sum() for p in network.parameters() if p.requires_grad]
    return torch.stack(empty).sum()


class GenerativeModule(L.LightningModule):
    """Base of the training modules.

    A subclass names its stage, lists its networks in :meth:`trainable` and writes one
    ``training_step`` out of the step losses below. All losses of a step come from the same forward
    values, so one optimiser with a parameter group per network and one backward pass equal the
    official three optimisers stepped in turn; ``accumulate_grad_batches``, ``gradient_clip_val``
    (per network), plain ``ddp`` and ``global_step`` keep their usual meaning.

    Random numbers of a step are a function of ``(seed, batch, sample)`` alone: they do not depend
    on the number of processes and need no state for an exact resume.

    Args:
        vae: Range-image autoencoder.
        sit: Flow transformer over its latents.
        discriminator: Patch discriminator, or None where the stage trains none.
        weights: Loss weights.
        optimizer: Optimiser settings.
        path: Interpolant between latents (time 0) and noise (time 1).
        time_sampling: Density of the training times.
        ema_decay: Decay of the averaged SiT.
        ema_buffers: ``copy`` the latent statistics, or ``decay`` them as the official code does.
        latent_norm: Latent statistics; None makes a fresh one.
        init_from: Checkpoint of the stage before.
        init_networks: Which networks are taken from ``init_from``; None means ``default_init``.
        rgb_weights: RGB-pretrained SiT, official ``.pt`` or ours; None starts from random values.
        keep_projector: Keep the RGB model's projection head where its shape fits.
        seed: Key of the training draws.
        max_skipped_steps: Consecutive steps with a non-finite gradient before training stops.
        channels_last: Keep images and kernels of VAE and discriminator with their channels next to
            each other. The same numbers to rounding; files keep the usual order.
        compile: Compile the networks for training with ``torch.compile``: VAE, discriminator and
            each block of the SiT. The first step takes minutes; files have the same names.
    """

    stage: str
    default_init: tuple[str, ...] = ()
    trains_velocity: bool = True
    data_class: type[L.LightningDataModule] = LidarDataModule  # that it works with, see StageCLI

    def __init__(
        self,
        vae: VAE,
        sit: SiT,
        discriminator: PatchDiscriminator | None = None,
        weights: LossWeights = LossWeights(),
        optimizer: OptimizerConfig = OptimizerConfig(),
        path: Literal["linear", "cosine"] = "linear",
        time_sampling: Literal["uniform", "lognormal"] = "uniform",
        ema_decay: float = 0.9999,
        ema_buffers: Literal["copy", "decay"] = "copy",
        latent_norm: LatentNorm | None = None,
        init_from: str | None = None,
        init_networks: list[str] | None = None,
        rgb_weights: str | None = None,
        keep_projector: bool = False,
        seed: int = 0,
        max_skipped_steps: int = 10,
        channels_last: bool = False,
        compile: bool = False,
    ) -> None:
        super().__init__()
        with warnings.catch_warnings():
            # Lightning advises to leave networks out. Kept, they are class paths in a checkpoint of
            # the CLI, from which the networks are rebuilt.
            warnings.filterwarnings(
                "ignore", message="Attribute '.*' is an instance of `nn.Module`"
            )
            self.save_hyperparameters()
        self.vae = vae
        self.sit = sit
        self.discriminator = discriminator
        self.latent_norm = latent_norm or LatentNorm(vae.latent_channels)
        self.weights = weights
        self.optimizer_config = optimizer
        self.interpolant = Interpolant(path)
        self.time_sampling = time_sampling
        self.init_from = init_from
        self.init_networks = self.default_init if init_networks is None else tuple(init_networks)
        self.rgb_weights = rgb_weights
        self.keep_projector = keep_projector
        self.seed = seed
        self.max_skipped_steps = max_skipped_steps
        self.channels_last = channels_last
        self.compiles = compile
        self.ema: EMA | None = None
        if self.trains_velocity:
            self.ema = EMA(sit, self.latent_norm, ema_decay, ema_buffers)
        self.geometry: ScanGeometry | None = None
        self.augmentation: Augmentation | None = None
        self.loaded_step = 0
        self._data_source: str | None = None
        self._learned_from: list[str | None] = []  # sources of the weights that were loaded
        self._has_weights = False
        self._previous_geometry: Mapping[str, Any] | None = None
        self._skipped_in_a_row = 0

    # What a stage declares

    def trainable(self) -> dict[str, nn.Module]:
        """Networks that this stage trains, by name; frozen parameters inside stay frozen."""
        raise NotImplementedError

    def needs_features(self) -> bool:
        """Whether a training batch must hold feature grids."""
        return self.weights.vae_alignment != 0 or self.weights.sit_alignment != 0

    # Starting a stage

    def configure_model(self) -> None:
        """Arranges the memory of the networks, and compiles them for a fit."""
        self.arrange_networks()
        if self.compiles and self.trainer.state.fn == "fit":
            # In place and part by part: names in checkpoints stay, and equal blocks share a graph.
            parts = [self.vae.encoder, self.vae.decoder, self.discriminator, *self.sit.blocks]
            for part in parts:
                if part is not None:
                    part.compile(dynamic=False)

    def arrange_networks(self) -> None:
        """Puts the kernels of VAE and discriminator into the memory format of ``channels_last``."""
        format_ = torch.channels_last if self.channels_last else torch.contiguous_format
        for network in (self.vae, self.discriminator):
            if network is not None:
                cast(Any, network).to(memory_format=format_)  # not in torch's own stubs

    def setup(self, stage: str) -> None:
        """Checks data against networks."""
        datamodule = getattr(self.trainer, "datamodule", None)
        if not isinstance(datamodule, LidarDataModule):
            raise ValueError(
                f"{type(self).__name__} needs a LidarDataModule, got {type(datamodule).__name__}"
            )
        self.geometry, self.augmentation = datamodule.geometry, datamodule.augmentation
        self._check_sizes(self.geometry)
        if stage != "predict":
            self._data_source = datamodule.feature_source
        if self.needs_features() and stage != "predict":
            self._check_features(self.geometry, datamodule)

    def on_train_start(self) -> None:
        """Fits the state of a resumed optimiser to this run."""
        optimizer = cast(torch.optim.Optimizer, self.optimizers(use_pl_optimizer=False))
        self.arrange_optimizer(optimizer, self._fused)

    @staticmethod
    def arrange_optimizer(optimizer: torch.optim.Optimizer, fused: bool) -> None:
        """Puts the state of an AdamW where it has to be, in the memory format of the weights.

        A fused optimiser walks through the memory of weights and moments alike, unchecked.

        Args:
            optimizer: It may hold the state of a run with other settings.
            fused: Whether one kernel moves all weights.
        """
        for group in optimizer.param_groups:
            group["fused"] = fused
        for parameter, state in optimizer.state.items():
            state["step"] = state["step"].to(parameter.device if fused else "cpu")
            for name in ("exp_avg", "exp_avg_sq"):
                if state[name].stride() != parameter.stride():
                    state[name] = torch.empty_like(parameter).copy_(state[name])

    def on_fit_start(self) -> None:
        """Loads the stage before, unless this run goes on from a checkpoint of its own."""
        if not self._has_weights:
            self.load_previous_stage()
        if self._previous_geometry is not None:
            self._check_geometry(self._previous_geometry, str(self.init_from))
        if leaks_labels(self.feature_source):
            rank_zero_warn(
                f"Features of {self.feature_source!r} read the labels: the numbers of this run and "
                "of all that starts from it must not be compared with others."
            )

    @property
    def feature_source(self) -> str | None:
        """Feature source of the data, but what loaded weights learned from if that leaks labels.

        A later stage does not undo the leak.
        """
        return next(filter(leaks_labels, self._learned_from), self._data_source)

    def load_previous_stage(self) -> None:
        """Loads ``rgb_weights`` and ``init_from`` and restarts the EMA from the loaded weights.

        A fit does it by itself; called earlier, it says early what does not fit.

        Raises:
            ValueError: Listing everything in the file that does not fit this stage.
        """
        if self.rgb_weights is not None:
            rgb = read_checkpoint(self.rgb_weights)
            self._learned_from.append(rgb.feature_source)
            report = transfer_rgb(
                rgb,
                self.sit,
                self.latent_norm,
                keep_projector=self.keep_projector,
            )
            rank_zero_info(report.table())
        if self.init_from is not None:
            before = read_checkpoint(self.init_from)
            networks = {name: self.get_submodule(name) for name in self.init_networks}
            load_into(networks, before, stage=self.stage)
            self._previous_geometry = before.geometry
            self._learned_from.append(before.feature_source)
        if self.ema is not None:
            self.ema.reset(self.sit, self.latent_norm)
        self._has_weights = True

    def _check_geometry(self, stored: Mapping[str, Any], source: str) -> None:
        """Refuses weights that were trained on other range images than this run's."""
        there, here = ScanGeometry.from_dict(dict(stored)), self.scan_geometry
        parts = {
            "projection": (there.projection, here.projection),
            "codec": (there.codec, here.codec),
        }
        different = [
            f"{name} {theirs} there, {ours} here"
            for name, (theirs, ours) in parts.items()
            if theirs != ours
        ]
        if different:
            raise ValueError(
                f"{source} was trained on other range images: {'; '.join(different)}. Set sensor, "
                "projection and codec of the data module to those of the checkpoint"
            )

    def _check_sizes(self, geometry: ScanGeometry) -> None:
        if self.sit.in_channels != self.vae.latent_channels:
            raise ValueError(
                f"sit.in_channels is {self.sit.in_channels}, but the VAE has "
                f"{self.vae.latent_channels} latent channels; give both the same number"
            )
        sensor = geometry.projection.sensor
        image_size = (sensor.beams, sensor.columns)
        latent_size = self.vae.latent_size(image_size)
        if tuple(latent_size) != tuple(self.sit.input_size):
            raise ValueError(
                f"a {image_size} range image gives {latent_size} latents, but sit.input_size is "
                f"{tuple(self.sit.input_size)}; set sit.input_size to {latent_size}"
            )

    def _check_features(self, geometry: ScanGeometry, datamodule: LidarDataModule) -> None:
        if datamodule.features_dir is None:
            raise ValueError(
                f"stage {self.stage} aligns with 3D features, but the data module has none; give "
                "it an extractor or features_dir, or set the alignment weights to 0"
            )
        if tuple(geometry.grid_size) != tuple(self.sit.grid_size):
            raise ValueError(
                f"feature grids are {geometry.grid_size}, but the SiT has "
                f"{tuple(self.sit.grid_size)} tokens; set data.grid_size to the latter"
            )
        if datamodule.feature_dim != self.sit.feature_dim:
            raise ValueError(
                f"features have width {datamodule.feature_dim}, but sit.feature_dim is "
                f"{self.sit.feature_dim}; set it to the former"
            )

    # Losses of one step

    def draw_path(self, num_scans: int, batch_number: int, stream: int = 0) -> PathDraws:
        """Posterior noise, times and path noise for this process's part of a global batch.

        Args:
            num_scans: Scans B of the batch on this process.
            batch_number: Number of the batch since the start of training, or of the split.
            stream: Separates training (0) from evaluation draws.
        """
        world, rank = self.trainer.world_size, self.trainer.global_rank
        key = np.random.SeedSequence([self.seed, stream, batch_number]).generate_state(1)
        generator = torch.Generator(self.device).manual_seed(int(key[0]))
        total = num_scans * world
        shape = (total, self.vae.latent_channels, *self.sit.input_size)
        drawn = PathDraws(
            torch.randn(shape, generator=generator, device=self.device),
            sample_time(total, self.time_sampling, generator=generator),
            torch.randn(shape, generator=generator, device=self.device),
        )
        return PathDraws(*(values[rank::world] for values in drawn))

    @property
    def batch_number(self) -> int:
        """Training batches before this one, over all epochs and resumed runs."""
        return self.trainer.fit_loop.epoch_loop.total_batch_idx

    def vae_losses(
        self, image: Tensor, posterior: Posterior, reconstruction: Tensor
    ) -> dict[str, Tensor]:
        """L_AE: reconstruction, KL and the adversarial term; the discriminator stays untouched."""
        weights, parts = self.weights, {}
        if weights.reconstruction != 0:
            error = losses.reconstruction_loss(reconstruction, image, weights.reconstruction_norm)
            parts["reconstruction"] = weights.reconstruction * error
        if weights.kl != 0:
            parts["kl"] = weights.kl * posterior.kl().mean()
        if self.discriminator is not None and weights.adversarial != 0 and self._adversarial:
            with frozen(self.discriminator):
                logits = self.discriminator(reconstruction)
            parts["adversarial"] = weights.adversarial * losses.generator_loss(logits)
        if not parts.keys() & {"reconstruction", "adversarial"}:
            parts["reconstruction"] = _nothing_of(self.vae)
        return parts

    @property
    def _adversarial(self) -> bool:
        """Whether the adversarial losses count yet."""
        return self.global_step >= self.weights.adversarial_start

    def discriminator_losses(self, image: Tensor, reconstruction: Tensor) -> dict[str, Tensor]:
        """Hinge loss on scans and detached reconstructions; a plain 0 before its start.

        Before it, the discriminator gets gradients of 0, as if the loss were computed and had
        factor 0: under DDP each trained network must take part in each step.
        """
        if self.discriminator is None:
            return {}
        if self.weights.discriminator == 0 or not self._adversarial:
            return {"discriminator": _nothing_of(self.discriminator)}
        real = self.discriminator(image)
        fake = self.discriminator(reconstruction.detach())
        loss = losses.discriminator_loss(real, fake)
        return {"discriminator": self.weights.discriminator * loss}

    def vae_alignment_losses(
        self, latents: Tensor, features: Tensor | None, draws: PathDraws
    ) -> dict[str, Tensor]:
        """lambda1 L_align with running latent statistics: the gradient reaches the encoder."""
        if self.weights.vae_alignment == 0:
            return {}
        normalised = self.latent_norm.normalise(latents)
        noisy = self.interpolant.interpolate(normalised, draws.noise, draws.time)
        projected = self.sit.project_features(noisy, draws.time)
        return {"vae_alignment": self.weights.vae_alignment * self._aligned(projected, features)}

    def flow_losses(
        self, latents: Tensor, features: Tensor | None, draws: PathDraws
    ) -> dict[str, Tensor]:
        """L_denoise + lambda2 L_align on detached latents; updates the latent statistics."""
        weights = self.weights
        normalised = self.latent_norm.update(latents.detach())
        noisy = self.interpolant.interpolate(normalised, draws.noise, draws.time)
        velocity, projected = self._predict(
            self.sit, noisy, draws.time, weights.denoising != 0, weights.sit_alignment != 0
        )
        parts = {}
        if velocity is None:
            parts["denoising"] = _nothing_of(self.sit)
        else:
            target = self.interpolant.target(normalised, draws.noise, draws.time)
            error = losses.flow_matching_loss(velocity, target).mean()
            parts["denoising"] = weights.denoising * error
        if projected is not None:
            parts["sit_alignment"] = weights.sit_alignment * self._aligned(projected, features)
        return parts

    @staticmethod
    def _predict(
        sit: SiT, noisy: Tensor, time: Tensor, velocity: bool, features: bool
    ) -> tuple[Tensor | None, Tensor | None]:
        """Velocity and projected features, what is not asked for being None and not computed."""
        if velocity and features:
            return sit(noisy, time)
        if velocity:
            return sit.velocity(noisy, time), None
        return None, sit.project_features(noisy, time) if features else None

    def weigh_and_log(self, parts: dict[str, Tensor]) -> Tensor:
        """Sums weighted losses; logs the sum as ``train/loss``, each loss without its weight.

        Args:
            parts: Weighted losses under the names of their weights in :class:`LossWeights`.
        """
        total = torch.stack(list(parts.values())).sum()
        weights = {name: getattr(self.weights, name) for name in parts}
        values = {
            f"train/{name}": value.detach() / weights[name]
            for name, value in parts.items()
            if weights[name] != 0
        }
        self.log_dict({**values, "train/loss": total.detach()})
        return total

    def _aligned(self, projected: Tensor, features: Tensor | None) -> Tensor:
        if features is None:
            raise ValueError(
                f"stage {self.stage} aligns with 3D features, but the batch holds no feature_grid"
            )
        return losses.alignment_loss(
            projected, features, skip_empty_cells=self.weights.skip_empty_cells
        ).mean()

    # Optimisation

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """One AdamW with a parameter group per trained network, fused where the device has it."""
        groups = [
            {"params": [p for p in network.parameters() if p.requires_grad], "name": name}
            for name, network in self.trainable().items()
        ]
        return torch.optim.AdamW(groups, **asdict(self.optimizer_config), fused=self._fused)

    @property
    def _fused(self) -> bool:
        """Whether one kernel moves all weights.

        In float16 it would also undo the scale of the gradients, after they were clipped.
        """
        supported = self.device.type in ("cpu", "cuda", "mps", "xpu")
        return supported and self.trainer.precision != "16-mixed"

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: int | float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clips each network's gradient norm by itself and logs it as ``grad_norm/<network>``.

        A non-finite norm drops the whole step: no weight, moment or average moves.

        Raises:
            RuntimeError: After ``max_skipped_steps`` such steps in a row.
        """
        if gradient_clip_algorithm not in (None, "norm"):
            raise ValueError(
                "gradients are clipped by norm per network; leave gradient_clip_algorithm out, got "
                f"{getattr(gradient_clip_algorithm, 'value', gradient_clip_algorithm)!r}"
            )
        limit = float("inf") if gradient_clip_val is None else float(gradient_clip_val)
        norms = {
            group["name"]: nn.utils.get_total_norm(
                [p.grad for p in group["params"] if p.grad is not None]
            )
            for group in optimizer.param_groups
        }
        self.log_dict({f"grad_norm/{name}": norm for name, norm in norms.items()})
        if not torch.stack(list(norms.values())).isfinite().all():
            self._skip_step(optimizer, norms)
            return
        self._skipped_in_a_row = 0
        for group in optimizer.param_groups:
            nn.utils.clip_grads_with_norm_(group["params"], limit, norms[group["name"]])

    def _skip_step(self, optimizer: torch.optim.Optimizer, norms: dict[str, Tensor]) -> None:
        optimizer.zero_grad(set_to_none=True)
        self._skipped_in_a_row += 1
        if self._skipped_in_a_row >= self.max_skipped_steps:
            found = ", ".join(f"{name} {float(norm):.3g}" for name, norm in norms.items())
            raise RuntimeError(
                f"{self._skipped_in_a_row} steps in a row had a non-finite gradient ({found}) at "
                f"step {self.global_step}; lower the learning rate, train in bf16 or fp32 instead "
                "of fp16, or check the scans with `r3dpa check`"
            )

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Steps the optimiser, then the averages, unless the step was dropped."""
        super().optimizer_step(*args, **kwargs)
        if self.ema is not None and self._skipped_in_a_row == 0:
            self.ema.update(self.sit, self.latent_norm)

    # Evaluation

    def reconstruct(self, image: Tensor) -> Tensor:
        """Encoded range images ``(B, 1, H, W)`` through the VAE's posterior mean and back."""
        return self.vae.decode(self.vae.encode(image).mean)

    def evaluate(self, batch: LidarBatch, batch_idx: int, prefix: str) -> None:
        """Logs the losses on held-out scans, and the reconstruction error in metres.

        The SiT is the averaged one where the stage has an average.
        """
        image, mask = batch["range_image"], batch["valid_mask"]
        codec = self.scan_geometry.codec
        draws = self.draw_path(len(image), batch_idx, stream=1)
        posterior = self.vae.encode(image)
        reconstruction = self.vae.decode(posterior.mean)
        error_m = (codec.to_range(reconstruction) - codec.to_range(image)).abs()
        values = {
            "reconstruction": losses.reconstruction_loss(
                reconstruction, image, self.weights.reconstruction_norm
            ),
            "range_error_m": error_m[mask].mean(),
        }
        if self.trains_velocity or self.needs_features():
            values |= self._evaluate_flow(posterior, batch.get("feature_grid"), draws)
        self.log_dict(
            {f"{prefix}/{name}": value for name, value in values.items()},
            batch_size=image.shape[0],
            sync_dist=True,
        )

    def _evaluate_flow(
        self, posterior: Posterior, features: Tensor | None, draws: PathDraws
    ) -> dict[str, Tensor]:
        networks = self if self.ema is None else self.ema
        latents = networks.latent_norm.normalise(posterior.sample(draws.posterior_noise))
        noisy = self.interpolant.interpolate(latents, draws.noise, draws.time)
        velocity, projected = self._predict(
            networks.sit, noisy, draws.time, self.trains_velocity, self.needs_features()
        )
        values = {}
        if velocity is not None:
            target = self.interpolant.target(latents, draws.noise, draws.time)
            values["denoising"] = losses.flow_matching_loss(velocity, target).mean()
        if projected is not None:
            values["alignment"] = self._aligned(projected, features)
        return values

    def validation_step(self, batch: LidarBatch, batch_idx: int) -> None:
        """Evaluates a batch of the validation split under ``val/``."""
        self.evaluate(batch, batch_idx, "val")

    def test_step(self, batch: LidarBatch, batch_idx: int) -> None:
        """Evaluates a batch of the test split under ``test/``."""
        self.evaluate(batch, batch_idx, "test")

    def predict_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """Reconstructed ranges ``(B, H, W)`` in metres, -1 where the image has no return."""
        geometry = self.scan_geometry
        image = self.reconstruct(batch["range_image"])
        return geometry.codec.decode(image[:, 0], geometry.projection.sensor)

    # Checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds stage and scan geometry, enough to sample from, and what it was trained with.

        Weights are written in the usual order in memory, whatever this run works with.
        """
        state = checkpoint["state_dict"]
        checkpoint["state_dict"] = {name: value.contiguous() for name, value in state.items()}
        checkpoint["r3dpa"] = {
            "stage": self.stage,
            "geometry": self.scan_geometry.to_dict(),
            "augmentation": None if self.augmentation is None else asdict(self.augmentation),
            "feature_source": self.feature_source,
            "interpolant": self.interpolant.path,
            "version": __version__,
            "commit": source_commit(),
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage or of other range images.

        Raises:
            ValueError: Naming both stages or both geometries.
        """
        self.loaded_step = checkpoint.get("global_step", 0)
        self._has_weights = True
        found = checkpoint.get("r3dpa", {}).get("stage")
        if found != self.stage:
            raise ValueError(
                f"the checkpoint is of stage {found!r}, this is {self.stage!r}; to start a stage "
                "from another one, give model.init_from instead of ckpt_path"
            )
        for state in checkpoint.get("optimizer_states", []):
            for group in state["param_groups"]:
                group.update(asdict(self.optimizer_config))  # those of this run, not the old ones
        self._learned_from.append(checkpoint["r3dpa"].get("feature_source"))
        stored = checkpoint["r3dpa"]["geometry"]
        if self.geometry is None:
            self.geometry = ScanGeometry.from_dict(stored)
        else:
            self._check_geometry(stored, "the checkpoint")

    @property
    def scan_geometry(self) -> ScanGeometry:
        """Geometry of the scans it trains on, known from setup or from a checkpoint."""
        if self.geometry is None:
            raise RuntimeError("the module has no scan geometry yet: set it up with a data module")
        return self.geometry
