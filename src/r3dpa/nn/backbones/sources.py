"""Feature sources by name, as the command line and configurations ask for them."""

from __future__ import annotations

from pathlib import Path

from torch import nn

from r3dpa.nn.backbones.geometric import GeometricFeatures
from r3dpa.nn.backbones.scalr import ScaLR

#: Names that :func:`feature_source` knows.
SOURCES = ("scalr", "waffleiron-s", "geometric")


def feature_source(name: str, ckpt: str | Path | None = None, dim: int = 768) -> nn.Module:
    """Frozen feature extractor, see :class:`r3dpa.data.Extractor`.

    Args:
        name: ``"scalr"``: distilled from images, needs the released checkpoint;
            ``"waffleiron-s"``: trained on simulated scans without labels; ``"geometric"``: local
            shape, without training.
        ckpt: Weights of ``"scalr"`` or ``"waffleiron-s"``; the latter has its own where None.
        dim: Width D of the features; of ``"scalr"`` that of its checkpoint.

    Raises:
        ValueError: If the name is unknown, a checkpoint is missing, given to a source without
            weights or unreadable, or ``dim`` is none that the source can have.
    """
    if name not in SOURCES:
        raise ValueError(f"there is no feature source {name!r}; there are {', '.join(SOURCES)}.")
    if name == "scalr":
        if ckpt is None:
            others = ", ".join(source for source in SOURCES if source != name)
            raise ValueError(
                "feature source scalr needs ckpt, the released ckpt_last.pth; without it, choose "
                f"one of {others}."
            )
        scalr = ScaLR.from_checkpoint(ckpt)
        if scalr.dim != dim:
            raise ValueError(f"{ckpt} has features of width {scalr.dim}, but dim is {dim}.")
        return scalr
    if name == "waffleiron-s":
        from r3dpa.nn.backbones.pretrained import WaffleIronS

        return WaffleIronS(None if ckpt is None else Path(ckpt), dim=dim)
    if ckpt is not None:
        raise ValueError(f"feature source {name} has no weights: leave ckpt ({ckpt}) out.")
    return GeometricFeatures(dim)
