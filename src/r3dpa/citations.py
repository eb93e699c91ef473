"""References of what a checkpoint was made with, as BibTeX."""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

from r3dpa.pretrained import DEFAULT_WEIGHTS

# Keys of citations.bib by what a checkpoint states.
_OF_STAGE = {
    "joint": ["r3dpa", "repa_e"],
    "few_step": ["r3dpa", "mean_flows"],
    "r2dm": ["r2dm"],
    "r2flow": ["r2flow"],
    "lidm": ["lidm"],
    "lidm_first_stage": ["lidm"],
}
_OF_NETWORK = {"VAE": "lidm", "UNet": "lidm", "SiT": "sit", "AverageVelocitySiT": "sit"}
_OF_FEATURES = {
    "waffleiron-s": ["waffleiron"],
    "waffleiron-s-2": ["waffleiron"],
    "scalr": ["scalr", "waffleiron"],
}


def cite(ckpt: Path = Path(DEFAULT_WEIGHTS)) -> str:
    """Print BibTeX of the method, networks and features that a checkpoint was made with.

    The data set is not known from a checkpoint: add the reference of yours.

    Args:
        ckpt: Checkpoint file, hf://owner/name, or a name of ``r3dpa models``.
    """
    from r3dpa.checkpoints import read_checkpoint

    checkpoint = read_checkpoint(ckpt)
    classes = [state.class_path.rpartition(".")[2] for state in checkpoint.networks.values()]
    keys = keys_of(checkpoint.stage, classes, checkpoint.feature_source, checkpoint.sampling)
    entries = files("r3dpa").joinpath("citations.bib").read_text().strip()
    by_key = {re.split(r"[{,]", entry, maxsplit=2)[1]: entry for entry in entries.split("\n\n")}
    return "\n\n".join(by_key[key] for key in keys)


def keys_of(
    stage: str, classes: Iterable[str], features: str | None, sampling: Iterable[str]
) -> list[str]:
    """Return the keys of ``citations.bib`` for a stage, network classes, features and guidance."""
    keys = list(_OF_STAGE.get(stage, ["r3dpa"]))
    keys += [_OF_NETWORK[name] for name in classes if name in _OF_NETWORK]
    keys += _OF_FEATURES.get(features or "", [])
    keys += [name for name in sampling if name == "perturbed_attention"]
    return list(dict.fromkeys(keys))
