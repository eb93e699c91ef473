"""``r3dpa replay``: a batch that broke a training step, run again under observation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from r3dpa.checkpoints import Checkpoint, read_checkpoint
from r3dpa.checkpoints.networks import format_table
from r3dpa.modules import FlowMatching, GenerativeModule, JointAlignment, VAEAlignment
from r3dpa.modules.bad_batches import BadBatch
from r3dpa.modules.step_losses import PathDraws

__all__ = ["replay"]

_STAGES: dict[str, type[GenerativeModule]] = {
    stage.stage: stage for stage in (VAEAlignment, JointAlignment, FlowMatching)
}
_AUTOCAST = {"bf16-mixed": torch.bfloat16, "16-mixed": torch.float16}
_REPEATED = (*_AUTOCAST, "32-true")


@dataclass
class _Layers:
    """What the layers of one network did in one step, in the order of the calls."""

    called: set[str] = field(default_factory=set)
    outputs: dict[str, bool] = field(default_factory=dict)  # not finite; were its inputs finite?
    gradients: dict[str, None] = field(default_factory=dict)  # not finite


def replay(file: Path, ckpt: Path, device: str = "cpu") -> str:
    """Repeats the losses of a skipped step and finds where they stop to be finite.

    The step is run as it was, with its own draws, loss weights and precision: on the whole batch,
    where hooks look at what each layer gives and at the gradient of it, and on each scan alone,
    where batch norm and latent statistics are those of this scan. Not repeated are the scaling of
    the loss in float16, weights of less than 32 bits and the other processes of a distributed run.

    Args:
        file: File of ``<run_dir>/bad_batches``.
        ckpt: Weights, best those of the last step before: they are not kept with the batch.
        device: ``cpu``, ``cuda`` or ``cuda:1``; the kernels of a GPU may round otherwise.

    Returns:
        What was run, a table of the losses, one of the networks, and a conclusion.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file is not what it should be, or the networks are of other sizes.
    """
    saved, weights = BadBatch.read(file), read_checkpoint(ckpt)
    module = _module(saved, weights).to(device)
    batch = {name: value.to(device) for name, value in saved.tensors.items()}
    draws = PathDraws(*(values.to(device) for values in saved.draws))
    state = {name: value.clone() for name, value in module.state_dict().items()}

    layers, hooks = _watch(module)
    try:
        together = _losses(module, saved, batch, draws, backward=True)
    except RuntimeError as error:  # shapes of the batch against those of the networks
        raise ValueError(f"{file} cannot be run with the networks of {ckpt}: {error}") from error
    for hook in hooks:
        hook.remove()
    rows = {"recorded": saved.losses, "all scans": together}
    num_scans = len(draws.time)
    names = saved.names or [f"scan {index}" for index in range(num_scans)]
    for index in range(num_scans):
        module.load_state_dict(state)
        one = slice(index, index + 1)
        rows[names[index]] = _losses(
            module,
            saved,
            {name: value[one] for name, value in batch.items()},
            PathDraws(*(values[one] for values in draws)),
            backward=False,
        )
    columns = list(dict.fromkeys(name for values in rows.values() for name in values))
    lines = [
        f"{file}: stage {saved.stage}, step {saved.step}, batch {saved.number}, process "
        f"{saved.rank} of {saved.world_size}, {saved.precision}",
        f"weights: {ckpt}, stage {weights.stage}, step {weights.step}",
        *(
            []
            if saved.precision in _REPEATED
            else [f"{saved.precision} is not repeated: run in float32, which may not break"]
        ),
        *_broken("input", {**saved.tensors, **saved.draws._asdict()}),
        *_broken("weight", state),
        format_table(
            ["", *columns],
            [
                [name, *(f"{values[c]:.4g}" if c in values else "-" for c in columns)]
                for name, values in rows.items()
            ],
        ),
        format_table(
            ["network", "layers", "outputs not finite", "first", "gradients not finite", "first"],
            [_network_row(name, network) for name, network in layers.items()],
        ),
        _conclusion(layers, saved),
    ]
    return "\n".join(lines)


def _module(saved: BadBatch, weights: Checkpoint) -> GenerativeModule:
    """The stage with the networks of the checkpoint and the settings of the batch."""
    if saved.stage not in _STAGES:
        raise ValueError(f"stage {saved.stage!r} is none of {', '.join(_STAGES)}")
    names = ["vae", "sit", "latent_norm"]
    if saved.stage != FlowMatching.stage:
        names.append("discriminator")
    networks = {name: cast(Any, weights.network(name).build()) for name in names}
    started = saved.step >= saved.weights.adversarial_start
    settings = replace(saved.weights, adversarial_start=0) if started else saved.weights
    return _STAGES[saved.stage](
        **networks, weights=settings, path=saved.path, seed=saved.seed, guards=None
    )


def _losses(
    module: GenerativeModule,
    saved: BadBatch,
    batch: Mapping[str, Tensor],
    draws: PathDraws,
    backward: bool,
) -> dict[str, float]:
    """Losses without weights, and ``loss``, their weighted sum."""
    with torch.set_grad_enabled(backward):
        with _autocast(saved.precision, draws.time.device):
            parts = module.step_losses(batch, draws)
            total = torch.stack(list(parts.values())).sum()
        if backward:
            total.backward()
    found = {**module.unweighted(parts), "loss": total.detach()}
    return {name: float(value) for name, value in found.items()}


def _autocast(precision: str, device: torch.device) -> AbstractContextManager[Any]:
    dtype = _AUTOCAST.get(precision)
    return torch.autocast(device.type, dtype or torch.bfloat16, enabled=dtype is not None)


def _watch(module: GenerativeModule) -> tuple[dict[str, _Layers], list[RemovableHandle]]:
    """By network, what the next pass will fill; and the hooks that do."""
    found: dict[str, _Layers] = {}
    hooks = []
    for network in ("vae", "sit", "discriminator"):
        root = getattr(module, network)
        if root is not None:
            found[network] = _Layers()
            for name, layer in root.named_modules(prefix=network):
                if not list(layer.children()):
                    hooks.append(layer.register_forward_hook(_observer(name, found[network])))
    return found, hooks


def _observer(name: str, found: _Layers) -> Any:
    def observe(layer: nn.Module, inputs: Any, output: Any) -> None:
        found.called.add(name)
        if not isinstance(output, Tensor):
            return
        if not _finite([output]):
            found.outputs.setdefault(name, _finite(inputs))
        if output.requires_grad:
            output.register_hook(
                lambda gradient: (
                    None if _finite([gradient]) else found.gradients.setdefault(name, None)
                )
            )

    return observe


def _finite(values: Iterable[Any]) -> bool:
    return all(bool(v.isfinite().all()) for v in values if isinstance(v, Tensor))


def _broken(kind: str, tensors: Mapping[str, Tensor]) -> list[str]:
    lines = []
    for name, value in tensors.items():
        num_bad = int((~value.isfinite()).sum())
        if num_bad:
            lines.append(f"{kind} {name}: {num_bad} of {value.numel()} values are not finite")
    return lines


def _network_row(name: str, network: _Layers) -> list[str]:
    first = next(iter(network.outputs), "-")
    if first in network.outputs:
        first += " (inputs finite)" if network.outputs[first] else " (inputs not finite)"
    return [
        name,
        str(len(network.called)),
        str(len(network.outputs)),
        first,
        str(len(network.gradients)),
        next(iter(network.gradients), "-"),
    ]


def _conclusion(seen: Mapping[str, _Layers], saved: BadBatch) -> str:
    starts = [name for network in seen.values() for name, sound in network.outputs.items() if sound]
    if starts:
        return f"layers that turned finite inputs into others: {', '.join(starts)}"
    if any(network.outputs for network in seen.values()):
        return "no layer turned finite inputs into others: it came with inputs or latents"
    if any(network.gradients for network in seen.values()):
        return "all outputs are finite: it starts in a loss or in a gradient"
    others = " It may lie in the batch of another process." if saved.world_size > 1 else ""
    return (
        "everything is finite with these weights: give the checkpoint of an earlier or later step, "
        f"or the device of the run.{others}"
    )
