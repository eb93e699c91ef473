"""Every test names its hard case and says how the naive computation failed; a list is written.

A test looks like this::

    @pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
    @pytest.mark.numerics(section=6, case="cosine in half precision")
    def test_cosine(dtype, naive):
        ...
        assert error > 1e-3
        naive(f"bfloat16 cosine off by {error:.1e}")

Parameters that are dtypes are the precisions of the list; ``precision="float64"`` in the marker
gives it for a test without them (default: float32). ``elsewhere.csv`` lists the marked tests of
other folders, and cases without a test with the reason.
"""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch

SECTIONS = {
    1: "Interpolant and sampler",
    2: "Feature guidance",
    3: "Range image",
    4: "VAE and GAN",
    5: "Latent statistics and EMA",
    6: "Alignment loss",
    7: "Optimisation, distribution, resume",
    8: "Metrics",
}


@pytest.fixture
def naive(request):
    """``naive(text)``: record how the naive computation failed, once the test has asserted it."""

    def record(text: str) -> None:
        request.node.user_properties.append(("naive", text))

    return record


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem):
    """Adds case and precision to the report; a test that names a case must record a failure."""
    mark = pyfuncitem.get_closest_marker("numerics")
    if mark is None or not mark.kwargs:
        return (yield)
    given = getattr(pyfuncitem, "callspec", None)
    dtypes = [p for p in (given.params if given else {}).values() if isinstance(p, torch.dtype)]
    names = [str(dtype).removeprefix("torch.") for dtype in dtypes]
    pyfuncitem.user_properties += [
        ("case", (mark.kwargs["section"], mark.kwargs["case"])),
        ("precision", " ".join(names) or mark.kwargs.get("precision", "float32")),
    ]
    result = yield
    if not any(key == "naive" for key, _ in pyfuncitem.user_properties):
        pytest.fail("the test names a hard case but recorded no failure of the naive computation")
    return result


def pytest_terminal_summary(terminalreporter, config):
    """Writes the list of cases to the file of ``--numerics-list``, of the tests that ran."""
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
    """Markdown: a table per section of the tests that ran, and the cases that are left out."""
    runs: dict[str, list[pytest.TestReport]] = {}
    for report in reports:
        runs.setdefault(report.nodeid.partition("[")[0], []).append(report)
    with (Path(__file__).parent / "elsewhere.csv").open(encoding="utf-8") as file:
        others = list(csv.DictReader(file))
    found: dict[tuple[int, str], list[tuple[str, str, str]]] = {}
    for test, its_runs in runs.items():
        properties = [dict(run.user_properties) | {"ok": run.passed} for run in its_runs]
        if "case" in properties[0]:
            texts = dict.fromkeys(p.get("naive", "") for p in properties)
            names = dict.fromkeys(p["precision"] + " FAILED" * (not p["ok"]) for p in properties)
            row = (test, "; ".join(texts), ", ".join(names))
            found.setdefault(properties[0]["case"], []).append(row)
    for other in (other for other in others if other["test"] in runs):
        passed = all(run.passed for run in runs[other["test"]])
        row = (other["test"], other["naive"], other["precisions"] + " FAILED" * (not passed))
        found.setdefault((int(other["section"]), other["case"]), []).append(row)
    lines = ["# Hard numerical cases", "", f"{len(found)} cases have tests that ran."]
    for section, title in SECTIONS.items():
        lines += ["", f"## {section}. {title}", ""]
        lines += ["| case | test | naive failure seen | passes in |", "| --- | --- | --- | --- |"]
        for (own, case), rows in found.items():
            for test, text, names in rows if own == section else ():
                cells = (case, Path(test).name, text.replace("|", "\\|"), names)
                lines.append(f"| {' | '.join(cells)} |")
    lines += ["", "## Left out", ""]
    left_out = [other for other in others if not other["test"]]
    lines += [f"- {other['section']}. {other['case']}: {other['naive']}" for other in left_out]
    return "\n".join(lines) + "\n"
