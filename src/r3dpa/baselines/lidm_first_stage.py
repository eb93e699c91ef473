"""Training of LiDM's autoencoder."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa import losses
from r3dpa.baselines.base import Baseline
from r3dpa.baselines.lidm_networks import VQAutoencoder
from r3dpa.data.datasets import LidarBatch
from r3dpa.geometry import unproject
from r3dpa.modules.settings import OptimizerConfig
from r3dpa.modules.stage import frozen, networks_as_settings, zero_loss
from r3dpa.nn import PatchDiscriminator

_MOST_WEIGHT = 1e4


class LiDMFirstStage(Baseline):
    """Vector-quantised autoencoder of range images, as LiDM trains it.

    Loss: mean of l1 and, where they have a factor, errors of the empty pixels and of x and y of the
    points; codebook; and a patch discriminator, weighed so that its gradient at the last layer is
    ``adversarial`` times as long as the gradient of the mean.

    Source: Ran et al. (CVPR 2024), with the released configuration as default.

    Args:
        network: Autoencoder.
        discriminator: Of images, with points of three channels.
        mask_factor: Weight of the second output, which needs ``network.mask``.
        geometry_factor: Weight of the squared distance of points seen from above.
        adversarial: Ratio of gradient norms, discriminator to reconstruction.
        adversarial_start: Step at which the discriminator begins.
        released_start: End the discriminator after that step instead, as in the released code.
        released_geometry: Read ranges from images that are mapped to [0, 1] twice, as in the
            released code, in which empty pixels are at 6.6 m.
        curve_length: Columns that are averaged before points are compared.
        optimizer: Optimiser settings; the released rate is 4.5e-6 times the batch size.
        seed: Key of the training draws.
    """

    stage = "lidm_first_stage"
    network: VQAutoencoder

    def __init__(
        self,
        network: VQAutoencoder,
        discriminator: PatchDiscriminator,
        mask_factor: float = 0.0,
        geometry_factor: float = 0.0,
        adversarial: float = 0.6,
        adversarial_start: int = 1,
        released_start: bool = True,
        released_geometry: bool = True,
        curve_length: int = 1,
        optimizer: OptimizerConfig = OptimizerConfig(3.6e-5, (0.5, 0.9), 0.0),
        seed: int = 0,
    ) -> None:
        if mask_factor and not network.mask:
            raise ValueError(f"mask_factor {mask_factor:g} needs a network with mask: true")
        shape = (network.latent_channels, 1, 1)
        super().__init__(network, shape, optimizer, None, seed)
        with networks_as_settings():
            self.save_hyperparameters()
        self.discriminator = discriminator
        self.mask_factor, self.geometry_factor = mask_factor, geometry_factor
        self.adversarial, self.adversarial_start = adversarial, adversarial_start
        self.released_start, self.released_geometry = released_start, released_geometry
        self.curve_length = curve_length

    def image_shape(self) -> tuple[int, ...]:
        """Images of any size that the strides divide and that hold a patch."""
        sensor = self.scan_geometry.projection.sensor
        self.network.latent_size((sensor.beams, sensor.columns))
        least = self.discriminator.least_size
        if min(sensor.beams, sensor.columns) < least:
            raise ValueError(
                f"images of {sensor.beams} x {sensor.columns} pixels are smaller than a patch of "
                f"the discriminator: give them {least} rows and columns, or the discriminator "
                "fewer num_layers"
            )
        return self.network.in_channels, sensor.beams, sensor.columns

    def coordinates(self, image: Tensor) -> Tensor:
        """Points ``(B, 3, H, W / curve_length)`` in metres of images ``(B, 1, H, W)``.

        Ranges are clamped to the limits of the sensor, so that empty pixels have points too.
        """
        projection, codec = self.scan_geometry.projection, self.scan_geometry.codec
        image = image / 2 + 0.5 if self.released_geometry else image
        limits = projection.sensor.range_min_m, projection.sensor.range_max_m
        range_m = codec.to_range(image[:, 0]).clamp(*limits)
        points = unproject(range_m, projection, corner=True).movedim(-1, 1)
        return F.avg_pool2d(points, (1, self.curve_length))

    def reconstruction(
        self, image: Tensor, prediction: Tensor, returns: Tensor
    ) -> dict[str, Tensor]:
        """Weighted errors, divided by their number, of outputs ``(B, 1 or 2, H, W)``.

        ``returns`` ``(B, 1, H, W)`` is 1 where there is a return, else -1.
        """
        of_range = prediction[:, :1] if self.mask_factor else prediction
        parts = {"reconstruction": F.l1_loss(*torch.broadcast_tensors(of_range, image))}
        if self.mask_factor:
            parts["mask"] = self.mask_factor * F.l1_loss(prediction[:, 1:2], returns)
        if self.geometry_factor:
            there, here = (self.coordinates(x)[:, :2] for x in (image, prediction[:, :1]))
            parts["geometry"] = self.geometry_factor * (there - here).square().sum(dim=1).mean()
        return {name: value / len(parts) for name, value in parts.items()}

    def logits(self, image: Tensor, *more: Tensor) -> Tensor:
        """Patch logits of images or outputs, with x and y of their points where those count."""
        if self.geometry_factor:
            more = (*more, self.coordinates(image[:, :1])[:, :2])
        return self.discriminator(torch.cat([image, *more], dim=1))

    def adversarial_loss(self, prediction: Tensor, error: Tensor) -> tuple[Tensor, Tensor]:
        """Weight of the generator's loss by the gradients at the last layer, and that loss."""
        with frozen(self.discriminator):
            loss = losses.generator_loss(self.logits(prediction))
        last = self.network.get_parameter("decoder.conv_out.weight")
        ours, theirs = (
            torch.autograd.grad(value, last, retain_graph=True)[0].norm() for value in (error, loss)
        )
        return self.adversarial * (ours / (theirs + 1e-4)).clamp(0, _MOST_WEIGHT).detach(), loss

    def discriminator_loss(self, image: Tensor, prediction: Tensor, returns: Tensor) -> Tensor:
        """Hinge loss on scans and detached outputs."""
        more = (returns,) if self.mask_factor else ()
        real, fake = self.logits(image, *more), self.logits(prediction.detach())
        return losses.discriminator_loss(real, fake)

    def is_adversarial(self, step: int) -> bool:
        """Whether the discriminator takes part in an optimiser step, counted from 0."""
        if self.released_start:
            return step <= self.adversarial_start
        return step >= self.adversarial_start

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on encoded range images ``(B, 1, H, W)``."""
        image = batch["range_image"]
        returns = torch.where(batch["valid_mask"], 1.0, -1.0).view_as(image)
        quantised = self.network.quantize(self.network.encode(image).mean)
        prediction = self.network.predict(quantised.latents)
        parts = self.reconstruction(image, prediction, returns)
        error = torch.stack(list(parts.values())).sum()
        parts["codebook"] = quantised.loss
        if self.is_adversarial(self.global_step):
            weight, loss = self.adversarial_loss(prediction, error)
            parts["adversarial"] = weight * loss
            parts["discriminator"] = self.discriminator_loss(image, prediction, returns)
        else:
            parts["discriminator"] = zero_loss(self.discriminator)
        self.log_dict({f"train/{name}": value.detach() for name, value in parts.items()})
        return self.log_loss(torch.stack(list(parts.values())).sum())

    def validation_step(self, batch: LidarBatch, batch_idx: int) -> None:
        """Add the absolute error of held-out scans through the codebook to the means."""
        image = batch["range_image"]
        decoded = self.network.decode(self.network.encode(image).mean)
        self.held_out.update(
            batch["index"], reconstruction=(decoded - image).abs().flatten(1).mean(1)
        )

    test_step = validation_step

    def trainable(self) -> dict[str, nn.Module]:
        """Autoencoder and discriminator."""
        return {"network": self.network, "discriminator": self.discriminator}
