"""``r3dpa convert``, ``report`` and ``replay``: checkpoints, losses and bad batches of a run."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

MYPY = False  # true for mypy; jsonargparse would run a TYPE_CHECKING block, and import torch
if MYPY:
    from torch import nn

    from r3dpa.callbacks.bad_batches import BadBatch
    from r3dpa.checkpoints import Checkpoint
    from r3dpa.modules import GenerativeModule

_AUTOCAST = {"bf16-mixed": "bfloat16", "16-mixed": "float16"}


def convert(
    source: Path,
    out: Path,
    *,
    to: Literal["r3dpa", "official"] = "r3dpa",
    overwrite: bool = False,
    sit_args: dict[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
    networks: list[str] | None = None,
    half: bool = False,
) -> str:
    """Convert official checkpoints into ours, or ours into official ones.

    Args:
        source: Official ``.pt``, Lightning ``.ckpt`` or exported ``.safetensors``.
        out: File to write, ``.safetensors`` for ours and ``.pt`` for the official layout.
        to: Layout of the result.
        overwrite: Replace ``out`` if it exists.
        sit_args: Official files only: SiT arguments that the file lacks, such as
            ``{alignment_depth: 4}``.
        encoding: Official files only: range encoding, if the file lacks it.
        networks: Write these alone; sampling needs ``vae ema ema_latent_norm``.
        half: Write weights in float16, half as large.
    """
    from r3dpa.checkpoints import convert as convert_checkpoint

    return convert_checkpoint(
        source,
        out,
        to=to,
        overwrite=overwrite,
        sit_args=sit_args,
        encoding=encoding,
        networks=networks,
        half=half,
    )


def report(run: Path) -> str:
    """Draw the loss curves of a run and list where each loss started and ended.

    The table has the mean of the first and of the last tenth of the values of a quantity, and their
    difference.

    Args:
        run: Folder given to ``r3dpa fit`` as ``--run_dir``.
    """
    from statistics import fmean

    from r3dpa import viz
    from r3dpa.io import text_table

    curves = viz.read_curves(run)
    if not curves:
        raise ValueError(f"{run} holds no version_*/metrics.csv; give the --run_dir of a fit")
    drawn = {name: curve for name, curve in curves.items() if len(curve[1]) > 1}
    if drawn:
        viz.save(viz.loss_curves(drawn), run / "loss_curves.png")
    rows = []
    for name, (_, values) in curves.items():
        tenth = max(1, len(values) // 10)
        first, last = fmean(values[:tenth]), fmean(values[-tenth:])
        rows.append([name, f"{first:.5g}", f"{last:.5g}", f"{last - first:+.5g}"])
    table = text_table(rows, ["quantity", "first tenth", "last tenth", "change"], "lrrr", "plain")
    return f"{table}\ncurves: {run / 'loss_curves.png'}" if drawn else table


def replay(file: Path, ckpt: Path, device: str = "cpu") -> str:
    """Repeat a skipped step to find the layer that failed.

    The losses are computed as in training, with the draws, loss weights and precision of the step:
    of the whole batch, where hooks look at the output of each layer and at its gradient, and of
    each scan alone. The loss scale of float16 and the other processes of a distributed run are not
    repeated: where all is finite, give another checkpoint or the file of another process.

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
    seen = _Observer()
    hooks = [
        layer.register_forward_hook(partial(seen, name))
        for name, layer in module.named_modules()
        if name.split(".")[0] in ("vae", "sit", "discriminator") and not list(layer.children())
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
    table = text_table(cells, ["", *columns], "l" + "r" * len(columns))
    return "\n".join([*lines, table, *seen.conclusion()])


class _Observer:
    """Layers that were called, and those whose output or gradient is not finite."""

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

    def conclusion(self) -> list[str]:
        """Numbers of layers at fault, the first of them, and those that had finite inputs."""
        lines = [
            f"layers whose {kind} is not finite: {len(names)} of {len(self.called)}"
            + (f", the first {next(iter(names))}" if names else "")
            for kind, names in (("output", self.outputs), ("gradient", self.gradients))
        ]
        starts = ", ".join(name for name, inputs_finite in self.outputs.items() if inputs_finite)
        return [*lines, f"layers that turned finite inputs into others: {starts or 'none'}"]


def _module(saved: BadBatch, weights: Checkpoint) -> GenerativeModule:
    from r3dpa.modules import FewStep, FlowMatching, JointAlignment, VAEAlignment

    stages = {s.stage: s for s in (VAEAlignment, JointAlignment, FlowMatching, FewStep)}
    stage = stages[saved.about["stage"]]
    more = [] if issubclass(stage, FlowMatching) else ["discriminator"]
    more += ["thin_decoder"] if "thin_decoder" in weights.networks else []
    names = ["vae", "sit", "latent_norm", *more]
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
