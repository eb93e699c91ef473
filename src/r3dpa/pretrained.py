"""Trained weights by name: shipped with this package, in files, or on Hugging Face."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import yaml

from r3dpa.io import first_line, text_table

DEFAULT_WEIGHTS = "r3dpa-s"
"""Name of the weights that commands use without ``--ckpt``."""
#: Suffix of the file of mean features per object class, beside the weights of the same name.
OBJECTS_SUFFIX = ".objects"
_FOLDER = Path(__file__).parent / "weights"
_HUB = "hf:/"  # a Path joins the two slashes of hf://


class Weights(NamedTuple):
    """Weights in this package: ``.safetensors`` with its ``.yaml``, and a card in Markdown."""

    name: str
    path: Path
    card: Path


def shipped() -> dict[str, Weights]:
    """Weights of this package by name."""
    files = sorted(_FOLDER.glob("*.safetensors"))
    return {file.stem: Weights(file.stem, file, file.with_suffix(".md")) for file in files}


def weights_file(source: str | Path) -> Path:
    """File of a checkpoint given by name, as a file, or as ``hf://owner/name``.

    A repository of Hugging Face holds one ``.safetensors`` with its ``.yaml`` of the same name, or
    ``hf://owner/name/file.safetensors`` names one of several.

    Raises:
        FileNotFoundError: If there is neither such a file nor such a name.
        ValueError: If a repository cannot be read.
    """
    text = str(source)
    if text.startswith(_HUB):
        return _from_hub(text.removeprefix(_HUB).lstrip("/"))
    path, known = Path(source), shipped()
    if path.is_file():
        return path
    if text in known:
        return known[text].path
    names = ", ".join(known) or "none"
    missing = f"no checkpoint file {path}"
    if text == DEFAULT_WEIGHTS:
        missing = f"the weights {text} are not in this package ({_FOLDER})"
    raise FileNotFoundError(
        f"{missing}; give an existing file, hf://owner/name, or a name of `r3dpa models` ({names})"
    )


def objects_file(source: str | Path) -> Path:
    """File of mean features of object classes beside a checkpoint, see :func:`weights_file`.

    Raises:
        FileNotFoundError: If there is none.
    """
    weights = weights_file(source)
    path = weights.with_suffix(OBJECTS_SUFFIX)
    if not path.is_file():
        raise FileNotFoundError(
            f"no object features {path} beside {weights.name}: write them with `r3dpa data "
            "objects`, or give a file of it as --objects"
        )
    return path


def check_features(source: str | Path) -> None:
    """Refuse weights that 3D features cannot guide, by the file beside them; reads no weights.

    Raises:
        FileNotFoundError: If there are no such weights.
        ValueError: If they were trained without 3D features.
    """
    path = weights_file(source)
    description = path.with_suffix(".yaml")
    if not description.is_file():
        return
    about = yaml.safe_load(description.read_text(encoding="utf-8"))
    if "feature_source" in about and about["feature_source"] is None:
        raise without_features(path)


def without_features(path: Path) -> ValueError:
    """Error of a checkpoint that 3D features cannot guide."""
    return ValueError(
        f"{path} was trained without 3D features, so that none can guide it; give a checkpoint of "
        "a run with an extractor"
    )


def models(name: str | None = None) -> str:
    """List the trained weights of this package, or show the card of one.

    Args:
        name: Weights whose card to show: data, recipe, scores and known failures.
    """
    known = shipped()
    if name is None:
        rows = [
            [w.name, f"{w.path.stat().st_size / 1e6:.1f} MB", str(w.card)] for w in known.values()
        ]
        return text_table(rows, ["name", "size", "card"], "lrl", "plain")
    if name not in known:
        raise ValueError(f"unknown weights '{name}'; choose from {', '.join(known) or 'none'}")
    return known[name].card.read_text()


def _from_hub(place: str) -> Path:
    owner, _, rest = place.partition("/")
    name, _, file = rest.partition("/")
    if not owner or not name:
        raise ValueError(f"hf://{place}: give hf://owner/name or hf://owner/name/file.safetensors")
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        raise ValueError(
            f"hf://{place}: downloads need huggingface_hub: pip install 'r3dpa[hub]'"
        ) from None
    stem = file.removesuffix(".safetensors") or "*"
    patterns = [file or "*.safetensors", f"{stem}.yaml", f"{stem}{OBJECTS_SUFFIX}"]
    try:
        folder = Path(snapshot_download(f"{owner}/{name}", allow_patterns=patterns))
    except (OSError, ValueError) as error:  # requests' errors are OSErrors
        raise ValueError(f"hf://{place} cannot be read: {first_line(error)}") from error
    files = sorted(folder.rglob(file or "*.safetensors"))
    if len(files) != 1:
        names = ", ".join(path.name for path in files) or "none"
        raise ValueError(f"hf://{place}: expected one .safetensors file, found {names}; name one")
    return files[0]
