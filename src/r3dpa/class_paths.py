"""Where classes stand now that checkpoints and YAML files of earlier versions name elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Old module or class, and the new one; the longest one that fits counts.
MOVED = {
    "r3dpa.data.datamodules.LabelledPointDataModule": "r3dpa.data.LabelledPointDataModule",
    "r3dpa.data.datamodules.PointDataModule": "r3dpa.data.PointDataModule",
    "r3dpa.data.objects": "r3dpa.editing.objects",
    "r3dpa.flow.diffusion": "r3dpa.baselines.diffusion_paths",
    "r3dpa.geometry.scan_geometry": "r3dpa.geometry.codec",
    "r3dpa.nn.backbones": "r3dpa.features",
    "r3dpa.nn.backbones.point_features": "r3dpa.features.scalr",
    "r3dpa.nn.backbones.vit": "r3dpa.features.dinov2",
    "r3dpa.nn.velocity_network.EMA": "r3dpa.nn.ema.EMA",
    "r3dpa.simulation": "lidarsim",
    "r3dpa.simulation.Weather": "lidarsim.scene.Conditions",
    "r3dpa.simulation.scene.Weather": "lidarsim.scene.Conditions",
    "r3dpa.simulation.sensor": "lidarsim.sensors.spinning",
    "r3dpa.weather": "lidarsim",
    "r3dpa.weather.weather": "lidarsim.weather",
}


_SIT = ("r3dpa.nn.SiT", "r3dpa.nn.sit.SiT")
_AVERAGE_VELOCITY = "r3dpa.nn.average_velocity.AverageVelocitySiT"


def current_path(path: str) -> str:
    """Import path of today for an import path of any version; other text stays as it is."""
    parts = path.split(".")
    for count in range(len(parts), 1, -1):
        if new := MOVED.get(".".join(parts[:count])):
            return ".".join([new, *parts[count:]])
    return path


def with_current_paths(value: Any) -> Any:
    """A value of a YAML file with the import paths of today."""
    if isinstance(value, dict):
        return current_network({key: with_current_paths(item) for key, item in value.items()})
    if isinstance(value, list):
        return [with_current_paths(item) for item in value]
    return current_path(value) if isinstance(value, str) else value


def current_network(config: Mapping[str, Any]) -> dict[str, Any]:
    """Class path and arguments of a network for the classes of this version.

    Version 0.1.0 kept the guidance of generated scenes and the blocks of average velocities among
    the arguments of SiT.
    """
    init_args = dict(config.get("init_args") or {})
    recorded = {"guidance_block", "guidance_scale", "average_blocks"} & set(init_args)
    if config.get("class_path") not in _SIT or not recorded:
        return dict(config)
    init_args.pop("guidance_block", None)
    init_args.pop("guidance_scale", None)
    average_blocks = init_args.pop("average_blocks", 0)
    if not average_blocks:
        return {**config, "init_args": init_args}
    init_args["average_blocks"] = average_blocks
    return {**config, "class_path": _AVERAGE_VELOCITY, "init_args": init_args}
