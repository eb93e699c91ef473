"""Base class of all training stages, and the random draws and held-out means that they share."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, NamedTuple, cast

import lightning as L
import torch
from lightning.pytorch.callbacks import StochasticWeightAveraging
from torch import Tensor, nn

from r3dpa import __version__, losses
from r3dpa.checkpoints import Checkpoint
from r3dpa.data.augmentation import Augmentation
from r3dpa.flow.interpolant import LINEAR, Interpolant, sample_time
from r3dpa.flow.noise import random_generator
from r3dpa.geometry import ScanGeometry
from r3dpa.io import source_commit
from r3dpa.modules.alignment_release import ResidualAverages
from r3dpa.modules.checks import check_planned_images, check_same_images, planned_geometry
from r3dpa.modules.held_out import HeldOutMeans
from r3dpa.modules.settings import LossWeights, OptimizerConfig, TimeSampling
from r3dpa.nn import VelocityNetwork

_PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")


class PathDraws(NamedTuple):
    """Random numbers of one training step.

    ``posterior_noise`` and ``noise`` are ``(B, C, h, w)`` standard normal, ``time`` is ``(B,)``.
    ``uniform`` ``(B,)`` in [0, 1) selects the noise on the latents of a decoder, ``further``
    ``(B, 2)`` what an encoder sees: intensity, classes. Both are empty in draws without them.
    """

    posterior_noise: Tensor
    time: Tensor
    noise: Tensor
    uniform: Tensor = torch.empty(0)
    further: Tensor = torch.empty(0, 2)


class Stage(L.LightningModule, ABC):
    """Base class of all training stages.

    It owns the random draws of a step, the optimiser and its clipping, the means over held-out
    samples, and the facts that a checkpoint records. All losses of a step come from the same
    forward values, so one AdamW with a parameter group per network and one backward pass equal
    several optimisers stepped in turn; ``accumulate_grad_batches``, ``gradient_clip_val`` (per
    network), plain ``ddp`` and ``global_step`` keep their usual meaning.

    Random numbers of a step are a function of ``(seed, batch, sample)`` alone: they do not depend
    on the number of processes or on where a run was interrupted.

    A subclass names its ``stage``, sets ``latent_shape`` and lists its networks in
    :meth:`trainable`. Stages with loss weights set ``weights``, stages of a flow ``sit`` too.

    Args:
        optimizer: Optimiser settings.
        seed: Key of the training draws.
        time_sampling: Density of the training times.

    Attributes:
        latent_shape: Channels, rows and columns ``(C, h, w)`` of the samples that are drawn.
        geometry: Projection and range encoding of the scans, from setup or a checkpoint; None
            before, and in stages on RGB images.
        loaded_step: Optimiser steps of the checkpoint that was loaded.
        logged_losses: Losses of the last training batch, read by the step guard.
        step_skipped: Whether the step guard skipped the last step.
    """

    stage: str
    latent_shape: tuple[int, ...]
    weights: LossWeights
    sit: VelocityNetwork
    interpolant: Interpolant = LINEAR
    geometry: ScanGeometry | None = None
    augmentation: Augmentation | None = None
    feature_source: str | None = None
    loaded_step = 0

    def __init__(
        self, optimizer: OptimizerConfig, seed: int, time_sampling: TimeSampling = "uniform"
    ) -> None:
        super().__init__()
        self.optimizer_config = optimizer
        self.seed = seed
        self.time_sampling: TimeSampling = time_sampling
        self.held_out = HeldOutMeans()
        self.logged_losses: dict[str, Tensor] = {}
        self.grad_norms: dict[str, Tensor] | None = None  # of this step, if the guard has them
        self.step_skipped = False
        self.residuals = ResidualAverages()
        self._step_residuals: list[Tensor] = []  # of the batches of this step

    @abstractmethod
    def trainable(self) -> dict[str, nn.Module]:
        """Networks that this stage trains, by name; frozen parameters inside stay frozen."""

    # Data

    def check_trainer(self, trainer: L.Trainer, *, fits: bool) -> None:
        """Refuse settings of the trainer that this stage cannot run, or ``fits``, train with."""
        check_trainer(trainer)
        if fits:
            self.optimizer_config.check_last_step(trainer.max_steps)

    def check_before_data(
        self, trainer: L.Trainer, datamodule: L.LightningDataModule, resumed: Checkpoint | None
    ) -> None:
        """Refuse what a fit cannot work with, as far as that shows before its data are prepared.

        A fit checks all of it again, when scans may have been simulated for hours.

        Args:
            trainer: Trainer of the fit.
            datamodule: Its data.
            resumed: Checkpoint that it goes on from; None for a new run.
        """
        self.check_trainer(trainer, fits=True)
        if resumed is None:
            return
        self._check_stage(resumed.stage)
        planned = planned_geometry(datamodule)
        if planned is not None and resumed.geometry is not None:
            check_planned_images(planned, resumed.geometry, "the checkpoint")

    def attach_scans(self) -> tuple[Any, ScanGeometry]:
        """Data module and scan geometry, after a check of the trainer; keeps what files record.

        The data module may be any that gives :class:`r3dpa.data.LidarBatch` batches.
        """
        self.check_trainer(self.trainer, fits=self.trainer.state.fn == "fit")
        datamodule = getattr(self.trainer, "datamodule", None)
        geometry = getattr(datamodule, "geometry", None)
        if not isinstance(geometry, ScanGeometry):
            raise ValueError(
                f"--data.class_path: {type(self).__name__} needs a data module that gives "
                "r3dpa.data.LidarBatch batches and has a geometry (r3dpa.geometry.ScanGeometry), "
                f"such as r3dpa.data.LidarDataModule, got {type(datamodule).__name__}; in Python, "
                "give trainer.fit a datamodule"
            )
        self.geometry = geometry
        self.augmentation = getattr(datamodule, "augmentation", None)
        return datamodule, geometry

    @property
    def scan_geometry(self) -> ScanGeometry:
        """Geometry of the scans it trains on, known from setup or from a checkpoint."""
        if self.geometry is None:
            raise RuntimeError("the module has no scan geometry yet: set it up with a data module")
        return self.geometry

    # Random draws

    @property
    def batch_number(self) -> int:
        """Training batches before this one, over all epochs and resumed runs."""
        return self.trainer.fit_loop.epoch_loop.total_batch_idx

    def draw_path(self, num_samples: int, number: int | None = None) -> PathDraws:
        """Posterior noise, times and path noise for this process's part of a global batch.

        They are a function of ``(seed, batch, sample)``, whatever the number of processes.

        Args:
            num_samples: Samples B of the batch on this process.
            number: Number of the batch since the start of training. Default: the batch at hand.
        """
        world, rank = self.trainer.world_size, self.trainer.global_rank
        number = self.batch_number if number is None else number
        draws = self._draw([self.seed, 0, number], num_samples * world)
        return PathDraws(*(values[rank::world] for values in draws))

    def draw_held_out(self, index: Tensor) -> PathDraws:
        """Draws for held-out samples ``(B,)``, a function of ``(seed, index)``."""
        each = [self._draw([self.seed, 1, number], 1) for number in index.tolist()]
        return PathDraws(*map(torch.cat, zip(*each, strict=True)))

    def _draw(self, key: list[int], total: int) -> PathDraws:
        generator = random_generator(key, self.device, bits=32)
        shape = (total, *self.latent_shape)
        return PathDraws(
            torch.randn(shape, generator=generator, device=self.device),
            sample_time(total, self.time_sampling, generator=generator),
            torch.randn(shape, generator=generator, device=self.device),
            torch.rand(total, generator=generator, device=self.device),
            torch.rand(total, 2, generator=generator, device=self.device),
        )

    # Losses

    def flow_errors(
        self,
        sit: VelocityNetwork,
        latents: Tensor,
        features: Tensor | None,
        draws: PathDraws,
        *,
        velocity: bool,
        alignment: bool,
    ) -> dict[str, Tensor]:
        """L_denoise and L_align, each ``(B,)``, of normalised latents: those requested, by name."""
        noisy = self.interpolant.interpolate(latents, draws.noise, draws.time)
        predicted, projected = None, None
        if velocity and alignment:
            predicted, projected = sit(noisy, draws.time)
        elif velocity:
            predicted = sit.velocity(noisy, draws.time)
        elif alignment:
            projected = sit.project_features(noisy, draws.time)
        errors = {}
        if predicted is not None:
            target = self.interpolant.target(latents, draws.noise, draws.time)
            errors["denoising"] = losses.flow_matching_loss(predicted, target)
        if projected is not None:
            errors["alignment"] = self.alignment_errors(projected, features)
        return errors

    def flow_losses(
        self, normalised: Tensor, features: Tensor | None, draws: PathDraws
    ) -> dict[str, Tensor]:
        """L_denoise + lambda2 L_align on normalised latents without gradient."""
        weights = self.weights
        trains_velocity = weights.denoising != 0
        aligns = weights.sit_alignment != 0 and not self.alignment_ended
        errors = self.flow_errors(
            self.sit, normalised, features, draws, velocity=trains_velocity, alignment=aligns
        )
        if trains_velocity:
            parts = {"denoising": weights.denoising * errors["denoising"].mean()}
        else:
            parts = {"denoising": zero_loss(self.sit)}
        if aligns:
            parts["sit_alignment"] = weights.sit_alignment * errors["alignment"].mean()
        elif weights.sit_alignment != 0:
            parts["sit_alignment"] = zero_loss(self.sit.projector)
        return parts

    @property
    def alignment_ended(self) -> bool:
        """Whether the alignment of the flow has been stopped or released."""
        stop = self.weights.alignment_stop
        return self.residuals.released or (stop is not None and self.global_step >= stop)

    def alignment_errors(self, projected: Tensor, features: Tensor | None) -> Tensor:
        """L_align ``(B,)`` of projected tokens and feature grids, both ``(B, N, D)``."""
        if features is None:
            raise ValueError(
                f"stage {self.stage} aligns with 3D features, but the batch holds no feature_grid"
            )
        if self.weights.centre_features:
            features = losses.centred_features(features)
        skip = self.weights.skip_empty_cells
        return losses.alignment_loss(projected, features, skip_empty_cells=skip)

    def weigh_and_log(self, parts: Mapping[str, Tensor]) -> Tensor:
        """Sum of weighted losses; logs it as ``train/loss``, and each loss without its weight.

        The logged values are kept in ``logged_losses``; losses of weight 0 are not logged.
        """
        total = torch.stack(list(parts.values())).sum()
        factors = {name: getattr(self.weights, name) for name in parts}
        if self.weights.adversarial_ratio is not None and "adversarial" in factors:
            factors["adversarial"] = 1.0  # balanced by its gradient, not weighted
        values = {n: value.detach() / factors[n] for n, value in parts.items() if factors[n] != 0}
        values["loss"] = total.detach()
        if "sit_alignment" in values:
            self._step_residuals.append(1 + values["sit_alignment"])
        self.logged_losses = values
        self.log_dict({f"train/{name}": value for name, value in values.items()})
        return total

    # Optimisation

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """One AdamW with a parameter group per trained network, fused where the device has it."""
        groups = [
            {"params": [p for p in network.parameters() if p.requires_grad], "name": name}
            for name, network in self.trainable().items()
        ]
        settings = self.optimizer_config.adamw()
        return torch.optim.AdamW(groups, **settings, fused=self._uses_fused_optimizer())

    def _uses_fused_optimizer(self) -> bool:
        """Whether to use fused AdamW.

        Not with float16, where it would unscale the gradients after clipping.
        """
        supported = self.device.type in ("cpu", "cuda", "mps", "xpu")
        return supported and self.trainer.precision != "16-mixed"

    def on_train_start(self) -> None:
        """Restore a resumed optimiser to its device and to the memory format of the weights.

        A fused optimiser walks through the memory of weights and moments alike, unchecked.
        """
        optimizer = cast(torch.optim.Optimizer, self.optimizers(use_pl_optimizer=False))
        fused = self._uses_fused_optimizer()
        for group in optimizer.param_groups:
            group["fused"] = fused
        for parameter, state in optimizer.state.items():
            state["step"] = state["step"].to(parameter.device if fused else "cpu")
            for name in ("exp_avg", "exp_avg_sq"):
                if state[name].stride() != parameter.stride():
                    state[name] = torch.empty_like(parameter).copy_(state[name])

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Set the rate of the coming step, a function of its number alone."""
        self._follow_residual()
        config = self.optimizer_config
        rate = config.rate(self.global_step, self.trainer.max_steps)
        relative = {
            "discriminator": config.discriminator_rate,
            "thin_decoder": config.thin_decoder_rate,
        }
        for group in optimizer.param_groups:
            group["lr"] = relative.get(group["name"], 1.0) * rate

    def _follow_residual(self) -> None:
        """Add the alignment residual of this step to its averages.

        It is the mean over the processes and over the batches that the step accumulates.
        """
        residuals, self._step_residuals = self._step_residuals, []
        if not residuals or self.step_skipped or self.alignment_ended:
            return
        within, decays = self.weights.alignment_release, self.weights.alignment_decays
        if within is not None:
            residual = torch.stack(residuals).mean()
            mean = cast(Tensor, self.trainer.strategy.reduce(residual, reduce_op="mean"))
            fall = self.residuals.update(mean.item(), decays, within)
            self.log("train/alignment_fall", fall)

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: int | float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip each network's gradient norm by itself, and log it as ``grad_norm/<network>``."""
        algorithm = gradient_clip_algorithm
        if algorithm not in (None, "norm"):
            raise ValueError(
                "gradients are clipped by norm per network; leave gradient_clip_algorithm out, got "
                f"{getattr(algorithm, 'value', algorithm)!r}"
            )
        norms = self.grad_norms or gradient_norms(optimizer, self.device)
        self.grad_norms = None
        self.log_dict({f"grad_norm/{name}": norm for name, norm in norms.items()})
        limit = float(gradient_clip_val or 0)
        limit = limit if limit > 0 else float("inf")  # 0 and below: no clipping, as in Lightning
        for group in optimizer.param_groups:
            nn.utils.clip_grads_with_norm_(group["params"], limit, norms[group["name"]])

    # Held-out samples

    def on_validation_epoch_end(self) -> None:
        """Log the means over the held-out samples as ``val/<name>``."""
        self._log_held_out("val")

    def on_test_epoch_end(self) -> None:
        """Log the means over the held-out samples as ``test/<name>``."""
        self._log_held_out("test")

    def _log_held_out(self, split: str) -> None:
        means = self.held_out.compute()
        self.log_dict({f"{split}/{name}": mean for name, mean in means.items()})
        self.held_out.reset()

    # Checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add stage, interpolant and version, and of scans what sampling and a resume need."""
        facts: dict[str, Any] = {
            "stage": self.stage,
            "interpolant": self.interpolant.path,
            "version": __version__,
            "commit": source_commit(),
        }
        if self.geometry is not None:
            facts["geometry"] = self.geometry.to_dict()
            facts["augmentation"] = None if self.augmentation is None else asdict(self.augmentation)
            facts["feature_source"] = self.feature_source
        checkpoint["r3dpa"] = facts
        if self.residuals.steps:
            checkpoint["alignment_residuals"] = asdict(self.residuals)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse the checkpoint of another stage or of other range images, and keep its step.

        Optimiser settings stay as this run has them.
        """
        self.loaded_step = checkpoint.get("global_step", 0)
        facts = checkpoint.get("r3dpa", {})
        self._check_stage(facts.get("stage"))
        if "geometry" in facts:
            self._check_geometry(ScanGeometry.from_dict(facts["geometry"]), "the checkpoint")
        if "state_dict" in checkpoint:
            self._check_networks(checkpoint["state_dict"])
        self.residuals = ResidualAverages(**checkpoint.get("alignment_residuals", {}))
        for state in checkpoint.get("optimizer_states", []):
            for group in state["param_groups"]:
                group.update(self.optimizer_config.adamw())

    def _check_networks(self, theirs: Mapping[str, Tensor]) -> None:
        """Refuse to go on from networks of other sizes."""
        ours = self.state_dict()
        for name in sorted(ours.keys() | theirs.keys()):
            given, here = (list(s[name].shape) if name in s else "none" for s in (theirs, ours))
            if given != here:
                raise ValueError(
                    f"the checkpoint has other networks: {name} is {given} there, {here} here. "
                    "Set the networks as in config.yaml of its run"
                )

    def _check_stage(self, stage: str | None) -> None:
        """Refuse to go on from the checkpoint of another stage."""
        if stage != self.stage:
            raise ValueError(
                f"the checkpoint is of stage {stage!r}, this is {self.stage!r}; to start a stage "
                "from another one, give --model.init_args.init_from, not --ckpt_path"
            )

    def _check_geometry(self, recorded: ScanGeometry, source: str) -> None:
        """Refuse weights that were trained on other range images than this run's."""
        if self.geometry is None:
            self.geometry = recorded
        check_same_images(self.geometry, recorded, source)


