"""The import rule: an area imports only the areas listed for it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "r3dpa"
CORE = {"geometry", "flow", "losses", "nn"}
ALLOWED = {
    "io": set(),
    "unpickling": set(),
    "imports": set(),
    "geometry": set(),
    "flow": set(),
    "losses": set(),
    "simulation": {"geometry"},
    "nn": {"geometry"},
    "viz": {"geometry"},
    "metrics": {"geometry", "nn"},
    "data": {"geometry", "simulation"},
    "checkpoints": {"nn"},
    "generation": {"geometry", "nn", "flow"},
    "editing": {"geometry", "nn", "flow", "generation"},
    "modules": CORE | {"data", "checkpoints", "generation"},
    "scoring": {"data", "metrics", "viz"},
    "snapshots": {"checkpoints", "modules", "nn"},
    "callbacks": {"geometry", "data", "generation", "modules", "nn", "viz"}
    | {"checkpoints", "metrics", "scoring"},
    "ablation": {"imports", "metrics", "modules", "checkpoints", "viz"},
    "bench": CORE
    | {"imports", "simulation", "data", "checkpoints", "generation", "metrics", "modules", "viz"}
    | {"editing"},
    "__main__": {"cli"},
    "cli": CORE
    | {"simulation", "data", "checkpoints", "generation", "modules", "callbacks", "viz", "bench"}
    | {"metrics", "scoring", "snapshots", "imports", "ablation", "editing"},
}


def violations(source: str, area: str) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module == "r3dpa":
            names = [f"r3dpa.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("r3dpa.")}
    return found - ALLOWED[area] - {area, "io", "unpickling", "__version__"}


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE))
)
def test_area_imports_only_what_it_may(path):
    area = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if area != "__init__":
        assert not violations(path.read_text(), area)


@pytest.mark.parametrize(
    ("area", "source"),
    [("geometry", "from r3dpa.nn import VAE"), ("flow", "def f():\n    import r3dpa.losses")],
)
def test_a_forbidden_import_is_found(area, source):
    assert violations(source, area)


def test_every_area_has_a_rule():
    areas = {p.name.removesuffix(".py") for p in PACKAGE.iterdir() if p.suffix in ("", ".py")}
    assert areas - {"__init__", "__pycache__"} == set(ALLOWED)
