"""``r3dpa bench control``: do guided scenes, edits and inversions do what they are asked?

Every comparison is paired: both ways get the same scans and the same noise. What guides is never
the only judge: features are extracted again from the points of the scenes that were made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from r3dpa.bench import control_edits, control_guidance
from r3dpa.bench.control_report import Finding, write_control
from r3dpa.bench.control_scans import Bench, ControlSettings, Part, ScanDesk
from r3dpa.data.objects import ObjectLibrary
from r3dpa.generation import SceneGenerator
from r3dpa.io import command, machine, versions
from r3dpa.nn.backbones import feature_source

__all__ = ["ControlSettings", "Part", "control"]

_PARTS: dict[Part, Callable[[Bench], Finding]] = {
    "strength": control_guidance.strength,
    "guided": control_guidance.guided,
    "mix": control_guidance.mix,
    "inpaint": control_edits.inpaint,
    "complete": control_edits.complete,
    "round_trip": control_edits.round_trip,
    "cost": control_guidance.cost,
}


def control(
    generator: SceneGenerator,
    source: str | None,
    data: Path,
    library: Path,
    out: Path,
    settings: ControlSettings,
    features_ckpt: Path | None = None,
    about: Mapping[str, Any] | None = None,
) -> str:
    """Measure control with one model; write tables and sheets.

    Strength and window are compared on the training drives; everything else is of the validation
    drives.

    Args:
        generator: Networks, in float32.
        source: Feature source that they were aligned with.
        data: Root of a data set of ``r3dpa simulate``, with labels.
        library: Objects with features of that source, with class car.
        out: Folder for ``control.json``, ``control.md`` and a sheet for each application. Parts
            are added to those that are in it, so that they may be measured one by one.
        settings: How much is measured.
        features_ckpt: Weights of the feature source, where it has none of its own.
        about: What the model is.

    Returns:
        All tables.

    Raises:
        ValueError: If a part is unknown, the checkpoint has no feature source or another than the
            objects, or the data cannot be used; the message tells which.
    """
    if unknown := [part for part in settings.parts if part not in _PARTS]:
        raise ValueError(f"there is no part {', '.join(unknown)}; there are {', '.join(_PARTS)}")
    if source is None:
        raise ValueError("the checkpoint was trained without 3D features: none can guide it")
    if source == "oracle":
        raise ValueError(
            "the checkpoint was aligned with the simulator's labels (oracle), which cannot be "
            "extracted again from generated points: measure one of another feature source"
        )
    objects = ObjectLibrary.load(library)
    objects.check_source(source, generator.sit.feature_dim)
    extractor: Any = feature_source(source, features_ckpt, generator.sit.feature_dim)
    desk = ScanDesk(generator, extractor.to(generator.device))
    generator.sit.requires_grad_(False)  # the gradients that guide are of latents
    bench = Bench(desk, objects.feature("car"), data, settings)
    facts = {
        "model": dict(about or {}) | {"feature_source": source, "objects": library.name},
        "settings": asdict(settings) | {"data": data.name},
        "command": command(),
        "machine": machine()
        | {"threads": torch.get_num_threads(), "device": str(generator.device)},
        "versions": versions(torch),
    }
    out.mkdir(parents=True, exist_ok=True)
    text = ""
    for part in settings.parts:
        finding = _PARTS[part](bench)
        text = write_control(out, part, finding, facts, generator.geometry.projection)
    return text
