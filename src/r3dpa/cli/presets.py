"""Stages and presets of ``r3dpa fit joint --preset demo``, known before torch is imported."""

from __future__ import annotations

import sys
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from r3dpa.cli.messages import suggestion
from r3dpa.pretrained import weights_file

DEFAULT_PRESET = "kitti360"
_STAGE_FOLDERS = ("experiment", "baseline")
# Options of the stage commands, those of Lightning included, or the first part of their names.
_OPTIONS = (
    *("help", "config", "print_config", "preset", "run_dir", "ckpt_path", "allow_import"),
    *("model", "data", "trainer", "checkpoint", "scorer", "optimizer", "lr_scheduler"),
    *("seed_everything", "weights_only", "return_predictions", "verbose", "datamodule"),
)
_CHECKPOINT_OPTIONS = (
    "--ckpt_path",
    "--model.init_args.init_from",
    "--model.init_args.rgb_weights",
)
_CHECKPOINT_WORDS = ("last", "best", "hpc", "null")  # of --ckpt_path, beside files


class StageWords(NamedTuple):
    """Words of a stage command, with the files of a stage in place of its name."""

    words: list[str]
    preset: str | None  # None where the words name files themselves


def conf_folder() -> Path:
    """Folder of the shipped configurations, in a checkout and in an installed package alike."""
    return Path(str(files("r3dpa") / "conf"))


def stage_files() -> dict[str, Path]:
    """Return the configurations that name a model, by stage; overlays such as ``*_demo`` do not."""
    paths = [
        p for folder in _STAGE_FOLDERS for p in sorted((conf_folder() / folder).glob("*.yaml"))
    ]
    return {path.stem: path for path in paths if "\n  class_path: " in path.read_text()}


def expand_preset(words: list[str]) -> StageWords:
    """Replace ``STAGE [--preset NAME]`` by the shipped configurations.

    Raises:
        ValueError: If there is no such stage or preset.
    """
    if not words or words[0].startswith("-"):
        return StageWords(words, None)
    stage, rest, preset = words[0], list(words[1:]), DEFAULT_PRESET
    if "--preset" in rest[:-1]:
        place = rest.index("--preset")
        preset = rest[place + 1]
        del rest[place : place + 2]
    conf, demo, stages = conf_folder(), preset == "demo", stage_files()
    _check_known("stage", stage, list(stages))
    _check_known("preset", preset, preset_names())
    data = "dead_leaves" if demo and stage in ("image_vae", "rgb_pretraining") else preset
    configs = [conf / "trainer.yaml", conf / "data" / f"{data}.yaml", stages[stage]]
    if demo:
        configs.insert(1, conf / "trainer_demo.yaml")
        overlay = stages[stage].with_stem(f"{stage}_demo")
        configs += [overlay] if overlay.is_file() else []
    expanded = [word for path in configs for word in ("--config", str(path))]
    return StageWords([*expanded, "--run_dir", f"runs/{preset}/{stage}", *rest], preset)


def preset_names() -> list[str]:
    """Return the names of the shipped data configurations."""
    return [path.stem for path in sorted((conf_folder() / "data").glob("*.yaml"))]


def run(args: list[str]) -> None:
    """Run a stage command, ``["fit", "joint"]``, and answer simple mistakes at once.

    Raises:
        ValueError: If a stage, preset or option is unknown.
        FileNotFoundError: If a configuration or checkpoint does not exist.
    """
    command, words = args[0], args[1:]
    overview = _overview(command)
    if "-h" in words or "--help" in words:
        sys.stdout.write(f"{overview}\n")
        sys.stdout.flush()  # the options of Lightning follow after seconds
    elif not any(word.startswith(("--config", "--model", "-c")) for word in words) and (
        not words or words[0].startswith("-")
    ):
        sys.stderr.write(f"{overview}\n\nr3dpa {command}: give a stage, or --config FILE\n")
        sys.exit(2)
    _check_words(expand_preset(words).words)
    from r3dpa.cli.stages import run as run_stage

    run_stage(args)


def _overview(command: str) -> str:
    """What a stage command takes, before the options that Lightning lists."""
    lines = [f"usage: r3dpa {command} STAGE [--preset NAME] [options]"]
    lines += [f"       r3dpa {command} --config FILE [--config FILE ...] [options]", "", "stages:"]
    for stage, path in stage_files().items():
        comment = path.read_text().partition("\n")[0].removeprefix("# ")
        lines.append(f"  {stage:<17}{comment.partition(': ')[0].rstrip(':.')}")
    lines += ["", f"presets (data; default: {DEFAULT_PRESET}):", f"  {', '.join(preset_names())}"]
    lines += ["", "A run writes to --run_dir; --ckpt_path last resumes it."]
    return "\n".join(lines)


def _check_known(kind: str, name: str, known: list[str]) -> None:
    if name not in known:
        near = suggestion(name, known)
        raise ValueError(f"unknown {kind} '{name}'{near}; choose from {', '.join(known)}")


def _check_words(words: list[str]) -> None:
    """Refuse unknown options and absent files, as far as that needs no class."""
    for place, word in enumerate(words):
        option, equals, value = word.partition("=")
        if not option.startswith("--"):
            continue
        name = option[2:].partition(".")[0].rstrip("+")
        if not any(known.startswith(name) for known in _OPTIONS):  # argparse takes short forms
            near = suggestion(option, [f"--{known}" for known in _OPTIONS])
            raise ValueError(f"unknown option {option}{near}")
        if not equals:
            value = words[place + 1] if place + 1 < len(words) else ""
        if option == "--config" and value.endswith((".yaml", ".yml")) and not Path(value).exists():
            raise FileNotFoundError(f"--config {value}: no such file")
        if option in _CHECKPOINT_OPTIONS and not value.startswith((*_CHECKPOINT_WORDS, "hf:/")):
            try:
                weights_file(value)
            except FileNotFoundError as error:
                raise FileNotFoundError(f"{option}: {error}") from None
