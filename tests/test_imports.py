"""The import rule: an area imports only the areas listed for it, and no import closes a circle."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"
PACKAGES = ("lidarsim", "r3dpa")
CORE = {"geometry", "flow", "losses", "nn"}
METHOD = CORE | {"features", "data", "checkpoints", "generation", "editing", "lidarsim"}
METHOD |= {"scenes", "scene_vae", "pretrained", "modules"}
METRICS = {"metrics", "feature_names"}
ALLOWED = {
    "lidarsim": set(),
    "class_paths": set(),
    "feature_names": set(),
    "pretrained": set(),
    "losses": set(),
    "io": {"lidarsim"},  # atomic writes, locks, worker processes
    "geometry": {"lidarsim"},  # LidarSensor, rings of a scan
    "flow": {"losses"},
    "nn": {"geometry", "losses"},
    "features": {"geometry", "nn", "feature_names"},
    "data": {"geometry", "features", "lidarsim"},
    "checkpoints": {"geometry", "nn", "pretrained", "class_paths"},
    # A batch of scenes writes its files and shows its pages.
    "scenes": {"geometry", "data", "lidarsim", "viz"},
    "citations": {"checkpoints", "pretrained"},
    "scheduled_velocity": {"flow", "nn"},
    "generation": {"geometry", "nn", "flow", "checkpoints", "scenes", "scheduled_velocity"},
    "scene_vae": {"geometry", "nn", "generation", "checkpoints", "scenes"},
    # Objects are cut out of labelled scans.
    "editing": {
        "geometry",
        "nn",
        "flow",
        "checkpoints",
        "generation",
        "scenes",
        "data",
        "lidarsim",
    },
    "modules": METHOD | {"scheduled_velocity"},
    # Divergences that realism has, too.
    "metrics": {"geometry", "nn", "features", "lidarsim", "feature_names"},
    "viz": METHOD | {"metrics"},
    "baselines": METHOD,
    "scene_files": METHOD | {"viz", "stages", "feature_names"},
    "stages": {"flow", "checkpoints", "generation", "baselines"},
    "callbacks": METHOD | METRICS | {"viz"},
    "ablation": METHOD | METRICS | {"viz", "callbacks"},
    "bench": METHOD | {"metrics", "viz", "callbacks", "stages"},
    "__main__": {"cli"},
    "cli": METHOD
    | METRICS
    | {"viz", "callbacks", "stages", "scene_files", "bench", "ablation", "class_paths"},
}
ANYWHERE = {"io", "__version__"}


def area_of(name: str) -> str:
    """Area of a dotted name: the part of r3dpa that it belongs to, or lidarsim."""
    package, _, rest = name.partition(".")
    return package if package == "lidarsim" else rest.partition(".")[0]


@cache
def imported(source: str) -> set[str]:
    """Dotted names of both packages that a source imports, but for the type checker alone."""
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
    return {name for name in names if name.startswith(tuple(f"{p}." for p in PACKAGES))}


def violations(source: str, area: str) -> set[str]:
    anywhere = set() if area == "lidarsim" else ANYWHERE
    return {area_of(name) for name in imported(source)} - ALLOWED[area] - {area} - anywhere


@cache
def modules() -> dict[str, Path]:
    paths = [path for package in PACKAGES for path in (SOURCE / package).rglob("*.py")]
    names = {".".join(path.relative_to(SOURCE).with_suffix("").parts): path for path in paths}
    return {name.removesuffix(".__init__"): path for name, path in names.items()}


def module_graph() -> dict[str, set[str]]:
    """Modules that each module imports; a name of a module is an import of that module."""
    known = modules()
    edges = {}
    for name, path in known.items():
        targets = {
            target if target in known else target.rpartition(".")[0]
            for target in imported(path.read_text())
        }
        edges[name] = targets & set(known) - {name}
    return edges | {package: set() for package in PACKAGES}  # load their names on first use


def area_graph() -> dict[str, set[str]]:
    """Areas that each area imports."""
    edges: dict[str, set[str]] = {}
    for name, targets in module_graph().items():
        areas = {area_of(target) for target in targets if target != "r3dpa"}
        edges.setdefault(area_of(name), set()).update(areas - {area_of(name)})
    return edges


@pytest.mark.parametrize("name", sorted(set(modules()) - {"r3dpa"}))
def test_area_imports_only_what_it_may(name):
    assert not violations(modules()[name].read_text(), area_of(name))


@pytest.mark.parametrize("graph", [module_graph, area_graph])
def test_no_import_closes_a_circle(graph):
    try:
        TopologicalSorter(graph()).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


@pytest.mark.parametrize(
    ("area", "source"),
    [
        ("geometry", "from r3dpa.nn import VAE"),
        ("flow", "def f():\n    import r3dpa.data"),
        ("lidarsim", "from r3dpa.io import atomic_path"),
    ],
)
def test_a_forbidden_import_is_found(area, source):
    assert violations(source, area)


def test_every_area_has_a_rule():
    folder = SOURCE / "r3dpa"
    areas = {p.name.removesuffix(".py") for p in folder.iterdir() if p.suffix in ("", ".py")}
    assert areas - {"__init__", "__pycache__", "conf", "weights"} | {"lidarsim"} == set(ALLOWED)


def test_lidarsim_needs_no_torch_and_nothing_of_r3dpa():
    optional = {"lidarsim.clouds_las"}  # needs laspy
    names = sorted(name for name in set(modules()) - optional if name.startswith("lidarsim"))
    code = f"""
import sys, time
started = time.perf_counter()
import lidarsim
seconds = time.perf_counter() - started
for name in {names}:
    __import__(name)
loaded = {{name.partition(".")[0] for name in sys.modules}}
print(seconds, *loaded & {{"torch", "r3dpa", "lightning", "yaml", "tqdm", "filelock"}})
"""
    command = [sys.executable, "-c", code]
    for _ in range(3):  # a first import may read from a cold disk
        run = subprocess.run(command, capture_output=True, text=True, check=True)
        seconds, *loaded = run.stdout.split()
        assert not loaded
        if float(seconds) < 0.3:
            return
    pytest.fail(f"lidarsim takes {seconds} s to import")


def test_sampling_loads_neither_lightning_nor_baselines():
    code = """
import sys
import r3dpa.scene_files.sample, r3dpa.scene_files.generated, r3dpa.stages, r3dpa.viz.scenes
print(*{"lightning", "r3dpa.baselines", "r3dpa.modules"} & set(sys.modules))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []
