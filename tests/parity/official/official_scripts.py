"""The official sampler script and training script, run as they are on the CPU with given weights.

Both scripts expect CUDA, several processes and files of data. What they would ask of those is
answered here by overlays of the modules they import; their own lines run unchanged.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock

import lightning as L
import numpy as np
import torch
from official_code import OfficialCode, OneProcess, Overlay
from torch import Tensor, nn
from torch.utils.data import DataLoader

from r3dpa.checkpoints import Checkpoint, to_official
from r3dpa.modules import JointAlignment
from r3dpa.modules.stage import PathDraws

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


class Trained(NamedTuple):
    """What some training steps took and led to."""

    seconds: list[float]
    weights: dict[str, dict[str, Tensor]]


def train_official(code, checkpoint, image, features, draws, steps, folder) -> Trained:
    """Runs ``main`` of the official ``train_repae.py`` for some steps on one batch."""
    script = code["train_repae"]
    weights, process = to_official(checkpoint), OneProcess(time.perf_counter)
    networks: dict[str, nn.Module] = {}
    posterior_noise, times, noise = draws

    def keep(name: str, network: nn.Module, state: dict[str, Tensor]) -> nn.Module:
        network.load_state_dict(state)
        networks[name] = network
        return network

    def loss(config: Any) -> nn.Module:
        function = code["loss.losses"].ReconstructionLoss_Single_Stage(config)
        keep("discriminator", function.discriminator, weights["discriminator"])
        return function

    batch = {"image": image, "features": features}
    samples = [dict(zip(batch, pair, strict=True)) for pair in zip(image, features, strict=True)]
    with (
        replaced(
            script,
            Accelerator=lambda **_: process,
            SiT_models={
                _MODEL: lambda **given: keep(
                    "sit", official_sit(code, checkpoint, **given), weights["model"]
                )
            },
            vae_models={_VAE: lambda: keep("vae", official_vae(code, checkpoint), weights["vae"])},
            ReconstructionLoss_Single_Stage=loss,
            KITTI360=lambda *_, **__: samples,
            euler_sampler=lambda model, latents, *_, **__: latents[..., : _STRIDE[1]],
            logging=logging.getLogger(__name__),
        ),
        replaced(
            code["models.autoencoder"],
            torch=Overlay(torch, randn=lambda shape, device: posterior_noise),
        ),
        replaced(
            code["models.sit"],
            torch=Overlay(
                torch, rand=lambda shape: times.view(shape), randn_like=lambda values: noise
            ),
        ),
        contextlib.redirect_stdout(io.StringIO()),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        script.main(_training_options(code, checkpoint, image, steps, folder))
    return Trained(
        process.seconds, {name: network.state_dict() for name, network in networks.items()}
    )


def _training_options(code, checkpoint, image, steps, folder):
    """Those of the second stage as published, but without compiling and in full precision."""
    configs, sizes = code.repo / "configs", checkpoint.network("sit").arguments
    options = code["train_repae"].parse_args(["--exp-name", "joint"])
    vars(options).update(
        output_dir=str(folder),
        mixed_precision="no",
        allow_tf32=False,
        compile=False,
        seed=None,
        model=_MODEL,
        vae=_VAE,
        resolution=list(image.shape[-2:]),
        num_classes=sizes["num_classes"],
        encoder_depth=sizes["alignment_depth"],
        cfg_prob=0.0,
        qk_norm=sizes["qk_norm"],
        dataset_config=str(configs / "kitti.yaml"),
        batch_size=len(image),
        num_workers=0,
        loss_cfg_path=str(configs / "l1_lpips_kl_gan.yaml"),
        adam_weight_decay=0.03,
        epochs=steps,
        max_train_steps=steps,
    )
    return options


@contextmanager
def replaced(module: Any, **names: Any) -> Iterator[None]:
    """Other content of a module for a while."""
    before = {name: getattr(module, name) for name in names}
    vars(module).update(names)
    try:
        yield
    finally:
        vars(module).update(before)


class _GivenDraws(JointAlignment):
    """Joint training without a data module, with the same draws in every step."""

    draws: PathDraws

    def setup(self, stage: str) -> None:
        """Needs no scans: the batch is given."""

    def draw_path(self, num_scans: int, batch_number: int | None = None) -> PathDraws:
        return self.draws


class _Timer(L.Callback):
    """Time of each step: losses, backward, clipping, optimiser and averages."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.seconds: list[float] = []
        self.start = 0.0

    def on_train_batch_start(self, *args: Any) -> None:
        self.start = self.clock()

    def on_train_batch_end(self, *args: Any) -> None:
        self.seconds.append(self.clock() - self.start)


def train_ours(checkpoint, image, features, draws, steps) -> Trained:
    """Trains as `train_official` does, by a Trainer with one optimiser and one backward pass."""
    networks: dict[str, Any] = {
        name: checkpoint.network(name).build()
        for name in ("vae", "sit", "discriminator", "latent_norm")
    }
    module = _GivenDraws(**networks, ema_buffers="decay")
    module.draws = PathDraws(*draws)
    timer = _Timer(time.perf_counter)
    batch = {"range_image": image, "feature_grid": features}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice on loaders and loggers
        trainer = L.Trainer(
            accelerator="cpu",
            max_steps=steps,
            gradient_clip_val=1.0,
            callbacks=[timer],
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
        trainer.fit(module, DataLoader([batch] * steps, batch_size=None))
    states = {
        name: replace(checkpoint.network(name), state_dict=network.state_dict())
        for name, network in networks.items()
    }
    content = to_official(Checkpoint(checkpoint.path, checkpoint.stage, states))
    weights = {
        ours: {key: value.detach() for key, value in content[theirs].items()}
        for ours, theirs in (("vae", "vae"), ("sit", "model"), ("discriminator", "discriminator"))
    }
    return Trained(timer.seconds, weights)
