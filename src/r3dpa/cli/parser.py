"""Parsers with one-line errors, and lists as words; options that several commands share."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from types import UnionType
from typing import Any, Literal, NoReturn, Union, cast, get_args, get_origin

import yaml
from jsonargparse import (
    ArgumentParser,
    Namespace,
    get_loader,
    set_loader,
    set_parsing_settings,
)
from jsonargparse.typing import NonNegativeInt, PositiveInt

from r3dpa.class_paths import current_path, with_current_paths
from r3dpa.pretrained import DEFAULT_WEIGHTS

# Packages whose classes a configuration may name. An argument of any type gets plain values alone:
# the classes of other packages, and those that nothing restricts to a base, can start a shell.
_ALLOWED = ("r3dpa", "lidarsim", "lightning", "torch.nn", "torch.optim")
set_parsing_settings(
    instantiate_subclass_spec_in_any=False,
    import_path_denylist=["*"],
    import_path_allowlist=list(_ALLOWED),
)
_load_yaml = get_loader("yaml")


def _load_yaml_of_any_version(text: str) -> Any:
    return with_current_paths(_load_yaml(text))


set_loader("yaml", _load_yaml_of_any_version, (yaml.YAMLError,))
_DENIED = re.compile(r"Importing '([\w.]+)' is not allowed, .* set_parsing_settings to allow it")


class Parser(ArgumentParser):
    """Parser with errors in one line; ``--quick`` stands for ``--quick true``."""

    def add_argument(self, *args: Any, **kwargs: Any) -> Any:
        """Adds an argument; boolean ones need no value."""
        if kwargs.get("type") is bool:
            kwargs |= {"nargs": "?", "const": True}
        return super().add_argument(*args, **kwargs)

    def parse_args(self, args: Any = None, *others: Any, **settings: Any) -> Any:
        """Parses words, in which classes may have the import paths of earlier versions."""
        words = []
        for word in sys.argv[1:] if args is None else args:
            name, equals, value = word.rpartition("=")  # --option=class or class
            words.append(f"{name}{equals}{current_path(value)}")
        return super().parse_args(words, *others, **settings)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Prints the message and exits with status 2; parsers of nested classes raise it."""
        if not self.exit_on_error:
            super().error(message, ex)
        parser = getattr(ex, "subcommand_parser", None) or self
        prog = parser.prog.replace(" [options]", "")
        sys.stderr.write(f"{prog}: {_short(message)}; see {prog} --help\n")
        sys.exit(2)


def _short(message: str) -> str:
    """An error of jsonargparse in one line, without the types that a union tried."""
    denied = _DENIED.search(message)
    if denied is not None:
        return (
            f"{denied[1]} is not allowed: a configuration may name classes of "
            f"{', '.join(_ALLOWED)}, and of a package of yours after --allow_import PACKAGE"
        )
    head, _, tail = message.partition("Does not validate against any of the Union subtypes")
    causes = re.search(r"Errors:\s*(.*?)\s*Given value type:", tail, re.DOTALL)
    if causes is not None:
        found = re.split(r"(?:^|\s)- (?=[A-Z])", " ".join(causes[1].split()))
        found = [c for c in found if c and "null" not in c and "Expected a path" not in c]
        value = tail.rpartition("Given value: ")[2].strip()
        message = f"{head}{found[0] if found else 'cannot be used'} (got {value})"
    message = re.sub(r'Parser key "([^"]+)": ', r"--\1: ", " ".join(message.split()).rstrip("."))
    return re.sub(r"Expected an? <class '(\w+)'>", r"expected \1", message)


def _with_lists(parser: Parser, words: Sequence[str]) -> list[str]:
    """The words, those of a list as one.

    ``--box -10 10 -20 0``, ``--box -10,10,-20,0`` and ``--box '[-10, 10, -20, 0]'`` are the same.
    """
    types = {
        name: _item_types(getattr(action, "_typehint", None))
        for action in parser._actions
        for name in action.option_strings
    }
    joined: list[str] = []
    rest = list(words)
    while rest:
        name, equals, value = rest[0].partition("=")
        joined.append(rest.pop(0))
        if not types.get(name):
            continue
        items = [value] if equals else []
        while rest and not equals and re.match(r"[^-]|-\.?\d|$", rest[0]):  # no option
            items.append(rest.pop(0))
        if items and not items[0].lstrip().startswith("["):
            parts = [part.strip() for item in items for part in item.split(",")]
            quoted = parts if types[name] <= {int, float} else map(json.dumps, parts)
            items = [f"[{', '.join(quoted)}]"]
        joined = [*joined[:-1], name, *items]
    return joined


