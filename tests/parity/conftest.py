"""Golden numbers of the official code: where they lie and how a case is read."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

REPOSITORY = Path(__file__).resolve().parents[2]
SYNTHETIC = REPOSITORY / "tests" / "parity" / "data"
SHARED = REPOSITORY.parent / "shared" / "parity"
BASELINES = REPOSITORY / "tests" / "parity" / "data_baselines"
SHARED_BASELINES = REPOSITORY.parent / "shared" / "parity_baselines"


class Case:
    """One ``.npz`` of golden numbers with its entry of ``cases.json``."""

    def __init__(self, folder: Path, name: str):
        self.folder = folder
        self.config = json.loads((folder / "cases.json").read_text())[name]["config"]
        with np.load(folder / f"{name}.npz") as arrays:
            self.arrays = {key: arrays[key] for key in arrays.files}

    def __getitem__(self, key: str) -> torch.Tensor:
        return torch.from_numpy(np.asarray(self.arrays[key]).copy())

    def __contains__(self, key: str) -> bool:
        return key in self.arrays

    def keys(self, prefix: str = "") -> list[str]:
        return [key for key in self.arrays if key.startswith(prefix)]

    def weights(self, prefix: str = "w/") -> dict[str, torch.Tensor]:
        """Official state dict: the arrays below ``prefix``, without the prefix."""
        return {key[len(prefix) :]: self[key] for key in self.keys(prefix)}


@pytest.fixture(scope="session")
def parity_dir(pytestconfig) -> Path:
    given = pytestconfig.getoption("--parity-dir")
    if given is not None:
        if not (given / "cases.json").is_file():
            raise pytest.UsageError(f"--parity-dir {given} holds no cases.json")
        return given
    return SHARED if (SHARED / "cases.json").is_file() else SYNTHETIC


def case_loader(folder: Path):
    """``load(name)``; skips a case that ``cases.json`` does not list, and no other."""
    listed = json.loads((folder / "cases.json").read_text())

    def load(name: str) -> Case:
        if name not in listed:
            pytest.skip(f"{name} is no case of {folder}")
        if not (folder / f"{name}.npz").is_file():
            pytest.fail(f"{folder} lists {name} in cases.json, but holds no {name}.npz")
        return Case(folder, name)

    return load


@pytest.fixture(scope="session")
def load_case(parity_dir):
    """``load_case(name)`` of the official R3DPA code; some are KITTI-derived and not here."""
    return case_loader(parity_dir)


@pytest.fixture(scope="session")
def baseline_case(baseline_dir):
    """``baseline_case(name)`` of R2DM, R2Flow or LiDM."""
    return case_loader(baseline_dir)


def listing_loader(folder: Path, shipped: Path):
    """``load(name)``: a recorded state-dict listing, which no seed or size changes."""

    def load(name: str):
        file = folder / f"{name}.json"
        return json.loads((file if file.is_file() else shipped / file.name).read_text())

    return load


@pytest.fixture(scope="session")
def baseline_listing(baseline_dir):
    """``baseline_listing(name)``: a listing of a baseline."""
    return listing_loader(baseline_dir, BASELINES)


@pytest.fixture(scope="session")
def baseline_dir(pytestconfig, parity_dir) -> Path:
    """Golden numbers of R2DM, R2Flow and LiDM: the ``--parity-dir`` where one is given."""
    if pytestconfig.getoption("--parity-dir") is not None:
        return parity_dir
    return SHARED_BASELINES if (SHARED_BASELINES / "cases.json").is_file() else BASELINES


@pytest.fixture(scope="session")
def official_listing(parity_dir):
    """``official_listing(name)``: a listing of R3DPA."""
    return listing_loader(parity_dir, SYNTHETIC)


def assert_close(actual, expected, atol=1e-5, rtol=1e-5):
    """Tolerance of parity/README.md unless a test says otherwise; dtypes may differ."""
    actual, expected = torch.as_tensor(actual), torch.as_tensor(expected)
    torch.testing.assert_close(
        actual.double(), expected.double(), atol=atol, rtol=rtol, check_device=False
    )


def compare_all(case, results, exempt=None, tolerance=lambda key, expected: {}):
    """Every recorded output against the result of its name, but for exempt positions."""
    assert set(results) == set(case.keys("out/"))
    wrong = []
    for key, actual in results.items():
        actual, expected = torch.as_tensor(actual).detach(), case[key]
        if key in (exempt or {}):
            assert actual.shape == expected.shape, key
            actual, expected = actual[..., ~exempt[key]], expected[..., ~exempt[key]]
        try:
            assert_close(actual, expected, **tolerance(key, expected))
        except AssertionError as error:
            wrong.append(f"{key}: {error}")
    assert not wrong, "\n".join(wrong)


@pytest.fixture(scope="session")
def close():
    return assert_close


@pytest.fixture(scope="session")
def compare():
    return compare_all
