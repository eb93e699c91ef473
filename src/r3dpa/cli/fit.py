"""Commands whose parsers need Lightning: simple mistakes are answered before it is imported."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

import yaml

from r3dpa.cli.class_arguments import class_arguments, trainer_arguments
from r3dpa.cli.messages import suggestion
from r3dpa.cli.presets import (
    DEFAULT_PRESET,
    check_known,
    expand_preset,
    preset_names,
    shipped,
    stage_files,
)
from r3dpa.feature_names import SOURCES
from r3dpa.pretrained import weights_file

# Options of the stage commands and of Lightning, or the first part of their names.
_OPTIONS = (
    "help",
    "config",
    "print_config",
    "preset",
    "run_dir",
    "dry_run",
    "columns",
    "ckpt_path",
    "allow_import",
    "model",
    "data",
    "trainer",
    "checkpoint",
    "scorer",
    "optimizer",
    "lr_scheduler",
    "seed_everything",
    "weights_only",
    "return_predictions",
    "verbose",
    "datamodule",
)
_FEATURE_OPTIONS = (
    "help",
    "config",
    "print_config",
    "data",
    "columns",
    "extractor",
    "ckpt",
    "grid_sizes",
    "out",
    "trainer",
)
_PREPARE_OPTIONS = ("help", "config", "print_config", "data")
_CHECKPOINT_OPTIONS = (
    "--ckpt_path",
    "--model.init_args.init_from",
    "--model.init_args.rgb_weights",
)
_YAML = (".yaml", ".yml")
_CLASS_KEYS = ("init_args", "dict_kwargs", "help")  # beside arguments of a class
_CHECKPOINT_WORDS = ("last", "null")  # of --ckpt_path, beside files


def run(args: list[str]) -> None:
    """Run a stage command, ``["fit", "joint"]``, and answer simple mistakes at once.

    Raises:
        ValueError: If there is no such stage or preset.
        FileNotFoundError: If a checkpoint does not exist.
    """
    command, words = args[0], args[1:]
    _check_words(command, words)
    if "--dry_run" in words and command != "fit":
        _refuse(command, "--dry_run is an option of r3dpa fit")
    overview = _overview(command)
    if "-h" in words or "--help" in words:
        sys.stdout.write(f"{overview}\n")
        sys.stdout.flush()  # the options of Lightning follow after seconds
    elif not _names_stage(words):
        sys.stderr.write(f"{overview}\n\n")
        _refuse(command, "give a stage, or --config FILE")
    expanded = expand_preset(words)  # refuses an unknown stage or preset
    check_class_arguments(command, expanded.words)
    from r3dpa.cli.stages import run as run_stage

    run_stage(args)


def features(args: list[str]) -> None:
    """Run ``data features``, given its name and the words after it.

    Raises:
        ValueError: If the data do not exist, or the feature source is unknown.
    """
    for option, value in _options(args[1:]):
        is_path = "/" in value or value.endswith(_YAML)
        if option == "--data" and is_path and not shipped(value).exists():
            raise ValueError(f"--data {value}: no such folder of scans or data YAML")
        if option == "--extractor":
            check_known("feature source", value, SOURCES)
        _check_option("data features", option, _FEATURE_OPTIONS)
        _check_config("data features", option, value)
    from r3dpa.cli.features import features as write_features

    write_features(args)


def prepare(args: list[str]) -> None:
    """Run ``data prepare``, given its name and the words after it, and refuse simple mistakes."""
    words = args[1:]
    for option, value in _options(words):
        _check_option("data prepare", option, _PREPARE_OPTIONS)
        _check_config("data prepare", option, value)
    check_class_arguments("data prepare", words)
    from r3dpa.cli.features import prepare as prepare_data

    prepare_data(args)


def _names_stage(words: list[str]) -> bool:
    """Whether the words start with a stage, or give a configuration or a model."""
    if words and not words[0].startswith("-"):
        return True
    return any(word.startswith(("--config", "--model", "-c")) for word in words)


def _overview(command: str) -> str:
    """Return the usage, stages and presets that the help of a stage command begins with."""
    lines = [f"usage: r3dpa {command} STAGE [--preset NAME] [options]"]
    lines += [f"       r3dpa {command} --config FILE [--config FILE ...] [options]", "", "stages:"]
    for stage, path in stage_files().items():
        comment = path.read_text().partition("\n")[0].removeprefix("# ")
        lines.append(f"  {stage:<17}{comment.partition(': ')[0].rstrip(':.')}")
    lines += ["", f"presets (data; default: {DEFAULT_PRESET}):", f"  {', '.join(preset_names())}"]
    lines += ["", "A run writes to --run_dir; --ckpt_path last resumes it."]
    if command == "fit":
        lines += ["--dry_run prints batch, time, memory and disk of a run, and writes nothing."]
    return "\n".join(lines)


def _refuse(command: str, problem: str) -> NoReturn:
    """Print a usage error as the parsers do, and exit."""
    sys.stderr.write(f"r3dpa {command}: {problem}; see r3dpa {command} --help\n")
    sys.exit(2)


def _options(words: list[str]) -> Iterator[tuple[str, str]]:
    """Options and the word after each, or the text after its ``=``."""
    for word, following in pairwise([*words, ""]):
        option, equals, value = word.partition("=")
        if option.startswith("--") or option == "-c":
            yield "--config" if option == "-c" else option, value if equals else following


def _check_option(command: str, option: str, known: tuple[str, ...]) -> None:
    """Refuse an unknown option."""
    name = option[2:].partition(".")[0].rstrip("+")
    if not any(other.startswith(name) for other in known):  # argparse takes short forms
        near = suggestion(option, [f"--{other}" for other in known])
        _refuse(command, f"unknown option {option}{near}")
    _check_trainer_option(command, option)


def _check_config(command: str, option: str, value: str) -> None:
    """Refuse a YAML file that does not exist."""
    if option == "--config" and value.endswith(_YAML) and not shipped(value).exists():
        _refuse(command, f"--config: no file {value}")


def _check_trainer_option(command: str, option: str) -> None:
    """Refuse an option that names no argument of the trainer."""
    group, _, keys = option.partition(".")
    name = keys.partition(".")[0].rstrip("+")
    if group == "--trainer" and name:
        known = ["help", *trainer_arguments()]
        if not any(argument.startswith(name) for argument in known):
            near = suggestion(name, known, "--trainer.")
            _refuse(command, f"unknown option {option}{near}")


def check_class_arguments(command: str, words: list[str]) -> None:
    """Refuse an option that names no argument of the class of the model or the data.

    That is the class which the words before the option chose, as for the parser.
    """
    class_paths = {"model": "", "data": ""}
    for option, value in _options(words):
        group, _, keys = option[2:].partition(".")
        name = keys.removeprefix("init_args.").partition(".")[0].rstrip("+")
        if option == "--config" and value.endswith(_YAML):
            class_paths |= _class_paths(shipped(value))
        elif group in class_paths and name in ("", "class_path"):
            class_paths[group] = value
        elif group in class_paths and name not in _CLASS_KEYS:
            known = class_arguments(class_paths[group])
            if known and name not in known:
                _refuse(command, f"unknown option {option}{suggestion(name, known)}")


def _class_paths(path: Path) -> dict[str, str]:
    """Classes of the model and the data in a YAML file, where it names them."""
    try:
        config = yaml.safe_load(path.read_text())
    except yaml.YAMLError:  # which the parser reports
        return {}
    class_paths = {}
    for group in ("model", "data"):
        section = config.get(group) if isinstance(config, dict) else None
        class_path = section.get("class_path") if isinstance(section, dict) else section
        if isinstance(class_path, str):
            class_paths[group] = class_path
    return class_paths


def _check_words(command: str, words: list[str]) -> None:
    """Refuse unknown options and absent files, as far as that needs no class."""
    checkpoint_options = () if "--print_config" in words else _CHECKPOINT_OPTIONS
    for option, value in _options(words):
        _check_option(command, option, _OPTIONS)
        _check_config(command, option, value)
        is_file = value not in _CHECKPOINT_WORDS and not value.startswith("hf:/")
        if option in checkpoint_options and is_file:
            try:
                weights_file(value)
            except FileNotFoundError as error:
                raise FileNotFoundError(f"{option}: {error}") from None
