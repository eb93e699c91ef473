"""What the stages on RGB images share: settings, checkpoints, steps."""

from __future__ import annotations

import warnings
from typing import Any, cast

from torch import Tensor

from r3dpa.data.image_datamodule import ImageDataModule
from r3dpa.data.images import ImageBatch
from r3dpa.flow import Interpolant
from r3dpa.modules.guards import StepGuard
from r3dpa.modules.optimisation import GuardedOptimisation
from r3dpa.modules.settings import GuardConfig, LossWeights, OptimizerConfig, TimeSampling
from r3dpa.nn import ImageVAE

__all__ = ["ImageStage"]


class ImageStage(GuardedOptimisation):
    """Base of the stages that know no LiDAR: they see images of an :class:`ImageDataModule`.

    Optimiser, clipping, guards and draws are those of the other stages.

    Args:
        vae: Image autoencoder.
        weights: Loss weights.
        optimizer: Optimiser settings.
        time_sampling: Density of the training times.
        seed: Key of the training draws.
        guards: When a step is dropped, and when training stops; None trains without.
    """

    data_class = ImageDataModule
    vae: ImageVAE  # type: ignore[assignment]  # of images, not of range images

    def __init__(
        self,
        vae: ImageVAE,
        weights: LossWeights,
        optimizer: OptimizerConfig,
        time_sampling: TimeSampling,
        seed: int,
        guards: GuardConfig | None,
    ) -> None:
        super().__init__()
        with warnings.catch_warnings():
            # Kept, networks are class paths in a checkpoint, from which they are rebuilt.
            warnings.filterwarnings(
                "ignore", message="Attribute '.*' is an instance of `nn.Module`"
            )
            self.save_hyperparameters()
        self.vae = vae
        self.weights, self.optimizer_config = weights, optimizer
        self.time_sampling, self.seed = time_sampling, seed
        self.interpolant = Interpolant("linear")
        self.discriminator, self.ema = None, None
        self.guard = None if guards is None else StepGuard(guards)
        self.resumed = False

    @property
    def datamodule(self) -> ImageDataModule:
        """That of the trainer."""
        return cast(Any, self.trainer).datamodule

    @property
    def latent_size(self) -> tuple[int, int]:
        """Rows and columns of the latents of the images."""
        size = self.datamodule.image_size
        return self.vae.latent_size((size, size))

    def setup(self, stage: str) -> None:
        """Checks data against networks.

        Raises:
            ValueError: If the trainer has no :class:`ImageDataModule`, or its images do not fit.
        """
        found = getattr(self.trainer, "datamodule", None)
        if not isinstance(found, ImageDataModule):
            raise ValueError(
                f"{type(self).__name__} needs an ImageDataModule, got {type(found).__name__}"
            )
        self.vae.latent_size((found.image_size, found.image_size))

    def training_step(self, batch: ImageBatch, batch_idx: int) -> Tensor:
        """One step on a batch of images or of their posteriors."""
        draws = self.draw_path(len(batch["index"]), self.batch_number)
        return self.weigh_and_log(self.step_losses(batch, draws))

    def evaluate(self, batch: ImageBatch, batch_idx: int) -> dict[str, Tensor]:
        """Losses of held-out images without their weights, by name."""
        raise NotImplementedError

    def validation_step(self, batch: ImageBatch, batch_idx: int) -> None:
        """Evaluates held-out images under ``val/``."""
        self._log(batch, batch_idx, "val")

    def test_step(self, batch: ImageBatch, batch_idx: int) -> None:
        """Evaluates held-out images under ``test/``."""
        self._log(batch, batch_idx, "test")

    def _log(self, batch: ImageBatch, batch_idx: int, prefix: str) -> None:
        values = self.evaluate(batch, batch_idx)
        self.log_dict(
            {f"{prefix}/{name}": value for name, value in values.items()},
            batch_size=len(batch["index"]),
            sync_dist=True,
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the images that it was trained with to what every stage adds."""
        super().on_save_checkpoint(checkpoint)
        checkpoint["r3dpa"]["images"] = self.datamodule.settings

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuses the checkpoint of another stage.

        Raises:
            ValueError: Naming both stages.
        """
        super().on_load_checkpoint(checkpoint)
        self.resumed = True
