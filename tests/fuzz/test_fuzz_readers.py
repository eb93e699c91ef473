"""The fuzzer at a small count, and that it finds what it is for; ``make fuzz`` runs 1e5 inputs."""

from __future__ import annotations

import time

import numpy as np
import pytest
from fuzz_readers import Hang, Reader, fuzz, readers

INPUTS = 20


@pytest.fixture(scope="module")
def all_readers(tmp_path_factory):
    return readers(tmp_path_factory.mktemp("fuzz"))


def test_no_reader_crashes_hangs_or_asks_for_much_memory(all_readers, capsys):
    wrong = {}
    for name, reader in all_readers.items():
        wrong |= {f"{name} {len(wrong)}": why for _, why in fuzz(name, reader, INPUTS, seed=1)}
    with capsys.disabled():
        print(f"\n{INPUTS} inputs each: {', '.join(all_readers)}")  # noqa: T201 - counts of the run
    assert len(all_readers) >= 20
    assert not wrong


@pytest.mark.parametrize(
    ("read", "reason"),
    [
        (lambda: [][0], "IndexError"),
        (lambda: np.zeros(2**40), "MemoryError|ArrayMemoryError"),
        (lambda: time.sleep(9), "does not end"),
    ],
)
def test_bad_readers_are_found(read, reason, tmp_path, monkeypatch):
    monkeypatch.setattr("fuzz_readers.SECONDS", 0.2)
    file = tmp_path / "a"

    def damaged_only():
        if file.read_bytes() != b"valid":
            read()

    assert not issubclass(Hang, Exception)  # readers do not catch it
    (_, found), *_ = fuzz("a", Reader(file, damaged_only, b"valid"), 3, seed=0)
    assert any(part in found for part in reason.split("|"))
