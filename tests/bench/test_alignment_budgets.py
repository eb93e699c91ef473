import os

import pytest
from alignment_budgets import compare, draw, step_seconds


def test_steps_are_timed_by_their_fastest_stretch(tmp_path):
    """100 steps in 50 s, then 100 in 80 s; in the other run the first stretch was interrupted."""
    for name, times in (("a", (0, 50, 130)), ("b", (0, 900, 960))):
        (tmp_path / name / "checkpoints").mkdir(parents=True)
        for number, time in enumerate(times, 1):
            file = tmp_path / name / "checkpoints" / f"step={100 * number:07d}.ckpt"
            file.touch()
            os.utime(file, (time, time))
    assert step_seconds([tmp_path / "a", tmp_path / "b"]) == pytest.approx(0.5)


def test_changes_at_equal_steps_and_hours_by_hand(tmp_path):
    """A step of the aligned row takes twice as long: its step 100 is step 200 of the base row."""
    rows = {
        "none": {100: {"FWID": {"0": 0.4, "1": 0.8}}, 200: {"FWID": {"0": 0.2, "1": 0.4}}},
        "aligned": {100: {"FWID": {"0": 0.2, "1": 0.4}}, 200: {"FWID": {"0": 0.1, "1": 0.1}}},
    }
    found = compare(rows, "none", {"none": 18.0, "aligned": 36.0})
    assert found["none"][200]["hours"] == found["aligned"][100]["hours"] == 1
    row = found["aligned"][100]["FWID"]
    assert row["mean"] == pytest.approx(0.3)
    assert row["equal_steps"]["change"] == pytest.approx(-0.5)
    assert row["equal_steps"]["interval"] == pytest.approx([-0.5, -0.5])
    assert row["equal_hours"]["change"] == pytest.approx(0)
    assert found["aligned"][200]["FWID"]["equal_hours"] is None  # the base has no such budget
    last = found["aligned"][200]["FWID"]["equal_steps"]
    assert last["change"] == pytest.approx((-0.5 - 0.75) / 2)
    # Student's t of one degree of freedom is 12.7; the standard error of -0.5 and -0.75 is 0.125.
    assert last["interval"][1] - last["change"] == pytest.approx(12.706 * 0.125, rel=1e-3)
    draw(found, "FWID", tmp_path / "budgets.png")
    assert (tmp_path / "budgets.png").stat().st_size > 0
