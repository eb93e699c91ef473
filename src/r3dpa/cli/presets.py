"""Stages and presets of ``r3dpa fit joint --preset demo``, known before torch is imported."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import yaml

from r3dpa.cli.messages import suggestion

DEFAULT_PRESET = "kitti360"
_STAGE_FOLDERS = ("experiment", "baseline")


class StageWords(NamedTuple):
    """Words of a stage command, with the files of a stage in place of its name."""

    words: list[str]
    preset: str | None  # None where the words name files themselves


def conf_folder() -> Path:
    """Folder of the shipped configurations, in a checkout and in an installed package alike."""
    return Path(str(files("r3dpa") / "conf"))


def shipped(path: str | Path) -> Path:
    """Return the file, or the one of the package where ``conf/...`` does not exist here."""
    of_package = conf_folder().parent / path
    is_shipped = not Path(path).exists() and of_package.exists()
    return of_package if is_shipped else Path(path)


def find_configs(words: Sequence[str]) -> list[str]:
    """Replace the files after ``--config`` or ``-c`` by those that :func:`shipped` finds.

    Raises:
        ValueError: If one is empty or no YAML: the parser itself would not name it.
    """
    replaced: list[str] = []
    for word in words:
        name, _, value = word.partition("=")
        if name in ("--config", "-c") and value:
            word = f"{name}={_checked(value)}"
        elif replaced and replaced[-1] in ("--config", "-c"):
            word = _checked(word)
        replaced.append(word)
    return replaced


def _checked(config: str) -> str:
    """Name of a configuration; refuses a file that is empty or no YAML."""
    if config.startswith("conf/"):
        config = str(shipped(config))
    if not config.endswith((".yaml", ".yml")) or not Path(config).is_file():
        return config  # the parser refuses it, or it is the text of one
    try:
        content = yaml.safe_load(Path(config).read_text(encoding="utf-8"))
    except UnicodeDecodeError as error:
        raise ValueError(f"{config}: is no text") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise ValueError(f"{config}{where}: {getattr(error, 'problem', 'is no YAML')}") from error
    if content is None:
        raise ValueError(f"{config}: is empty; a configuration has lines such as 'trainer:'")
    return config


def stage_files() -> dict[str, Path]:
    """Return the configurations that choose a model, by stage; overlays do not choose one."""
    stages = {}
    for folder in _STAGE_FOLDERS:
        for path in sorted((conf_folder() / folder).glob("*.yaml")):
            if "\nmodel:\n  class_path: " in path.read_text():
                stages[path.stem] = path
    return stages


def expand_preset(words: list[str]) -> StageWords:
    """Replace ``STAGE [--preset NAME]`` by the shipped configurations.

    Raises:
        ValueError: If there is no such stage or preset.
    """
    if not words or words[0].startswith("-"):
        return StageWords(words, None)
    parser = argparse.ArgumentParser(prog="r3dpa", add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", default=DEFAULT_PRESET)
    given, rest = parser.parse_known_args(words[1:])
    stage, preset = words[0], given.preset
    conf, demo, stages = conf_folder(), preset == "demo", stage_files()
    check_known("stage", stage, list(stages))
    check_known("preset", preset, preset_names())
    data = "dead_leaves" if demo and stage in ("image_vae", "rgb_pretraining") else preset
    configs = [conf / "trainer.yaml", conf / "data" / f"{data}.yaml", stages[stage]]
    if demo:
        configs.insert(1, conf / "demo" / "trainer.yaml")
        overlay = conf / "demo" / f"{stage}.yaml"
        configs += [overlay] if overlay.is_file() else []
    expanded = [word for path in configs for word in ("--config", str(path))]
    return StageWords([*expanded, "--run_dir", f"runs/{preset}/{stage}", *rest], preset)


def preset_names() -> list[str]:
    """Return the names of the shipped data configurations."""
    return [path.stem for path in sorted((conf_folder() / "data").glob("*.yaml"))]


def check_known(kind: str, name: str, known: Sequence[str]) -> None:
    """Refuse a name that is not known."""
    if name not in known:
        near = suggestion(name, known)
        raise ValueError(f"unknown {kind} '{name}'{near}; choose from {', '.join(known)}")
