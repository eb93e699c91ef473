"""A tiny checkpoint with channels for intensity and class."""

from __future__ import annotations

from tiny_networks import VAE_ARGS, tiny_checkpoint

from r3dpa.geometry import NUM_CLASSES, LidarSensor, RangeCodec, ScanGeometry, SphericalProjection


def labelled_checkpoint(folder, **vae_args):
    codec = RangeCodec(return_channel=True, intensity_channel=True, num_classes=NUM_CLASSES)
    geometry = ScanGeometry(SphericalProjection(LidarSensor(16, 64)), codec, (2, 8))
    channels = {"in_channels": 2, "intensity": True, "num_classes": NUM_CLASSES}
    path = folder / "labelled.safetensors"
    return tiny_checkpoint(path, geometry, vae_args=VAE_ARGS | channels | vae_args)
