"""Whether networks, data and checkpoints of a stage fit, as far as that needs no scans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from r3dpa.checkpoints import Checkpoint
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.geometry import (
    RangeCodec,
    RingProjection,
    ScanGeometry,
)
from r3dpa.nn import VAE, ImageVAE, VelocityNetwork


def check_image(vae: VAE, codec: RangeCodec) -> None:
    """Refuse a VAE of other images than a codec encodes."""
    of_vae = (vae.image_channels, vae.intensity, vae.num_classes)
    of_codec = (codec.channels, codec.intensity_channel, codec.num_classes)
    if of_vae != of_codec:
        text = "channels {}, intensity {}, num_classes {}"
        raise ValueError(
            f"the VAE is for images with {text.format(*of_vae)}, but --data.init_args.codec gives "
            f"{text.format(*of_codec)}: "
            "set in_channels, intensity and num_classes of --model.init_args.vae to the latter"
        )


def check_latents(vae: VAE | ImageVAE, sit: VelocityNetwork, image_size: tuple[int, int]) -> None:
    """Refuse a velocity network of other latents than the images have."""
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
    sit: VelocityNetwork, geometry: ScanGeometry, datamodule: object, stage: str
) -> None:
    """Refuse data without feature grids, or with grids of another size than the network's."""
    if getattr(datamodule, "features_dir", "") is None:
        raise ValueError(
            f"stage {stage} aligns with 3D features, but the data module has none; give "
            "it an extractor or features_dir, or set the alignment weights to 0"
        )
    if tuple(geometry.grid_size) != tuple(sit.grid_size):
        raise ValueError(
            f"feature grids are {geometry.grid_size}, but the {type(sit).__name__} has "
            f"{tuple(sit.grid_size)} tokens; set --data.init_args.grid_size to the latter"
        )
    feature_dim = getattr(datamodule, "feature_dim", sit.feature_dim)
    if feature_dim != sit.feature_dim:
        raise ValueError(
            f"features have width {feature_dim}, but the {type(sit).__name__} has "
            f"feature_dim {sit.feature_dim}; set "
            "--model.init_args.sit.init_args.feature_dim to the former"
        )


def planned_geometry(datamodule: object) -> ScanGeometry | None:
    """Geometry that the settings of a data module give before its setup.

    Of images of rings it has sizes and encoding alone: their inclinations are measured in scans.
    None for a data module of another kind, whose geometry is known after its setup.

    Raises:
        ValueError: If the feature grid does not divide the range image.
    """
    if not isinstance(datamodule, LidarDataModule):
        return None
    sensor, grid_size = datamodule.sensor, datamodule.grid_size
    try:
        sensor.cell_size(grid_size)
    except ValueError as error:
        raise ValueError(
            f"{error}: set --data.init_args.grid_size, or beams and columns of "
            "--data.init_args.sensor, so that it does"
        ) from None
    return ScanGeometry(datamodule.known_projection, datamodule.codec, grid_size)


def check_same_images(here: ScanGeometry, recorded: ScanGeometry, source: str) -> None:
    """Refuse weights of a ``source`` that were trained on other range images than ``here``."""
    for name in ("projection", "codec"):
        theirs, ours = getattr(recorded, name), getattr(here, name)
        if theirs != ours:
            raise ValueError(
                f"{source} was trained on other range images: {name} {theirs} there, {ours} "
                "here. Set sensor, projection and codec of the data module as in the checkpoint"
            )


def check_planned_images(planned: ScanGeometry, recorded: Mapping[str, Any], source: str) -> None:
    """Refuse recorded range images that differ from the planned ones, unless they are of rings."""
    geometry = ScanGeometry.from_dict(dict(recorded))
    if not isinstance(geometry.projection, RingProjection):
        check_same_images(planned, geometry, source)


def check_path(before: Checkpoint, path: str) -> None:
    """Refuse a checkpoint whose velocities, if it has any, are of another path."""
    if {"sit", "ema"} & before.networks.keys() and before.interpolant != path:
        raise ValueError(
            f"{before.path} was trained on the {before.interpolant} path: set "
            "--model.init_args.path to it"
        )
