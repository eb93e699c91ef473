"""``r3dpa convert``, ``report`` and ``replay``: checkpoints, losses and skipped steps of a run."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any, Literal


def convert(
    ckpt: Path,
    out: Path,
    *,
    to: Literal["r3dpa", "official"] = "r3dpa",
    overwrite: bool = False,
    sit_args: dict[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
    networks: list[str] | None = None,
    half: bool = False,
    decoder: Path | None = None,
    decoder_share: float = 1.0,
    flow: Path | None = None,
) -> str:
    """Convert official checkpoints into ours, or ours into official ones.

    Args:
        ckpt: Official ``.pt``, Lightning ``.ckpt``, exported ``.safetensors``, or a name of
            ``r3dpa models``.
        out: File to write, ``.safetensors`` for ours and ``.pt`` for the official layout.
        to: Layout of the result.
        overwrite: Replace ``out`` if it exists.
        sit_args: Official files only: SiT arguments that the file lacks, such as
            ``{alignment_depth: 4}``.
        encoding: Official files only: range encoding, if the file lacks it.
        networks: Write these alone; sampling needs ``vae ema ema_latent_norm``.
        half: Write weights in float16, half as large.
        decoder: Checkpoint whose VAE replaces the VAE of ``ckpt``. Both must have the same encoder,
            as after ``train_encoder: false``.
        decoder_share: Share of that decoder in a mean of the weights of both, above 0; 1 takes it
            as it is.
        flow: Checkpoint whose flow, with its latent statistics, replaces the flow of ``ckpt``; the
            few steps of ``ckpt`` stay. Both must have the same encoder.
    """
    from r3dpa.checkpoints import convert as convert_checkpoint

    return convert_checkpoint(
        ckpt,
        out,
        to=to,
        overwrite=overwrite,
        sit_args=sit_args,
        encoding=encoding,
        networks=networks,
        half=half,
        decoder=decoder,
        decoder_share=decoder_share,
        flow=flow,
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
    if not curves and (run / "config.yaml").is_file():
        raise ValueError(
            f"{run} has no logged values yet: a run logs every --trainer.log_every_n_steps steps "
            "(see its config.yaml), and had fewer"
        )
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

    The losses are computed in float32, with the draws and loss weights of the step.

    Args:
        file: One of the files in ``<run_dir>/bad_batches``.
        ckpt: Weights, ideally of the last step before it.
        device: ``cpu``, ``cuda`` or ``cuda:1``.
    """
    from r3dpa.callbacks.bad_batches import format_values, read_bad_batch
    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.geometry import ScanGeometry
    from r3dpa.modules import FewStep, FlowMatching, JointAlignment, LossWeights, VAEAlignment

    saved, weights = read_bad_batch(file), read_checkpoint(ckpt)
    stages = {s.stage: s for s in (VAEAlignment, JointAlignment, FlowMatching, FewStep)}
    if saved["stage"] not in stages:
        raise ValueError(
            f"{file} is of stage {saved['stage']}, but only {', '.join(stages)} can be repeated"
        )
    if missing := {"vae", "sit"} - set(weights.networks):
        raise ValueError(
            f"{ckpt} has no network {min(missing)}, which the step needs: give a .ckpt of the run"
        )
    known = {"vae", "sit", "latent_norm", "discriminator", "thin_decoder"} & set(weights.networks)
    networks: Any = {name: weights.network(name).build() for name in known}
    settings = LossWeights(**saved["weights"])
    module = stages[saved["stage"]](
        **networks,
        weights=settings,
        path=saved["path"],
        latent_noise=saved["latent_noise"],
        further_dropout=saved.get("further_dropout", 0.0),
    ).to(device)
    if weights.geometry is not None:
        module.geometry = ScanGeometry.from_dict(dict(weights.geometry))
    draws = saved["draws"]._make(value.to(device) for value in saved["draws"])
    batch: Any = {name: value.to(device) for name, value in saved["batch"].items()}
    # Without a trainer there is no number of the batch, and nothing to log to.
    module.draw_path = lambda *_: draws  # type: ignore[method-assign]
    module.log_dict = lambda *_: None  # type: ignore[method-assign]

    lines = [f"{file}: stage {saved['stage']}, step {saved['step']}, {saved['precision']}"]
    for name, value in (batch | draws._asdict() | module.state_dict()).items():
        if num_bad := int((~value.isfinite()).sum()):
            lines.append(f"{name}: {num_bad} of {value.numel()} values are not finite")
    broken: dict[str, bool] = {}  # layers with a bad output, and whether their inputs were finite

    def observe(name: str, layer: Any, inputs: Any, output: Any) -> None:
        if not output.isfinite().all():
            broken.setdefault(name, all(bool(value.isfinite().all()) for value in inputs))

    for name, layer in module.named_modules():
        if not list(layer.children()):
            layer.register_forward_hook(partial(observe, name))
    try:
        module.training_step(batch, 0)
    except RuntimeError as error:  # the shapes of the batch do not fit the networks
        raise ValueError(f"{file} cannot be run with the networks of {ckpt}: {error}") from error
    lines.append(f"losses then: {format_values(saved['losses'])}")
    losses = {name: float(loss) for name, loss in module.logged_losses.items()}
    lines.append(f"losses now:  {format_values(losses)}")
    causes = ", ".join(name for name, inputs_finite in broken.items() if inputs_finite) or "none"
    lines.append(f"layers whose output is not finite: {len(broken)}, from finite inputs: {causes}")
    if not broken and all(map(math.isfinite, losses.values())):
        lines.append(
            "these weights give finite values for this batch in float32: look at later weights, at "
            "the gradients, or at the precision of the step"
        )
    return "\n".join(lines)
