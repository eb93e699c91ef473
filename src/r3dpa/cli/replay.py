"""``r3dpa replay``: a batch that broke a training step, run again under observation."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

MYPY = False  # true for mypy; jsonargparse would run a TYPE_CHECKING block, and import torch
if MYPY:
    from torch import nn

    from r3dpa.callbacks.bad_batches import BadBatch
    from r3dpa.checkpoints import Checkpoint
    from r3dpa.modules import GenerativeModule

__all__ = ["replay"]

_AUTOCAST = {"bf16-mixed": "bfloat16", "16-mixed": "float16"}


class _Observer:
    """Layers of a network that were called, and those whose output or gradient is not finite."""

    def __init__(self) -> None:
        self.called: set[str] = set()
        self.outputs: dict[str, bool] = {}  # and whether the inputs were finite
        self.gradients: dict[str, None] = {}

    def __call__(self, name: str, layer: nn.Module, inputs: Any, output: Any) -> None:
        self.called.add(name)
        if not _finite(output):
            self.outputs.setdefault(name, all(map(_finite, inputs)))
        if getattr(output, "requires_grad", False):
            note = self.gradients.setdefault
            output.register_hook(lambda grad: None if _finite(grad) else note(name, None))

    def row(self, network: str) -> list[str]:
        first = next(iter(self.outputs), "-")
        if first in self.outputs:
            first += " (inputs finite)" if self.outputs[first] else " (inputs not finite)"
        called, outputs, gradients = map(len, (self.called, self.outputs, self.gradients))
        return [network, f"{called}", f"{outputs}", first, f"{gradients}", *self.gradients, "-"][:6]


def replay(file: Path, ckpt: Path, device: str = "cpu") -> str:
    """Repeat a skipped step to find the layer that failed.

    The losses are computed as in training, with the draws, loss weights and precision of the step:
    of the whole batch, where hooks look at the output of each layer and at its gradient, and of
    each scan alone. The loss scale of float16 and the other processes of a distributed run are not
    repeated.

    Args:
        file: Of ``<run_dir>/bad_batches``.
        ckpt: Weights, best those of the last step before it.
        device: ``cpu``, ``cuda`` or ``cuda:1``.
    """
    from r3dpa.callbacks.bad_batches import BadBatch
    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.io import text_table

    saved, weights = BadBatch.read(file), read_checkpoint(ckpt)
    about, module = saved.about, _module(saved, weights).to(device)
    state = {name: value.clone() for name, value in module.state_dict().items()}
    seen = {name: _Observer() for name in ("vae", "sit", "discriminator") if getattr(module, name)}
    hooks = [
        layer.register_forward_hook(partial(seen[name.split(".")[0]], name))
        for name, layer in module.named_modules()
        if name.split(".")[0] in seen and not list(layer.children())
    ]
    try:
        rows = {"recorded": about["losses"], "all scans": _losses(module, saved, slice(None), True)}
    except RuntimeError as error:  # shapes of the batch against those of the networks
        raise ValueError(f"{file} cannot be run with the networks of {ckpt}: {error}") from error
    for hook in hooks:
        hook.remove()
    for index in range(len(saved.draws.time)):
        module.load_state_dict(state)
        name = about["names"][index] if about["names"] else f"scan {index}"
        rows[name] = _losses(module, saved, slice(index, index + 1), False)
    lines = [
        "{0}: stage {stage}, step {step}, batch {number}, process {rank} of {world_size}, "
        "{precision}".format(file, **about),
        f"weights: {ckpt}, stage {weights.stage}, step {weights.step}",
    ]
    if about["precision"] not in (*_AUTOCAST, "32-true"):
        lines.append(f"{about['precision']} is not repeated: run in float32, which may not break")
    inputs = saved.tensors | saved.draws._asdict()
    for kind, tensors in (("input", inputs), ("weight", state)):
        for name, value in tensors.items():
            if num_bad := int((~value.isfinite()).sum()):
                lines.append(f"{kind} {name}: {num_bad} of {value.numel()} values are not finite")
    columns = list(dict.fromkeys(name for values in rows.values() for name in values))
    cells = [
        [name, *(f"{found[c]:.4g}" if c in found else "-" for c in columns)]
        for name, found in rows.items()
    ]
    layers = [observer.row(name) for name, observer in seen.items()]
    head = ["network", "layers", "outputs not finite", "first", "gradients not finite", "first"]
    tables = (
        text_table(cells, ["", *columns], "l" + "r" * len(columns)),
        text_table(layers, head, "llllll"),
    )
    conclusion = _conclusion(list(seen.values()), about["world_size"])
    return "\n".join([*lines, *tables, conclusion])


def _module(saved: BadBatch, weights: Checkpoint) -> GenerativeModule:
    """The stage with the networks of the checkpoint and the settings of the batch."""
    from r3dpa.modules import FlowMatching, JointAlignment, VAEAlignment

    stages = {stage.stage: stage for stage in (VAEAlignment, JointAlignment, FlowMatching)}
    stage = stages[saved.about["stage"]]
    names = ["vae", "sit", "latent_norm", *(["discriminator"] if stage is not FlowMatching else [])]
    networks: dict[str, Any] = {name: weights.network(name).build() for name in names}
    settings = saved.weights
    if saved.about["step"] >= settings.adversarial_start:
        settings = replace(settings, adversarial_start=0)
    return stage(**networks, weights=settings, path=saved.about["path"])


def _losses(
    module: GenerativeModule, saved: BadBatch, scans: slice, grad: bool
) -> dict[str, float]:
    """Losses of some scans without weights, and ``loss``, their weighted sum."""
    import torch

    from r3dpa.modules.steps import PathDraws

    draws = PathDraws(*(values[scans].to(module.device) for values in saved.draws))
    batch: Any = {name: value[scans].to(module.device) for name, value in saved.tensors.items()}
    # There is no trainer: no number of the batch, and nothing to log to.
    module.draw_path = lambda *_: draws  # type: ignore[method-assign]
    module.log_dict = lambda *_: None  # type: ignore[method-assign]
    name = _AUTOCAST.get(saved.about["precision"])
    dtype = getattr(torch, name or "bfloat16")
    with torch.set_grad_enabled(grad):
        with torch.autocast(module.device.type, dtype, enabled=name is not None):
            total = cast(torch.Tensor, module.training_step(batch, 0))
        if grad:
            total.backward()
    return {name: float(value) for name, value in module.logged_losses.items()}


def _finite(value: Any) -> bool:
    return not hasattr(value, "isfinite") or bool(value.isfinite().all())


def _conclusion(seen: list[_Observer], world_size: int) -> str:
    outputs = [item for observer in seen for item in observer.outputs.items()]
    if starts := [name for name, inputs_finite in outputs if inputs_finite]:
        return f"layers that turned finite inputs into others: {', '.join(starts)}"
    if outputs:
        return "no layer turned finite inputs into others: it came with inputs or latents"
    if any(observer.gradients for observer in seen):
        return "all outputs are finite: it starts in a loss or in a gradient"
    others = "; it may lie in the batch of another process" if world_size > 1 else ""
    return f"everything is finite with these weights: give an earlier or later checkpoint{others}"