@contextmanager
def networks_as_settings() -> Iterator[None]:
    """For ``save_hyperparameters()``, without Lightning's advice to leave networks out.

    Kept, they are class paths in a checkpoint of the CLI, from which the networks are rebuilt.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Attribute '.*' is an instance of `nn.Module`")
        yield


@contextmanager
def frozen(*networks: nn.Module) -> Iterator[None]:
    """Record the forward pass inside without gradients to the networks' own parameters.

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


def zero_loss(network: nn.Module) -> Tensor:
    """Loss of exactly 0 that gives each trained parameter a gradient of 0, at no cost.

    Under DDP each trained network must take part in each step.
    """
    empty = [p.flatten()[:0].sum() for p in network.parameters() if p.requires_grad]
    return torch.stack(empty).sum()


def gradient_norms(optimizer: torch.optim.Optimizer, device: torch.device) -> dict[str, Tensor]:
    """Gradient norm of each parameter group by its name, on the device."""
    return {
        group.get("name", str(index)): nn.utils.get_total_norm(
            [p.grad for p in group["params"] if p.grad is not None]
        ).to(device)  # without any gradient it is made on the host
        for index, group in enumerate(optimizer.param_groups)
    }


def check_trainer(trainer: L.Trainer) -> None:
    """Refuse precisions and callbacks that the stages cannot train with."""
    settings = cast(Any, trainer)
    if settings.precision not in _PRECISIONS:
        raise ValueError(
            f"--trainer.precision {settings.precision} is not supported, as weights, statistics "
            f"and prepared scans are float32: give one of {', '.join(_PRECISIONS)}"
        )
    if settings.reload_dataloaders_every_n_epochs:
        raise ValueError(
            "--trainer.reload_dataloaders_every_n_epochs would break the order of a resumed run: "
            "leave it out; the loaders shuffle each epoch anew"
        )
    if any(isinstance(callback, StochasticWeightAveraging) for callback in settings.callbacks):
        raise ValueError(
            "StochasticWeightAveraging is not supported: leave the callback out; stages that train "
            "a SiT keep an average of their own, see --model.init_args.ema_decay"
        )
