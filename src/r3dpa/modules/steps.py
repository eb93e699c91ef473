"""Parts of a training step that all modules share: random draws, frozen passes, AdamW, clipping."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple, cast

import lightning as L
import torch
from torch import Tensor, nn
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from r3dpa import losses
from r3dpa.flow import sample_time
from r3dpa.flow.noise import random_generator
from r3dpa.modules.settings import LossWeights
from r3dpa.nn import VelocityNetwork


class PathDraws(NamedTuple):
    """Random numbers of one training step.

    ``posterior_noise`` and ``noise`` are ``(B, C, h, w)`` standard normal, ``time`` is ``(B,)``,
    and ``uniform`` ``(B,)`` in [0, 1) selects the noise on the latents of a decoder; empty in draws
    for steps without.
    """

    posterior_noise: Tensor
    time: Tensor
    noise: Tensor
    uniform: Tensor = torch.empty(0)


def draw_path(module: Any, num_samples: int, number: int | None = None) -> PathDraws:
    """Posterior noise, times and path noise for this process's part of a global batch.

    They are a function of ``(seed, batch, sample)``, whatever the number of processes.

    Args:
        module: Attached to a trainer, on its device; has ``seed``, ``latent_shape`` ``(C, h, w)``
            and ``time_sampling``.
        num_samples: Samples B of the batch on this process.
        number: Number of the batch since the start of training; None is that of the batch at hand.
    """
    world, rank = module.trainer.world_size, module.trainer.global_rank
    number = batch_number(module) if number is None else number
    drawn = _draw(module, [module.seed, 0, number], num_samples * world)
    return PathDraws(*(values[rank::world] for values in drawn))


def draw_held_out(module: Any, index: Tensor) -> PathDraws:
    """Draws for held-out scans ``(B,)``, a function of ``(seed, index)``."""
    each = [_draw(module, [module.seed, 1, number], 1) for number in index.tolist()]
    return PathDraws(*map(torch.cat, zip(*each, strict=True)))


def _draw(module: Any, key: list[int], total: int) -> PathDraws:
    generator = random_generator(key, module.device, bits=32)
    shape = (total, *module.latent_shape)
    return PathDraws(
        torch.randn(shape, generator=generator, device=module.device),
        sample_time(total, module.time_sampling, generator=generator),
        torch.randn(shape, generator=generator, device=module.device),
        torch.rand(total, generator=generator, device=module.device),
    )


class HeldOutMeans(Metric):
    """Means over held-out scans, each counted once, whatever the batches and processes.

    Loaders of several processes repeat scans to give all of them the same number of batches.
    """

    full_state_update = False
    index: list[Tensor]
    values: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        self.names: tuple[str, ...] = ()
        self.add_state("index", [], dist_reduce_fx="cat")
        self.add_state("values", [], dist_reduce_fx="cat")

    def update(self, index: Tensor, **sums: Tensor | tuple[Tensor, Tensor]) -> None:
        """Adds scans by their index ``(B,)``: a value ``(B,)`` each, or its sum and its weight."""
        pairs = [s if isinstance(s, tuple) else (s, torch.ones_like(s)) for s in sums.values()]
        self.names = tuple(sums)
        self.index.append(index)
        self.values.append(torch.stack([torch.stack(pair, dim=1).float() for pair in pairs], dim=1))

    def compute(self) -> dict[str, float]:
        """Means by name; 0 where all weights are 0."""
        index, order = dim_zero_cat(self.index).cpu().sort(stable=True)
        once = order[index.diff(prepend=index[:1] - 1) != 0]
        total, weight = dim_zero_cat(self.values).cpu()[once].double().sum(dim=0).unbind(dim=1)
        return dict(zip(self.names, (total / weight.clamp(min=1)).tolist(), strict=True))


def log_held_out(module: Any) -> None:
    """Logs the means over the held-out scans as ``val/<name>`` or ``test/<name>``."""
    split = "test" if module.trainer.testing else "val"
    module.log_dict({f"{split}/{name}": mean for name, mean in module.held_out.compute().items()})
    module.held_out.reset()


def each_reconstruction_loss(reconstruction: Tensor, image: Tensor, weights: LossWeights) -> Tensor:
    """Reconstruction loss ``(B,)`` of each image."""
    pairs = zip(reconstruction.split(1), image.split(1), strict=True)
    return torch.stack([losses.reconstruction_loss(*p, weights.reconstruction_norm) for p in pairs])


def batch_number(module: L.LightningModule) -> int:
    """Training batches before this one, over all epochs and resumed runs."""
    return module.trainer.fit_loop.epoch_loop.total_batch_idx


@contextmanager
def networks_as_settings() -> Iterator[None]:
    """For ``save_hyperparameters()``, without Lightning's advice to leave networks out.

    Kept, they are class paths in a checkpoint of the CLI, from which the networks are rebuilt.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Attribute '.*' is an instance of `nn.Module`")
        yield


@contextmanager
def frozen(*networks: nn.Module) -> Iterator[None]:
    """Records the forward pass inside without gradients to the networks' own parameters.

    Gradients still flow through the networks to their inputs.
    """
    parameters = [p for network in networks for p in network.parameters() if p.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)


def zero_loss(network: nn.Module) -> Tensor:
    """A loss of exactly 0 that gives each trained parameter a gradient of 0, at no cost.

    Under DDP each trained network must take part in each step.
    """
    empty = [p.flatten()[:0].sum() for p in network.parameters() if p.requires_grad]
    return torch.stack(empty).sum()


