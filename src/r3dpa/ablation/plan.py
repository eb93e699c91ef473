"""Rows of ``r3dpa fit`` commands; each different training is run once, then tested.

A table is a folder with ``table.yaml`` and one YAML file per row, see ``conf/ablation``. The
commands of a row follow those of the scale, and what the last one trains is tested::

    label: vanilla alignment
    published: {FRID: 7.23, JSD: 4.64}       # as printed in the paper, optional
    commands:
      vae: fit {vae_alignment} --model.init_args.rgb_weights {prior}
      flow: fit {flow_matching} --model.init_args.init_from {vae}

A name in braces stands for a word of the scale, which may use those before it, or the checkpoint of
an earlier command, ``{seed}`` for the seed, ``{out}`` for the folder of the ablation, and
``{here}`` for that of the scale.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from r3dpa.io import sha256_of
from r3dpa.metrics.results import PUBLISHED_SCALES

_NAME = re.compile(r"{(\w+)}")
_WEIGHTS = re.compile(r'"([^"{]+\.(?:pt|pth|ckpt|safetensors))"')
_digest = cache(sha256_of)  # tables share weights
_NOT_TRAINED = ("scorer", "run_dir", "ckpt_path")  # keys that do not change a training


class Stage(NamedTuple):
    """A training, shared by all rows in which it is the same.

    ``name``, also of its run folder, is the experiment and a hash of the resolved ``config``, the
    files of weights in it, the seed, and the stages ``before``. ``words`` are those after ``fit``,
    and ``config`` what they amount to with seed 0. Of released weights or samples, which are given
    instead, the config is empty and ``words`` is their path alone.
    """

    name: str
    folder: Path
    words: list[str]
    config: dict[str, Any]
    before: tuple[str, ...]

    @property
    def on_scans(self) -> bool:
        """Whether it trains on scans, not on images."""
        return bool(self.config) and "grid_size" in self.config["data"]["init_args"]

    @property
    def on_features(self) -> bool:
        """Whether the scans come with feature grids."""
        data = self.config["data"]["init_args"] if self.on_scans else {}
        return bool(data.get("extractor") or data.get("features_dir"))

    @property
    def evaluation(self) -> Path:
        """File with the numbers of its test."""
        return self.folder / "evaluation" / "evaluation.json"


class Row(NamedTuple):
    """A line of a table: its stages by seed, of which the last one is tested."""

    key: str
    label: str
    published: dict[str, float]
    stages: dict[int, list[Stage]]


class Table(NamedTuple):
    """Rows in order; orders of the paper: ``better`` or ``alike``, and the keys of two rows."""

    name: str
    caption: str
    rows: list[Row]
    orders: list[tuple[str, str, str]]


class Plan(NamedTuple):
    """Tables to be made in a folder at a scale, and options of ``r3dpa data reference``."""

    out: Path
    scale: str
    about: str
    reference: list[str]
    seeds: tuple[int, ...]
    tables: list[Table]

    @property
    def chains(self) -> list[list[Stage]]:
        """Stages of each row and seed."""
        rows = [row for table in self.tables for row in table.rows]
        return [chain for row in rows for chain in row.stages.values()]

    @property
    def stages(self) -> list[Stage]:
        """All stages, each once, after those that they start from."""
        return list({stage.name: stage for chain in self.chains for stage in chain}.values())


class _Scale(NamedTuple):
    out: Path
    words: dict[str, str]
    commands: dict[str, str]
    resolve: Callable[[str], dict[str, Any]]

    def stages(self, own: dict[str, str], seed: int, file: Path) -> list[Stage]:
        """Stages of a row: its ``own`` commands, each after those that it needs."""
        stages: dict[str, Stage] = {}
        for name, text in (self.commands | own).items():
            for word in reversed(self.words):  # one may use those before it
                text = text.replace(f"{{{word}}}", self.words[word])
            used = [n for n in _NAME.findall(text) if n not in ("seed", "out")]
            place = f"{file}: commands.{name}"
            if unknown := [n for n in used if n not in stages]:
                known = f"nothing known before it; give one of {', '.join([*stages, *self.words])}"
                raise ValueError(f"{place}: {{{unknown[0]}}} is {known}")
            words = shlex.split(text.replace("{seed}", str(seed)))
            if words[:1] != ["fit"] or not words[1:] or words[1].startswith("-"):
                raise ValueError(f"{place}: {text!r} is no command `fit EXPERIMENT ...`")
            content = json.dumps([words[1:], self.resolve(text.replace("{seed}", "0"))])
            for n in used:
                checkpoint = f"{{out}}/stages/{stages[n].name}/checkpoints/last.ckpt"
                content = content.replace(f"{{{n}}}", checkpoint)
            config = json.loads(content)[1]
            trained = {key: value for key, value in config.items() if key not in _NOT_TRAINED}
            paths = map(Path, _WEIGHTS.findall(json.dumps(trained)))
            files = [_digest(path) for path in paths if path.is_file()]
            hashed = json.dumps([trained, files, "{seed}" in text and seed], sort_keys=True)
            title = f"{words[1]}-{hashlib.sha256(hashed.encode()).hexdigest()[:10]}"
            words, config = json.loads(content.replace("{out}", str(self.out)))
            before = tuple(stages[n].name for n in used)
            stages[name] = Stage(title, self.out / "stages" / title, words, config, before)
        needed = {stages[name].name for name in own}
        for stage in reversed(stages.values()):
            needed.update(stage.before if stage.name in needed else ())
        return list({s.name: s for s in stages.values() if s.name in needed}.values())


def make_plan(
    folder: Path,
    scale: Path,
    seeds: Sequence[int],
    out: Path,
    resolve: Callable[[str], dict[str, Any]],
    rgb_weights: Path | None = None,
    released: Mapping[str, Path] | None = None,
) -> Plan:
    """Plan of the table in a folder, or of all tables in folders below it.

    ``resolve`` gives the whole configuration of an ``r3dpa fit`` command, with ``{names}`` as they
    are, and ``rgb_weights`` replace the command ``prior`` of the scale. ``released`` are
    checkpoints to sample from, or folders of samples, in place of the trainings of a row, by its
    name without the number. ``ValueError`` if there is no table or scale, a file is invalid, or a
    seed is negative or occurs twice.
    """
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ValueError(f"--seeds must be different numbers from 0 on, got {list(seeds)}")
    if not scale.is_file():
        known = sorted(other.stem for other in scale.parent.glob("*.yaml"))
        raise ValueError(f"{scale}: there is no such scale; give one of {', '.join(known) or '-'}")
    about = _read(scale, ("about", "words"), ("commands", "reference"))
    words = {"here": shlex.quote(str(scale.parent)), **about["words"]}
    commands = about.get("commands", {})
    if rgb_weights is not None:
        if not rgb_weights.is_file():
            raise ValueError(f"--rgb_weights {rgb_weights}: there is no such file")
        words["prior"] = shlex.quote(str(rgb_weights))
        commands.pop("prior", None)
    given = _Scale(out, words, commands, cache(resolve))
    single = (folder / "table.yaml").is_file()
    folders = [folder] if single else sorted(path.parent for path in folder.glob("*/table.yaml"))
    if not folders:
        raise ValueError(f"{folder}: holds no table.yaml, nor does any folder in it")
    released = dict(released or {})
    tables = [_table(path, given, seeds, released) for path in folders]
    names = {_name_of(row.key) for table in tables for row in table.rows}
    if unknown := [name for name in released if name not in names]:
        raise ValueError(f"--released.{unknown[0]}: there is no such row; give one of {names}")
    options = shlex.split(about.get("reference", ""))
    return Plan(out, scale.stem, about["about"], options, tuple(seeds), tables)


def _table(
    folder: Path, scale: _Scale, seeds: Sequence[int], released: Mapping[str, Path]
) -> Table:
    path_of_table = folder / "table.yaml"
    about = _read(path_of_table, ("caption",), ("better", "alike"))
    rows: dict[str, Row] = {}
    for file in sorted(set(folder.glob("*.yaml")) - {path_of_table}):
        row = _read(file, ("label", "commands"), ("published",))
        published = row.get("published", {})
        path, only_released = released.get(_name_of(file.stem)), row["commands"] == "released"
        if only_released and path is None:
            continue
        if not row["commands"] or not published.keys() <= PUBLISHED_SCALES.keys():
            known = ", ".join(PUBLISHED_SCALES)
            raise ValueError(f"{file}: has no command, or published names none of {known}")
        if path is None:
            stages = {seed: scale.stages(row["commands"], seed, file) for seed in seeds}
        else:
            stages = {seed: [_given(path, scale.out)] for seed in seeds}
        rows[file.stem] = Row(file.stem, row["label"], published, stages)
    orders = [(name, *pair) for name in ("better", "alike") for pair in about.get(name, ())]
    for name, *pair in orders:
        if len(pair) != 2 or not rows.keys() >= set(pair):
            raise ValueError(f"{path_of_table}: {name}: {pair} is no pair of {sorted(rows)}")
    return Table(folder.name, about["caption"], list(rows.values()), orders)


def _name_of(key: str) -> str:
    return re.sub(r"^\d+_", "", key)


def _given(path: Path, out: Path) -> Stage:
    """Stage of released weights or samples."""
    if not path.exists():
        raise ValueError(f"--released {path}: there is no such file or folder")
    content = _digest(path) if path.is_file() else str(path.resolve())
    name = f"released-{hashlib.sha256(content.encode()).hexdigest()[:10]}"
    return Stage(name, out / "stages" / name, [str(path)], {}, ())


def _read(path: Path, needed: Sequence[str], more: Sequence[str]) -> dict[str, Any]:
    """A YAML file with these keys; a ``ValueError`` says what is wrong with it."""
    try:
        given: dict[str, Any] = dict(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: is no YAML of keys and values: {error}") from error
    if not set(needed) <= given.keys() <= {*needed, *more}:
        raise ValueError(
            f"{path}: holds {[*given]}; needed are the keys {needed}, {more} may be given"
        )
    return given
