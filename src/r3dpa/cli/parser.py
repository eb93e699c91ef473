"""Parser of the commands that are plain functions."""

from __future__ import annotations

from typing import Any

from jsonargparse import ArgumentParser


class FlagParser(ArgumentParser):
    """Takes ``--quick`` for ``--quick true``."""

    def add_argument(self, *args: Any, **kwargs: Any) -> Any:
        """Adds an argument; the value of a boolean one may be left out."""
        if kwargs.get("type") is bool:
            kwargs |= {"nargs": "?", "const": True}
        return super().add_argument(*args, **kwargs)
