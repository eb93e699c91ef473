"""``r3dpa gallery``: one page of generated scenes, their nearest scans, edits and weather."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from jsonargparse.typing import NonNegativeInt, PositiveInt

from r3dpa.cli.parser import check_file
from r3dpa.pretrained import DEFAULT_WEIGHTS


def gallery(
    *,
    out: Path,
    ckpt: Path = Path(DEFAULT_WEIGHTS),
    num: PositiveInt = 64,
    data: Path | None = None,
    quality: Literal["draft", "good", "best"] = "good",
    seed: NonNegativeInt = 0,
    batch_size: PositiveInt = 8,
    device: str = "auto",
) -> str:
    """Write one page of scenes in order, none left out, with clouds to turn.

    The nearest training scan beside each scene shows what is memorised. Edits of the first scene
    follow, and fog, rain and snow in it.

    Args:
        out: HTML file to write.
        ckpt: Checkpoint of stage joint or flow_matching, a name of ``r3dpa models``, or
            ``hf://owner/name``.
        num: Number of scenes.
        data: Training data, a folder of scans or a data YAML; default: no nearest scans.
        quality: Sampler of the scenes.
        seed: Scenes depend on it and on their number.
        batch_size: Scenes generated together.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from torch import Tensor

    from r3dpa.cli.features import read_data
    from r3dpa.editing import SceneEditor, regions
    from r3dpa.generation import SceneGenerator
    from r3dpa.io import usable_device, write_text
    from r3dpa.viz.gallery import gallery_page

    check_file(out)
    generator = SceneGenerator.from_checkpoint(ckpt, quality, device=usable_device(device))
    module = None if data is None else read_data(data)
    if module is not None:
        module.setup("fit")
        if module.sensor != generator.geometry.projection.sensor:
            raise ValueError(f"{data}: is of another sensor than {ckpt}: {module.sensor}")
    projection = generator.geometry.projection
    editor = SceneEditor(generator, batch_size=batch_size)

    def edit(scene_m: Tensor) -> dict[str, Tensor]:
        ahead = regions.angle_box(projection, -30, 30, -25, 3)
        beams = regions.dropped_beams(projection, range(0, projection.sensor.beams, 2))
        return {
            "ahead generated anew": editor.inpaint(scene_m, ahead, 2, seed).range_m,
            "every other beam filled": editor.complete(scene_m, beams, 1, seed).range_m,
            "varied": editor.vary(scene_m, 2, seed).range_m,
        }

    page = gallery_page(generator, str(ckpt), num, edit, module, seed, batch_size)
    html = page.html("r3dpa gallery")
    write_text(out, html)
    return f"open {out}: {len(page.scans)} scenes, {len(html) / 1e6:.0f} MB"
