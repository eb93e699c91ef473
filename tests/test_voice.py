"""Phrases that readers had to decode, and names that say nothing, stay out of the project."""

from __future__ import annotations

import ast
import json
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
UNIT = r"[kMG]?B|[µm]?s|h|seconds|minutes|hours|nats|bits|bytes|FLOP"
WHOLE = r"scan|scene|pixel|core|step|batch|point|image|beam|cell|space|file"

#: Pattern, whose letters match in either case -> what to write in its place.
BANNED = {
    r"\b(those|that) of\b": "the noun: 'the weights of the checkpoint', or 'as in ...'",
    r"\b(is|are) an? ``\w+Error``": "a section Raises:, or 'raises ``ValueError`` if ...'",
    r"there (is|are) no [^.;:]+; there (is|are)": "unknown class 'x'; choose from a, b, c",
    r"(?<![a-z])(asked|told)(?![a-z])": "what happens: requested, required, predicted, reported",
    rf"(\b(one|two|three|four|five|\d)|\b({UNIT})) a ({WHOLE})\b": "per: '131 kB per scan'",
    r"\b(core|time|steps|turns) a (scan|scene|stage|second)\b|\ba scan and core\b": "per",
    r"\bnone for none\b": "'None for no split', or 'default: no split'",
    r"\b(per|every|each|what) (this|so|that) many\b": "'every n-th scan', or the unit",
    r"(?<=\. )(trained|known|kept|written|given) are\b": "a subject: 'Trains the VAE, ...'",
    r"[\"'] \* bool\(": "an if expression",
    r"\bdict\(locals\(\)\)": "the names that are meant",
    r"json\.loads\(\s*json\.dumps\(": "r3dpa.io.json_values",
}

#: Words that hide what a variable holds, and for functions also what they do.
NO_VARIABLES = {"found", "own", "made", "one", "told", "asked"}
NO_FUNCTIONS = NO_VARIABLES | {"filled", "kept", "given", "taken"}


@cache
def lines() -> dict[Path, str]:
    """Files, of notebooks the cells, as one line each: no sentence or string is wrapped."""
    texts = {}
    for suffix in (".py", ".md", ".yaml", ".html", ".js"):
        for folder in ("src", "conf"):
            for path in sorted((ROOT / folder).rglob(f"*{suffix}")):
                texts[path] = path.read_text()
    for path in (*sorted(ROOT.glob("*.md")), *sorted((ROOT / "notebooks").glob("*.md"))):
        texts[path] = path.read_text()
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text())["cells"]
        texts[path] = "\n\n".join("".join(cell["source"]) for cell in cells)
    wrapped = re.compile(r"\"?\s*\n\s*(# ?|f?\"(?=\w))?")
    return {path: wrapped.sub(" ", text) for path, text in texts.items()}


@cache
def sources() -> dict[Path, ast.Module]:
    paths = sorted((ROOT / "src").rglob("*.py"))
    return {path: ast.parse(path.read_text()) for path in paths}


@pytest.mark.parametrize("pattern", BANNED)
def test_no_banned_phrase(pattern):
    hits = []
    for path, line in lines().items():
        for match in re.finditer(pattern, line, re.IGNORECASE):
            around = line[max(match.start() - 60, 0) : match.end() + 60]
            hits.append(f"{path.relative_to(ROOT)}: {around}")
    assert not hits, f"write {BANNED[pattern]}:\n" + "\n".join(hits)


def test_names_of_functions_and_variables_say_what_they_hold():
    hits = []
    for path, tree in sources().items():
        for node in ast.walk(tree):
            name, banned = "", NO_VARIABLES
            if isinstance(node, ast.FunctionDef):
                name, banned = node.name, NO_FUNCTIONS
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                name = node.id
            elif isinstance(node, ast.arg):
                name = node.arg
            if name.strip("_") in banned:
                hits.append(f"{path.relative_to(ROOT)}:{node.lineno}: {name}")
    assert not hits, "\n".join(hits)


def test_errors_begin_in_lower_case_and_end_without_a_period():
    hits = []
    for path, tree in sources().items():
        for node in ast.walk(tree):
            if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)):
                continue
            for message in node.exc.args[:1]:
                parts = message.values if isinstance(message, ast.JoinedStr) else [message]
                words = [str(part.value) for part in parts if isinstance(part, ast.Constant)]
                first = words[0] if isinstance(parts[0], ast.Constant) else ""
                last = words[-1] if isinstance(parts[-1], ast.Constant) else ""
                # Names of classes, as RePaint, and abbreviations may begin a message.
                if re.match(r"[A-Z][a-z]*\b", first) or last.endswith("."):
                    hits.append(f"{path.relative_to(ROOT)}:{node.lineno}: {first}...{last}")
    assert not hits, "\n".join(hits)
