"""The fuzzer at a small count, and that it finds what it is for; ``make fuzz`` runs many inputs."""

from __future__ import annotations

import os
import re
import time

import numpy as np
import pytest
from fuzz_readers import Hang, Reader, fuzz, readers

pytestmark = pytest.mark.fuzz
INPUTS = int(os.environ.get("FUZZ_INPUTS", "20"))  # for each reader


@pytest.fixture(scope="module")
def all_readers(tmp_path_factory):
    return readers(tmp_path_factory.mktemp("fuzz"))


def test_no_reader_crashes_hangs_or_asks_for_much_memory(all_readers, tmp_path):
    """What goes wrong is kept in the folder of the test."""
    wrong = {}
    for name, reader in all_readers.items():
        for data, why in fuzz(name, reader, INPUTS, seed=1):
            kept = tmp_path / f"{re.sub(r'[^a-z]+', '_', name)}_{len(wrong)}"
            kept.write_bytes(data)
            wrong[str(kept)] = why
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
