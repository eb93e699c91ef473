"""What the three training modules share: settings, start of a stage, checkpoints."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Literal, cast

import lightning as L
import torch
from lightning.pytorch.utilities import rank_zero_info

from r3dpa.checkpoints import (
    load_into,
    read_checkpoint,
    transfer_rgb,
)
from r3dpa.data.augmentation import Augmentation
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.flow import Interpolant
from r3dpa.geometry import ScanGeometry
from r3dpa.modules.evaluation import Evaluation
from r3dpa.modules.guards import StepGuard
from r3dpa.modules.optimisation import GuardedOptimisation
from r3dpa.modules.settings import GuardConfig, LossWeights, OptimizerConfig, PathName, TimeSampling
from r3dpa.modules.step_losses import PathDraws, frozen
from r3dpa.nn import EMA, VAE, LatentNorm, PatchDiscriminator, SiT, VelocityNetwork

__all__ = ["GenerativeModule", "PathDraws", "frozen"]

_GUARDS = GuardConfig()


class GenerativeModule(Evaluation, GuardedOptimisation):
    """Base of the training modules.

    A subclass names its stage, lists its networks in :meth:`trainable` and adds up the losses of a
    step in :meth:`step_losses`. All losses of a step come from the same forward values, so one
    optimiser with a parameter group per network and one backward pass equal the official three
    optimisers stepped in turn; ``accumulate_grad_batches``, ``gradient_clip_val`` (per network),
    plain ``ddp`` and ``global_step`` keep their usual meaning.

    Random numbers of a step are a function of ``(seed, batch, sample)`` alone: they do not depend
    on the number of processes and need no state for an exact resume.

    Args:
        vae: Range-image autoencoder.
        sit: Velocity network over its latents, :class:`r3dpa.nn.SiT` or :class:`r3dpa.nn.UNet`.
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
        rgb_weights: RGB-pretrained SiT, official ``.pt`` or ours, for a SiT only; None starts from
            random values.
        keep_projector: Keep the RGB model's projection head where its shape fits.
        seed: Key of the training draws.
        guards: When a step is dropped, and when training stops; None trains without: the first
            non-finite gradient then breaks the weights.
        channels_last: Keep images and kernels of VAE and discriminator with their channels next to
            each other. The same numbers to rounding; files keep the usual order.
        compile: Compile the networks for training with ``torch.compile``: VAE, discriminator and
            each block of the velocity network. The first step takes minutes; files have the same
            names.
    """

    replayed = True
    default_init: tuple[str, ...] = ()
    trains_velocity: bool = True
    data_class: type[L.LightningDataModule] = LidarDataModule  # that it works with, see StageCLI

    def __init__(
        self,
        vae: VAE,
        sit: VelocityNetwork,
        discriminator: PatchDiscriminator | None = None,
        weights: LossWeights = LossWeights(),
        optimizer: OptimizerConfig = OptimizerConfig(),
        path: PathName = "linear",
        time_sampling: TimeSampling = "uniform",
        ema_decay: float = 0.9999,
        ema_buffers: Literal["copy", "decay"] = "copy",
        latent_norm: LatentNorm | None = None,
        init_from: str | None = None,
        init_networks: list[str] | None = None,
        rgb_weights: str | None = None,
        keep_projector: bool = False,
        seed: int = 0,
        guards: GuardConfig | None = _GUARDS,
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
        self.guard = None if guards is None else StepGuard(guards)
        self.channels_last = channels_last
        self.compiles = compile
        self.ema: EMA | None = None
        if self.trains_velocity:
            self.ema = EMA(sit, self.latent_norm, ema_decay, ema_buffers)
        self.geometry: ScanGeometry | None = None
        self.augmentation: Augmentation | None = None
        self.loaded_step = 0
        self.feature_source: str | None = None
        self._has_weights = False
        self._previous_geometry: Mapping[str, Any] | None = None

    # Starting a stage

    def configure_model(self) -> None:
        """Arranges the memory of the networks, and compiles them for a fit."""
        self.arrange_networks()
        if self.compiles and self.trainer.state.fn == "fit":
            # In place and part by part: names in checkpoints stay, and equal blocks share a graph.
            parts = [self.vae.encoder, self.vae.decoder, self.discriminator]
            for part in [*parts, *self.sit.compiled_parts]:
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
            self.feature_source = datamodule.feature_source
        if self.needs_features() and stage != "predict":
            self._check_features(self.geometry, datamodule)

    def on_fit_start(self) -> None:
        """Loads the stage before, unless this run goes on from a checkpoint of its own."""
        if not self._has_weights:
            self.load_previous_stage()
        if self._previous_geometry is not None:
            self._check_geometry(self._previous_geometry, str(self.init_from))

    def load_previous_stage(self) -> None:
        """Loads ``rgb_weights`` and ``init_from`` and restarts the EMA from the loaded weights.

        A fit does it by itself; called earlier, it says early what does not fit.

        Raises:
            ValueError: Listing everything in the file that does not fit this stage.
        """
        if self.rgb_weights is not None:
            if not isinstance(self.sit, SiT):
                raise ValueError(
                    f"rgb_weights start a SiT, but model.sit is a {type(self.sit).__name__}; "
                    "leave rgb_weights out"
                )
            rgb = read_checkpoint(self.rgb_weights)
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
                f"feature grids are {geometry.grid_size}, but the {type(self.sit).__name__} has "
                f"{tuple(self.sit.grid_size)} tokens; set data.grid_size to the latter"
            )
        if datamodule.feature_dim != self.sit.feature_dim:
            raise ValueError(
                f"features have width {datamodule.feature_dim}, but sit.feature_dim is "
                f"{self.sit.feature_dim}; set it to the former"
            )

    # Checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds stage and scan geometry, enough to sample from, and what it was trained with.

        Weights are written in the usual order in memory, whatever this run works with.
        """
        state = checkpoint["state_dict"]
        checkpoint["state_dict"] = {name: value.contiguous() for name, value in state.items()}
        super().on_save_checkpoint(checkpoint)
        checkpoint["r3dpa"] |= {
            "geometry": self.scan_geometry.to_dict(),
            "augmentation": None if self.augmentation is None else asdict(self.augmentation),
            "feature_source": self.feature_source,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage or of other range images.

        Raises:
            ValueError: Naming both stages or both geometries.
        """
        self.loaded_step = checkpoint.get("global_step", 0)
        self._has_weights = True
        super().on_load_checkpoint(checkpoint)
        stored = checkpoint["r3dpa"]["geometry"]
        if self.geometry is None:
            self.geometry = ScanGeometry.from_dict(stored)
        else:
            self._check_geometry(stored, "the checkpoint")
