"""The official sampler script, run as it is on the CPU with given weights.

The script expects CUDA and several processes. Overlays of the modules that it imports stand in for
both; its own lines run unchanged.
"""

from __future__ import annotations

import contextlib
import io
import json
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import torch
from official_code import OfficialCode, Overlay
from torch import nn

from r3dpa.checkpoints import Checkpoint, to_official

_MODEL, _VAE = "r3dpa/2", "h2p4d8"
_STRIDE = (4, 8)
_STEP = 1


class _Cpu:
    """In place of a number of GPUs: ``rank % count`` is then the CPU."""

    def __rmod__(self, rank: int) -> torch.device:
        return torch.device("cpu")


def official_sit(code: OfficialCode, checkpoint: Checkpoint, **given: Any) -> nn.Module:
    """The official SiT with the sizes of ``sit`` in a checkpoint; fresh weights."""
    sizes = checkpoint.network("sit").arguments
    same = ("input_size", "in_channels", "num_classes", "qk_norm", "patch_size", "hidden_size")
    same += ("depth", "num_heads", "mlp_ratio", "projector_dim")
    arguments = {name: sizes[name] for name in same} | {
        "encoder_depth": sizes["alignment_depth"],
        "decoder_hidden_size": sizes["hidden_size"],
        "class_dropout_prob": 0.0,
        "bn_momentum": 0.1,
        "fused_attn": True,
    }
    return code["models.sit"].SiT(**arguments | given | {"z_dims": [sizes["feature_dim"]]})


def official_vae(code: OfficialCode, checkpoint: Checkpoint) -> nn.Module:
    """The official range-image VAE with the sizes of ``vae`` in a checkpoint; fresh weights."""
    sizes = checkpoint.network("vae").arguments
    width = {"ch": sizes["channels"], "num_res_blocks": sizes["num_res_blocks"]}
    autoencoder, lidm = code["models.autoencoder"], code["models.model_lidm"]
    overlay = Overlay(
        lidm, Encoder=partial(lidm.Encoder, **width), Decoder=partial(lidm.Decoder, **width)
    )
    with replaced(autoencoder, model_lidm=overlay):
        return autoencoder.AutoencoderKL(
            embed_dim=sizes["latent_channels"],
            ch_mult=list(sizes["channel_multipliers"]),
            strides=[list(stride) for stride in sizes["strides"]],
            attn_levels=list(sizes["attention_levels"]),
            in_channels=1,
            out_ch=1,
            lib_name="lidm",
        )


def save_for_official(code: OfficialCode, checkpoint: Checkpoint, folder: Path) -> None:
    """Writes the experiment folder that ``generate.py`` reads: ``args.json`` and one checkpoint."""
    sizes = checkpoint.network("sit").arguments
    options = {
        "dataset_config": str(code.repo / "configs" / "kitti.yaml"),
        "vae": _VAE,
        "resolution": [size * by for size, by in zip(sizes["input_size"], _STRIDE, strict=True)],
        "model": _MODEL,
        "num_classes": sizes["num_classes"],
        "cfg_prob": 0.0,
        "encoder_depth": sizes["alignment_depth"],
        "bn_momentum": 0.1,
        "fused_attn": True,
        "qk_norm": sizes["qk_norm"],
    }
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "args.json").write_text(json.dumps(options))
    content = {key: value for key, value in to_official(checkpoint).items() if key != "args"}
    torch.save(content, folder / "checkpoints" / f"{_STEP:07d}.pt")


def write_official_scenes(code, checkpoint, experiment, out, num, batch_size, steps, noise=None):
    """Runs ``main`` of the official ``generate.py``: Euler steps, decode, all of its files."""
    generate = code["generate"]
    overlay: dict[str, Any] = {
        "cuda": Mock(is_available=lambda: True, device_count=_Cpu),
        "load": lambda path, map_location: torch.load(path, weights_only=True),
    }
    if noise is not None:
        batches = iter(noise.split(batch_size))
        overlay["randn"] = lambda *shape, device: next(batches)
    alone = Mock(get_rank=lambda: 0, get_world_size=lambda: 1)
    options = Namespace(
        tf32=False,
        global_seed=0,
        sample_dir=str(out),
        exp_path=str(experiment),
        train_steps=_STEP,
        pproc_batch_size=batch_size,
        num_fid_samples=num,
        mode="ode",
        cfg_scale=1.0,
        path_type=checkpoint.interpolant,
        num_steps=steps,
        heun=False,
        guidance_low=0.0,
        guidance_high=1.0,
    )
    with (
        replaced(
            generate,
            torch=Overlay(torch, **overlay),
            dist=alone,
            tqdm=lambda steps, **_: steps,
            SiT_models={_MODEL: partial(official_sit, code, checkpoint)},
            UNet_models={},
            vae_models={_VAE: partial(official_vae, code, checkpoint)},
        ),
        contextlib.redirect_stdout(io.StringIO()),
        torch.enable_grad(),  # it switches gradients off for good
    ):
        generate.main(options)
    (images,) = out.glob("*/numpy/img.npz")
    return np.load(images)["arr_0"][:, 0]


@contextmanager
def replaced(module: Any, **names: Any) -> Iterator[None]:
    """Other content of a module for a while."""
    before = {name: getattr(module, name) for name in names}
    vars(module).update(names)
    try:
        yield
    finally:
        vars(module).update(before)
