"""Checks of trainer, data and earlier stages against the networks; each error says the remedy."""

from __future__ import annotations

from typing import Any

from lightning.pytorch.callbacks import StochasticWeightAveraging

from r3dpa.geometry import RangeCodec, ScanGeometry
from r3dpa.nn import VAE, ImageVAE, VelocityNetwork

_PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")


def check_trainer(trainer: Any) -> None:
    """Refuses precisions and callbacks that the stages cannot train with."""
    if trainer.precision not in _PRECISIONS:
        raise ValueError(
            f"--trainer.precision {trainer.precision} is not supported, as weights, statistics and "
            f"prepared scans are float32: give one of {', '.join(_PRECISIONS)}"
        )
    if trainer.reload_dataloaders_every_n_epochs:
        raise ValueError(
            "--trainer.reload_dataloaders_every_n_epochs would break the order of a resumed run: "
            "leave it out; the loaders shuffle each epoch anew"
        )
    if any(isinstance(callback, StochasticWeightAveraging) for callback in trainer.callbacks):
        raise ValueError(
            "StochasticWeightAveraging is not supported: leave the callback out; stages that train "
            "a SiT keep an average of their own, see --model.init_args.ema_decay"
        )


def geometry_of(datamodule: object, module: object) -> ScanGeometry:
    """Geometry of any data module whose batches are those of :class:`r3dpa.data.LidarBatch`."""
    geometry = getattr(datamodule, "geometry", None)
    if not isinstance(geometry, ScanGeometry):
        raise ValueError(
            f"--data.class_path: {type(module).__name__} needs a data module that gives "
            "r3dpa.data.LidarBatch batches and has a geometry (r3dpa.geometry.ScanGeometry), such "
            f"as r3dpa.data.LidarDataModule, got {type(datamodule).__name__}"
        )
    return geometry


def check_image(vae: VAE, codec: RangeCodec) -> None:
    """Refuses a VAE of other images than those of a codec."""
    own = vae.image_channels, vae.intensity, vae.num_classes
    theirs = codec.channels, codec.intensity_channel, codec.num_classes
    if own != theirs:
        names = ("channels", "intensity", "num_classes")
        given = (
            ", ".join(f"{n} {v}" for n, v in zip(names, vs, strict=True)) for vs in (own, theirs)
        )
        raise ValueError(
            "the VAE is one of images with {}, but --data.init_args.codec gives {}: set "
            "in_channels, intensity and num_classes of --model.init_args.vae to the "
            "latter".format(*given)
        )


def check_latents(vae: VAE | ImageVAE, sit: VelocityNetwork, image_size: tuple[int, int]) -> None:
    """Refuses a velocity network of other latents than those of the images."""
    if sit.in_channels != vae.latent_channels:
        raise ValueError(
            f"the {type(sit).__name__} has in_channels {sit.in_channels}, but the VAE has "
            f"{vae.latent_channels} latent channels; set "
            "--model.init_args.sit.init_args.in_channels to the latter"
        )
    latent_size = vae.latent_size(image_size)
    if latent_size != tuple(sit.input_size):
        raise ValueError(
            f"images of {image_size} pixels give {latent_size} latents, but the "
            f"{type(sit).__name__} has input_size {tuple(sit.input_size)}; set "
            "--model.init_args.sit.init_args.input_size to the former"
        )


def check_features(
    sit: VelocityNetwork, geometry: ScanGeometry, datamodule: Any, stage: str
) -> None:
    """Refuses data without feature grids, or with grids of another size than the network's."""
    if getattr(datamodule, "features_dir", "") is None:
        raise ValueError(
            f"stage {stage} aligns with 3D features, but the data module has none; give it an "
            "extractor or features_dir, or set the alignment weights to 0"
        )
    if tuple(geometry.grid_size) != tuple(sit.grid_size):
        raise ValueError(
            f"feature grids are {geometry.grid_size}, but the {type(sit).__name__} has "
            f"{tuple(sit.grid_size)} tokens; set --data.init_args.grid_size to the latter"
        )
    feature_dim = getattr(datamodule, "feature_dim", sit.feature_dim)
    if feature_dim != sit.feature_dim:
        raise ValueError(
            f"features have width {feature_dim}, but the {type(sit).__name__} has feature_dim "
            f"{sit.feature_dim}; set --model.init_args.sit.init_args.feature_dim to the former"
        )


def check_geometry(there: ScanGeometry, here: ScanGeometry, source: str) -> None:
    """Refuses weights that were trained on other range images than this run's."""
    for name in ("projection", "codec"):
        theirs, ours = getattr(there, name), getattr(here, name)
        if theirs != ours:
            raise ValueError(
                f"{source} was trained on other range images: {name} {theirs} there, {ours} here. "
                "Set sensor, projection and codec of the data module to those of the checkpoint"
            )
