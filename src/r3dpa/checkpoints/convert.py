"""From one checkpoint layout to another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from r3dpa.atomic import atomic_path
from r3dpa.checkpoints.files import (
    official_neighbour,
    read_checkpoint,
    refuse_existing,
    save_checkpoint,
)
from r3dpa.checkpoints.networks import Checkpoint, format_table
from r3dpa.checkpoints.official import statistics_of, to_official

__all__ = ["ConversionReport", "convert"]


@dataclass(frozen=True)
class ConversionReport:
    """What :func:`convert` wrote, network by network."""

    source: Path
    outputs: tuple[Path, ...]
    checkpoint: Checkpoint

    def table(self) -> str:
        """The report as text."""
        rows = [
            (name, state.class_path.rpartition(".")[2], str(len(state.state_dict)), f"{size:,}")
            for name, state in self.checkpoint.networks.items()
            for size in [sum(value.numel() for value in state.state_dict.values())]
        ]
        lines = [f"{self.source} -> {', '.join(str(path) for path in self.outputs)}"]
        lines.append(format_table(("network", "class", "tensors", "elements"), rows))
        lines += [
            f"not converted: {key} ({reason})" for key, reason in self.checkpoint.left_out.items()
        ]
        return "\n".join(lines)


def convert(
    source: str | Path,
    out: str | Path,
    to: Literal["r3dpa", "official"] = "r3dpa",
    *,
    overwrite: bool = False,
    sit_args: Mapping[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
) -> ConversionReport:
    """Rewrites a checkpoint of any layout in ours, or in the official one.

    Weights stay equal bit for bit; optimisers are left out. A checkpoint without SiT becomes the
    official VAE file with its neighbours for discriminator and latent statistics.

    Args:
        source: Checkpoint that :func:`read_checkpoint` understands.
        out: ``.safetensors`` for ours, ``.pt`` for the official layout.
        to: Layout to write.
        overwrite: Replace existing files.
        sit_args: As for :func:`read_checkpoint`.
        encoding: As for :func:`read_checkpoint`.

    Raises:
        FileNotFoundError: If there is no such source.
        ValueError: If it cannot be read, has no counterpart in the other layout, or the output
            exists already.
    """
    source, out = Path(source), Path(out)
    checkpoint = read_checkpoint(source, sit_args=sit_args, encoding=encoding)
    if to == "r3dpa":
        save_checkpoint(checkpoint, out, overwrite=overwrite)
        outputs = [out, out.with_suffix(".yaml")]
    elif to == "official":
        outputs = _save_official(checkpoint, out, overwrite)
    else:
        raise ValueError(f"convert writes 'r3dpa' or 'official' checkpoints, got {to!r}")
    return ConversionReport(source, tuple(outputs), checkpoint)


def _save_official(checkpoint: Checkpoint, out: Path, overwrite: bool) -> list[Path]:
    if out.suffix != ".pt":
        raise ValueError(f"official checkpoints are called <name>.pt, got {out}")
    content = to_official(checkpoint)
    if {"model", "ema"} & set(content):
        files: dict[Path, Any] = {out: content}
    else:
        files = {out: content["vae"]} if "vae" in content else {}
        if "discriminator" in content:
            files[official_neighbour(out, "discriminator-ckpt")] = content["discriminator"]
        if "latent_norm" in checkpoint.networks:
            norm = checkpoint.network("latent_norm").state_dict
            files[official_neighbour(out, "latents-stats")] = statistics_of(norm)
    refuse_existing(list(files), overwrite)
    for path, weights in files.items():
        with atomic_path(path) as temporary:
            torch.save(weights, temporary)
    return list(files)
