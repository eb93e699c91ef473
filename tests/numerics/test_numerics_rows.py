"""Every hard case has a test or a reason, and every test a case."""

from __future__ import annotations

import pytest
from rows import ROWS, SECTIONS, TESTS, marked_tests

pytestmark = pytest.mark.numerics


def named_rows():
    named = {}
    for path in sorted((TESTS / "numerics").glob("test_numerics_*.py")):
        for name, row in marked_tests(path).items():
            if row is not None:  # else a property, see conftest.py
                named.setdefault(row, []).append(name)
    return named


def test_rows_are_unique():
    keys = [(row.section, row.case) for row in ROWS]
    assert len(set(keys)) == len(keys)
    assert {section for section, _ in keys} == set(SECTIONS)


def test_every_named_row_exists():
    assert set(named_rows()) <= {(row.section, row.case) for row in ROWS}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.section} {row.case}")
def test_a_row_has_either_tests_or_a_reason(row):
    tested = bool(row.elsewhere) or (row.section, row.case) in named_rows()
    assert tested != bool(row.left_out)


@pytest.mark.parametrize(
    "test", [one.test for row in ROWS for one in row.elsewhere], ids=lambda test: test
)
def test_tests_elsewhere_exist_and_carry_the_marker(test):
    path, _, name = test.partition("::")
    assert name.split("::")[0] in marked_tests(TESTS / path)
