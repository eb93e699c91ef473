"""Realism before and after a change of the simulator, from two tables of ``r3dpa data realism``.

    r3dpa data realism --scans SIMULATED --reference REAL --out after.json
    python tests/bench/compare_realism.py before.json after.json

A measure is worse if its distance to the real recordings grew by more than a tenth of the distance
between two real recordings (the floor). Exits with 1 if one is.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from r3dpa.io import text_table

ALLOWED_GROWTH = 0.1  # of the floor


def read_rows(path):
    """Measures of a realism table by name."""
    return {row["name"]: row for row in json.loads(path.read_text())["rows"]}


def compare(before, after):
    """Text of the comparison and the names of the measures that are worse."""
    rows, worse = [], []
    for name, old in before.items():
        new, floor = after[name], old["floor"]
        growth = (new["distance"] - old["distance"]) / floor
        if growth > ALLOWED_GROWTH:
            worse.append(name)
        numbers = [old["value_a"], new["value_a"], old["value_b"]]
        values = ["-" if number is None else f"{number:.4g}" for number in numbers]
        ratios = [f"{old['distance'] / floor:.2f}", f"{new['distance'] / floor:.2f}"]
        verdict = "WORSE" if name in worse else "better" if growth < -ALLOWED_GROWTH else ""
        rows.append([name, old["unit"], *values, *ratios, f"{floor:.3g}", verdict])
    heads = ["measure", "unit", "before", "after", "real", "distance / floor before", "after"]
    table = text_table(rows, [*heads, "floor", ""], style="pipe")
    within = [
        sum(row["distance"] <= row["floor"] for row in measures.values())
        for measures in (before, after)
    ]
    counts = f"within the floor: {within[0]} before, {within[1]} after, of {len(before)}"
    return f"{table}\n\n{counts}\nworse: {', '.join(worse) or 'none'}", worse


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    arguments = parser.parse_args()
    text, worse = compare(read_rows(arguments.before), read_rows(arguments.after))
    sys.stdout.write(text + "\n")
    sys.exit(bool(worse))


if __name__ == "__main__":
    main()
