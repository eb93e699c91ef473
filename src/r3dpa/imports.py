"""Which classes a configuration may name: those of a few packages, unless the user allows more.

Whoever is handed a YAML file runs it without reading all of it. Importing a module already runs its
code, so a class of any other package is refused before its module is imported; an allowed module
that merely imports ``os`` gives no access to it, since what is named is also looked up where it is
defined.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from jsonargparse import set_parsing_settings
from lightning.pytorch.cli import LightningArgumentParser

__all__ = ["PACKAGES", "ConfigParser"]

#: Packages whose classes and functions every configuration may name. Of ``torch`` and ``lightning``
#: only what configurations need: ``torch.hub`` downloads and runs code, and
#: ``LightningModule.load_from_checkpoint`` can be told to unpickle.
PACKAGES = (
    "r3dpa",
    "torch.nn",
    "torch.optim",
    "torchmetrics",
    *(
        f"lightning.{part}"
        for part in (
            *(f"pytorch.{name}" for name in ("accelerators", "callbacks", "loggers", "plugins")),
            *("pytorch.profilers", "pytorch.strategies"),
            *(f"fabric.{name}" for name in ("accelerators", "loggers", "plugins", "strategies")),
        )
    ),
)
#: Parts of these that run what they are told to: commands, and the official code from elsewhere.
_REFUSED = ("r3dpa.bench", "r3dpa.cli")
_OPTION = "--allow-imports"
_DENIED = re.compile(r"Importing '([^']+)' is not allowed, denied by")
_KEY = re.compile(r'Parser key "([^"]+)"')


class ConfigParser(LightningArgumentParser):
    """Parser of configurations in which only classes of :data:`PACKAGES` can be named.

    Others need ``--allow-imports package[,package]`` on the command line; in a configuration file
    that key has no effect. The rule holds for the whole process from the first parsing on, since
    jsonargparse has one for all parsers; each parsing sets it anew.
    """

    _allowed_before: tuple[str, ...] = ()
    _words: tuple[str, ...] = ()

    def add_allow_imports(self) -> None:
        """Adds the option; not in the constructor, since every nested class has such a parser."""
        self.add_argument(
            "--allow_imports",
            _OPTION,
            type=str | None,
            help="packages, separated by commas, of which classes may be named beside those of "
            f"{', '.join(PACKAGES)}; their code is run",
        )

    def parse_args(  # type: ignore[override] # of argparse; jsonargparse's has more, too
        self, args: Sequence[str] | None = None, *more: Any, **options: Any
    ) -> Any:
        """Parses as usual, with the rule in force.

        Raises:
            ValueError: If a class of another package is named, with its place and the option; or
                if the option names no package.
        """
        words = sys.argv[1:] if args is None else list(args)
        added = tuple(_added(words))
        ConfigParser._words = tuple(map(str, words))
        set_parsing_settings(
            import_path_denylist=["*", *_REFUSED, *ConfigParser._allowed_before],
            import_path_allowlist=[*PACKAGES, *added],
        )
        ConfigParser._allowed_before = tuple(set(added) - set(PACKAGES))
        return super().parse_args(args, *more, **options)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Reports what is wrong; a refused class by its place, with what to do.

        Raises:
            ValueError: If a class is refused.
        """
        denied = _DENIED.search(message)
        if denied is None or not self.exit_on_error:  # parsers of nested classes do not exit
            super().error(message, ex)
        # The keys that lead to the class stand before it, from the outermost on.
        place = ".".join(_KEY.findall(message[: denied.start()]))
        files = _files_with(denied[1], self._words)
        raise ValueError(
            f"{files}configuration key {place}: class {denied[1]!r} is refused: only those of "
            "r3dpa, torch.nn, torch.optim, torchmetrics and parts of lightning may be named, since "
            f"to import one runs its code. If you trust it, give {_OPTION} "
            f"{denied[1].partition('.')[0]}"
        ) from None


def _files_with(class_path: str, words: Sequence[str]) -> str:
    """Files on the command line that contain a class path, as the beginning of a message."""
    paths = [Path(word.rpartition("=")[2]) for word in words]
    configs = [path for path in paths if path.suffix in (".yaml", ".yml") and path.is_file()]
    found = [str(path) for path in configs if class_path in path.read_text(errors="replace")]
    return "".join(f"{path}: " for path in found)


def _added(words: Sequence[str]) -> list[str]:
    """Packages that the command line allows.

    Raises:
        ValueError: If one is no name of a package.
    """
    found: list[str] = []
    for place, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name in (_OPTION, _OPTION.replace("-i", "_i")):
            found += (value if equals else next(iter(words[place + 1 :]), "")).split(",")
    packages = [package.strip() for package in found]
    for package in packages:
        if not all(part.isidentifier() for part in package.split(".")):
            raise ValueError(
                f"{_OPTION} needs names of packages, separated by commas, got {package!r}"
            )
    return packages
