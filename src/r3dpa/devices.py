"""The device that a user names, for all commands."""

from __future__ import annotations

import torch

from r3dpa.unpickling import first_line

__all__ = ["usable_device"]


def usable_device(name: str) -> str:
    """A device by name, the GPU or else the CPU for ``auto``.

    Raises:
        ValueError: If there is none of this name.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=name)
    except (AssertionError, NotImplementedError, RuntimeError) as error:  # whatever torch lacks
        raise ValueError(
            f"device {name!r} cannot be used here ({first_line(error)}): give cpu or auto"
        ) from error
    return name
