"""From one checkpoint layout to another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import yaml

from r3dpa.checkpoints.files import (
    official_neighbour,
    read_checkpoint,
    refuse_existing,
    save_checkpoint,
)
from r3dpa.checkpoints.networks import Checkpoint, NetworkState, format_table
from r3dpa.checkpoints.official import facts_of, statistics_of, to_official
from r3dpa.checkpoints.transfer import TransferReport, transfer_rgb
from r3dpa.io import atomic_path
from r3dpa.nn.latent_norm import LatentNorm
from r3dpa.nn.sit import SiT

__all__ = ["ConversionReport", "convert"]

_LOST = ("sensor and encoding", "step", "arguments of the latent statistics")


@dataclass(frozen=True)
class ConversionReport:
    """Files, networks and RGB transfer of one :func:`convert`."""

    source: Path
    outputs: tuple[Path, ...]
    checkpoint: Checkpoint
    transfer: TransferReport | None = None

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
        if self.transfer is not None:
            lines += ["", self.transfer.table()]
        return "\n".join(lines)


def convert(
    source: str | Path,
    out: str | Path,
    to: Literal["r3dpa", "official"] = "r3dpa",
    *,
    overwrite: bool = False,
    sit_args: Mapping[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
    into: str | Path | None = None,
) -> ConversionReport:
    """Rewrites a checkpoint of any layout in ours, or in the official one.

    Weights stay equal bit for bit; optimisers are left out. An official training checkpoint that
    this writes keeps all facts for the way back. A checkpoint without SiT becomes the official VAE
    file with its neighbours for discriminator and latent statistics, which lose some.

    With ``into`` the result is another SiT initialised from RGB weights, as with ``rgb_weights`` of
    the training stages; see :func:`transfer_rgb`. Weights that the source does not have are random,
    the same ones at each call.

    Args:
        source: Checkpoint that :func:`read_checkpoint` understands.
        out: ``.safetensors`` for ours, ``.pt`` for the official layout.
        to: Layout to write.
        overwrite: Replace existing files.
        sit_args: As for :func:`read_checkpoint`.
        encoding: As for :func:`read_checkpoint`.
        into: YAML file with ``class_path`` and ``init_args`` of the SiT that RGB weights are put
            into; to ``r3dpa`` only.

    Raises:
        FileNotFoundError: If there is no such source.
        ValueError: If it cannot be read, has no counterpart in the other layout, or the output
            exists already.
    """
    source, out = Path(source), Path(out)
    if into is not None and to != "r3dpa":
        raise ValueError(f"convert puts RGB weights into 'r3dpa' checkpoints only, got to {to!r}")
    checkpoint = read_checkpoint(source, sit_args=sit_args, encoding=encoding)
    transfer = None
    if into is not None:
        checkpoint, transfer = _transferred(checkpoint, Path(into))
    if to == "r3dpa":
        save_checkpoint(checkpoint, out, overwrite=overwrite)
        outputs = [out, out.with_suffix(".yaml")]
    elif to == "official":
        outputs = _save_official(checkpoint, out, overwrite)
        if not {"sit", "ema"} & set(checkpoint.networks):
            lost = dict.fromkeys(_LOST, "official files of a VAE have no place for it")
            checkpoint = replace(checkpoint, left_out={**checkpoint.left_out, **lost})
    else:
        raise ValueError(f"convert writes 'r3dpa' or 'official' checkpoints, got {to!r}")
    return ConversionReport(source, tuple(outputs), checkpoint, transfer)


def _transferred(checkpoint: Checkpoint, into: Path) -> tuple[Checkpoint, TransferReport]:
    """Checkpoint with a SiT for range images that starts from the RGB weights of another."""
    try:
        config = yaml.safe_load(into.read_text(encoding="utf-8"))
        state = NetworkState(config["class_path"], config.get("init_args") or {}, {})
    except (yaml.YAMLError, UnicodeDecodeError, LookupError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{into}: names no network ({type(error).__name__}: {error}); give a YAML file with "
            "class_path and init_args of a SiT, such as conf/net/sit_b2.yaml"
        ) from error
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        sit = state.new()
    if not isinstance(sit, SiT):
        raise ValueError(f"{into}: RGB weights are for a SiT, but it names {state.class_path}")
    norm = LatentNorm(sit.in_channels)
    report = transfer_rgb(checkpoint, sit, norm, keep_projector=True)
    networks = {
        "sit": NetworkState.of(sit, state.init_args),
        "latent_norm": NetworkState.of(norm, {"channels": sit.in_channels}),
    }
    others = dict.fromkeys(checkpoint.networks.keys() - networks.keys(), "no part of RGB weights")
    left_out = {**checkpoint.left_out, **others}
    # Options and sensor were those of the source.
    kept = replace(checkpoint, networks=networks, geometry=None, official_args={})
    return replace(kept, left_out=left_out), report


def _save_official(checkpoint: Checkpoint, out: Path, overwrite: bool) -> list[Path]:
    if out.suffix != ".pt":
        raise ValueError(f"official checkpoints are called <name>.pt, got {out}")
    content = to_official(checkpoint)
    if {"model", "ema"} & set(content):
        files: dict[Path, Any] = {out: content | facts_of(checkpoint)}
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
