"""``r3dpa gallery``: scenes of a checkpoint as one page."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from jsonargparse.typing import NonNegativeInt, PositiveInt

from r3dpa.io import check_file
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
    follow, and fog, rain and snow in it. Where the weights have features of cars, a car is put into
    it: the two of eight draws that are most like one.

    Args:
        out: HTML file to write.
        ckpt: Checkpoint of stage joint, flow_matching or few_step, a name of ``r3dpa models``, or
            ``hf://owner/name``.
        num: Number of scenes.
        data: Training data, a folder of scans or a data YAML; default: no nearest scans.
        quality: Sampler of the scenes.
        seed: Scenes depend on it and on their number.
        batch_size: Scenes generated together.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.cli.features import read_data
    from r3dpa.generation import SceneGenerator
    from r3dpa.io import number_of, usable_device, write_text
    from r3dpa.scene_files.shown_edits import ShownEdits
    from r3dpa.viz.gallery import gallery_page

    check_file(out)
    checkpoint = read_checkpoint(ckpt)
    generator = SceneGenerator.from_checkpoint(checkpoint, quality, device=usable_device(device))
    edit = ShownEdits(generator, checkpoint, seed, batch_size)
    module = None if data is None else read_data(data)
    if module is not None:
        module.setup("fit")
        if module.sensor != generator.geometry.projection.sensor:
            raise ValueError(f"{data}: is of another sensor than {ckpt}: {module.sensor}")
    page = gallery_page(generator, str(ckpt), num, edit, module, seed, batch_size)
    html = page.html("r3dpa gallery")
    write_text(out, html)
    return f"open {out}: {number_of(num, 'scene')}, {len(html) / 1e6:.0f} MB"
