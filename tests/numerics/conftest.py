"""Every test names its hard case and says how the naive computation failed; a list is written.

A test looks like this::

    @pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
    @pytest.mark.numerics(section=6, case="cosine in half precision")
    def test_cosine(dtype, naive):
        ...
        assert error > 1e-3
        naive(f"bfloat16 cosine off by {error:.1e}")

Parameters that are dtypes are the precisions of the list; ``precision="float64"`` in the marker
says it for a test without them (float32 if left out).
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from rows import ROWS, SECTIONS, Row

_ROW, _NAIVE, _PRECISION = "numerics row", "numerics naive", "numerics precision"


@pytest.fixture
def naive(request):
    """``naive(text)``: record how the naive computation failed, once the test has asserted it."""

    def record(text: str) -> None:
        request.node.user_properties.append((_NAIVE, text))

    return record


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem):
    """Add row and precision to the report; a test that names a row must record a failure."""
    mark = pyfuncitem.get_closest_marker("numerics")
    if mark is None or not mark.kwargs:
        bare = mark in pyfuncitem.own_markers
        if bare and not getattr(pyfuncitem.obj, "is_hypothesis_test", False):
            pytest.fail("a test that is no property must name its hard case in the marker")
        return (yield)
    given = getattr(pyfuncitem, "callspec", None)
    dtypes = [p for p in (given.params if given else {}).values() if isinstance(p, torch.dtype)]
    names = [str(dtype).removeprefix("torch.") for dtype in dtypes]
    pyfuncitem.user_properties += [
        (_ROW, (mark.kwargs["section"], mark.kwargs["case"])),
        (_PRECISION, " ".join(names) or mark.kwargs.get("precision", "float32")),
    ]
    result = yield
    if not any(key == _NAIVE for key, _ in pyfuncitem.user_properties):
        pytest.fail("the test names a hard case but recorded no failure of the naive computation")
    return result


def pytest_terminal_summary(terminalreporter, config):
    """Write the list of cases to the file of ``--numerics-list``, of the tests that ran."""
    path = config.getoption("--numerics-list", default=None)
    if path is not None:
        reports = [
            report
            for outcome in ("passed", "failed")
            for report in terminalreporter.stats.get(outcome, [])
            if report.when == "call"
        ]
        path.write_text(_list(reports), encoding="utf-8")
        terminalreporter.write_line(f"hard numerical cases: {path}")


def _list(reports: list[pytest.TestReport]) -> str:
    """Markdown: a table per section of what ran, and the rows that were left out."""
    covered, lines = 0, list[str]()
    for section, title in SECTIONS.items():
        lines += ["", f"## {section}. {title}", ""]
        lines += ["| case | test | naive failure seen | passes in |", "| --- | --- | --- | --- |"]
        for row in (row for row in ROWS if row.section == section):
            entries = _entries(row, reports)
            covered += bool(entries)
            lines += [f"| {row.case} | {' | '.join(entry)} |" for entry in entries]
    left_out = [row for row in ROWS if row.left_out]
    lines += ["", "## Left out", ""]
    lines += [f"- {row.section}. {row.case}: {row.left_out}" for row in left_out]
    rows_seen = f"{covered} of {len(ROWS)} rows have tests that ran; {len(left_out)} are left out."
    return "\n".join(["# Hard numerical cases", "", rows_seen, *lines]) + "\n"


def _entries(row: Row, reports: list[pytest.TestReport]) -> list[tuple[str, str, str]]:
    """Test, naive failure and precisions of every test of a row that ran."""
    runs: dict[str, list[pytest.TestReport]] = {}
    for report in reports:
        runs.setdefault(report.nodeid.partition("[")[0], []).append(report)
    entries = []
    for test, its_runs in runs.items():
        if (_ROW, (row.section, row.case)) in its_runs[0].user_properties:
            texts = [t for run in its_runs for key, t in run.user_properties if key == _NAIVE]
            names = [
                name if run.passed else f"{name} FAILED"
                for run in its_runs
                for key, name in run.user_properties
                if key == _PRECISION
            ]
            entries.append((test, "; ".join(dict.fromkeys(texts)), ", ".join(dict.fromkeys(names))))
    for other in row.elsewhere:
        its_runs = runs.get(f"tests/{other.test}", [])
        if its_runs:
            passed = all(run.passed for run in its_runs)
            names = [other.precisions if passed else f"{other.precisions} FAILED"]
            entries.append((f"tests/{other.test}", other.naive, *names))
    return [(Path(test).name, text.replace("|", "\\|"), names) for test, text, names in entries]