def weigh_and_log(module: Any, parts: Mapping[str, Tensor]) -> Tensor:
    """Sum of weighted losses; logs it as ``train/loss``, and each loss without its weight.

    The logged values are kept in ``module.logged_losses``; losses of weight 0 are not logged.
    """
    total = torch.stack(list(parts.values())).sum()
    factors = {name: getattr(module.weights, name) for name in parts}
    values = {n: value.detach() / factors[n] for n, value in parts.items() if factors[n] != 0}
    values["loss"] = total.detach()
    module.logged_losses = values
    module.log_dict({f"train/{name}": value for name, value in values.items()})
    return total


def uses_fused(module: L.LightningModule) -> bool:
    """Whether one kernel moves all weights.

    In float16 it would also undo the scale of the gradients, after they were clipped.
    """
    supported = module.device.type in ("cpu", "cuda", "mps", "xpu")
    return supported and module.trainer.precision != "16-mixed"


def fit_optimizer(module: L.LightningModule) -> None:
    """Moves the state of a resumed optimiser to its device, in the memory format of the weights.

    A fused optimiser walks through the memory of weights and moments alike, unchecked.
    """
    optimizer = cast(torch.optim.Optimizer, module.optimizers(use_pl_optimizer=False))
    fused = uses_fused(module)
    for group in optimizer.param_groups:
        group["fused"] = fused
    for parameter, state in optimizer.state.items():
        state["step"] = state["step"].to(parameter.device if fused else "cpu")
        for name in ("exp_avg", "exp_avg_sq"):
            if state[name].stride() != parameter.stride():
                state[name] = torch.empty_like(parameter).copy_(state[name])


def set_learning_rate(module: Any, optimizer: torch.optim.Optimizer) -> None:
    """Sets the rate of the coming step, a function of its number alone."""
    config = module.optimizer_config
    rate = config.rate(module.global_step, module.trainer.max_steps)
    own = {"discriminator": config.discriminator_rate, "thin_decoder": config.thin_decoder_rate}
    for group in optimizer.param_groups:
        group["lr"] = own.get(group.get("name", ""), 1.0) * rate


def gradient_norms(
    module: L.LightningModule, optimizer: torch.optim.Optimizer
) -> dict[str, Tensor]:
    """Gradient norm of each parameter group by its name."""
    return {
        group.get("name", str(index)): nn.utils.get_total_norm(
            [p.grad for p in group["params"] if p.grad is not None]
        ).to(module.device)  # without any gradient it is made on the host
        for index, group in enumerate(optimizer.param_groups)
    }


def clip_per_network(
    module: L.LightningModule,
    optimizer: torch.optim.Optimizer,
    gradient_clip_val: int | float | None = None,
    gradient_clip_algorithm: str | None = None,
) -> None:
    """Clips each network's gradient norm by itself and logs it as ``grad_norm/<network>``.

    The norms are those in ``module.grad_norms`` where :class:`r3dpa.callbacks.StepGuard` has
    computed them.
    """
    algorithm = gradient_clip_algorithm
    if algorithm not in (None, "norm"):
        raise ValueError(
            "gradients are clipped by norm per network; leave gradient_clip_algorithm out, got "
            f"{getattr(algorithm, 'value', algorithm)!r}"
        )
    norms = module.__dict__.pop("grad_norms", None) or gradient_norms(module, optimizer)
    module.log_dict({f"grad_norm/{name}": norm for name, norm in norms.items()})
    limit = float(gradient_clip_val or 0)
    limit = limit if limit > 0 else float("inf")  # 0 and below: no clipping, as in Lightning
    for group in optimizer.param_groups:
        nn.utils.clip_grads_with_norm_(group["params"], limit, norms[group["name"]])


def flow_errors(
    module: Any,
    sit: VelocityNetwork,
    latents: Tensor,
    features: Tensor | None,
    draws: PathDraws,
    velocity: bool,
    alignment: bool,
) -> dict[str, Tensor]:
    """L_denoise and L_align, each ``(B,)``, of normalised latents: those requested, by name."""
    noisy, errors = module.interpolant.interpolate(latents, draws.noise, draws.time), {}
    predicted, projected = None, None
    if velocity and alignment:
        predicted, projected = sit(noisy, draws.time)
    elif velocity:
        predicted = sit.velocity(noisy, draws.time)
    elif alignment:
        projected = sit.project_features(noisy, draws.time)
    if predicted is not None:
        target = module.interpolant.target(latents, draws.noise, draws.time)
        errors["denoising"] = losses.flow_matching_loss(predicted, target)
    if projected is not None:
        errors["alignment"] = align(module, projected, features)
    return errors


def flow_losses(
    module: Any, normalised: Tensor, features: Tensor | None, draws: PathDraws
) -> dict[str, Tensor]:
    """L_denoise + lambda2 L_align on normalised latents without gradient."""
    denoising, alignment = module.weights.denoising, module.weights.sit_alignment
    stop = module.weights.alignment_stop
    aligns = alignment != 0 and (stop is None or module.global_step < stop)
    errors = flow_errors(module, module.sit, normalised, features, draws, denoising != 0, aligns)
    if "denoising" in errors:
        parts = {"denoising": denoising * errors["denoising"].mean()}
    else:
        parts = {"denoising": zero_loss(module.sit)}
    if "alignment" in errors:
        parts["sit_alignment"] = alignment * errors["alignment"].mean()
    elif alignment != 0:
        parts["sit_alignment"] = zero_loss(module.sit.projector)
    return parts


def align(module: Any, projected: Tensor, features: Tensor | None) -> Tensor:
    """L_align ``(B,)`` of projected tokens and feature grids, both ``(B, N, D)``."""
    if features is None:
        raise ValueError(
            f"stage {module.stage} aligns with 3D features, but the batch holds no feature_grid"
        )
    if module.weights.centre_features:
        features = losses.centred_features(features)
    skip = module.weights.skip_empty_cells
    return losses.alignment_loss(projected, features, skip_empty_cells=skip)
