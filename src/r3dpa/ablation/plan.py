"""Rows of ``r3dpa fit`` commands; each different training is run once, then tested.

A table is a folder with ``table.yaml`` and one YAML file per row::

    # table.yaml
    caption: What the table shows.
    better: [[3_joint, 2_vanilla]]    # orders found in the paper: the first is better
    alike: [[2_vanilla, 1_none]]      # neither is clearly better

    # 2_vanilla.yaml
    label: vanilla alignment
    published: {FRID: 7.23, JSD: 4.64}       # as printed in the paper, optional
    commands:                                # in order; what the last one trains is tested
      vae: fit {vae_alignment} --model.init_args.rgb_weights {prior}
      flow: fit {flow_matching} --model.init_args.init_from {vae}

A scale defines data, networks and length::

    words:                                   # abbreviations; one may use those before it
      demo: --preset demo --seed_everything {seed} --trainer.max_steps 400
      vae_alignment: vae_alignment {demo}
      flow_matching: flow_matching {demo}
    commands:                                # run first where a row needs them
      prior: fit rgb_pretraining --preset demo
    reference: --spaces fwid,fgeo            # options of `r3dpa reference`

A name in braces stands for an abbreviation or the checkpoint of an earlier command, ``{seed}`` for
the seed, ``{out}`` for the folder of the ablation, and ``{here}`` for that of the scale.
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from r3dpa.metrics.results import PUBLISHED_SCALES

_PRIOR = "prior"  # the command that a file of RGB-pretrained weights replaces
_NAME = re.compile(r"{(\w+)}")
_WEIGHTS = re.compile(r'"([^"{]+\.(?:pt|pth|ckpt|safetensors))"')
_NOT_TRAINED = ("scorer", "run_dir", "ckpt_path")  # keys that do not change a training

Resolve = Callable[[str], dict[str, Any]]
"""Gives the whole configuration of an ``r3dpa fit`` command, with ``{names}`` as they are."""


class Stage(NamedTuple):
    """A training, shared by all rows in which it is the same.

    ``name``, also of its folder, is the experiment and a hash of the resolved ``config``, the files
    of weights in it, the seed, and the stages ``before``. ``words`` are those after ``fit``, and
    ``config`` what they amount to with seed 0.
    """

    name: str
    words: list[str]
    config: dict[str, Any]
    before: tuple[str, ...]

    @property
    def experiment(self) -> str:
        """Name without the hash."""
        return self.name.rpartition("-")[0]

    @property
    def on_scans(self) -> bool:
        """Whether it trains on scans, not on images."""
        return "grid_size" in self.config["data"]["init_args"]

    def folder(self, out: Path) -> Path:
        """Run folder."""
        return out / "stages" / self.name

    def evaluation(self, out: Path) -> Path:
        """File with the numbers of its test."""
        return self.folder(out) / "evaluation" / "evaluation.json"


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
    """Tables to be made at a scale, for some seeds; ``reference`` are options of that command."""

    scale: str
    about: str
    reference: list[str]
    seeds: tuple[int, ...]
    tables: list[Table]

    @property
    def stages(self) -> list[Stage]:
        """All stages, each once, after those that they start from."""
        chains = [c for table in self.tables for row in table.rows for c in row.stages.values()]
        return list({stage.name: stage for chain in chains for stage in chain}.values())

    @property
    def tested(self) -> list[Stage]:
        """Stages whose scenes are compared with real scans, each once."""
        rows = [row for table in self.tables for row in table.rows]
        return list({c[-1].name: c[-1] for row in rows for c in row.stages.values()}.values())

    @property
    def missing_weights(self) -> list[Path]:
        """Files of weights that stages and their tests need, and that do not exist."""
        named = {path for stage in self.stages for path in _weights_in(stage.config)}
        return sorted(path for path in named if not path.is_file())


class _Scale(NamedTuple):
    """Abbreviations and commands of a scale, a file in place of ``prior``, cached resolver."""

    words: dict[str, str]
    commands: dict[str, str]
    prior: Path | None
    resolve: Resolve

    def stages(self, own: dict[str, str], seed: int, file: Path) -> list[Stage]:
        """Stages of a row: its ``own`` commands, each after those that it needs."""
        checkpoints = {} if self.prior is None else {_PRIOR: str(self.prior)}
        stages: dict[str, Stage] = {}
        for name, command in (self.commands | own).items():
            if name in checkpoints:
                continue
            place, text = f"{file}: commands.{name}", command
            for word in reversed(self.words):  # one may use those before it
                text = text.replace(f"{{{word}}}", self.words[word])
            used = {f"{{{n}}}": n for n in _NAME.findall(text) if n not in ("seed", "out")}
            if unknown := [n for n in used.values() if n not in checkpoints]:
                known = ", ".join([*checkpoints, *self.words])
                raise ValueError(
                    f"{place}: {{{unknown[0]}}} is nothing known before it; give one of {known}"
                )
            words = shlex.split(text.replace("{seed}", str(seed)))
            if words[:1] != ["fit"] or not words[1:] or words[1].startswith("-"):
                raise ValueError(f"{place}: {command!r} is no command `fit EXPERIMENT ...`")
            content = json.dumps(self.resolve(text.replace("{seed}", "0")))
            for mark, before in used.items():
                content = content.replace(mark, checkpoints[before])
                words = [word.replace(mark, checkpoints[before]) for word in words]
            config = json.loads(content)
            trained = {key: value for key, value in config.items() if key not in _NOT_TRAINED}
            files = [_digest(path) for path in _weights_in(trained) if path.is_file()]
            hashed = json.dumps([trained, files, "{seed}" in text and seed], sort_keys=True)
            title = f"{words[1]}-{hashlib.sha256(hashed.encode()).hexdigest()[:10]}"
            before = tuple(stages[n].name for n in used.values() if n in stages)
            stages[name] = Stage(title, words[1:], config, before)
            checkpoints[name] = f"{{out}}/stages/{title}/checkpoints/last.ckpt"
        needed = {stages[name].name for name in own if name in stages}
        if not needed:
            raise ValueError(f"{file}: has no command that trains")
        for stage in reversed(stages.values()):
            needed.update(stage.before if stage.name in needed else ())
        return list({s.name: s for s in stages.values() if s.name in needed}.values())


def make_plan(
    folder: Path,
    scale: Path,
    seeds: Sequence[int],
    resolve: Resolve,
    rgb_weights: Path | None = None,
) -> Plan:
    """Plan of a table, or of all tables below a folder.

    Args:
        folder: With a ``table.yaml``, or with folders that have one.
        scale: YAML file.
        seeds: Different ones, at least one.
        resolve: See :data:`Resolve`.
        rgb_weights: RGB-pretrained SiT, instead of pretraining one.

    Raises:
        ValueError: If there is no table or scale, a file is invalid, or a seed is negative or
            occurs twice.
    """
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ValueError(
            f"--seeds must be different numbers from 0 on, at least one, got {list(seeds)}"
        )
    if rgb_weights is not None and not rgb_weights.is_file():
        raise ValueError(f"--rgb_weights {rgb_weights}: there is no such file")
    if not scale.is_file():
        known = sorted(other.stem for other in scale.parent.glob("*.yaml"))
        raise ValueError(f"{scale}: there is no such scale; give one of {', '.join(known) or '-'}")
    about = _read(scale, ("about", "words"), ("commands", "reference"))
    words = {"here": shlex.quote(str(scale.parent)), **about["words"]}
    given = _Scale(words, about.get("commands", {}), rgb_weights, cache(resolve))
    single = (folder / "table.yaml").is_file()
    folders = [folder] if single else sorted(path.parent for path in folder.glob("*/table.yaml"))
    if not folders:
        raise ValueError(f"{folder}: holds no table.yaml, nor does any folder in it")
    tables = [_table(path, given, seeds) for path in folders]
    options = shlex.split(about.get("reference", ""))
    return Plan(scale.stem, about["about"], options, tuple(seeds), tables)


def _table(folder: Path, scale: _Scale, seeds: Sequence[int]) -> Table:
    path = folder / "table.yaml"
    about = _read(path, ("caption",), ("better", "alike"))
    rows: dict[str, Row] = {}
    for file in sorted(set(folder.glob("*.yaml")) - {path}):
        row = _read(file, ("label", "commands"), ("published",))
        published = row.get("published", {})
        if unknown := published.keys() - PUBLISHED_SCALES.keys():
            raise ValueError(
                f"{file}: published: {min(unknown)!r} is no metric of the paper; give some of "
                f"{', '.join(PUBLISHED_SCALES)}"
            )
        if row["label"] in {other.label for other in rows.values()}:
            raise ValueError(f"{file}: another row has the label {row['label']!r}, too")
        stages = {seed: scale.stages(row["commands"], seed, file) for seed in seeds}
        rows[file.stem] = Row(file.stem, row["label"], published, stages)
    if not rows:
        raise ValueError(f"{folder}: has a table.yaml but no row; add a YAML file for each")
    orders = [(name, *pair) for name in ("better", "alike") for pair in about.get(name, ())]
    for name, *pair in orders:
        if len(pair) != 2 or not rows.keys() >= set(pair):
            raise ValueError(f"{path}: {name}: {pair} is no pair of {sorted(rows)}")
    return Table(folder.name, about["caption"], list(rows.values()), orders)


def _weights_in(config: Any) -> list[Path]:
    """Files of weights from elsewhere."""
    return [Path(name) for name in _WEIGHTS.findall(json.dumps(config))]


@cache
def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read(path: Path, needed: Sequence[str], more: Sequence[str] = ()) -> dict[str, Any]:
    """A YAML file with these keys; a ``ValueError`` says what is wrong with it."""
    try:
        given = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: is no YAML: {error}") from error
    if not isinstance(given, dict) or not set(needed) <= given.keys() <= {*needed, *more}:
        found = list(given) if isinstance(given, dict) else type(given).__name__
        raise ValueError(
            f"{path}: holds {found}; needed are the keys {list(needed)}, {list(more)} may be given"
        )
    return given
