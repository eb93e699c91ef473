"""An installed wheel holds the configurations, and its commands find them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

TOP = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_commands_of_an_installed_wheel(tmp_path):
    source, site = tmp_path / "source", tmp_path / "site"
    skipped = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in ("src", "conf"):
        shutil.copytree(TOP / name, source / name, symlinks=True, ignore=skipped)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(TOP / name, source / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--no-build-isolation", "--no-deps"]
    subprocess.run([*pip, "-q", "-w", tmp_path, source], check=True, timeout=300)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(site)
    shipped = {f"r3dpa/{p.relative_to(TOP)}" for p in (TOP / "conf").rglob("*.yaml")}
    assert shipped <= names
    environment = {**os.environ, "PYTHONPATH": str(site)}

    def r3dpa(*words):
        return subprocess.run(
            [sys.executable, "-m", "r3dpa", *words],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=200,
        ).stdout

    assert "class_path: r3dpa.modules.JointAlignment" in r3dpa(
        *("fit", "joint", "--preset", "demo", "--print_config")
    )
    assert r3dpa("ablate", "conf/ablation", "--scale", "demo", "--budget_only").startswith("budget")
