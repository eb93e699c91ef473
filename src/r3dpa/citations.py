"""References of what a checkpoint was made with, as BibTeX."""

from __future__ import annotations

import re
from importlib.resources import files
from typing import TYPE_CHECKING

from r3dpa.pretrained import DEFAULT_WEIGHTS

if TYPE_CHECKING:
    from r3dpa.checkpoints import Checkpoint

# Keys of citations.bib by what a checkpoint states.
_OF_STAGE = {
    "joint": ["r3dpa", "repa_e"],
    "few_step": ["r3dpa", "mean_flows"],
    "r2dm": ["r2dm"],
    "r2flow": ["r2flow"],
    "lidm": ["lidm"],
    "lidm_first_stage": ["lidm"],
}
_OF_NETWORK = {"VAE": "lidm", "SiT": "sit", "AverageVelocitySiT": "sit"}
_OF_FEATURES = {"waffleiron-s": ["waffleiron"], "scalr": ["scalr", "waffleiron"]}


def cite(ckpt: str = DEFAULT_WEIGHTS) -> str:
    """Print BibTeX of the method, networks and features that a checkpoint was made with.

    The data set is not known from a checkpoint: add the reference of yours.

    Args:
        ckpt: Checkpoint file, hf://owner/name, or a name of ``r3dpa models``.
    """
    from r3dpa.checkpoints import read_checkpoint

    entries = files("r3dpa").joinpath("citations.bib").read_text().strip()
    by_key = {re.split(r"[{,]", entry, maxsplit=2)[1]: entry for entry in entries.split("\n\n")}
    return "\n\n".join(by_key[key] for key in _keys(read_checkpoint(ckpt)))


def _keys(checkpoint: Checkpoint) -> list[str]:
    keys = list(_OF_STAGE.get(checkpoint.stage, ["r3dpa"]))
    for network in checkpoint.networks.values():
        name = network.class_path.rpartition(".")[2]
        keys += [_OF_NETWORK[name]] if name in _OF_NETWORK else []
    keys += _OF_FEATURES.get(checkpoint.feature_source or "", [])
    keys += ["perturbed_attention"] if "perturbed_attention" in checkpoint.sampling else []
    return list(dict.fromkeys(keys))
