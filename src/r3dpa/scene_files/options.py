"""Options that several commands share, as the parser reads them; imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jsonargparse.typing import NonNegativeInt, PositiveInt

from r3dpa.io import check_folder
from r3dpa.pretrained import DEFAULT_WEIGHTS

ODESolver = Literal["euler", "heun", "midpoint", "ab2", "ab3", "dpmpp_2m", "unipc"]


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Checkpoint that generates scenes, and files that they are written to.

    Args:
        ckpt: Checkpoint of stage joint, flow_matching or few_step, or of a baseline, ``.ckpt`` or
            exported ``.safetensors``; a name of ``r3dpa models``; or ``hf://owner/name``.
        out: Folder for scenes, pictures, page and metadata; must not hold other scenes.
        seed: Scene i depends on (seed, i) alone, not on the batch size.
        batch_size: Scenes generated together.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        weights: Averaged (``ema``) or last weights of the SiT.
        formats: Files of points: ``bin``, ``ply``, ``npz``; ``range_m.npy`` is always written.
        pictures: Number of scenes to draw.
        overwrite: Replace the scenes of a folder.
    """

    out: Path
    ckpt: Path = Path(DEFAULT_WEIGHTS)
    seed: NonNegativeInt = 0
    batch_size: PositiveInt = 8
    device: str = "auto"
    weights: Literal["ema", "last"] = "ema"
    formats: tuple[Literal["bin", "ply", "npz"], ...] = ("bin",)
    pictures: NonNegativeInt = 16
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_folder(self.out)


@dataclass(frozen=True, kw_only=True)
class EditOptions(SceneOptions):
    """Options shared by all edits.

    Args:
        solver: ODE solver, to noise and back; ``midpoint`` has the least error there and back.
        steps: Solver steps from data to noise; default: 16, of baselines 32.
        shift: Finer steps near noise (above 1) or data (below 1).
        columns: Columns of files without names, such as ``x,y,z,intensity,ring``; default:
            inferred from the values.
    """

    solver: ODESolver = "midpoint"
    steps: int | None = None
    shift: float = 1.0
    columns: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class FolderOptions:
    """Options shared by ``weather`` and ``corrupt``.

    Args:
        out: Folder of the results.
        seed: Of the random draws, together with the name of each scan.
        workers: Processes.
        columns: Columns of files without names, such as ``x,y,z,intensity,ring``; default:
            inferred from the values.
        drop_nan: Leave out points with NaN.
        show: Scans on the page at most.
    """

    out: Path
    seed: NonNegativeInt = 0
    workers: PositiveInt = 1
    columns: tuple[str, ...] = ()
    drop_nan: bool = False
    show: NonNegativeInt = 4
