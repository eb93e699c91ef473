"""Options that ``r3dpa sample`` and the edits share, and checks before the work."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jsonargparse.typing import NonNegativeInt, PositiveInt


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Checkpoint that makes scenes, and files that they are written to.

    Args:
        ckpt: Checkpoint of stage joint or flow_matching, ``.ckpt`` or exported ``.safetensors``.
        out: Folder for scenes, pictures, page and metadata; must not hold other scenes.
        seed: Scene i depends on (seed, i) alone, not on the batch size.
        batch_size: Scenes made together.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        weights: Averaged (``ema``) or last weights of the SiT.
        formats: Files of points: ``bin``, ``ply``, ``npz``; ``range_m.npy`` is always written.
        pictures: Number of scenes to draw.
        overwrite: Write into a folder that holds scenes already, and start anew.
    """

    ckpt: Path
    out: Path
    seed: NonNegativeInt = 0
    batch_size: PositiveInt = 8
    device: str = "auto"
    weights: Literal["ema", "last"] = "ema"
    formats: tuple[str, ...] = ("bin",)
    pictures: NonNegativeInt = 16
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_folder(self.out)


@dataclass(frozen=True, kw_only=True)
class EditOptions(SceneOptions):
    """Those of all edits.

    Args:
        solver: ODE solver, to noise and back; ``midpoint`` loses least on that way.
        steps: Solver steps of a whole way.
        shift: Finer steps near noise (above 1) or data (below 1).
    """

    solver: Literal["midpoint", "heun", "euler", "ab2", "ab3", "dpmpp_2m", "unipc"] = "midpoint"
    steps: int = 32
    shift: float = 1.0


def check_folder(out: Path | None) -> None:
    """Refuses an output folder whose place is taken by a file, before the work starts."""
    for folder in () if out is None else (out, *out.parents):
        if folder.is_file():
            raise ValueError(f"{folder} is a file; give another --out")


def check_file(out: Path | None) -> None:
    """Refuses an output file whose place is taken by a folder, before the work starts."""
    if out is not None and out.is_dir():
        raise ValueError(f"{out} is a folder; give --out the name of a file")
    check_folder(None if out is None else out.parent)
