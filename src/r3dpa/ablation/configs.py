"""YAML files of a stage merged into one, as the command line would merge them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

__all__ = ["merged", "merged_files", "read_config", "with_value"]

_SUFFIXES = (".yaml", ".yml")


def read_config(path: Path) -> dict[str, Any]:
    """A YAML file in which names of other YAML files are replaced by what those hold.

    Args:
        path: The file; names inside are relative to its folder.

    Raises:
        ValueError: If a file is missing, is no YAML, or holds no mapping.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"{path}: there is no such file") from error
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: is no YAML: {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path}: holds {type(content).__name__}, not keys with values")
    return {key: _inlined(value, path.parent) for key, value in content.items()}


def _inlined(value: Any, folder: Path) -> Any:
    if isinstance(value, dict):
        return {key: _inlined(item, folder) for key, item in value.items()}
    if isinstance(value, str) and value.endswith(_SUFFIXES) and (folder / value).is_file():
        return read_config(folder / value)
    return value


def merged(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Two configurations, of which the second wins key by key.

    A block that names another ``class_path`` replaces the whole block before it: arguments of one
    class mean nothing to another. Lists replace lists.
    """
    if after.get("class_path", before.get("class_path")) != before.get("class_path"):
        return dict(after)
    result = dict(before)
    for key, value in after.items():
        old = result.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = merged(old, value)
        result[key] = value
    return result


def merged_files(paths: Iterable[Path]) -> dict[str, Any]:
    """Files merged in their order; errors as :func:`read_config`."""
    result: dict[str, Any] = {}
    for path in paths:
        result = merged(result, read_config(path))
    return result


def with_value(config: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy with the value of a dotted key set, such as ``model.init_args.seed``."""
    for part in reversed(key.split(".")):
        value = {part: value}
    return merged(config, value)
