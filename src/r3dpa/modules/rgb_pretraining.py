"""Stage 0: a flow transformer pretrained on the latents of RGB images."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, Protocol, cast

import torch
from torch import Tensor, nn

from r3dpa import losses
from r3dpa.checkpoints import load_into, read_checkpoint
from r3dpa.data.images import ImageBatch, ImageDataset, ImageEntry, latent_statistics
from r3dpa.data.store import CachedTensors
from r3dpa.modules.encoding import encoded_once
from r3dpa.modules.image_stage import ImageStage
from r3dpa.modules.settings import GuardConfig, LossWeights, OptimizerConfig, TimeSampling
from r3dpa.modules.step_losses import PathDraws
from r3dpa.nn import EMA, ImageVAE, LatentNorm, Posterior, SiT

__all__ = ["ImageTeacher", "RGBPretraining"]

_GUARDS = GuardConfig()


class ImageTeacher(Protocol):
    """Frozen network whose features of images a SiT is aligned with.

    Attributes:
        dim: Width F of the features.
        trained: Whether it has other than random weights.
    """

    dim: int
    trained: bool

    def __call__(self, image: Tensor, grid_size: tuple[int, int]) -> Tensor:
        """Features ``(B, N, F)`` of the cells of a grid, row-major.

        Args:
            image: ``(B, 3, S, S)`` in [-1, 1].
            grid_size: Rows and columns of the cells.
        """
        ...


class RGBPretraining(ImageStage):
    """Stage 0: unconditional SiT on image latents, by L_denoise (+ lambda L_align).

    The image VAE is frozen: each training image is encoded once, before the first step, and the
    latent statistics are those of the data set.
    With a teacher the tokens are aligned with its features of the image (REPA), which are computed
    in each step. The checkpoint is what ``rgb_weights`` of the other stages takes.

    Source: R3DPA (ICRA 2026), section "Implementation Details", with the recipe of REPA-E (Leng et
    al. 2025): 1 M steps at batch 256 on the latents 4 x 32 x 32 of ImageNet.

    Args:
        vae: Image autoencoder; its weights come from ``init_from`` and stay fixed.
        sit: Flow transformer.
        teacher: Frozen image network to align with, such as
            :class:`r3dpa.nn.backbones.DINOv2`; None aligns with nothing.
        init_from: Trained image VAE: checkpoint of stage ``image_vae``, or the
            ``diffusion_pytorch_model.safetensors`` of a VAE of Stable Diffusion.
        weights: Loss weights; those of the velocity and of ``sit_alignment`` count. The latter must
            be 0 without a teacher.
        optimizer: Optimiser settings.
        time_sampling: Density of the training times.
        ema_decay: Decay of the averaged SiT.
        ema_buffers: ``copy`` the latent statistics, or ``decay`` them as the official code does.
        latents_dir: Folder of the encoded images, which runs may share: 33 kB each at 4 x 32 x 32;
            ``<run_dir>/latents`` where None.
        seed: Key of the training draws.
        guards: When a step is dropped, and when training stops; None trains without.

    Raises:
        ValueError: If networks, teacher and weights do not belong together.
    """

    stage = "rgb_pretraining"
    ema: EMA

    def __init__(
        self,
        vae: ImageVAE,
        sit: SiT,
        teacher: nn.Module | None = None,
        init_from: str | None = None,
        weights: LossWeights = LossWeights(sit_alignment=0.0),
        optimizer: OptimizerConfig = OptimizerConfig(),
        time_sampling: TimeSampling = "uniform",
        ema_decay: float = 0.9999,
        ema_buffers: Literal["copy", "decay"] = "copy",
        latents_dir: str | None = None,
        seed: int = 0,
        guards: GuardConfig | None = _GUARDS,
    ) -> None:
        super().__init__(vae, weights, optimizer, time_sampling, seed, guards)
        if (teacher is None) != (weights.sit_alignment == 0):
            raise ValueError(
                "teacher and weights.sit_alignment go together: give a teacher and a weight above "
                f"0, or neither; got teacher {type(teacher).__name__} and weight "
                f"{weights.sit_alignment}"
            )
        if sit.in_channels != vae.latent_channels:
            raise ValueError(
                f"sit.in_channels is {sit.in_channels}, but the VAE has {vae.latent_channels} "
                "latent channels; give both the same number"
            )
        if teacher is not None and cast(ImageTeacher, teacher).dim != sit.feature_dim:
            raise ValueError(
                f"sit.feature_dim is {sit.feature_dim}, but the teacher's features have width "
                f"{cast(ImageTeacher, teacher).dim}; set the former to the latter"
            )
        self.sit = sit
        self.latent_norm = LatentNorm(vae.latent_channels)
        self.ema = EMA(sit, self.latent_norm, ema_decay, ema_buffers)
        self.vae.requires_grad_(False)
        self.sit.projector.requires_grad_(teacher is not None)
        # In a tuple, so that checkpoints do not hold weights that never change.
        self._teacher = () if teacher is None else (teacher.eval().requires_grad_(False),)
        self.init_from, self.latents_dir = init_from, latents_dir

    def setup(self, stage: str) -> None:
        """Checks data against networks.

        Raises:
            ValueError: As :class:`ImageStage`, if the latents have another size than the SiT's, or
                if the teacher of a fit has random weights.
        """
        super().setup(stage)
        if stage == "fit" and not all(cast(ImageTeacher, one).trained for one in self._teacher):
            raise ValueError(
                "the teacher has random weights: give model.init_args.teacher.init_args.weights "
                "the file of a trained one, such as dinov2_vitb14_pretrain.pth, or train without "
                "(model.init_args.teacher null, model.init_args.weights.sit_alignment 0)"
            )
        if self.latent_size != tuple(self.sit.input_size):
            raise ValueError(
                f"images of {self.datamodule.image_size} pixels give {self.latent_size} latents, "
                f"but sit.input_size is {tuple(self.sit.input_size)}; set it to the former"
            )

    def on_fit_start(self) -> None:
        """Loads the VAE, encodes the images that are not encoded yet, measures their latents.

        Raises:
            ValueError: If there is no trained VAE.
        """
        if not self.resumed:
            if self.init_from is None:
                raise ValueError(
                    "stage rgb_pretraining trains on the latents of a trained image VAE: give "
                    "model.init_from a checkpoint of stage image_vae, or the "
                    "diffusion_pytorch_model.safetensors of Stable Diffusion's VAE"
                )
            load_into({"vae": self.vae}, read_checkpoint(self.init_from), stage=self.stage)
        posteriors = self._encoded()
        self.datamodule.use_posteriors(posteriors, with_images=bool(self._teacher))
        if not self.resumed:
            mean, variance = latent_statistics(posteriors)
            self.latent_norm.running_mean.copy_(mean)
            self.latent_norm.running_var.copy_(variance)
            self.latent_norm.num_batches_tracked.fill_(1)
            self.ema.reset(self.sit, self.latent_norm)

    def _encoded(self) -> CachedTensors[ImageEntry]:
        """Posteriors of all training images; the processes share the work.

        A ``fast_dev_run`` makes those of its batches alone.
        """
        trainer, datamodule = self.trainer, self.datamodule
        entries = cast(ImageDataset, datamodule.train_set).entries
        if cast(Any, trainer).fast_dev_run:
            batches = int(trainer.limit_train_batches)
            entries = entries[: batches * datamodule.batch_size * trainer.world_size]
        return encoded_once(
            self,
            self.vae,
            Path(self.latents_dir or Path(trainer.default_root_dir) / "latents"),
            {"images": datamodule.settings},
            (2 * self.vae.latent_channels, *self.latent_size),
            entries,
            lambda some: ImageDataset(datamodule.source, some, datamodule.image_size),
            "image",
            shared=True,
        )

    def trainable(self) -> dict[str, nn.Module]:
        """The SiT alone."""
        return {"sit": self.sit}

    def step_losses(self, batch: ImageBatch, draws: PathDraws) -> dict[str, Tensor]:
        """Losses of posterior moments ``(B, 2C, h, w)`` and, with a teacher, images."""
        posterior = Posterior(batch["posterior_moments"])
        normalised = self.latent_norm.normalise(posterior.sample(draws.posterior_noise))
        return self.flow_losses(normalised, self._features(batch), draws)

    @torch.no_grad()
    def _features(self, batch: ImageBatch) -> Tensor | None:
        for teacher in self._teacher:
            image = batch["image"]
            # Trainers do not move what is in a tuple; to move what is there costs next to nothing.
            return teacher.to(image.device)(image, self.sit.grid_size)
        return None

    def evaluate(self, batch: ImageBatch, batch_idx: int) -> dict[str, Tensor]:
        """Losses of the averaged SiT on held-out images."""
        draws = self.draw_path(len(batch["index"]), batch_idx, stream=1)
        posterior = self.vae.encode(batch["image"])
        latents = self.ema.latent_norm.normalise(posterior.sample(draws.posterior_noise))
        noisy = self.interpolant.interpolate(latents, draws.noise, draws.time)
        features = self._features(batch)
        velocity, projected = self._predict(
            self.ema.sit, noisy, draws.time, velocity=True, features=features is not None
        )
        assert velocity is not None
        target = self.interpolant.target(latents, draws.noise, draws.time)
        values = {"denoising": losses.flow_matching_loss(velocity, target).mean()}
        if projected is not None:
            values["alignment"] = self._aligned(projected, features)
        return values
