"""Rows of a table as trainings; a training that several rows share is planned once.

A table is a YAML file of rows, each a label, commands and the numbers that the paper printed::

    caption: Effect of alignment.
    rows:
      vanilla:
        label: vanilla alignment
        published: {FRID: 7.23, JSD: 4.64}
        commands:
          vae: r3dpa fit vae_alignment --model.init_args.rgb_weights {prior}
          flow: r3dpa fit flow_matching --model.init_args.init_from {vae}
    better: [[joint, vanilla]]

The last command of a row is tested. ``{vae}`` stands for the checkpoint that the command ``vae``
makes. A scale is a YAML file with commands for all tables, ``prior`` here, and with what it adds to
the commands of rows: ``options``, and settings as in a file after ``--config``, for all of them
(``config``), for a stage (``stages``) and for a table (``tables``).
"""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from r3dpa.flow.sampler import SamplerConfig, settings_of
from r3dpa.io import sha256_of
from r3dpa.metrics.results import PUBLISHED_SCALES

_NAME = re.compile(r"{(\w+)}")
_WEIGHTS = re.compile(r'"[^"]+\.(?:pt|pth|ckpt|safetensors)"')
_SEEDS = ("seed_everything", "model.init_args.seed", "data.init_args.seed", "scorer.seed")
_NOT_TRAINED = ("scorer", "run_dir", "ckpt_path")  # keys that do not change a training
_PARTS_OF_SCALE = ("options", "config", "stages", "tables", "commands", "reference")
_digest = cache(sha256_of)  # tables share weights


class PlannedStage(NamedTuple):
    """A training, shared by all rows in which it is the same.

    The name is the experiment, a hash of all that the training depends on, and the seed. ``words``
    follow ``r3dpa fit``, ``config`` is what they amount to with seed 0, and ``before`` names the
    stages that it starts from. Released weights or samples have as ``words`` their path and options
    of ``r3dpa sample``, and no configuration.
    """

    name: str
    folder: Path
    words: list[str]
    config: dict[str, Any]
    before: tuple[str, ...]
    on_scans: bool = True  # as all commands of rows

    @property
    def on_features(self) -> bool:
        """Whether the scans come with feature grids."""
        return self.on_scans and bool(self.config["data"]["init_args"].get("extractor"))

    @property
    def checkpoint(self) -> Path:
        """Last checkpoint of the training."""
        return self.folder / "checkpoints" / "last.ckpt"

    @property
    def evaluation(self) -> Path:
        """File with the numbers of its test."""
        return self.folder / "evaluation" / "evaluation.json"


class Row(NamedTuple):
    """A line of a table: its stages by seed, of which the last one is tested."""

    key: str
    label: str
    published: dict[str, float]
    stages: dict[int, list[PlannedStage]]


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
    def chains(self) -> list[list[PlannedStage]]:
        """Stages of each row and seed."""
        rows = [row for table in self.tables for row in table.rows]
        return [chain for row in rows for chain in row.stages.values()]

    @property
    def stages(self) -> list[PlannedStage]:
        """All stages, each once, after those that they start from."""
        return list({stage.name: stage for chain in self.chains for stage in chain}.values())


Resolve = Callable[[tuple[str, ...]], dict[str, Any]]
"""Returns the whole configuration of the words after ``r3dpa``."""


def make_plan(
    tables: Path,
    scale: Path,
    seeds: Sequence[int],
    out: Path,
    resolve: Resolve,
    rgb_weights: Path | None = None,
    released: Mapping[str, Path] | None = None,
) -> Plan:
    """Plan the trainings of a table, or of all tables of a folder.

    Args:
        tables: YAML file of a table, with or without its ending, or a folder of tables.
        scale: YAML file of a scale.
        seeds: Plan each row for each of them.
        out: Folder of the ablation.
        resolve: Returns the configuration of a command.
        rgb_weights: Weights in place of the command ``prior`` of the scale.
        released: Checkpoint to sample from, or folder of samples, in place of the trainings of a
            row, by its key.

    Raises:
        ValueError: If a file is invalid, a folder has no table, or a seed is negative or occurs
            twice.
    """
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ValueError(f"--seeds must be different numbers from 0 on, got {list(seeds)}")
    if rgb_weights is not None and not rgb_weights.is_file():
        raise ValueError(f"--rgb_weights {rgb_weights} does not exist")
    about = _read(scale, ("about",), _PARTS_OF_SCALE)
    planner = _Planner(out, about, rgb_weights, cache(resolve))
    released = dict(released or {})
    files = sorted(tables.glob("*.yaml")) if tables.is_dir() else [tables.with_suffix(".yaml")]
    if not files:
        raise ValueError(f"{tables} holds no table; give a YAML file, or a folder of them")
    contents = {file: _read(file, ("caption", "rows"), ("better", "alike")) for file in files}
    keys = [key for content in contents.values() for key in content["rows"]]
    for key in released:
        if key not in keys:
            raise ValueError(f"--released.{key}: unknown row; choose from {', '.join(keys)}")
    planned = [
        _plan_table(file, content, planner, seeds, released) for file, content in contents.items()
    ]
    options = shlex.split(about.get("reference", ""))
    return Plan(out, scale.stem, about["about"], options, tuple(seeds), planned)


