"""``r3dpa replay``: a batch that broke a training step, run again under observation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from r3dpa.callbacks.bad_batches import BadBatch
from r3dpa.checkpoints import Checkpoint, read_checkpoint
from r3dpa.checkpoints.networks import format_table
from r3dpa.modules import FlowMatching, GenerativeModule, JointAlignment, VAEAlignment
from r3dpa.modules.steps import PathDraws

_STAGES = {stage.stage: stage for stage in (VAEAlignment, JointAlignment, FlowMatching)}
_AUTOCAST = {"bf16-mixed": torch.bfloat16, "16-mixed": torch.float16}


@dataclass
class _Layers:
    """What the layers of one network did in a step, in the order of the calls."""

    called: set[str] = field(default_factory=set)
    outputs: dict[str, bool] = field(default_factory=dict)  # not finite; were its inputs finite?
    gradients: dict[str, None] = field(default_factory=dict)  # not finite

    def observe(self, name: str, inputs: Any, output: Any) -> None:
        self.called.add(name)
        if not isinstance(output, Tensor):
            return
        if not _finite(output):
            self.outputs.setdefault(name, all(map(_finite, inputs)))
        if output.requires_grad:

            def note(gradient: Tensor) -> None:
                if not _finite(gradient):
                    self.gradients.setdefault(name, None)

            output.register_hook(note)


def replay(file: Path, ckpt: Path, device: str = "cpu") -> str:
    """Repeats the losses of a skipped step and finds where they stop to be finite.

    The step is run as it was, with its own draws, loss weights and precision: on the whole batch,
    where hooks look at what each layer gives and at the gradient of it, and on each scan alone,
    where batch norm and latent statistics are those of this scan. Not repeated are the scaling of
    the loss in float16 and the other processes of a distributed run.

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
    state = {name: value.clone() for name, value in module.state_dict().items()}
    layers = {name: _Layers() for name in ("vae", "sit", "discriminator") if getattr(module, name)}
    hooks = [
        layer.register_forward_hook(
            lambda _, inputs, output, name=name, seen=seen: seen.observe(name, inputs, output)
        )
        for network, seen in layers.items()
        for name, layer in getattr(module, network).named_modules(prefix=network)
        if not list(layer.children())
    ]
    every = slice(None)
    try:
        rows = {"recorded": saved.losses, "all scans": _losses(module, saved, every, backward=True)}
    except RuntimeError as error:  # shapes of the batch against those of the networks
        raise ValueError(f"{file} cannot be run with the networks of {ckpt}: {error}") from error
    for hook in hooks:
        hook.remove()
    for index in range(len(saved.draws.time)):
        module.load_state_dict(state)
        name = saved.names[index] if saved.names else f"scan {index}"
        rows[name] = _losses(module, saved, slice(index, index + 1), backward=False)
    columns = list(dict.fromkeys(name for values in rows.values() for name in values))
    lines = [
        f"{file}: stage {saved.stage}, step {saved.step}, batch {saved.number}, process "
        f"{saved.rank} of {saved.world_size}, {saved.precision}",
        f"weights: {ckpt}, stage {weights.stage}, step {weights.step}",
    ]
    if saved.precision not in (*_AUTOCAST, "32-true"):
        lines.append(f"{saved.precision} is not repeated: run in float32, which may not break")
    tensors = {f"input {name}": value for name, value in saved.tensors.items()}
    tensors |= {f"input {name}": value for name, value in saved.draws._asdict().items()}
    for name, value in (
        tensors | {f"weight {name}": value for name, value in state.items()}
    ).items():
        num_bad = int((~value.isfinite()).sum())
        if num_bad:
            lines.append(f"{name}: {num_bad} of {value.numel()} values are not finite")
    cells = [
        [name, *(f"{values[c]:.4g}" if c in values else "-" for c in columns)]
        for name, values in rows.items()
    ]
    lines.append(format_table(["", *columns], cells))
    head = ["network", "layers", "outputs not finite", "first", "gradients not finite", "first"]
    lines.append(format_table(head, [_row(name, seen) for name, seen in layers.items()]))
    return "\n".join([*lines, _conclusion(layers, saved)])


def _module(saved: BadBatch, weights: Checkpoint) -> GenerativeModule:
    """The stage with the networks of the checkpoint and the settings of the batch."""
    if saved.stage not in _STAGES:
        raise ValueError(f"stage {saved.stage!r} is none of {', '.join(_STAGES)}")
    names = ["vae", "sit", "latent_norm"]
    if saved.stage != FlowMatching.stage:
        names.append("discriminator")
    networks: dict[str, Any] = {name: weights.network(name).build() for name in names}
    started = saved.step >= saved.weights.adversarial_start
    settings = replace(saved.weights, adversarial_start=0) if started else saved.weights
    return _STAGES[saved.stage](**networks, weights=settings, path=saved.path, seed=saved.seed)


def _losses(
    module: GenerativeModule, saved: BadBatch, scans: slice, backward: bool
) -> dict[str, float]:
    """Losses of some scans without weights, and ``loss``, their weighted sum."""
    draws = PathDraws(*(values[scans].to(module.device) for values in saved.draws))
    batch: Any = {name: value[scans].to(module.device) for name, value in saved.tensors.items()}
    # Without a trainer there are no draws of a batch number and nothing to log to.
    module.draw_path = lambda *_: draws  # type: ignore[method-assign]
    module.log_dict = lambda *_: None  # type: ignore[method-assign]
    dtype = _AUTOCAST.get(saved.precision)
    with torch.set_grad_enabled(backward):
        with torch.autocast(module.device.type, dtype or torch.bfloat16, enabled=dtype is not None):
            total = cast(Tensor, module.training_step(batch, 0))
        if backward:
            total.backward()
    return {name: float(value) for name, value in module.logged_losses.items()}


def _finite(value: Any) -> bool:
    return not isinstance(value, Tensor) or bool(value.isfinite().all())


def _row(name: str, seen: _Layers) -> list[str]:
    first = next(iter(seen.outputs), "-")
    if first in seen.outputs:
        first += " (inputs finite)" if seen.outputs[first] else " (inputs not finite)"
    gradient = next(iter(seen.gradients), "-")
    counts = [str(len(part)) for part in (seen.called, seen.outputs, seen.gradients)]
    return [name, counts[0], counts[1], first, counts[2], gradient]


def _conclusion(layers: Mapping[str, _Layers], saved: BadBatch) -> str:
    starts = [n for network in layers.values() for n, sound in network.outputs.items() if sound]
    if starts:
        return f"layers that turned finite inputs into others: {', '.join(starts)}"
    if any(network.outputs for network in layers.values()):
        return "no layer turned finite inputs into others: it came with inputs or latents"
    if any(network.gradients for network in layers.values()):
        return "all outputs are finite: it starts in a loss or in a gradient"
    others = " It may lie in the batch of another process." if saved.world_size > 1 else ""
    return (
        "everything is finite with these weights: give the checkpoint of an earlier or later step, "
        f"or the device of the run.{others}"
    )
