"""No file can run code: what would read one that can is found in the source, outside one place."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "r3dpa"
#: The one unpickler, which looks every class up in a table.
UNPICKLER = "unpickling.py"
_NAMES = {"eval", "exec", "compile", "__import__"}
_MODULES = {"pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}
_UNPICKLING = re.compile(rf"({'|'.join(_MODULES)})\.(load|_?Unpickler$)")
_YAML = {"load", "load_all", "unsafe_load", "unsafe_load_all", "full_load", "full_load_all"}
_SAFE_LOADERS = {"SafeLoader", "CSafeLoader"}


def dangers(source: str) -> list[str]:
    """Calls and names in a source that may run what a file says, by line."""
    found, tree = [], ast.parse(source)
    safe = _SAFE_LOADERS | {
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        and any(ast.unparse(base).rpartition(".")[2] in _SAFE_LOADERS for base in node.bases)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module in {
            *_MODULES,
            "torch",
            "yaml",
            "numpy",
        }:
            found += [f"{node.lineno}: {a.name}" for a in node.names if "load" in a.name.lower()]
        if isinstance(node, ast.Attribute) and _UNPICKLING.match(ast.unparse(node)):
            found.append(f"{node.lineno}: {ast.unparse(node)}")
        if not isinstance(node, ast.Call):
            continue
        name, keys = ast.unparse(node.func), {k.arg: ast.unparse(k.value) for k in node.keywords}
        owner, _, last = name.rpartition(".")
        bad = name in _NAMES
        bad |= name in ("torch.load", "torch.jit.load") and keys.get("weights_only") != "True"
        bad |= name in ("torch.hub.load", "torch.package.PackageImporter")
        bad |= keys.get("allow_pickle", "False") != "False"
        bad |= last in ("read_array", "fromregex") and "allow_pickle" not in keys and owner != ""
        bad |= last == "load_from_checkpoint"
        if owner == "yaml" and last in _YAML:
            given = [ast.unparse(arg) for arg in node.args[1:]] + [keys.get("Loader", "")]
            bad |= last != "load" or not any(g.rpartition(".")[2] in safe for g in given)
        if bad:
            found.append(f"{node.lineno}: {name}")
    return found


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE))
)
def test_nothing_runs_what_a_file_says(path):
    found = dangers(path.read_text())
    if path.relative_to(PACKAGE).as_posix() == UNPICKLER:
        assert found
        assert all("pickle._Unpickler" in line for line in found)
    else:
        assert not found


@pytest.mark.parametrize(
    "source",
    [
        "torch.load(f)",
        "torch.load(f, weights_only=False)",
        "torch.load(f, weights_only=flag)",
        "from torch import load",
        "torch.hub.load(a, b)",
        "np.load(f, allow_pickle=True)",
        "np.lib.format.read_array(f)",
        "pickle.load(f)",
        "pickle.loads(b)",
        "pickle.Unpickler(f).load()",
        "from pickle import loads",
        "joblib.load(f)",
        "yaml.load(t)",
        "yaml.load(t, yaml.FullLoader)",
        "yaml.unsafe_load(t)",
        "from yaml import unsafe_load",
        "eval(t)",
        "exec(t)",
        "Module.load_from_checkpoint(p)",
    ],
)
def test_dangers_are_found(source):
    assert dangers(source)


@pytest.mark.parametrize(
    "source",
    [
        "torch.load(f, weights_only=True)",
        "np.load(f)",
        "np.load(f, allow_pickle=False)",
        "yaml.safe_load(t)",
        "yaml.load(t, yaml.SafeLoader)",
        "class A(yaml.SafeLoader): pass\nyaml.load(t, A)",
        "network.eval()",
        "json.loads(t)",
    ],
)
def test_what_is_safe_passes(source):
    assert not dangers(source)
