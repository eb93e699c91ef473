"""The import rule: an area imports only the areas listed for it, and no import closes a circle."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "r3dpa"
CORE = {"geometry", "flow", "losses", "nn"}
METHOD = CORE | {"data", "checkpoints", "generation", "modules"}
ALLOWED = {
    "io": set(),
    "geometry": set(),
    "flow": set(),
    "losses": set(),
    "simulation": set(),
    "nn": {"geometry"},
    "viz": {"geometry"},
    "metrics": {"geometry", "nn"},
    "data": {"geometry", "simulation", "weather"},
    "weather": {"geometry", "simulation", "data"},
    "pretrained": set(),
    "checkpoints": {"nn", "pretrained"},
    "generation": {"geometry", "nn", "flow", "checkpoints"},
    "scene_vae": {"geometry", "nn", "generation", "checkpoints"},
    "editing": {"geometry", "nn", "flow", "generation", "checkpoints"},
    "modules": CORE | {"data", "checkpoints", "generation", "editing"},
    "baselines": METHOD,
    "callbacks": METHOD | {"baselines"} | {"simulation", "metrics", "viz"},
    "ablation": {"metrics", "modules", "checkpoints", "viz"},
    "bench": METHOD | {"baselines", "simulation", "metrics", "viz", "editing", "callbacks"},
    "__main__": {"cli"},
    "cli": METHOD
    | {"baselines", "simulation", "metrics", "viz", "editing", "callbacks", "bench", "ablation"}
    | {"weather", "pretrained"},
}
ANYWHERE = {"io", "__version__"}


def imported(source: str) -> set[str]:
    """Dotted names of r3dpa that a source imports, wherever, but for the type checker alone."""
    tree = ast.parse(source)
    skipped = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    names = set()
    for node in set(ast.walk(tree)) - skipped:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.startswith("r3dpa.")}


def violations(source: str, area: str) -> set[str]:
    return {name.split(".")[1] for name in imported(source)} - ALLOWED[area] - {area} - ANYWHERE


def modules() -> dict[str, Path]:
    paths = {".".join(p.relative_to(PACKAGE.parent).parts)[:-3]: p for p in PACKAGE.rglob("*.py")}
    return {name.removesuffix(".__init__"): path for name, path in paths.items()}


def graph() -> dict[str, set[str]]:
    """Modules that each module imports; a name of a module is an import of that module."""
    known = modules()
    edges = {}
    for name, path in known.items():
        targets = {
            target if target in known else target.rpartition(".")[0]
            for target in imported(path.read_text())
        }
        edges[name] = targets & set(known) - {name}
    return edges


@pytest.mark.parametrize("name", sorted(modules()))
def test_area_imports_only_what_it_may(name):
    if name != "r3dpa":
        assert not violations(modules()[name].read_text(), name.split(".")[1])


def test_no_import_closes_a_circle():
    edges = graph()
    edges["r3dpa"] = set()  # its names are loaded on first use
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


@pytest.mark.parametrize(
    ("area", "source"),
    [("geometry", "from r3dpa.nn import VAE"), ("flow", "def f():\n    import r3dpa.losses")],
)
def test_a_forbidden_import_is_found(area, source):
    assert violations(source, area)


def test_every_area_has_a_rule():
    areas = {p.name.removesuffix(".py") for p in PACKAGE.iterdir() if p.suffix in ("", ".py")}
    assert areas - {"__init__", "__pycache__", "conf", "weights"} == set(ALLOWED)
