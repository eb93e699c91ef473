"""Options shared by all tests."""

from __future__ import annotations

from pathlib import Path


def pytest_addoption(parser):
    parser.addoption(
        "--parity-dir",
        type=Path,
        default=None,
        help="folder with cases.json and the .npz files of golden numbers "
        "(default: the shared folder where it is present, else the synthetic files)",
    )
