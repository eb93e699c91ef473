"""Options that ``r3dpa sample`` and the edits share, and checks of options before the work."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


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
    seed: int = 0
    batch_size: int = 8
    device: str = "auto"
    weights: Literal["ema", "last"] = "ema"
    formats: tuple[str, ...] = ("bin",)
    pictures: int = 16
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_least(1, batch_size=self.batch_size)
        check_least(0, seed=self.seed, pictures=self.pictures)
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


def check_least(least: int, **values: int | None) -> None:
    """Refuses a number below ``least``; None is none."""
    for name, value in values.items():
        if value is not None and value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")


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
