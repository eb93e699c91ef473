"""Weights of published networks: read without running code, loaded key by key."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor, nn

from r3dpa.io import UNPICKLING_ERRORS

_MODEL = "the model.ckpt of the released weights"


class FrozenNetwork(nn.Module):
    """Network that stays in evaluation mode: batch statistics would change its features."""

    def train(self, mode: bool = True) -> Self:
        """Keep evaluation mode, whatever ``mode`` is."""
        return super().train(False)


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Prefix errors of the block with the name of the file."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_released(path: Path, released: str = _MODEL) -> Any:
    """Read a file of ``torch.save``, tensors on the CPU, without running code in it."""
    if not path.is_file():
        raise ValueError(f"no such file; give {released}")
    try:
        # Memory-mapped, so that optimiser states are not read.
        return torch.load(
            path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path)
        )
    except UNPICKLING_ERRORS as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"is damaged, or holds more than tensors and plain values ({reason}); give {released}, "
            "or save its weights alone"
        ) from error


def read_state_dict(path: Path) -> dict[str, Tensor]:
    """Read the entry ``state_dict`` of a training checkpoint, see :func:`read_released`."""
    content = read_released(path)
    weights = content.get("state_dict") if isinstance(content, Mapping) else None
    if not isinstance(weights, Mapping) or not all(
        isinstance(value, Tensor) for value in weights.values()
    ):
        raise ValueError(f"holds no entry state_dict with tensors; give {_MODEL}")
    return dict(weights)


def load_strictly(
    network: nn.Module, weights: Mapping[str, Tensor], official_name: Callable[[str], str]
) -> None:
    """Load every key of an official state dict.

    Official weights may have additional last axes of size 1: some linear layers are convolutions.
    """
    state = network.state_dict()
    keys = {official_name(key): key for key in state}
    missing = [name for name in keys if name not in weights]
    unexpected = [name for name in weights if name not in keys]
    if missing or unexpected:
        raise ValueError(
            f"the weights do not fit this {type(network).__name__}: {len(missing)} missing "
            f"{missing[:5]}, {len(unexpected)} unexpected {unexpected[:5]}"
        )
    loaded = {}
    for name, key in keys.items():
        shape, expected = tuple(weights[name].shape), tuple(state[key].shape)
        if shape[: len(expected)] != expected or any(size != 1 for size in shape[len(expected) :]):
            raise ValueError(f"weight {name} has shape {shape}, but {expected} is expected")
        loaded[key] = weights[name].reshape(expected)
    network.load_state_dict(loaded)


def key_renamer(names: Mapping[str, str]) -> Callable[[str], str]:
    """Return a function that replaces the beginning of a key by the first entry that fits.

    Keys of the table are regular expressions, and ``{}`` in their values stands for a group.
    """

    def official_name(key: str) -> str:
        for ours, official in names.items():
            if match := re.match(ours, key):
                return official.format(*match.groups()) + key[match.end() :]
        raise KeyError(key)

    return official_name
