"""Parser of a command from the function that does the work."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import is_dataclass
from importlib import import_module
from inspect import cleandoc
from itertools import zip_longest
from pathlib import Path
from types import UnionType
from typing import Any, NoReturn, Union, cast, get_args, get_origin

import yaml
from jsonargparse import (
    ArgumentParser,
    DefaultHelpFormatter,
    Namespace,
    get_loader,
    set_loader,
    set_parsing_settings,
)

from r3dpa.class_paths import current_path, with_current_paths
from r3dpa.cli.messages import ALLOWED_PACKAGES, describe_error
from r3dpa.pretrained import weights_file

# An argument of any type gets plain values alone: the classes of other packages, and those that
# nothing restricts to a base class, can start a shell.
set_parsing_settings(
    instantiate_subclass_spec_in_any=False,
    import_path_denylist=["*"],
    import_path_allowlist=list(ALLOWED_PACKAGES),
)
_load_yaml = get_loader("yaml")


def _load_yaml_of_any_version(text: str) -> Any:
    return with_current_paths(_load_yaml(text))


set_loader("yaml", _load_yaml_of_any_version, (yaml.YAMLError,))
# One word for one thing in all commands; the function's own name is an option as well.
_COMMON_NAMES = {"limit": "--num", "frames": "--num", "scenes": "--num", "jobs": "--workers"}
_BOOLEANS = ("true", "false", "yes", "no", "on", "off")  # of YAML
# Arguments whose files and folders must exist.
_INPUTS = (
    "source",
    "path",
    "run",
    "file",
    "scan",
    "left",
    "right",
    "mask",
    "objects",
    "samples",
    "reference",
    "scans",
    "data",
)


class HelpFormatter(DefaultHelpFormatter):
    """Help without ``default: null``, which each text explains, and with plain type names."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text = super()._get_help_string(action)
        if action.default is None:
            text = text.replace(", default: %(default)s", "")
        return text

    def _get_type_str(self, action: argparse.Action) -> str | None:
        name = super()._get_type_str(action)
        if name is None:
            return None
        if name.startswith("Optional["):
            name = name[len("Optional[") : -1]
        return name.removeprefix("<class '").removesuffix("'>").removesuffix(" | null")


