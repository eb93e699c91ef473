"""The ``r3dpa`` command: one table of commands, whose files are imported when they run."""

from __future__ import annotations

import signal
import sys
from typing import NamedTuple

__all__ = ["COMMANDS", "main"]


class Command(NamedTuple):
    """Function ``file:name`` below ``r3dpa.cli``, or of another module, and summary for the help.

    jsonargparse reads the function: its arguments are the options, its docstring is the help, and
    what it returns is printed. Functions of :data:`OWN_PARSER` take the words of the command line.
    A ``resumable`` command continues its work when it is repeated after an interrupt.
    """

    target: str
    summary: str
    resumable: bool = False


COMMANDS = {
    "fit": Command("fit:run", "train a stage: r3dpa fit joint --preset demo"),
    "validate": Command("fit:run", "evaluate on the validation split"),
    "test": Command("fit:run", "sample scenes and compare them with real scans"),
    "predict": Command("fit:run", "reconstruct scans with a checkpoint"),
    "data simulate": Command("lidarsim:simulate", "write simulated scans", True),
    "data check": Command("data:check", "list bad scans and missing folders of a data set"),
    "data convert": Command("lidarsim.conversion:convert", "write scans in another format"),
    "data view": Command("data:view", "draw scans: pictures and a page with point clouds"),
    "data prepare": Command("fit:prepare", "simulate the scans of a data YAML", resumable=True),
    "data features": Command("fit:features", "write feature grids of scans", resumable=True),
    "data objects": Command("data:objects", "write mean features of object classes for inpaint"),
    "data sensors": Command("data:sensors", "list sensor presets"),
    "data sensor": Command("data:sensor", "estimate a sensor from its scans"),
    "data plan": Command("data:plan", "plan how to fine-tune r3dpa-s on scans of a sensor"),
    "data reference": Command("evaluate:reference", "write statistics of real scans", True),
    "data weather": Command("weather:weather", "simulate weather on recorded scans", True),
    "data corrupt": Command("weather:corrupt", "add sensor faults to recorded scans", True),
    "data realism": Command("evaluate:realism", "compare simulated scans with real ones"),
    "sample": Command(
        "r3dpa.scene_files.sample:sample", "generate scenes from a checkpoint", resumable=True
    ),
    "gallery": Command("gallery:gallery", "write a page of scenes, nearest scans and edits"),
    "edit inpaint": Command("edit:inpaint", "generate a part of a scan anew"),
    "edit mix": Command("edit:mix", "generate scenes that follow one scan on each side"),
    "edit complete": Command("edit:complete", "fill a missing sector or dropped beams", True),
    "edit vary": Command("edit:vary", "generate scenes similar to a scan"),
    "edit interpolate": Command("edit:interpolate", "generate the scenes between two scans"),
    "evaluate": Command("evaluate:evaluate", "compare samples of any generator with real scans"),
    "models": Command(
        "r3dpa.pretrained:models", "list trained weights; --name r3dpa-s shows a card"
    ),
    "cite": Command("r3dpa.citations:cite", "print BibTeX of what a checkpoint used"),
    "convert": Command("runs:convert", "convert checkpoints from and to the official layout"),
    "report": Command("runs:report", "draw the loss curves of a run and list the losses"),
    "replay": Command("runs:replay", "repeat a skipped step to find the layer that failed"),
    "ablate": Command("bench:ablate", "train and compare the paper's ablations", resumable=True),
    "bench sampling": Command("bench:sampling", "measure accuracy against sampling time", True),
    "bench training": Command("bench:training", "measure time and memory of training steps"),
    "completion": Command("completion:completion", "print a script that completes in bash"),
}
OWN_PARSER = ("fit:run", "fit:features", "fit:prepare")
# Commands of `data` and `edit` are known by their own name, too: `r3dpa view` is `r3dpa data view`.
ALIASES = {
    name.split()[1]: name
    for name in COMMANDS
    if name.startswith(("data ", "edit ")) and name.split()[1] not in COMMANDS
}
GROUPS = tuple(dict.fromkeys(name.split()[0] for name in COMMANDS if " " in name))


def _help(group: str) -> str:
    shown = {name: command for name, command in COMMANDS.items() if name.startswith(group)}
    lines = [f"  {name:<17}{command.summary}" for name, command in shown.items()]
    title = [] if group else ["Generate LiDAR scenes (R3DPA).", ""]
    end = "r3dpa COMMAND --help lists the options. `data` and `edit` may be left out, but for\n"
    end += "`data convert`, since `convert` is a command of its own.\n"
    end += "--allow_import PACKAGE lets a configuration name classes of a package that you trust."
    usage = " ".join(filter(None, ("usage: r3dpa", group, "COMMAND [options]")))
    return "\n".join([usage, "", *title, *lines, "", end])


def _find(args: list[str]) -> tuple[str, list[str]]:
    name = " ".join(args[: 2 if args[0] in GROUPS else 1])
    rest = args[len(name.split()) :]
    name = ALIASES.get(name, name)
    if name not in COMMANDS:
        from r3dpa.cli.messages import suggestion

        near = suggestion(name, [*COMMANDS, *ALIASES])
        hint = near or f"; choose from {', '.join(COMMANDS)}"
        sys.stderr.write(f"r3dpa: unknown command '{name}'{hint}\n")
        sys.exit(2)
    return name, rest


def _run(args: list[str]) -> None:
    if args == ["--version"]:
        from r3dpa import __version__

        sys.stdout.write(f"{__version__}\n")
        return
    group = args[0] if args and args[0] in GROUPS else ""
    rest = args[1:] if group else args
    if not rest or rest[0] in ("-h", "--help"):
        sys.stdout.write(f"{_help(group)}\n")
        return
    name, words = _find(args)
    prog = f"r3dpa {' '.join(args[: len(args) - len(words)])}"  # as it was typed
    from r3dpa.cli.parser import allow_imports, load, run_function

    command = COMMANDS[name]
    try:
        words = allow_imports(words)
        function = load(command.target)
        if command.target in OWN_PARSER:
            result = function([name, *words])
        else:
            result = run_function(function, words, prog)
    except KeyboardInterrupt:
        note = "; the same command continues" if command.resumable else ""
        if note and "--overwrite" in words:
            note = "; the same command without --overwrite continues"
        sys.stderr.write(f"{prog}: stopped{note}\n")
        sys.exit(130)  # as a shell reports an interrupt
    if result is not None:
        sys.stdout.write(f"{result}\n")


def main(args: list[str] | None = None) -> None:
    """Run the command line.

    Args:
        args: Words after ``r3dpa``. Default: the arguments of the process, with errors about files
            or values as one line on the terminal instead of a traceback.
    """
    if args is not None:
        _run(args)
        return
    args = sys.argv[1:]
    # As Ctrl-C: SIGTERM alone would end without a message, and Lightning handles only SIGINT.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        _run(args)
    except (ValueError, OSError) as error:
        if getattr(error, "during_training", False):
            raise
        message = str(error)
        if message.startswith("Caught "):  # in a process of a data loader, with its traceback
            message = message.strip().splitlines()[-1].partition(": ")[2]
        name = " ".join(args[: 2 if args[0] in GROUPS else 1])
        sys.exit(f"r3dpa {name}: {message}")
