"""Two official REPA-E steps, run here by a real Trainer with one optimiser and one backward."""

from __future__ import annotations

import math

import lightning as L
import pytest
import torch
from recorded_networks import our_name, sit_of, vae_of
from tiny_stages import SILENT
from torch.utils.data import DataLoader

from r3dpa import losses
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.modules import JointAlignment, LossWeights, OptimizerConfig
from r3dpa.modules.stage import PathDraws
from r3dpa.nn import LatentNorm, PatchDiscriminator

LOSSES = ("alignment_loss", "flow_matching_loss", "generator_loss", "discriminator_loss")


class RecordedData(L.LightningDataModule):
    """The recorded images and features in place of scans."""

    feature_source = "recorded"

    def __init__(self, case):
        super().__init__()
        names = {"range_image": "image", "feature_grid": "features"}
        self.batches = [
            {ours: case[f"in/step{step}/{theirs}"] for ours, theirs in names.items()}
            for step in range(case.config["steps"])
        ]
        sensor = LidarSensor(*self.batches[0]["range_image"].shape[2:])
        sit = case.config["sit"]
        grid_size = tuple(size // sit["patch_size"] for size in sit["input_size"])
        self.geometry = ScanGeometry(SphericalProjection(sensor), RangeCodec(), grid_size)

    def train_dataloader(self):
        return DataLoader(self.batches, batch_size=None)


class Recording(JointAlignment):
    """Takes the recorded draws and keeps what the official loop logged."""

    def use(self, case):
        self.case, self.steps = case, []

    def load_previous_stage(self):
        """Keeps the recorded average, which differs from the weights."""

    def draw_path(self, num_scans, number=None):
        self.steps.append({})
        values = f"in/step{self.batch_number}"
        return PathDraws(
            self.case[f"{values}/posterior_noise"],
            self.case[f"{values}/time_input"].flatten(),
            self.case[f"{values}/noises"],
        )

    def weigh_and_log(self, parts):
        self.steps[-1]["parts"] = {name: value.detach().clone() for name, value in parts.items()}
        return super().weigh_and_log(parts)

    def configure_gradient_clipping(self, *args, **kwargs):
        super().configure_gradient_clipping(*args, **kwargs)
        self.steps[-1]["norms"] = dict(self.trainer.callback_metrics)
        self.steps[-1]["gradients"] = {
            name: p.grad.clone() for name, p in self.named_parameters() if p.grad is not None
        }

    def optimizer_step(self, *args, **kwargs):
        super().optimizer_step(*args, **kwargs)
        self.steps[-1]["weights"] = {k: v.clone() for k, v in self.state_dict().items()}


def ours(official: str) -> str:
    """Our name of an official weight such as ``sit.bn.running_mean``."""
    network, _, key = official.partition(".")
    prefix = "ema." if network == "ema" else ""
    if network in ("sit", "ema"):
        key = our_name(key)
        if key.startswith("bn."):
            return f"{prefix}latent_norm.{key.removeprefix('bn.')}"
        return f"{prefix}sit.{key}"
    return official


def recorder(module, name, loss):
    """The loss as it is, which also keeps its results and the means of its arguments."""

    def recording(*args, **kwargs):
        result = loss(*args, **kwargs)
        step = module.steps[-1]
        step.setdefault(name, []).append(result.detach().clone())
        step[f"{name}_means"] = [value.detach().mean() for value in args]
        return result

    return recording


@pytest.fixture(scope="module")
def recorded(load_case):
    return load_case("joint_step")


@pytest.fixture(scope="module")
def run(recorded):
    config = recorded.config
    vae_loss = config["loss_config"]["losses"]
    sit, disc = config["sit"], config["discriminator"]
    module = Recording(
        vae=vae_of(config["vae"]),
        sit=sit_of(sit, learn_pos_embed=True),
        discriminator=PatchDiscriminator(disc["input_nc"], disc["ndf"], disc["n_layers"]),
        weights=LossWeights(
            reconstruction=vae_loss["reconstruction_weight"] / math.exp(vae_loss["logvar_init"]),
            reconstruction_norm=vae_loss["reconstruction_loss"],
            kl=float(vae_loss["kl_weight"]),
            adversarial=vae_loss["discriminator_weight"] * vae_loss["discriminator_factor"],
            discriminator=vae_loss["discriminator_factor"],
            adversarial_start=vae_loss["discriminator_start"],
            vae_alignment=config["vae_align_proj_coeff"],
            sit_alignment=config["proj_coeff"],
        ),
        optimizer=OptimizerConfig(
            config["lr"], tuple(config["betas"]), config["weight_decay"], config["eps"]
        ),
        latent_norm=LatentNorm(sit["in_channels"], momentum=sit["bn_momentum"]),
        ema_decay=config["ema_decay"],
        ema_buffers="decay",
    )
    module.load_state_dict({ours(key): value for key, value in recorded.weights().items()})
    module.use(recorded)
    trainer = L.Trainer(
        **SILENT,
        max_steps=config["steps"],
        gradient_clip_val=config["max_grad_norm"],
        limit_val_batches=0,
    )
    with pytest.MonkeyPatch.context() as patch:
        for name in LOSSES:
            patch.setattr(losses, name, recorder(module, name, getattr(losses, name)))
        trainer.fit(module, datamodule=RecordedData(recorded))
    assert len(module.steps) == config["steps"]
    return module.steps


@pytest.fixture(scope="module")
def values(recorded, run):
    """What we computed, under the name of the recorded array."""
    found = {}
    for step, ours_ in enumerate(run):
        parts, out = ours_["parts"], f"out/step{step}"
        adversarial = parts.get("adversarial", torch.zeros(()))
        vae = parts["reconstruction"] + parts["kl"] + adversarial
        found |= {
            f"{out}/vae/generator_total": vae,
            f"{out}/vae/total": vae + parts["vae_alignment"],
            f"{out}/vae/reconstruction_loss": parts["reconstruction"],
            f"{out}/vae/kl_loss": parts["kl"],
            f"{out}/vae/weighted_gan_loss": adversarial,
            f"{out}/vae/gan_loss": ours_["generator_loss"][0],
            f"{out}/vae/align_proj_loss": ours_["alignment_loss"][0],
            f"{out}/disc/loss": parts["discriminator"],
            f"{out}/disc/logits_real": ours_["discriminator_loss_means"][0],
            f"{out}/disc/logits_fake": ours_["discriminator_loss_means"][1],
            f"{out}/sit/denoising_loss": ours_["flow_matching_loss"][0],
            f"{out}/sit/proj_loss": ours_["alignment_loss"][1],
            f"{out}/sit/total": parts["denoising"] + parts["sit_alignment"],
        }
        for official, network in {"vae": "vae", "disc": "discriminator", "sit": "sit"}.items():
            found[f"{out}/{official}/grad_norm"] = ours_["norms"][f"grad_norm/{network}"]
            for key in recorded.keys(prefix := f"{out}/{official}/grad_clipped/"):
                name = ours(f"{network}.{key.removeprefix(prefix)}")
                found[key] = ours_["gradients"][name]
        for key in recorded.keys(prefix := f"{out}/weights/"):
            weights = run[steps_seen(recorded, step) - 1]["weights"]
            found[key] = weights[ours(key.removeprefix(prefix))]
    return found


def steps_seen(recorded, step):
    """Steps after which the weights of a step were stored.

    The recorder of the shared file kept references instead of copies: the arrays it calls step 0
    equal those of step 1 bit for bit. The batch-norm counter inside tells how old they are; the
    true weights after step 0 show in the losses and gradients of step 1.
    """
    counter = "sit.bn.num_batches_tracked"
    seen = recorded[f"out/step{step}/weights/{counter}"] - recorded[f"w/{counter}"]
    assert step + 1 <= seen <= recorded.config["steps"]
    return int(seen)


def test_joint_step_losses_and_gradients(recorded, values, close):
    assert set(values) == set(recorded.keys("out/"))
    for key, value in values.items():
        if "/weights/" not in key:
            close(value, recorded[key])


def has_reliable_step(run, name, steps):
    """Where AdamW's step of a weight is decided by its gradient and not by the rounding of it.

    AdamW divides by the size of the gradient. Sums of float32 terms are off by about 1e-6 of the
    largest gradient of the tensor; a hundred times that fixes the step to one percent of it.
    """
    reliable = True
    for step in run[:steps]:
        gradient = step["gradients"][name].abs()
        reliable = reliable & (gradient > 1e-4 * gradient.max())
    return reliable


def test_reliable_steps_leave_out_gradients_of_the_size_of_their_rounding():
    run = [{"gradients": {"w": torch.tensor([1.0, -2e-4, 5e-5])}}]
    run += [{"gradients": {"w": torch.tensor([-1.0, 5e-5, 1.0])}}]
    assert has_reliable_step(run, "w", 1).tolist() == [True, True, False]
    assert has_reliable_step(run, "w", 2).tolist() == [True, False, False]


def test_joint_step_weights_statistics_and_ema(recorded, run, values, close):
    """Weights in units of the learning rate, where the gradient exceeds its rounding error."""
    start, learning_rate = recorded.weights(), recorded.config["lr"]
    moved = dict.fromkeys(("vae", "sit", "ema", "discriminator"), 0.0)
    num_weights = num_compared = 0
    for key, value in values.items():
        _, separator, official = key.partition("/weights/")
        if separator:
            # Of float32 weights and averages of size 1 two roundings are 2.4e-7.
            statistic = ".bn." in official or "running_" in official
            tolerance = {"atol": 5e-6, "rtol": 1e-5} if statistic else {"atol": 0.0, "rtol": 3e-7}
            tolerance["atol"] = max(tolerance["atol"], 0.01 * learning_rate)
            name, expected = ours(official).removeprefix("ema."), recorded[key]
            network = official.partition(".")[0]
            if name in run[0]["gradients"]:
                reliable = has_reliable_step(run, name, len(run))
                num_weights += reliable.numel()
                num_compared += int(reliable.sum())
                close(value, expected, atol=2 * len(run) * learning_rate, rtol=3e-7)
                value, expected = value[reliable], expected[reliable]
            close(value, expected, **tolerance)
            change = (recorded[key].double() - start[official].double()).abs().max().item()
            moved[network] = max(moved[network], change)
    assert num_compared > 0.95 * num_weights
    assert all(change > 1e-3 * learning_rate for change in moved.values())
