"""API pages of both packages: ``python tests/write_api_pages.py build/docs``."""

import importlib
import pkgutil
import sys
from collections.abc import Iterator
from pathlib import Path


def module_names(package: str) -> Iterator[str]:
    """Yield the names of a package and of all its modules."""
    module = importlib.import_module(package)
    for name in module.__all__:  # imported on first use, which pdoc does not trigger
        setattr(module, name, getattr(module, name))
    yield package
    for found in pkgutil.walk_packages(module.__path__, f"{package}."):
        if not found.name.endswith(".__main__"):
            yield found.name


def main() -> None:
    """Write the pages into the folder of the command line."""
    import pdoc
    import pdoc.render

    pdoc.render.configure(docformat="google")
    names = [name for package in ("lidarsim", "r3dpa") for name in module_names(package)]
    pdoc.pdoc(*names, output_directory=Path(sys.argv[1]))


if __name__ == "__main__":
    main()
