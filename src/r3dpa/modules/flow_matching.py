"""Baseline: flow matching on the latents of a frozen VAE."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import torch
from torch import Tensor, nn

from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.datasets import LidarBatch
from r3dpa.data.posterior_cache import cache_posteriors
from r3dpa.geometry import ScanGeometry
from r3dpa.modules.base import GenerativeModule
from r3dpa.modules.settings import LossWeights
from r3dpa.modules.stage import PathDraws
from r3dpa.nn import VAE, Posterior, VelocityNetwork


class FlowMatching(GenerativeModule):
    """FM baseline: the SiT by L_denoise (+ lambda2 L_align) on a frozen, trained VAE.

    ``weights.sit_alignment`` 0, the default here, is the row "no alignment" of the paper's
    table III; 0.5 is "vanilla". The latents are normalised with the statistics that came with the
    VAE, which stay fixed as it does.

    Source: R3DPA (ICRA 2026), section "LiDAR Scene Generation with Flow Matching".

    Args:
        vae: Range-image autoencoder; its weights come from ``init_from`` and stay fixed.
        sit: Velocity network.
        weights: Loss weights; the ones of the VAE are not used here.
        cache_latents: Encode each training scan once, before the first step, and keep the posterior
            in ``<run_dir>/latents`` (131 kB per scan at 8 x 16 x 128): a step is then the same, to
            rounding, at a tenth of its cost. Scans may be rotated, but not mirrored.
        latents_dir: Folder of the cached posteriors, which several runs may share; default:
            ``<run_dir>/latents``.
        train_blocks: False keeps the velocity network as it came and trains its projection head
            alone: a readout, by whose features a flow that was never aligned can be guided (Luo et
            al., "Readout Guidance: Learning Control from Diffusion Features", CVPR 2024).
        **kwargs: See :class:`GenerativeModule`. ``init_from`` is needed to fit; to continue from
            the VAE-alignment stage let ``init_networks`` name ``sit`` too.
    """

    stage = "flow_matching"
    default_init: tuple[str, ...] = ("vae", "latent_norm")
    starts_from = "vae_alignment or joint"

    def __init__(
        self,
        vae: VAE,
        sit: VelocityNetwork,
        weights: LossWeights = LossWeights(sit_alignment=0.0),
        cache_latents: bool = False,
        latents_dir: str | None = None,
        train_blocks: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(vae, sit, weights=weights, **kwargs)
        if not train_blocks and weights.sit_alignment == 0:
            raise ValueError(
                "train_blocks: false trains the projection head alone, which needs "
                "weights.sit_alignment: give it a weight, or train the blocks"
            )
        self.cache_latents = cache_latents
        self.latents_dir = latents_dir
        self.vae.requires_grad_(False)
        self.sit.requires_grad_(train_blocks)
        self.sit.projector.requires_grad_(self.weights.sit_alignment != 0)

    def needs_features(self) -> bool:
        """Only lambda2 counts: the VAE is frozen."""
        return self.weights.sit_alignment != 0

    def load_previous_stage(self) -> None:
        """Load the trained VAE and its latent statistics; refuse to start without them."""
        if self.init_from is None:
            raise ValueError(
                f"stage {self.stage} trains on the latents of a trained VAE: give "
                f"--model.init_args.init_from a checkpoint of stage {self.starts_from}"
            )
        super().load_previous_stage()
        if not self.latent_norm.fitted:
            raise ValueError(
                f"stage {self.stage} trains with fixed latent statistics, and {self.init_from} "
                "gave none: let --model.init_args.init_networks name latent_norm beside vae"
            )

    def check_data(self, datamodule: object, geometry: ScanGeometry, stage: str) -> None:
        """Check data against networks, and whether posteriors of the data can be cached."""
        super().check_data(datamodule, geometry, stage)
        if not self.cache_latents or stage != "fit":
            return
        if not isinstance(datamodule, LidarDataModule):
            raise ValueError(
                "model.init_args.cache_latents needs a r3dpa.data.LidarDataModule, got "
                f"{type(datamodule).__name__}; set it to false"
            )
        datamodule.check_posteriors()
        datamodule.augmentation.check_latents(self.sit.input_size[1], datamodule.grid_size[1])

    def on_fit_start(self) -> None:
        """Load the VAE, and encode the training scans that are not encoded yet.

        A ``fast_dev_run`` encodes its few scans in each step.
        """
        super().on_fit_start()
        if not self.cache_latents or cast(Any, self.trainer).fast_dev_run:
            return
        dataset = self._datamodule.train_set
        geometry = self.scan_geometry.to_dict()
        posteriors = cache_posteriors(
            self,
            {"projection": geometry["projection"], "codec": geometry["codec"]},
            list(dict.fromkeys(dataset.scans)),
            lambda scans: replace(dataset, scans=scans, grids=None),
            "range_image",
        )
        self._datamodule.use_posteriors(posteriors)

    @property
    def _datamodule(self) -> LidarDataModule:
        return cast(Any, self.trainer).datamodule

    def trainable(self) -> dict[str, nn.Module]:
        """The SiT alone."""
        return {"sit": self.sit}

    def training_step(self, batch: LidarBatch, batch_idx: int) -> Tensor:
        """One step on range images or posteriors, and feature grids ``(B, N, D)``."""
        latents, draws = self.draw_latents(batch)
        normalised = self.latent_norm.normalise(latents)
        losses = self.flow_losses(normalised, batch.get("feature_grid"), draws)
        return self.weigh_and_log(losses)

    @torch.no_grad()
    def draw_latents(self, batch: LidarBatch) -> tuple[Tensor, PathDraws]:
        """Raw latents ``(B, C, h, w)`` of range images or posteriors, and the draws of the step."""
        if "posterior_moments" in batch:
            posterior = Posterior(batch["posterior_moments"])
        else:
            posterior = self.vae.encode(batch["range_image"])
        draws = self.draw_path(len(posterior.mean))
        return posterior.sample(draws.posterior_noise), draws