def _plan_table(
    file: Path,
    about: Mapping[str, Any],
    planner: _Planner,
    seeds: Sequence[int],
    released: Mapping[str, Path],
) -> Table:
    rows: dict[str, Row] = {}
    for key, row in about["rows"].items():
        where = f"{file}: {key}"
        _check_keys(where, row, ("label",), ("published", "commands"))
        published = row.get("published", {})
        _check_keys(f"{where}: published", published, (), tuple(PUBLISHED_SCALES))
        if key in released:
            trained = (
                planner.plan_row(file.stem, row["commands"], where) if "commands" in row else []
            )
            chain = [_released_stage(released[key], planner.out, _sampling_of(trained))]
            stages = dict.fromkeys(seeds, chain)
        elif "commands" in row:
            chain = planner.plan_row(file.stem, row["commands"], where)
            stages = {seed: _with_seed(chain, seed, planner.out) for seed in seeds}
        else:  # exists only as released weights or samples
            continue
        rows[key] = Row(key, row["label"], published, stages)
    orders = [(name, *pair) for name in ("better", "alike") for pair in about.get(name, ())]
    for name, *pair in orders:
        if len(pair) != 2 or not rows.keys() >= set(pair):
            raise ValueError(f"{file}: {name}: {pair} is no pair of {', '.join(rows)}")
    return Table(file.stem, about["caption"], list(rows.values()), orders)


class _Planner:
    """Makes the stages of rows from their commands and what the scale adds."""

    def __init__(
        self, out: Path, scale: dict[str, Any], prior: Path | None, resolve: Resolve
    ) -> None:
        self.out, self._scale, self._prior, self._resolve = out, scale, prior, resolve

    def plan_row(self, table: str, commands: dict[str, str], where: str) -> list[PlannedStage]:
        """Stages of a row with seed 0, each after those that it needs."""
        every = self._scale.get("commands", {}) | commands
        places = {"out": self.out}
        if self._prior is not None:
            every.pop("prior", None)
            places["prior"] = self._prior
        needed = set(commands)
        for name in reversed(every):
            if name in needed:
                needed.update(_NAME.findall(every[name]))
        stages: dict[str, PlannedStage] = {}
        for name, command in every.items():
            if name in needed:
                place = f"{where}: {name}"
                for used in _NAME.findall(command):
                    if used not in places:
                        known = ", ".join(list(every)[: list(every).index(name)])
                        raise ValueError(f"{place}: unknown {{{used}}}; choose from {known}")
                options = self._options(table, command, place, of_row=name in commands)
                words = [_NAME.sub(lambda used: str(places[used[1]]), word) for word in options]
                before = [stages[used].name for used in _NAME.findall(command) if used in stages]
                stages[name] = self._stage(words, before, on_scans=name in commands)
                places[name] = stages[name].checkpoint
        return list({stage.name: stage for stage in stages.values()}.values())

    def _options(self, table: str, command: str, where: str, of_row: bool) -> list[str]:
        """Words after ``r3dpa fit``, with those that the scale adds to a command of a row."""
        start = shlex.split(command)
        if start[:2] != ["r3dpa", "fit"] or len(start) < 3 or start[2].startswith("-"):
            raise ValueError(f"{where}: {command!r} is no command `r3dpa fit STAGE ...`")
        _, _, experiment, *options = start
        if not of_row:
            return [experiment, *options]
        added = shlex.split(self._scale.get("options", ""))
        for settings in (self._scale, self._scale.get("tables", {}).get(table, {})):
            for part in (settings.get("config"), settings.get("stages", {}).get(experiment)):
                if part:
                    added += ["--config", json.dumps(part)]
        return [experiment, *added, *options]

    def _stage(self, words: list[str], before: Iterable[str], on_scans: bool) -> PlannedStage:
        config = self._resolve(("fit", *words, *(_seed_words(0) if on_scans else ())))
        trained = {key: value for key, value in config.items() if key not in _NOT_TRAINED}
        # Wherever the folder is, and whether the stages in it are trained or not.
        place = json.dumps(f"{self.out}/").removesuffix('"')
        text = json.dumps(trained, sort_keys=True).replace(place, '"{out}/')
        named = [Path(json.loads(name)) for name in _WEIGHTS.findall(text)]
        files = [_digest(path) for path in named if path.is_file()]
        digest = hashlib.sha256(json.dumps([text, files]).encode()).hexdigest()[:10]
        name = f"{words[0]}-{digest}"
        return PlannedStage(
            name, self.out / "stages" / name, words, config, tuple(before), on_scans
        )


