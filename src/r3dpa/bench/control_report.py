"""Tables, sheets and files of ``r3dpa bench control``."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r3dpa import viz
from r3dpa.geometry import Projection
from r3dpa.io import atomic_path, one_line
from r3dpa.metrics.bootstrap import Interval, bootstrap_interval

__all__ = ["Finding", "Value", "difference_of", "mean_of", "share_of", "sheet_of", "write_control"]

Value = Interval | float | int | str
_SHEET_CASES = 8  # the first, never chosen


@dataclass(frozen=True)
class Finding:
    """What one part of the bench found.

    Args:
        title: What was asked.
        rows: Values by column, of each row by name.
        notes: What a reader must know.
        sheet: Range images of the first cases, top to bottom; none where empty.
        parts: Names of the parts that the rows of the sheet are tinted by.
    """

    title: str
    rows: Mapping[str, Mapping[str, Value]]
    notes: Sequence[str] = ()
    sheet: Sequence[viz.EditRow] = ()
    parts: Sequence[str] = ()


def mean_of(values: Sequence[float]) -> Interval:
    """Mean of one value per scene with its 95 % bootstrap interval; NaN values do not count.

    For two ways that were given the same scenes and noises, give it the differences.

    Raises:
        ValueError: If fewer than two values are known.
    """
    known = torch.tensor([value for value in values if not math.isnan(value)], dtype=torch.float64)
    return _resampled(lambda drawn: float(known[drawn].mean()), len(known))


def difference_of(first: Sequence[float], second: Sequence[float]) -> Interval:
    """Mean of the first minus the second value of each scene, see :func:`mean_of`."""
    return mean_of([a - b for a, b in zip(first, second, strict=True)])


def share_of(parts: Sequence[float], wholes: Sequence[float]) -> Interval:
    """Sum of the parts over the sum of the wholes, with its interval over the scenes.

    Returns:
        NaN throughout where the wholes are 0.
    """
    part, whole = (torch.tensor(v, dtype=torch.float64) for v in (parts, wholes))
    if not whole.any():
        return Interval(math.nan, math.nan, math.nan)
    # A resample of scenes without any point tells nothing: it counts as the value of all.
    value = float(part.sum() / whole.sum())
    return _resampled(
        lambda drawn: (
            float(part[drawn].sum() / whole[drawn].sum()) if whole[drawn].any() else value
        ),
        len(part),
    )


def write_control(
    out: Path, part: str, finding: Finding, facts: Mapping[str, Any], projection: Projection
) -> str:
    """Write a part into ``control.json`` and ``control.md``, and its sheet.

    Parts that an earlier run left in the folder stay, each with its own facts.

    Args:
        out: Folder.
        part: Its name.
        finding: What it found.
        facts: Model, settings and where it was measured.
        projection: Gives the scale of the sheet.

    Returns:
        The tables of all parts in the folder.

    Raises:
        ValueError: If ``control.json`` is there but is not one of this bench.
    """
    notes = list(finding.notes)
    if finding.sheet:
        file = f"control_{part}.png"
        viz.save(viz.edit_sheet(finding.sheet, finding.parts, projection), out / file)
        notes.append(f"The first {_SHEET_CASES} cases, not chosen: ![{part}]({file})")
    rows = {
        row: {column: _plain(value) for column, value in values.items()}
        for row, values in finding.rows.items()
    }
    parts = _written(out / "control.json")
    parts[part] = {"title": finding.title, "rows": rows, "notes": notes, **facts}
    with atomic_path(out / "control.json") as temporary:
        temporary.write_text(json.dumps({"parts": parts}, indent=1, allow_nan=False) + "\n")
    text = ["# What control at test time does", ""]
    for record in parts.values():
        text += [f"## {record['title']}", "", *_table(record["rows"]), ""]
        text += [f"- {note}" for note in record["notes"]]
        text += [f"- {name}: {one_line(record[name])}" for name in facts if name in record] + [""]
    text.append("Intervals: 95 %, bootstrap over the scenes; differences are paired by scene.")
    with atomic_path(out / "control.md") as temporary:
        temporary.write_text("\n".join(text) + "\n", encoding="utf-8")
    return "\n".join(text)


def _written(path: Path) -> dict[str, Any]:
    """Parts that are in the folder already."""
    if not path.exists():
        return {}
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["parts"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is not of `r3dpa bench control` ({error}): give another folder"
        ) from error


def sheet_of(*columns: tuple[str, Sequence[viz.EditRow | Tensor]]) -> list[viz.EditRow]:
    """Rows of the first cases, those of one case together.

    Args:
        columns: What is shown of each case: its name, and a range image ``(H, W)`` of each.
    """
    rows = []
    for case in range(min(_SHEET_CASES, *(len(images) for _, images in columns))):
        for name, images in columns:
            image = images[case]
            own = image if isinstance(image, viz.EditRow) else viz.EditRow("", image)
            rows.append(own._replace(name=f"{case}: {name}"))
    return rows


def _resampled(statistic: Callable[[Tensor], float], size: int) -> Interval:
    return bootstrap_interval(statistic, (size,), torch.Generator().manual_seed(0))


def _plain(value: Value) -> Any:
    if isinstance(value, Interval):
        ends = asdict(value)
        return {key: None if math.isnan(end) else end for key, end in ends.items()}
    return value


def _table(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    columns = list(dict.fromkeys(column for values in rows.values() for column in values))
    lines = [f"| | {' | '.join(columns)} |", "|---|" + "---:|" * len(columns)]
    for name, values in rows.items():
        cells = [_cell(values[column]) if column in values else "" for column in columns]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        if value["value"] is None:
            return "-"
        return f"{value['value']:.3g} ({value['low']:.3g}..{value['high']:.3g})"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