class Parser(ArgumentParser):
    """Parser with errors in one line; ``--quick`` stands for ``--quick true``."""

    words: Sequence[str] = ()  # of the command line, for messages

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"formatter_class": HelpFormatter} | kwargs)

    def add_argument(self, *args: Any, **kwargs: Any) -> Any:
        """Add an argument; boolean ones need no value, and some have a second, common name."""
        if kwargs.get("type") is bool:
            kwargs |= {"nargs": "?", "const": True}
        name = args[0].removeprefix("--")
        is_count = name == "scans" and kwargs.get("type") is int  # elsewhere a folder
        if args[0] != name and (name in _COMMON_NAMES or is_count):
            args = ("--num" if is_count else _COMMON_NAMES[name], *args)
            kwargs["dest"] = name
        return super().add_argument(*args, **kwargs)

    def parse_args(self, args: Any = None, *others: Any, **settings: Any) -> Any:
        """Parse words, in which classes may have the import paths of earlier versions.

        ``None`` is read as ``null``: jsonargparse itself writes it so for the parser of a class.
        """
        words = []
        for word in sys.argv[1:] if args is None else args:
            name, equals, value = word.rpartition("=")  # --option=class or class
            value = "null" if value == "None" else current_path(value)
            words.append(f"{name}{equals}{value}")
        return super().parse_args(words, *others, **settings)

    def instantiate(self, *args: Any, **settings: Any) -> Any:
        """Make the objects; an error of an optional one is its own, not about each type."""
        try:
            return super().instantiate(*args, **settings)
        except ValueError as error:
            cause: BaseException = error
            while "Union subtypes" in str(cause) and isinstance(cause.__cause__, ValueError):
                cause = cause.__cause__
            raise cause from None

    def format_help(self, *formatter: Any) -> str:  # which jsonargparse 4.53 gives
        """Help of the options, and of the fields of each optional dataclass."""
        texts = [super().format_help(*formatter)]
        for action in self._actions:
            kinds = [k for k in get_args(getattr(action, "_typehint", None)) if k is not type(None)]
            if len(kinds) == 1 and is_dataclass(kinds[0]) and not action.dest.endswith(".help"):
                fields = ArgumentParser(add_help=False, formatter_class=HelpFormatter)
                fields.add_class_arguments(kinds[0], action.dest)
                texts.append(fields.format_help().partition("\n\n")[2])
        return re.sub(r"<class '([\w.]+)'>", r"\1", "\n".join(texts))

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Print the message and exit with status 2; parsers of nested classes raise it."""
        if not self.exit_on_error:
            super().error(message, ex)
        parser = getattr(ex, "subcommand_parser", None) or self
        prog = parser.prog.replace(" [options]", "")
        text = describe_error(message, ex, parser, self.words)
        sys.stderr.write(f"{prog}: {text}; see {prog} --help\n")
        sys.exit(2)


def add_flag_values(parser: Parser, words: Sequence[str]) -> list[str]:
    """Write ``true`` after each boolean option without a value.

    argparse would take the next word for it, such as the input of a command.
    """
    flags = {
        name
        for action in parser._actions
        if getattr(action, "_typehint", None) is bool
        for name in action.option_strings
    }
    completed: list[str] = []
    for word, following in zip_longest(words, words[1:], fillvalue=""):
        completed.append(word)
        if word in flags and following.lower() not in _BOOLEANS:
            completed.append("true")
    return completed


def join_list_words(parser: Parser, words: Sequence[str]) -> list[str]:
    """Write the words after each list option as one, as jsonargparse expects them.

    ``--box -10 10 -20 0``, ``--box -10,10,-20,0`` and ``--box '[-10, 10, -20, 0]'`` are the same.
    A word in brackets, or with commas between its items, is a whole list: the next one may be of
    the command.
    """
    item_types = {
        name: _item_types(getattr(action, "_typehint", None))
        for action in parser._actions
        for name in action.option_strings
    }
    joined: list[str] = []
    rest = list(words)
    while rest:
        name, equals, value = rest[0].partition("=")
        if not item_types.get(name):
            joined.append(rest.pop(0))
            continue
        rest.pop(0)
        items = [value] if equals else []
        while rest and not equals and not _is_option(rest[0]):
            items.append(rest.pop(0))
            if len(items) == 1 and _is_whole_list(items[0].strip()):
                break
        if items and not items[0].lstrip().startswith("["):
            items = [part.strip() for part in ",".join(items).split(",") if part.strip()]
            if not item_types[name] <= {int, float}:
                items = [json.dumps(item) for item in items]
            items = [f"[{', '.join(items)}]"]
        joined += [name, *items]
    return joined


def _is_whole_list(word: str) -> bool:
    """Whether a word holds all items of a list; more follow after a comma at its end."""
    if word.startswith("["):
        return word.endswith("]")
    return "," in word and not word.endswith(",")


def _is_option(word: str) -> bool:
    """Whether a word starts an option; a negative number does not."""
    return word.startswith("-") and not word[1:].lstrip(".")[:1].isdigit()


def _item_types(kind: Any) -> set[Any]:
    """Types of the items of a list or tuple, also of an optional one; empty for other types."""
    if get_origin(kind) in (list, tuple, Sequence):
        return set(get_args(kind))
    if get_origin(kind) in (Union, UnionType):
        return set[Any]().union(*(_item_types(member) for member in get_args(kind)))
    return set()


def allow_imports(words: Sequence[str]) -> list[str]:
    """Let files name classes of the packages after ``--allow_import``; return the other words.

    Files are configurations and checkpoints. These are words of the command line alone: no file can
    allow itself anything.
    """
    parser = argparse.ArgumentParser(prog="r3dpa", add_help=False, allow_abbrev=False)
    parser.add_argument("--allow_import", action="append", default=[], metavar="PACKAGE")
    given, others = parser.parse_known_args(list(words))
    set_parsing_settings(import_path_allowlist=given.allow_import)
    if given.allow_import:
        # Imported here: torch takes seconds, and most commands allow nothing.
        from r3dpa.checkpoints.networks import allow_networks_of

        allow_networks_of(given.allow_import)
    return others


def load(target: str) -> Callable[..., Any]:
    """Import the function of ``file:name`` below ``r3dpa.cli``, or of ``package.module:name``."""
    file, _, name = target.partition(":")
    module = import_module(file if file.startswith(("r3dpa.", "lidarsim")) else f"r3dpa.cli.{file}")
    return cast(Callable[..., Any], getattr(module, name))


def make_parser(function: Callable[..., Any], prog: str | None = None) -> Parser:
    """Make the parser of a function.

    Keyword-only arguments are options, as are all arguments of functions outside this package.
    """
    positional = function.__module__.startswith(("r3dpa.cli.", "lidarsim.conversion"))
    description = cleandoc(function.__doc__ or "").partition("\n\nArgs:")[0]
    parser = Parser(prog=prog, description=description)
    parser.add_argument("--config", action="config", help="YAML file with options")
    parser.add_function_arguments(function, as_positional=positional, as_group=False)
    return parser


def parse(
    function: Callable[..., Any], words: Sequence[str], prog: str
) -> tuple[Parser, Namespace]:
    """Make the parser of a function, and parse a command line with it."""
    parser = make_parser(function, prog)
    parser.words = words
    words = join_list_words(parser, add_flag_values(parser, words))
    return parser, parser.parse_args(words)


def run_function(function: Callable[..., Any], words: Sequence[str], prog: str) -> Any:
    """Call a function with the arguments of a command line; return its result."""
    parser, config = parse(function, words, prog)
    arguments = parser.instantiate(config).as_dict()
    arguments.pop("config", None)
    _check_inputs(parser, arguments)
    return function(**arguments)


def _check_inputs(parser: Parser, arguments: Mapping[str, Any]) -> None:
    """Refuse files that do not exist, before torch is imported, which takes seconds."""
    for name in ("ckpt", "decoder", "flow"):
        ckpt = arguments.get(name)
        if isinstance(ckpt, Path) and not str(ckpt).startswith("hf:/"):
            weights_file(ckpt)
    options = {action.dest for action in parser._actions if action.option_strings}
    for name in _INPUTS:
        path = arguments.get(name)
        if isinstance(path, Path) and not path.exists():
            option = f"--{name} " if name in options else ""
            raise ValueError(f"{option}{path}: no such file or folder")
