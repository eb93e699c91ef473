"""Arguments of classes, from their source files: to import the classes takes seconds."""

from __future__ import annotations

import ast
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path


@cache
def trainer_arguments() -> list[str]:
    """Arguments of Lightning's trainer."""
    package = find_spec("lightning")
    assert package is not None
    assert package.origin is not None
    return _arguments("Trainer", [Path(package.origin).parent / "pytorch/trainer/trainer.py"])


@cache
def class_arguments(class_path: str) -> list[str]:
    """Arguments of a class of this package, by its import path or name; none of other classes."""
    package, _, name = class_path.rpartition(".")
    if not package or package.startswith("r3dpa."):
        return _arguments(name, sorted(Path(str(files("r3dpa"))).rglob("*.py")))
    return []


def _arguments(name: str, sources: Sequence[Path]) -> list[str]:
    """Arguments of a class of the files; with ``**kwargs``, of its base classes too."""
    texts = (path.read_text(encoding="utf-8") for path in sources)
    text = next((text for text in texts if re.search(rf"^class {name}\b", text, re.MULTILINE)), "")
    names: list[str] = []
    for cls in ast.parse(text).body:
        if not isinstance(cls, ast.ClassDef) or cls.name != name:
            continue
        functions = [node for node in cls.body if isinstance(node, ast.FunctionDef)]
        init = next((function for function in functions if function.name == "__init__"), None)
        if init is not None:
            names += [argument.arg for argument in (*init.args.args[1:], *init.args.kwonlyargs)]
        if init is None or init.args.kwarg is not None:
            for base in cls.bases:
                if isinstance(base, ast.Name):
                    names += _arguments(base.id, sources)
    return names
