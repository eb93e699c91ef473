"""What a stage says of held-out scans: losses, errors in metres, reconstructions."""

from __future__ import annotations

from torch import Tensor

from r3dpa import losses
from r3dpa.data.datasets import LidarBatch
from r3dpa.geometry import ScanGeometry
from r3dpa.modules.step_losses import PathDraws, StepLosses
from r3dpa.nn import EMA, Posterior

__all__ = ["Evaluation"]


class Evaluation(StepLosses):
    """Validation, test and prediction steps."""

    trains_velocity: bool
    ema: EMA | None
    geometry: ScanGeometry | None

    def needs_features(self) -> bool:
        """Whether a training batch must hold feature grids."""
        return self.weights.vae_alignment != 0 or self.weights.sit_alignment != 0

    @property
    def scan_geometry(self) -> ScanGeometry:
        """Geometry of the scans it trains on, known from setup or from a checkpoint."""
        if self.geometry is None:
            raise RuntimeError("the module has no scan geometry yet: set it up with a data module")
        return self.geometry

    def reconstruct(self, image: Tensor) -> Tensor:
        """Encoded range images ``(B, 1, H, W)`` through the VAE's posterior mean and back."""
        return self.vae.decode(self.vae.encode(image).mean)

    def evaluate(self, batch: LidarBatch, batch_idx: int, prefix: str) -> None:
        """Logs the losses on held-out scans, and the reconstruction error in metres.

        The error is the mean over all pixels with a return, the losses are means over the scans.
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
        }
        if self.trains_velocity or self.needs_features():
            values |= self._evaluate_flow(posterior, batch.get("feature_grid"), draws)
        self.log_dict(
            {f"{prefix}/{name}": value for name, value in values.items()},
            batch_size=image.shape[0],
            sync_dist=True,
        )
        # Weighted by pixels: the mean must not depend on how scans were put into batches.
        num_returns = int(mask.sum())
        self.log(
            f"{prefix}/range_error_m",
            error_m[mask].sum() / max(1, num_returns),
            batch_size=num_returns,
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
