"""Usage errors in one line: the option as it is typed, what is wrong, and the nearest name."""

from __future__ import annotations

import argparse
import inspect
import pydoc
from collections.abc import Iterable, Sequence
from dataclasses import is_dataclass
from difflib import get_close_matches

from jsonargparse import ArgumentParser

ALLOWED_PACKAGES = ("r3dpa", "lidarsim", "lightning", "torch.nn", "torch.optim")
"""Packages whose classes a configuration may name without ``--allow_import``."""
_NO_INTEGER = "invalid literal for int() with base 10: "
_REQUIRED, _UNKNOWN = "the following arguments are required: ", "unrecognized arguments: "


def suggestion(name: str, known: Iterable[str], prefix: str = "") -> str:
    """Return `` (did you mean ...?)`` with the nearest known name, or nothing if none is near.

    ``prefix`` stands before that name, and does not count when names are compared.
    """
    nearest = get_close_matches(name, list(known), n=1)
    return f" (did you mean {prefix}{nearest[0]}?)" if nearest else ""


def describe_error(
    message: str,
    error: Exception | None,
    parser: argparse.ArgumentParser,
    words: Sequence[str] = (),
) -> str:
    """Describe an error of a parser in one line.

    jsonargparse raises the error of each level of a nested option from the error of the next level.
    The chain of causes names the option key by key, and its end is what is wrong.

    Args:
        message: What jsonargparse would print.
        error: Exception that it comes from, if any.
        parser: Parser of the command.
        words: Its words, for the names of options that have several.
    """
    options = [name for action in parser._actions for name in action.option_strings]
    if message.startswith(_REQUIRED):
        positional = {action.dest for action in parser._actions if not action.option_strings}
        # LightningCLI puts the name of the command in front: fit.model
        names = [key.rpartition(".")[2] for key in message.removeprefix(_REQUIRED).split(", ")]
        missing = [name if name in positional else f"--{name}" for name in names]
        return f"{', '.join(missing)} must be given"
    if message.startswith(_UNKNOWN + "--"):
        name = message.removeprefix(_UNKNOWN).split()[0].partition("=")[0]
        return f"unknown option {name}{suggestion(name, options)}"
    keys: list[str] = []
    owner = ""  # class that the next key is an argument of
    cause: BaseException | None = error
    reason = message
    while cause is not None:
        reason = str(cause)
        if isinstance(cause, TypeError) and reason.startswith('Parser key "'):
            keys += [*_init_args(owner), reason.split('"')[1]]
            reason = reason.partition(":")[2]
        elif reason.startswith("Problem with given class_path '"):
            owner = _quoted(reason)
        cause = cause.__cause__
    if reason.startswith("Importing '"):
        return (
            f"{_quoted(reason)} is not allowed: a configuration may name classes of "
            f"{', '.join(ALLOWED_PACKAGES)}, and of a package of yours after --allow_import PACKAGE"
        )
    if reason.startswith("Option '"):
        name = _quoted(reason)
        place = "".join(f"{key}." for key in [*keys, *_init_args(owner)])
        return f"unknown option --{place}{name}{suggestion(name, argument_names(owner))}"
    if not keys:
        return _plain(reason)
    named = [action for action in parser._actions if action.dest == keys[0]]
    names = [name for action in named for name in action.option_strings or [action.dest]]
    typed = [name for name in names if name in words] or names or [f"--{keys[0]}"]
    return f"{'.'.join([typed[0], *keys[1:]])}: {_plain(reason)}"


def _init_args(owner: str) -> list[str]:
    """Key between a class chosen by its path and its arguments; fields of dataclasses need none."""
    return ["init_args"] if owner and not is_dataclass(pydoc.locate(owner)) else []


def argument_names(owner: str) -> list[str]:
    """Arguments of a class and of its base classes."""
    parser = ArgumentParser(exit_on_error=False)
    cls = pydoc.locate(owner)
    if inspect.isclass(cls):
        parser.add_class_arguments(cls, fail_untyped=False)
    return [action.dest for action in parser._actions]


def _plain(reason: str) -> str:
    """A reason of jsonargparse without its class names."""
    expected, _, value = " ".join(reason.split()).rstrip(".").partition(". Got value: ")
    if expected.startswith("Expected a typing.Literal["):
        choices = expected.partition("[")[2].rstrip("]").replace("'", "")
        return f"unknown value '{value}'; choose from {choices}"
    if expected.startswith("Expected a <class '"):
        expected = f"expected {_quoted(expected)}"
    number, _, limit = expected.partition(" does not conform to restriction v>")
    if limit:
        bound = f"{limit.removeprefix('=')} or greater" if "=" in limit else f"above {limit}"
        return f"expected a number {bound}, got {number}"
    if expected.startswith(_NO_INTEGER):
        return f"expected a whole number in digits, got {expected.removeprefix(_NO_INTEGER)}"
    if value:
        expected = f"{expected[0].lower()}{expected[1:]}, got '{value}'"
    return expected


def _quoted(text: str) -> str:
    """The first part of a text in single quotes."""
    return text.split("'")[1]
