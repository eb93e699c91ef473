"""Base class of the stages trained on RGB images."""

from __future__ import annotations

from typing import Any

from r3dpa.data.image_datamodule import ImageDataModule
from r3dpa.modules.stage import Stage
from r3dpa.nn import ImageVAE


class ImageStage(Stage):
    """Base class of the stages trained on RGB images; their checkpoints record the image source."""

    vae: ImageVAE

    @property
    def images(self) -> ImageDataModule:
        """Data module, whose images are of a size that the VAE can encode."""
        datamodule = getattr(self.trainer, "datamodule", None)
        if not isinstance(datamodule, ImageDataModule):
            raise ValueError(
                f"{type(self).__name__} needs an ImageDataModule, got {type(datamodule).__name__}"
            )
        self.vae.latent_size((datamodule.image_size, datamodule.image_size))
        return datamodule

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the images that it was trained with."""
        super().on_save_checkpoint(checkpoint)
        checkpoint["r3dpa"]["images"] = self.images.settings
