"""Stage 0: a flow transformer pretrained on the latents of RGB images."""

from __future__ import annotations

from typing import Any, Literal, cast

import torch
from torch import Tensor, nn

from r3dpa.checkpoints import load_into, read_checkpoint
from r3dpa.data.image_datamodule import ImageBatch, ImageDataset, latent_statistics
from r3dpa.data.images import ImageEntry
from r3dpa.data.posterior_cache import cache_posteriors
from r3dpa.data.store import CachedTensors
from r3dpa.features import DINOv2
from r3dpa.modules.checks import check_latents
from r3dpa.modules.image_vae import ImageStage
from r3dpa.modules.settings import LossWeights, OptimizerConfig, TimeSampling
from r3dpa.modules.stage import networks_as_settings
from r3dpa.nn import EMA, ImageVAE, LatentNorm, Posterior, SiT


class RGBPretraining(ImageStage):
    """Stage 0: unconditional SiT on image latents, by L_denoise (+ lambda L_align).

    The image VAE is frozen: each training image is encoded once, before the first step, and the
    latent statistics are measured on the data set.
    With a teacher the tokens are aligned with its features of the image (REPA). The checkpoint is
    what ``rgb_weights`` of the other stages takes.

    Source: R3DPA (ICRA 2026), section "Implementation Details", with the recipe of REPA-E (Leng et
    al. 2025): 1 M steps at batch 256 on the latents 4 x 32 x 32 of ImageNet.

    Args:
        vae: Image autoencoder; its weights come from ``init_from`` and stay fixed.
        sit: Flow transformer.
        teacher: Frozen image network to align with; None aligns with nothing.
        init_from: Trained image VAE: checkpoint of stage ``image_vae``, or the
            ``diffusion_pytorch_model.safetensors`` of a VAE of Stable Diffusion.
        weights: Loss weights; ``denoising`` and ``sit_alignment`` count. The latter must
            be 0 without a teacher.
        optimizer: Optimiser settings.
        time_sampling: Density of the training times.
        ema_decay: Decay of the averaged SiT.
        ema_buffers: ``copy`` the latent statistics, or ``decay`` them as the official code does.
        latents_dir: Folder of the encoded images, which runs may share: 33 kB each at 4 x 32 x 32;
            ``<run_dir>/latents`` where None.
        seed: Key of the training draws.
    """

    stage = "rgb_pretraining"

    def __init__(
        self,
        vae: ImageVAE,
        sit: SiT,
        teacher: DINOv2 | None = None,
        init_from: str | None = None,
        weights: LossWeights = LossWeights(sit_alignment=0.0),
        optimizer: OptimizerConfig = OptimizerConfig(),
        time_sampling: TimeSampling = "uniform",
        ema_decay: float = 0.9999,
        ema_buffers: Literal["copy", "decay"] = "copy",
        latents_dir: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(optimizer, seed, time_sampling)
        with networks_as_settings():
            self.save_hyperparameters()
        if (teacher is None) != (weights.sit_alignment == 0):
            raise ValueError(
                "teacher and weights.sit_alignment go together: give a teacher and a weight above "
                f"0, or neither; got {type(teacher).__name__} and {weights.sit_alignment}"
            )
        if teacher is not None and teacher.dim != sit.feature_dim:
            raise ValueError(
                f"sit.feature_dim is {sit.feature_dim}, but the teacher's features have width "
                f"{teacher.dim}; set the former to the latter"
            )
        self.vae = vae
        self.sit = sit
        self.weights = weights
        self.latent_shape = (vae.latent_channels, *sit.input_size)
        self.latent_norm = LatentNorm(vae.latent_channels)
        self.ema = EMA(sit, self.latent_norm, ema_decay, ema_buffers)
        self.vae.requires_grad_(False)
        self.sit.projector.requires_grad_(teacher is not None)
        # In a tuple, so that checkpoints do not hold weights that never change.
        self._teacher = () if teacher is None else (teacher.eval().requires_grad_(False),)
        self.init_from = init_from
        self.latents_dir = latents_dir
        self._resumed = False

    def setup(self, stage: str) -> None:
        """Check trainer and data against the networks, and that a teacher has weights."""
        self.check_trainer(self.trainer, fits=stage == "fit")
        size = self.images.image_size
        check_latents(self.vae, self.sit, (size, size))
        if stage == "fit" and not all(network.trained for network in self._teacher):
            raise ValueError(
                "the teacher has random weights: give --model.init_args.teacher.init_args.weights "
                "the file of a trained one, such as dinov2_vitb14_pretrain.pth, or train without "
                "(--model.init_args.teacher null --model.init_args.weights.sit_alignment 0)"
            )

    def on_fit_start(self) -> None:
        """Load the VAE, encode the images that are not encoded yet, and measure their latents."""
        if not self._resumed:
            if self.init_from is None:
                raise ValueError(
                    "stage rgb_pretraining trains on the latents of a trained image VAE: give "
                    "--model.init_args.init_from a checkpoint of stage image_vae, or the "
                    "diffusion_pytorch_model.safetensors of Stable Diffusion's VAE"
                )
            load_into({"vae": self.vae}, read_checkpoint(self.init_from), stage=self.stage)
        posteriors = self._encoded()
        self.images.use_posteriors(posteriors, with_images=bool(self._teacher))
        if not self._resumed:
            mean, variance = latent_statistics(posteriors)
            self.latent_norm.running_mean.copy_(mean)
            self.latent_norm.running_var.copy_(variance)
            self.latent_norm.num_batches_tracked.fill_(1)
            self.ema.reset(self.sit, self.latent_norm)

    def _encoded(self) -> CachedTensors[ImageEntry]:
        """Posteriors of all training images; the processes share the work.

        A ``fast_dev_run`` encodes its batches alone.
        """
        trainer, datamodule = self.trainer, self.images
        entries = datamodule.train_set.entries
        if cast(Any, trainer).fast_dev_run:
            batches = int(trainer.limit_train_batches)
            entries = entries[: batches * datamodule.batch_size * trainer.world_size]
        return cache_posteriors(
            self,
            {"images": datamodule.settings},
            entries,
            lambda some: ImageDataset(datamodule.source, some, datamodule.image_size),
            "image",
        )

    def trainable(self) -> dict[str, nn.Module]:
        """The SiT alone."""
        return {"sit": self.sit}

    def training_step(self, batch: ImageBatch, batch_idx: int) -> Tensor:
        """One step on posterior moments ``(B, 2C, h, w)`` and, with a teacher, images."""
        posterior = Posterior(batch["posterior_moments"])
        draws = self.draw_path(len(posterior.mean))
        normalised = self.latent_norm.normalise(posterior.sample(draws.posterior_noise))
        losses = self.flow_losses(normalised, self._features(batch), draws)
        return self.weigh_and_log(losses)

    @torch.no_grad()
    def _features(self, batch: ImageBatch) -> Tensor | None:
        for teacher in self._teacher:
            image = batch["image"]
            # Trainers do not move what is in a tuple; to move what is there costs next to nothing.
            return teacher.to(image.device)(image, self.sit.grid_size)
        return None

    def validation_step(self, batch: ImageBatch, batch_idx: int) -> None:
        """Held-out images: the losses of the averaged SiT."""
        posterior = self.vae.encode(batch["image"])
        draws = self.draw_held_out(batch["index"])
        normalised = self.ema.latent_norm.normalise(posterior.sample(draws.posterior_noise))
        errors = self.flow_errors(
            self.ema.sit,
            normalised,
            self._features(batch),
            draws,
            velocity=True,
            alignment=bool(self._teacher),
        )
        self.held_out.update(batch["index"], **errors)

    test_step = validation_step

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Step the optimiser, then the averages, unless the step was skipped."""
        super().optimizer_step(*args, **kwargs)
        if not self.step_skipped:
            self.ema.update(self.sit, self.latent_norm)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse the checkpoint of another stage."""
        super().on_load_checkpoint(checkpoint)
        self._resumed = True
