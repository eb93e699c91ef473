"""Names that come from files, before they are trusted: they must stay below the folder they are in.

A feature store, a reference, an archive or a manifest of somebody else may hold any name, and a
later step that writes one file per name would leave its folder with ``../../.bashrc``.
"""

from __future__ import annotations

import re

__all__ = ["refuse_name"]

_DRIVE_LETTER = re.compile(r"[A-Za-z]:")
_MOST_CHARACTERS = 1024


def refuse_name(name: object) -> str | None:
    """Why a name must not become part of a path; None if it may.

    Allowed are relative names in the notation ``folder/name`` of any depth.

    Args:
        name: What a file gives as the name of a scan, sample or member.
    """
    if not isinstance(name, str) or not name:
        return f"must be text that is not empty, got {name!r:.80}"
    if len(name) > _MOST_CHARACTERS:
        return f"has {len(name)} characters, at most {_MOST_CHARACTERS} are read"
    if not name.isprintable():  # NUL and line breaks among them
        return f"holds characters that cannot be printed: {name!r:.80}"
    if name.startswith("/") or "\\" in name or _DRIVE_LETTER.match(name):
        return f"is no relative path with / between folders: {name!r:.80}"
    if {"", ".", ".."} & set(name.split("/")):
        return f"leads out of its folder or in circles: {name!r:.80}"
    return None
