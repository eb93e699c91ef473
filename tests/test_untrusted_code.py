"""No file can run code: calls that may run what a file says are found in the source."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.fuzz
PACKAGE = Path(__file__).resolve().parents[1] / "src" / "r3dpa"
#: Restricted unpicklers, each of which looks every class up in a table.
UNPICKLERS = {"metrics/official_statistics.py"}
_DANGER = re.compile(
    r"(eval|exec|compile|__import__|torch\.hub\.load|.*\.load_from_checkpoint)\(.*"
    r"|(pickle|dill|cloudpickle|joblib|marshal|shelve)\.(loads?|_?Unpickler)\(.*"
    r"|torch\.(jit\.)?load\((?!.*weights_only=True).*"
    r"|.*allow_pickle=(?!False).*|np\.lib\.format\.read_array\((?!.*allow_pickle=False).*"
    r"|yaml\.(unsafe_|full_)load.*|yaml\.load\((?!.*(Safe|_)).*",
    re.DOTALL,
)


def dangers(source: str) -> list[str]:
    """Calls in a source that may run what a file says."""
    nodes = list(ast.walk(ast.parse(source)))
    calls = [node for node in nodes if isinstance(node, ast.Call)]
    suspects = [
        call
        for call in calls
        if re.search(r"eval|exec|compile|import|load|Unpickler|read_array", ast.unparse(call.func))
        or any(keyword.arg == "allow_pickle" for keyword in call.keywords)
    ]
    imports = [ast.unparse(node) for node in nodes if isinstance(node, ast.ImportFrom)]
    found = [call for call in map(ast.unparse, suspects) if _DANGER.fullmatch(call)]
    return found + [line for line in imports if re.match(r"from (torch|yaml|pickle) .*load", line)]


def test_nothing_runs_what_a_file_says():
    found = {path.relative_to(PACKAGE).as_posix(): path for path in PACKAGE.rglob("*.py")}
    found = {name: dangers(path.read_text()) for name, path in found.items()}
    assert not {name: calls for name, calls in found.items() if calls and name not in UNPICKLERS}


BAD = ["torch.load(f)", "torch.load(f, weights_only=False)", "from torch import load"]
BAD += ["torch.hub.load(a, b)", "np.load(f, allow_pickle=True)", "np.lib.format.read_array(f)"]
BAD += ["pickle.loads(b)", "pickle.Unpickler(f).load()", "joblib.load(f)", "yaml.load(t)"]
BAD += ["yaml.load(t, yaml.FullLoader)", "yaml.unsafe_load(t)", "eval(t)"]
BAD += ["Module.load_from_checkpoint(p)"]


@pytest.mark.parametrize("source", BAD)
def test_dangers_are_found(source):
    assert dangers(source)


def test_safe_calls_pass():
    calls = ["torch.load(f, weights_only=True)", "np.load(f, allow_pickle=False)"]
    assert not dangers("\n".join([*calls, "yaml.safe_load(t)", "network.eval()", "np.load(f)"]))
