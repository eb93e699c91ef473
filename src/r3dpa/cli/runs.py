"""``r3dpa convert`` and ``report``: checkpoints and losses of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal


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