def _with_seed(chain: Sequence[PlannedStage], seed: int, out: Path) -> list[PlannedStage]:
    """The stages with another seed; those on images have none."""
    names = {s.name: f"{s.name}-seed{seed}" if s.on_scans and seed else s.name for s in chain}
    checkpoints = {
        str(stage.checkpoint): str(out / "stages" / names[stage.name] / "checkpoints/last.ckpt")
        for stage in chain
    }
    return [
        stage._replace(
            name=names[stage.name],
            folder=out / "stages" / names[stage.name],
            words=[_replace_all(word, checkpoints) for word in stage.words]
            + (_seed_words(seed) if stage.on_scans else []),
            before=tuple(names[name] for name in stage.before),
        )
        for stage in chain
    ]


def _replace_all(text: str, replacements: Mapping[str, str]) -> str:
    for old, new in replacements.items():
        text = text.replace(old, new)
    return text


def _seed_words(seed: int) -> list[str]:
    return [word for key in _SEEDS for word in (f"--{key}", str(seed))]


def _sampling_of(chain: Sequence[PlannedStage]) -> list[str]:
    """Options of ``r3dpa sample`` as in the test of a row; baselines know their own."""
    if not chain or chain[-1].config["model"]["class_path"].startswith("r3dpa.baselines"):
        return []
    scorer = chain[-1].config["scorer"]
    sampler = SamplerConfig(**scorer["sampler"])
    options = {"solver": sampler.solver, "steps": sampler.steps, "precision": scorer["precision"]}
    # Even where they are defaults: `r3dpa sample` starts from the settings of a quality.
    options |= {name: getattr(sampler, name) for name in settings_of(sampler.solver)}
    if options.pop("sde_last_time", SamplerConfig.sde_last_time) != SamplerConfig.sde_last_time:
        raise ValueError(
            f"released weights are sampled by `r3dpa sample`, which ends the SDE at "
            f"{SamplerConfig.sde_last_time}, but the tests of this scale at "
            f"{sampler.sde_last_time}: leave sde_last_time out of scorer.sampler"
        )
    return [word for name, value in options.items() for word in (f"--{name}", str(value))]


def _released_stage(path: Path, out: Path, sampling: list[str]) -> PlannedStage:
    """Stage of released weights or samples."""
    if not path.exists():
        raise ValueError(f"--released {path} does not exist")
    content = _digest(path) if path.is_file() else str(path.resolve())
    about = " ".join([content, *sampling])
    name = f"released-{hashlib.sha256(about.encode()).hexdigest()[:10]}"
    return PlannedStage(name, out / "stages" / name, [str(path), *sampling], {}, (), on_scans=False)


def _read(path: Path, needed: Sequence[str], optional: Sequence[str]) -> dict[str, Any]:
    try:
        content: dict[str, Any] = dict(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (yaml.YAMLError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no YAML of keys and values: {error}") from error
    _check_keys(str(path), content, needed, optional)
    return content


def _check_keys(
    where: str, content: Mapping[str, Any], needed: Sequence[str], optional: Sequence[str]
) -> None:
    for key in needed:
        if key not in content:
            raise ValueError(f"{where}: missing {key!r}")
    for key in content:
        if key not in (*needed, *optional):
            known = ", ".join((*needed, *optional))
            raise ValueError(f"{where}: unknown {key!r}; choose from {known}")
