"""The stages with tiny networks, trained in this process on a few random batches."""

from __future__ import annotations

import tempfile

import lightning as L
import pytest
import torch
from tiny_networks import SIT_ARGS, VAE_ARGS
from torch import nn
from torch.utils.data import DataLoader

from r3dpa.callbacks import StepGuard
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.modules import FewStep, FlowMatching, JointAlignment, VAEAlignment
from r3dpa.nn import VAE, AverageVelocitySiT, PatchDiscriminator, SiT, ThinDecoder

# Only `r3dpa fit` saves plain arguments in place of networks; nothing is saved here.
QUIET = [
    pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`"),
    pytest.mark.filterwarnings("ignore:Found .* module.* in eval mode"),
    pytest.mark.filterwarnings("ignore:.*LeafSpec.*is deprecated"),
    pytest.mark.filterwarnings("ignore:step .* was skipped"),
]
SILENT = {f"enable_{part}": False for part in ("checkpointing", "progress_bar", "model_summary")}
SILENT |= {"accelerator": "cpu", "logger": False}
SENSOR = LidarSensor(beams=8, columns=16)
FEATURE_DIM = 6


class TinyData(L.LightningDataModule):
    """One random batch per step; where ``bad`` says so with a NaN in its features."""

    geometry = ScanGeometry(SphericalProjection(SENSOR), RangeCodec(), (2, 4))

    def __init__(self, bad=(False,)):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.batches = [
            {
                "range_image": 2 * torch.rand(2, 1, 8, 16, generator=generator) - 1,
                "feature_grid": torch.randn(2, 8, FEATURE_DIM, generator=generator),
            }
            for _ in bad
        ]
        for batch, is_bad in zip(self.batches, bad, strict=True):
            if is_bad:
                batch["feature_grid"][0, 0, 0] = torch.nan

    def train_dataloader(self):
        return DataLoader(self.batches, batch_size=None)


class Observed:
    """Keeps the losses of each step, the gradients around clipping, and the state after it.

    With ``separates_losses`` also the gradient of every single loss, in ``reached``.
    """

    separates_losses = False

    def on_fit_start(self):
        self.parts, self.reached, self.grads, self.clipped, self.states = [], [], [], [], []

    def load_previous_stage(self):
        """Keeps the weights made here."""

    def weigh_and_log(self, parts):
        self.parts.append({name: part.detach() for name, part in parts.items()})
        if self.separates_losses:
            named = [(name, p) for name, p in self.named_parameters() if p.requires_grad]
            self.reached.append({name: gradients(part, named) for name, part in parts.items()})
        return super().weigh_and_log(parts)

    def on_after_backward(self):
        self.last = self.present_gradients()  # the guard drops those of a bad step

    def configure_gradient_clipping(self, optimizer, **kwargs):
        self.grads.append(self.last)
        super().configure_gradient_clipping(optimizer, **kwargs)
        self.clipped.append(self.present_gradients())

    def present_gradients(self):
        return {n: p.grad.clone() for n, p in self.named_parameters() if p.grad is not None}

    def on_train_batch_end(self, outputs, batch, batch_idx):
        weights = {k: v.clone() for k, v in self.state_dict().items()}
        moments = [
            {k: torch.as_tensor(v).clone() for k, v in state.items()}
            for state in self.optimizers().state.values()
        ]
        self.states.append((weights, moments))


def gradients(loss, named):
    """Gradient of a loss by parameter name, where it is not zero."""
    parameters = [parameter for _, parameter in named]
    found = torch.autograd.grad(loss, parameters, allow_unused=True, retain_graph=True)
    return {
        name: gradient
        for (name, _), gradient in zip(named, found, strict=True)
        if gradient is not None and gradient.count_nonzero()
    }


STAGES = {
    "vae_alignment": type("ObservedVAEAlignment", (Observed, VAEAlignment), {}),
    "joint": type("ObservedJoint", (Observed, JointAlignment), {}),
    "flow_matching": type("ObservedFlowMatching", (Observed, FlowMatching), {}),
    "few_step": type("ObservedFewStep", (Observed, FewStep), {}),
}
ARGUMENTS = {
    "vae": VAE_ARGS | {"channel_multipliers": [1, 1], "strides": [[2, 2]]},
    "sit": SIT_ARGS | {"input_size": [4, 8], "hidden_size": 8, "feature_dim": FEATURE_DIM},
    "thin_decoder": {
        "latent_channels": 4,
        "channels": 32,
        "channel_multipliers": [1, 1],
        "strides": [[2, 2]],
        "num_res_blocks": 0,
    },
    "discriminator": {"channels": 4, "num_layers": 1},
    "latent_norm": {"channels": 4},
}


def tiny_sit(**more):
    kind = AverageVelocitySiT if "average_blocks" in more else SiT
    return kind(**ARGUMENTS["sit"] | more)


def stage_module(stage, sit=tiny_sit, **kwargs):
    """A stage with networks for :class:`TinyData`: latents of 4 x 8, grids of 2 x 4."""
    torch.manual_seed(0)
    few = {"average_blocks": 1} if stage == "few_step" else {}
    networks = {"vae": VAE(**ARGUMENTS["vae"]), "sit": sit(**few)}
    if stage == "few_step":
        networks["thin_decoder"] = ThinDecoder(**ARGUMENTS["thin_decoder"])
    elif stage != "flow_matching":
        networks["discriminator"] = PatchDiscriminator(**ARGUMENTS["discriminator"])
    # A fresh SiT has zero gates and output: no gradient would get past them.
    for parameter in networks["sit"].parameters():
        nn.init.normal_(parameter, std=0.3)
    return STAGES[stage](**networks, **kwargs)


def train(module, data=None, guard=True, callbacks=(), ckpt_path=None, **kwargs):
    """Trains with a step guard, kept as ``module.guard``; None trains without."""
    data = data or TinyData()
    module.guard = StepGuard() if guard is True else guard
    callbacks = [*callbacks, *([module.guard] if module.guard else [])]
    with tempfile.TemporaryDirectory() as folder:
        settings = SILENT | {"devices": 1, "default_root_dir": folder, "limit_val_batches": 0}
        settings |= {"max_steps": len(data.batches), "callbacks": callbacks}
        trainer = L.Trainer(**settings | kwargs)
        trainer.fit(module, datamodule=data, ckpt_path=ckpt_path, weights_only=False)
    return module


def group_of(name):
    return ".".join(name.split(".")[: 3 if name.startswith("sit.blocks") else 2])


class NamedData(TinyData):
    """Batches whose scans have names; ``left_out`` are not handed out, the others keep theirs."""

    def __init__(self, num, left_out=()):
        super().__init__([False] * num)
        for number, batch in enumerate(self.batches):
            batch["name"] = [f"drive/{number}a", f"drive/{number}b"]
        self.numbers = [number for number in range(num) if number not in left_out]
        self.batches = [self.batches[number] for number in self.numbers]


def infinite_image(module, batch):
    batch["range_image"][0, 0, 0, 0] = torch.inf


def huge_latents(module, batch):
    """Finite, as are the batch statistics: only what is computed from them overflows."""
    hook = module.vae.quant_conv.register_forward_hook(
        lambda *_: (hook.remove(), torch.full((2, 8, 4, 8), 1e38))[1]
    )


def constant_loss(module, batch):
    """A loss without a finite value, but with gradients that are."""
    module.added = torch.inf


def guarded(stage, bad=(), fault=infinite_image, numbers=None, **kwargs):
    """A stage whose batches of these numbers are broken before the step sees them."""

    class Module(STAGES[stage]):
        added = 0.0

        def own_number(self):
            return (numbers or range(99))[self.batch_number]

        def draw_path(self, num_scans, number=None):
            number = self.own_number() if number is None else number
            return super().draw_path(num_scans, number)

        def training_step(self, batch, batch_idx):
            if self.own_number() in bad:
                fault(self, batch)
            return super().training_step(batch, batch_idx)

        def weigh_and_log(self, parts):
            added, self.added = self.added, 0.0
            return super().weigh_and_log({name: part + added for name, part in parts.items()})

    module = stage_module(stage, **kwargs)
    module.__class__ = Module
    return module


# Which loss reaches which parts of the networks.
ENCODER, DECODER = {"vae.encoder", "vae.quant_conv"}, {"vae.decoder", "vae.post_quant_conv"}
DISCRIMINATOR = {"discriminator.main"}
ALIGNED = {"sit.x_embedder", "sit.t_embedder", "sit.y_embedder", "sit.blocks.0"}
REST = {"sit.blocks.1", "sit.final_layer"}
PROJECTOR = {"sit.projector"}
VAE_LOSSES = {"reconstruction": ENCODER | DECODER, "kl": ENCODER}
VAE_LOSSES |= {"adversarial": ENCODER | DECODER, "discriminator": DISCRIMINATOR}
SIT_LOSSES = {"denoising": ALIGNED | REST, "sit_alignment": ALIGNED | PROJECTOR}
REACH = {
    "vae_alignment": VAE_LOSSES | {"vae_alignment": ENCODER | PROJECTOR | {"sit.x_embedder"}},
    "joint": VAE_LOSSES | SIT_LOSSES | {"vae_alignment": ENCODER},
    "flow_matching": SIT_LOSSES,
    "few_step": {
        "denoising": {"sit.average"},
        "reconstruction": {"thin_decoder.decoder", "thin_decoder.post_quant_conv"},
    },
}
