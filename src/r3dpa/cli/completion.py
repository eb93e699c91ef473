"""``r3dpa completion``: tab completion of commands, stages and options."""

from __future__ import annotations

from typing import Literal

_SCRIPT = """\
_r3dpa() {{
    local current=${{COMP_WORDS[COMP_CWORD]}} words
    case "${{COMP_WORDS[*]:1:COMP_CWORD-1}} " in
{cases}
    esac
    COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o default -F _r3dpa r3dpa"""
# Of commands whose parsers need torch: the options that people type most.
_FEATURES = "--data --extractor --ckpt --grid_sizes --out --config --trainer.devices"
_STAGE = (
    "--preset --config --run_dir --dry_run --ckpt_path --print_config --model.init_args.init_from "
    "--model.init_args.rgb_weights --trainer.max_steps --trainer.devices "
    "--data.init_args.batch_size"
)


def completion(shell: Literal["bash"]) -> str:
    """Print the script that completes commands and options when the tab key is pressed.

    bash reads it at each start from a file that ``r3dpa completion bash`` fills once::

        r3dpa completion bash > ~/.local/share/bash-completion/completions/r3dpa

    Args:
        shell: Shell that runs the script.
    """
    from r3dpa.cli import ALIASES, COMMANDS, GROUPS
    from r3dpa.cli.presets import stage_files

    short_names = {name: alias for alias, name in ALIASES.items()}
    cases = []
    for name, command in COMMANDS.items():
        if command.target == "fit:run":
            cases.append(_case(f'"{name} "', f"{' '.join(stage_files())} {_STAGE}"))
            cases.append(_case(f'"{name} "*', _STAGE))
            continue
        patterns = [name, short_names[name]] if name in short_names else [name]
        parsed = {"data features": _FEATURES, "data prepare": "--config --data"}.get(name)
        options = parsed or _options_of(command.target)
        cases.append(_case("|".join(f'"{pattern} "*' for pattern in patterns), options))
    for group in GROUPS:
        members = [name.removeprefix(group).strip() for name in COMMANDS if name.startswith(group)]
        cases.append(_case(f'"{group} "', " ".join(members)))
    first = dict.fromkeys([*(name.split()[0] for name in COMMANDS), *ALIASES])
    cases.append(_case('" "', " ".join(first)))
    return _SCRIPT.format(cases="\n".join(cases))


def _case(pattern: str, words: str) -> str:
    return f'        {pattern}) words="{words}" ;;'


def _options_of(target: str) -> str:
    from r3dpa.cli.parser import load, make_parser

    names = [action.option_strings for action in make_parser(load(target))._actions]
    return " ".join(strings[0] for strings in names if strings and not strings[0].endswith("help"))