def _item_types(kind: Any) -> set[Any]:
    """Types of the items of a list or tuple, also of an optional one; empty for other types."""
    if get_origin(kind) in (list, tuple, Sequence):
        return set(get_args(kind))
    union = get_origin(kind) in (Union, UnionType)
    return set().union(*map(_item_types, get_args(kind))) if union else set()


def allow_imports(words: Sequence[str]) -> list[str]:
    """Let configurations name the packages after ``--allow_import``; return the other words.

    These are words of the command line alone: no configuration can allow itself anything.
    """
    parser = argparse.ArgumentParser(prog="r3dpa", add_help=False, allow_abbrev=False)
    parser.add_argument("--allow_import", action="append", default=[], metavar="PACKAGE")
    given, others = parser.parse_known_args(list(words))
    set_parsing_settings(import_path_allowlist=given.allow_import)
    return others


def load(target: str) -> Callable[..., Any]:
    """The function of ``file:name`` below ``r3dpa.cli``, or of ``package.module:name``."""
    file, _, name = target.partition(":")
    module = import_module(file if file.startswith(("r3dpa.", "lidarsim")) else f"r3dpa.cli.{file}")
    return cast(Callable[..., Any], getattr(module, name))


def parse(
    function: Callable[..., Any], words: Sequence[str], prog: str
) -> tuple[Parser, Namespace]:
    """Parser of a function and the values of a command line.

    Keyword-only arguments are options, and so are those of functions outside this package.
    """
    positional = function.__module__.startswith(("r3dpa.cli.", "lidarsim.conversion"))
    description = cleandoc(function.__doc__ or "").partition("\n\nArgs:")[0]
    parser = Parser(prog=prog, description=description)
    parser.add_argument("--config", action="config", help="YAML file with options")
    parser.add_function_arguments(function, as_positional=positional, as_group=False)
    return parser, parser.parse_args(_with_lists(parser, words))


def run_function(function: Callable[..., Any], words: Sequence[str], prog: str) -> Any:
    """Calls a function with the arguments of a command line; returns its result."""
    parser, config = parse(function, words, prog)
    try:
        arguments = parser.instantiate(config).as_dict()
    except ValueError as error:  # of an optional dataclass: the cause is its own check
        if "Union subtypes" in str(error) and isinstance(error.__cause__, ValueError):
            raise error.__cause__ from None
        raise
    arguments.pop("config", None)
    return function(**arguments)


ODESolver = Literal["euler", "heun", "midpoint", "ab2", "ab3", "dpmpp_2m", "unipc"]


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Checkpoint that makes scenes, and files that they are written to.

    Args:
        ckpt: Checkpoint of stage joint or flow_matching, ``.ckpt`` or exported ``.safetensors``, a
            name of ``r3dpa models``, or ``hf://owner/name``.
        out: Folder for scenes, pictures, page and metadata; must not hold other scenes.
        seed: Scene i depends on (seed, i) alone, not on the batch size.
        batch_size: Scenes made together.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        weights: Averaged (``ema``) or last weights of the SiT.
        formats: Files of points: ``bin``, ``ply``, ``npz``; ``range_m.npy`` is always written.
        pictures: Number of scenes to draw.
        overwrite: Write into a folder that holds scenes already, and start anew.
    """

    out: Path
    ckpt: Path = Path(DEFAULT_WEIGHTS)
    seed: NonNegativeInt = 0
    batch_size: PositiveInt = 8
    device: str = "auto"
    weights: Literal["ema", "last"] = "ema"
    formats: tuple[Literal["bin", "ply", "npz"], ...] = ("bin",)
    pictures: NonNegativeInt = 16
    overwrite: bool = False

    def __post_init__(self) -> None:
        check_folder(self.out)


@dataclass(frozen=True, kw_only=True)
class EditOptions(SceneOptions):
    """Those of all edits.

    Args:
        solver: ODE solver, to noise and back; ``midpoint`` loses least on that way.
        steps: Solver steps of a whole way.
        shift: Finer steps near noise (above 1) or data (below 1).
    """

    solver: ODESolver = "midpoint"
    steps: int = 32
    shift: float = 1.0


def check_folder(out: Path | None) -> None:
    """Refuses an output folder whose place is taken by a file, before the work starts."""
    for folder in () if out is None else (out, *out.parents):
        if folder.is_file():
            raise ValueError(f"{folder} is a file; give another --out")


def check_file(out: Path | None) -> None:
    """Refuses an output file whose place is taken by a folder, before the work starts."""
    if out is not None and out.is_dir():
        raise ValueError(f"{out} is a folder; give --out the name of a file")
    check_folder(None if out is None else out.parent)
