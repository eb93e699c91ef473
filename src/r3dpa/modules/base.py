"""Base class of the stages on range images: their start, their losses, evaluation, checkpoints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, Literal, cast

import lightning as L
import torch
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor

from r3dpa import losses
from r3dpa.checkpoints import (
    Checkpoint,
    load_into,
    read_checkpoint,
    transfer_rgb,
    with_projector_of,
    without_further_channels,
)
from r3dpa.checkpoints.image_size import resize_to
from r3dpa.checkpoints.transfer import TransferRow
from r3dpa.data.datasets import LidarBatch
from r3dpa.flow import Interpolant, PerturbedAttention
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.generation import SceneGenerator
from r3dpa.geometry import UNKNOWN_CLASS, ScanGeometry
from r3dpa.io import text_table
from r3dpa.modules.checks import (
    check_features,
    check_image,
    check_latents,
    check_path,
    check_planned_images,
    planned_geometry,
)
from r3dpa.modules.perceptual import PerceptualLoss
from r3dpa.modules.settings import LossWeights, OptimizerConfig, PathName, TimeSampling
from r3dpa.modules.stage import PathDraws, Stage, frozen, networks_as_settings, zero_loss
from r3dpa.nn import EMA, VAE, LatentNorm, PatchDiscriminator, Posterior, SiT, VelocityNetwork


class GenerativeModule(Stage):
    """Base class of the stages that train the range-image VAE or the flow over its latents.

    A subclass names its stage, lists its networks in :meth:`trainable` and has its own
    ``training_step``, composed of the losses here. Steps that are not finite are skipped by the
    callback :class:`r3dpa.callbacks.StepGuard`.

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
        init_other_sensor: Start from weights for images of another sensor: position tables and
            stems are resized where the images have another size.
        rgb_weights: RGB-pretrained SiT, official ``.pt`` or ours, for a SiT only; None starts from
            random values.
        keep_projector: Keep the RGB model's projection head where its shape fits.
        latent_noise: Largest share of noise in the latents that the decoder learns from, see
            :meth:`decoder_latents`, in the stages that train it; 0 for none.
        further_dropout: Share of samples whose classes the encoder does not see, and of those whose
            intensity it does not, see :meth:`encoder_images`, in the stages that train it.
        guidance: Perturbed-attention guidance of generated scenes, recorded in checkpoints.
        seed: Key of the training draws.
        channels_last: Keep images and kernels of VAE and discriminator with their channels next to
            each other. The same numbers to rounding; files keep the usual order.
        compile: Compile the networks for training with ``torch.compile``: VAE, discriminator and
            each block of the velocity network. The first step takes minutes; files have the same
            names.
    """

    stage: str
    default_init: tuple[str, ...] = ()
    trains_velocity: bool = True

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
        latent_noise: float = 0.0,
        further_dropout: float = 0.0,
        guidance: PerturbedAttention | None = None,
        seed: int = 0,
        channels_last: bool = False,
        compile: bool = False,
        init_other_sensor: bool = False,
    ) -> None:
        for name, share in {
            "latent_noise": latent_noise,
            "further_dropout": further_dropout,
        }.items():
            if not 0 <= share <= 1:
                raise ValueError(f"{name} must lie in [0, 1], got {share}")
        super().__init__(optimizer, seed, time_sampling)
        with networks_as_settings():
            self.save_hyperparameters()
        self.vae = vae
        self.sit = sit
        self.discriminator = discriminator
        self.latent_norm = latent_norm or LatentNorm(vae.latent_channels)
        self.weights = weights
        self.interpolant = Interpolant(path)
        self.latent_shape = (vae.latent_channels, *sit.input_size)
        self.init_from = init_from
        if init_networks is None:
            init_networks = [name for name in self.default_init if getattr(self, name) is not None]
        self.init_networks = tuple(init_networks)
        self.init_other_sensor = init_other_sensor
        self.rgb_weights = rgb_weights
        self.keep_projector = keep_projector
        self.channels_last = channels_last
        self.compiles = compile
        self.latent_noise = latent_noise
        self.further_dropout = further_dropout
        self.guidance = guidance
        self.ema: EMA | None = None
        if self.trains_velocity:
            self.ema = EMA(sit, self.latent_norm, ema_decay, ema_buffers)
        self._perceptual_loss: PerceptualLoss | None = None
        self._has_weights = False
        self._previous_geometry: Mapping[str, Any] | None = None

    # Starting a stage

    def configure_model(self) -> None:
        """Arrange the memory of the networks, and compile them for a fit."""
        format_ = torch.channels_last if self.channels_last else torch.contiguous_format
        for network in (self.vae, self.discriminator):
            if network is not None:
                cast(Any, network).to(memory_format=format_)  # not in torch's own stubs
        if self.compiles and self.trainer.state.fn == "fit":
            # In place and part by part: names in checkpoints stay, and equal blocks share a graph.
            parts = [self.vae.encoder, self.vae.decoder, self.discriminator]
            for part in [*parts, *self.sit.compiled_parts]:
                if part is not None:
                    part.compile(dynamic=False)

    def setup(self, stage: str) -> None:
        """Check trainer and data against the networks.

        The data module may be any that gives :class:`r3dpa.data.LidarBatch` batches and has a
        ``geometry`` after its own setup.
        """
        datamodule, geometry = self.attach_scans()
        self.check_data(datamodule, geometry, stage)
        if stage != "predict":
            self.feature_source = getattr(datamodule, "feature_source", None)

    def check_before_data(
        self, trainer: L.Trainer, datamodule: L.LightningDataModule, resumed: Checkpoint | None
    ) -> None:
        """Check trainer, networks and checkpoints, and load the stage before of a new run."""
        super().check_before_data(trainer, datamodule, resumed)
        planned = planned_geometry(datamodule)
        if planned is not None:
            self.check_data(datamodule, planned, "fit")
        if resumed is None:
            self.load_previous_stage()
            if planned is not None and self._previous_geometry is not None:
                check_planned_images(planned, self._previous_geometry, str(self.init_from))

    def check_data(self, datamodule: object, geometry: ScanGeometry, stage: str) -> None:
        """Refuse data that the networks are not made for, by their geometry and settings."""
        sensor = geometry.projection.sensor
        if geometry.codec.reflectance:
            raise ValueError(
                f"stage {self.stage} has no use for the reflectance of the images, which the "
                "baselines generate: set --data.init_args.codec.reflectance to false"
            )
        check_image(self.vae, geometry.codec)
        check_latents(self.vae, self.sit, (sensor.beams, sensor.columns))
        if stage != "predict" and self.needs_features():
            check_features(self.sit, geometry, datamodule, self.stage)

    def on_fit_start(self) -> None:
        """Load the stage before, unless this run goes on from a checkpoint of its own."""
        if not self._has_weights:
            self.load_previous_stage()
        if self._previous_geometry is not None:
            recorded = ScanGeometry.from_dict(dict(self._previous_geometry))
            self._check_geometry(recorded, str(self.init_from))

    def load_previous_stage(self) -> None:
        """Load ``rgb_weights`` and ``init_from``, and restart the EMA from the loaded weights.

        A fit calls it, and :meth:`check_before_data`.
        """
        if self.rgb_weights is not None:
            if not isinstance(self.sit, SiT):
                raise ValueError(
                    "--model.init_args.rgb_weights start a SiT, but the network is a "
                    f"{type(self.sit).__name__}: leave them out"
                )
            rgb = read_checkpoint(self.rgb_weights)
            rows = transfer_rgb(rgb, self.sit, self.latent_norm, self.keep_projector)
            rank_zero_info(f"RGB weights from {self.rgb_weights}\n{_table(rows)}")
        if self.init_from is not None:
            given = read_checkpoint(self.init_from)
            before = self.previous_networks(given)
            of_stage = {"vae": self.vae, "sit": self.sit, "latent_norm": self.latent_norm}
            of_stage |= self.trainable()
            if unknown := [name for name in self.init_networks if name not in of_stage]:
                raise ValueError(
                    f"--model.init_args.init_networks names {unknown[0]!r}, but the networks of "
                    f"this stage are {', '.join(of_stage)}"
                )
            networks = {name: of_stage[name] for name in self.init_networks}
            if self.init_other_sensor:
                before, rows = resize_to(networks, before, given)
                rank_zero_info(f"weights of another sensor from {self.init_from}\n{_table(rows)}")
            else:
                self._previous_geometry = before.geometry
            load_into(networks, before, stage=self.stage)
        if self.ema is not None:
            self.ema.reset(self.sit, self.latent_norm)
        self._has_weights = True

    def previous_networks(self, before: Checkpoint) -> Checkpoint:
        """Checkpoint of the stage before, with the networks that this stage has.

        Average velocities of stage few_step are left out, and so are refinement, intensity and
        class of a VAE where this run has none, and projection heads that this run cannot use.
        ``ValueError`` for velocities of another path.
        """
        if "sit" in self.init_networks:
            check_path(before, self.interpolant.path)
        networks = {}
        for name, state in before.networks.items():
            flow = {k: v for k, v in state.state_dict.items() if not k.startswith("average.")}
            networks[name] = replace(state, state_dict=flow)
        before = replace(before, networks=networks)
        if "vae" in networks and "vae" in self.init_networks:
            before = without_further_channels(before, self.vae)
        if not isinstance(self.sit, SiT):
            return before
        return with_projector_of(before, self.sit, aligns=self.needs_features())

    # Training

    def needs_features(self) -> bool:
        """Whether a training batch must hold feature grids."""
        return self.weights.vae_alignment != 0 or self.weights.sit_alignment != 0

    def vae_losses(
        self, image: Tensor, posterior: Posterior, prediction: Tensor
    ) -> dict[str, Tensor]:
        """L_AE: reconstruction, KL, perceptual and adversarial term.

        The discriminator stays untouched.
        """
        weights = self.weights
        parts = self.reconstruction_losses(image, prediction)
        if weights.kl != 0:
            parts["kl"] = weights.kl * posterior.kl().mean()
        if weights.perceptual != 0:
            if self._perceptual_loss is None:
                self._perceptual_loss = PerceptualLoss(self.scan_geometry)
            distance = self._perceptual_loss(self.vae.image_of(prediction), image)
            parts["perceptual"] = weights.perceptual * distance
        adversarial = weights.adversarial != 0 and self.global_step >= weights.adversarial_start
        if self.discriminator is not None and adversarial:
            scan = self.vae.scan_of(prediction)
            with frozen(self.discriminator):
                logits = self.discriminator(scan)
            if weights.adversarial_ratio is None:
                parts["adversarial"] = weights.adversarial * losses.generator_loss(logits)
            else:
                parts["adversarial"] = losses.balanced_generator_loss(
                    logits, scan, weights.adversarial_ratio
                )
        if not parts.keys() & {"reconstruction", "adversarial"}:
            parts["reconstruction"] = zero_loss(self.vae)
        return parts

    def reconstruction_losses(self, image: Tensor, prediction: Tensor) -> dict[str, Tensor]:
        """Weighted errors of outputs of a decoder, none if their weight is 0."""
        weights = self.weights
        if weights.reconstruction == 0:
            return {}
        if image.shape[1] == 1:
            error = losses.reconstruction_loss(prediction, image, weights.reconstruction_norm)
            return {"reconstruction": weights.reconstruction * error}
        each = self._range_losses(image, prediction)
        return {name: getattr(weights, name) * values.mean() for name, values in each.items()}

    def _range_losses(self, image: Tensor, prediction: Tensor) -> dict[str, Tensor]:
        """Losses ``(B,)`` of images of range and return, of their intensity and class too.

        Means over the pixels with a return, of classes with a label; the loss of returns is one
        over all pixels.
        """
        outputs = self.vae.outputs_of(prediction)
        ranges, returns = image[:, :1], image[:, 1:2] > 0
        if self.vae.modes == 2:
            error = self.vae.mixture_of(prediction).nll(ranges)
        else:
            error = losses.pixel_error(outputs.ranges, ranges, self.weights.reconstruction_norm)
        parts = {
            "reconstruction": losses.masked_mean(error, returns),
            "returns": losses.return_loss(cast(Tensor, outputs.returns), returns),
        }
        if outputs.intensity is not None:
            error = losses.pixel_error(outputs.intensity, image[:, 2:3])
            parts["intensity"] = losses.masked_mean(error, returns)
        if outputs.classes is not None:
            classes = image[:, -1:]
            error = losses.class_errors(outputs.classes, classes)
            parts["classes"] = losses.masked_mean(error, returns & (classes >= 0))
        return parts

    def discriminator_losses(self, image: Tensor, prediction: Tensor) -> dict[str, Tensor]:
        """Hinge loss on scans and detached reconstructions; zero before `adversarial_start`."""
        if self.discriminator is None:
            return {}
        weights = self.weights
        if weights.discriminator == 0 or self.global_step < weights.adversarial_start:
            return {"discriminator": zero_loss(self.discriminator)}
        real = self.discriminator(image[:, : self.vae.in_channels])
        fake = self.discriminator(self.vae.scan_of(prediction).detach())
        loss = losses.discriminator_loss(real, fake)
        return {"discriminator": weights.discriminator * loss}

    def encoder_images(self, image: Tensor, draws: PathDraws) -> Tensor:
        """Range images ``(B, C, H, W)`` as the encoder sees them in training.

        With ``further_dropout`` some have no intensity and some no classes, as scans that were
        recorded without. The decoder learns both from all.
        """
        if self.further_dropout == 0:
            return image
        no_intensity, no_classes = (draws.further < self.further_dropout).unbind(dim=1)
        image = image.clone()
        if self.vae.intensity:
            image[:, self.vae.in_channels].masked_fill_(no_intensity[:, None, None], -1.0)
        if self.vae.num_classes:
            image[:, -1].masked_fill_(no_classes[:, None, None], UNKNOWN_CLASS)
        return image

    def decoder_latents(self, latents: Tensor, draws: PathDraws) -> Tensor:
        """Raw latents ``(B, C, h, w)`` that the decoder learns to decode.

        With ``latent_noise`` they are, with a share s of noise drawn for each sample::

            (1 - s) * latents + s * noise        s = latent_noise * uniform

        The noise has the mean and spread of the latents. Latents
        drawn by a flow always carry an error, which a decoder trained on clean latents amplifies.

        Source: l-DeTok (Yang et al., "Latent denoising makes good tokenizers", ICLR 2026).
        """
        if self.latent_noise == 0:
            return latents
        share = self.latent_noise * draws.uniform[:, None, None, None]
        return (1 - share) * latents + share * self.latent_norm.denormalise(draws.noise)

    def vae_alignment_losses(
        self, latents: Tensor, features: Tensor | None, draws: PathDraws
    ) -> dict[str, Tensor]:
        """lambda1 L_align with running latent statistics: the gradient reaches the encoder."""
        if self.weights.vae_alignment == 0:
            return {}
        normalised = self.latent_norm.normalise(latents)
        noisy = self.interpolant.interpolate(normalised, draws.noise, draws.time)
        projected = self.sit.project_features(noisy, draws.time)
        alignment = self.alignment_errors(projected, features).mean()
        return {"vae_alignment": self.weights.vae_alignment * alignment}

    # Optimisation

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Step the optimiser, then the averages, unless the step was skipped."""
        super().optimizer_step(*args, **kwargs)
        if self.ema is not None and not self.step_skipped:
            self.ema.update(self.sit, self.latent_norm)

    # Evaluation

    def reconstruct(self, image: Tensor) -> Tensor:
        """Encoded range images ``(B, C, H, W)`` through the VAE's posterior mean and back."""
        return self.vae.decode(self.vae.encode(image).mean)

    def validation_step(self, batch: LidarBatch, batch_idx: int) -> None:
        """Add held-out scans to the means: the losses, and the reconstruction error in metres.

        The error is the mean over all pixels with a return, the class accuracy over those with a
        label; the losses are means over the scans.
        The SiT is the averaged one where the stage has an average.
        """
        image, mask = batch["range_image"], batch["valid_mask"]
        codec = self.scan_geometry.codec
        draws = self.draw_held_out(batch["index"])
        posterior = self.vae.encode(image)
        prediction = self.vae.predict(posterior.mean)
        reconstruction = self.vae.image_of(prediction)
        error_m = (codec.to_range(reconstruction[:, :1]) - codec.to_range(image[:, :1])).abs()
        networks, features = self.ema or self, batch.get("feature_grid")
        latents = networks.latent_norm.normalise(posterior.sample(draws.posterior_noise))
        values: dict[str, Tensor | tuple[Tensor, Tensor]] = {}
        values |= self.flow_errors(
            networks.sit,
            latents,
            features,
            draws,
            velocity=self.trains_velocity,
            alignment=self.needs_features(),
        )
        if image.shape[1] == 1:
            norm = self.weights.reconstruction_norm
            values["reconstruction"] = losses.reconstruction_errors(reconstruction, image, norm)
        else:
            values |= self._range_losses(image, prediction)
        if self.vae.num_classes:
            right = (reconstruction[:, -1:] == image[:, -1:]).flatten(1).sum(dim=1)
            values["class_accuracy"] = right, (image[:, -1:] >= 0).flatten(1).sum(dim=1)
        self.held_out.update(
            batch["index"],
            range_error_m=(
                torch.where(mask, error_m, 0.0).flatten(1).sum(dim=1),  # may be infinite elsewhere
                mask.flatten(1).sum(dim=1),
            ),
            **values,
            **self.held_out_errors(reconstruction, posterior.mean, draws),
        )

    def held_out_errors(
        self, reconstruction: Tensor, latents: Tensor, draws: PathDraws
    ) -> dict[str, Tensor | tuple[Tensor, Tensor]]:
        """Further values of held-out scans ``(B,)``, by the reconstruction and its raw latents."""
        return {}

    test_step = validation_step

    def predict_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """Reconstructed ranges ``(B, H, W)`` in metres, -1 where the image has no return."""
        geometry = self.scan_geometry
        image = self.reconstruct(batch["range_image"])
        return geometry.codec.ranges_of(image, geometry.projection.sensor)

    def scene_generator(
        self, sampler: SamplerConfig, precision: Literal["fp32", "bf16"] = "fp32"
    ) -> SceneGenerator:
        """Samples from the averaged weights."""
        assert self.ema is not None
        return SceneGenerator(
            self.vae,
            self.ema.sit,
            self.ema.latent_norm,
            self.scan_geometry,
            sampler,
            self.interpolant.path,
            precision,
            guidance=self.guidance,
        )

    # Checkpoints

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Write weights in the usual order in memory, and how scenes are to be sampled."""
        state = checkpoint["state_dict"]
        checkpoint["state_dict"] = {name: value.contiguous() for name, value in state.items()}
        super().on_save_checkpoint(checkpoint)
        sampling = {}
        if self.guidance is not None:
            sampling["perturbed_attention"] = asdict(self.guidance)
        checkpoint["r3dpa"]["sampling"] = sampling

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse the checkpoint of another stage or of other range images."""
        super().on_load_checkpoint(checkpoint)
        self._has_weights = True


def _table(rows: Sequence[TransferRow]) -> str:
    heads = ("weights", "tensors", "result", "reason")
    return text_table([tuple(map(str, row)) for row in rows], heads)
