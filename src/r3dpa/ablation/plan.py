"""Plan of an ablation: tables of rows of training stages, each stage identified by its content.

A table is a folder with ``table.yaml`` and one YAML file per row::

    # table.yaml
    caption: What the table shows.
    better:                       # orders found in the paper, in names of rows
      - [3_joint, 2_vanilla]      # the first is better than the second
    alike:
      - [2_vanilla, 1_none]       # neither is clearly better

    # 2_vanilla.yaml
    label: vanilla alignment
    published: {FRID: 7.23, JSD: 4.64}       # as printed in the paper, optional
    stages:                                  # in order; the last one is tested
      - name: vae
        experiment: vae_alignment            # of the scale
      - name: flow
        experiment: flow_matching
        start: {model.init_args.init_from: vae}   # configuration key: stage
        set: {model: {init_args: {weights: {sit_alignment: 0.5}}}}

A scale defines the configurations and the length of each experiment::

    common: [../../trainer.yaml]             # of all stages, relative to this file
    data: ../../data/demo.yaml               # of all stages on scans
    set: {scorer: {num_scenes: 144}}         # overrides of all stages on scans
    experiments:
      vae_alignment:
        configs: [../../experiment/vae_alignment.yaml]
        set: {trainer: {max_steps: 400}}

``{out}`` in a value stands for the folder of the ablation. An experiment with ``scans: false`` has
data of its own, one with ``seeded: false`` is run once for all seeds, and one with ``start:
{model.init_args.init_from: image_vae}`` needs another experiment before it in every row.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from r3dpa.metrics.results import published_scales

__all__ = ["Plan", "Row", "Scale", "Stage", "Table", "make_plan", "read_scale"]

#: Experiment that a file of RGB-pretrained weights replaces.
_PRIOR = "rgb_pretraining"
_WEIGHTS = (".pt", ".pth", ".ckpt", ".safetensors")
_SEED_KEYS = ("seed_everything", "model.init_args.seed", "data.init_args.seed", "scorer.seed")


def read_config(path: Path) -> dict[str, Any]:
    """A YAML file, with names of other YAML files (relative to it) replaced by their content.

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
    if isinstance(value, str) and value.endswith((".yaml", ".yml")) and (folder / value).is_file():
        return read_config(folder / value)
    return value


def merged(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """Two configurations, of which the second wins key by key; lists replace lists.

    A block that names another ``class_path`` replaces the whole block before it.
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


def with_value(config: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy with the value of a dotted key set, such as ``model.init_args.seed``."""
    for part in reversed(key.split(".")):
        value = {part: value}
    return merged(config, value)


def _merged_files(folder: Path, names: Iterable[Any]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name in names:
        result = merged(result, read_config(folder / str(name)))
    return result


@dataclass(frozen=True)
class Scale:
    """Configurations, data and length of each experiment, from a YAML file; see the module.

    ``common`` and ``experiments`` hold merged configurations without and with ``overrides``.
    """

    name: str
    folder: Path
    about: str
    common: dict[str, Any]
    data: dict[str, Any]
    overrides: dict[str, Any]
    experiments: dict[str, dict[str, Any]]

    @property
    def scorer(self) -> dict[str, Any]:
        """Settings of the test of a stage."""
        return merged(self.common.get("scorer", {}), self.overrides.get("scorer", {}))

    def config(self, experiment: str, seed: int) -> dict[str, Any]:
        """Configuration of an experiment for ``r3dpa fit``."""
        given = self.experiments[experiment]
        on_scans = given.get("scans", True)
        config = merged(self.common, self.data) if on_scans else self.common
        config = merged(config, _merged_files(self.folder, given["configs"]))
        config = merged(config, self.overrides) if on_scans else config
        config = merged(config, given.get("set", {}))
        for key in _SEED_KEYS if given.get("seeded", True) else ():
            config = with_value(config, key, seed)
        return config


@dataclass(frozen=True)
class Stage:
    """A training run, shared by all rows in which its configuration is the same.

    Args:
        experiment: Its name in the scale.
        config: For ``r3dpa fit``, without folders, devices and loggers.
        starts: Stage, or file of weights, whose checkpoint a configuration key gets.
        name: Experiment and hash of its configuration, of the files named in it and of the stages
            before it; also the name of its folder.
    """

    experiment: str
    config: dict[str, Any]
    starts: dict[str, Stage | Path]
    name: str

    @property
    def before(self) -> list[Stage]:
        """Stages that must be run first."""
        return [start for start in self.starts.values() if isinstance(start, Stage)]


@dataclass(frozen=True)
class Row:
    """A line of a table: its stages by seed, of which the last one is tested."""

    key: str
    label: str
    published: dict[str, float]
    stages: dict[int, tuple[Stage, ...]]

    def tested(self, seed: int) -> Stage:
        """The stage whose scenes are compared with real scans."""
        return self.stages[seed][-1]


@dataclass(frozen=True)
class Table:
    """Rows in order, and the orders found in the paper as pairs of row keys."""

    name: str
    caption: str
    rows: tuple[Row, ...]
    better: tuple[tuple[str, str], ...]
    alike: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Plan:
    """Tables to be made at a scale, for some seeds."""

    scale: Scale
    seeds: tuple[int, ...]
    tables: tuple[Table, ...]

    @property
    def stages(self) -> list[Stage]:
        """All stages, each once, after those that they start from."""
        rows = [row for table in self.tables for row in table.rows]
        stages = [stage for row in rows for chain in row.stages.values() for stage in chain]
        return list({stage.name: stage for stage in stages}.values())

    @property
    def tested(self) -> list[Stage]:
        """Stages that are tested, each once."""
        rows = [row for table in self.tables for row in table.rows]
        tested = (row.tested(seed) for row in rows for seed in self.seeds)
        return list({stage.name: stage for stage in tested}.values())

    @property
    def missing_weights(self) -> list[Path]:
        """Files of weights that stages and their tests need, and that do not exist."""
        named = {path for stage in self.stages for path in _weights_in(stage.config)}
        return sorted(path for path in named if not path.is_file())

    def on_scans(self, stage: Stage) -> bool:
        """Whether a stage trains on the scans, not on data of its own."""
        return self.scale.experiments[stage.experiment].get("scans", True)


def read_scale(path: Path) -> Scale:
    """Reads a scale.

    Raises:
        ValueError: If a key is missing or unknown, or a file cannot be read.
    """
    if not path.is_file():
        known = sorted(other.stem for other in path.parent.glob("*.yaml"))
        raise ValueError(f"{path}: there is no such scale; give one of {', '.join(known) or '-'}")
    needed = ("about", "common", "data", "set", "experiments")
    found = _keys(read_config(path), path, needed)
    options = ("set", "start", "scans", "seeded")
    experiments = {
        name: _keys(given, f"{path}: experiments.{name}", ("configs",), options)
        for name, given in found["experiments"].items()
    }
    common = _merged_files(path.parent, found["common"])
    return Scale(
        path.stem, path.parent, found["about"], common, found["data"], found["set"], experiments
    )


def make_plan(
    folder: Path, scale: Scale, seeds: Sequence[int], rgb_weights: Path | None = None
) -> Plan:
    """Plan of a table, or of all tables below a folder.

    Args:
        folder: With a ``table.yaml``, or with folders that have one.
        scale: Of :func:`read_scale`.
        seeds: Different ones, at least one.
        rgb_weights: RGB-pretrained SiT, instead of pretraining one.

    Raises:
        ValueError: If there is no table, a file is invalid, or a seed is negative or occurs twice.
    """
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ValueError(
            f"--seeds must be different numbers from 0 on, at least one, got {list(seeds)}"
        )
    if rgb_weights is not None and not rgb_weights.is_file():
        raise ValueError(f"--rgb_weights {rgb_weights}: there is no such file")
    single = (folder / "table.yaml").is_file()
    folders = [folder] if single else sorted(path.parent for path in folder.glob("*/table.yaml"))
    if not folders:
        raise ValueError(f"{folder}: holds no table.yaml, nor does any folder in it")
    tables = (_table(path, scale, seeds, rgb_weights) for path in folders)
    return Plan(scale, tuple(seeds), tuple(tables))


def _table(folder: Path, scale: Scale, seeds: Sequence[int], prior: Path | None) -> Table:
    path = folder / "table.yaml"
    about = _keys(read_config(path), path, ("caption",), ("better", "alike"))
    files = sorted(set(folder.glob("*.yaml")) - {path})
    rows = tuple(_row(file, scale, seeds, prior) for file in files)
    if not rows:
        raise ValueError(f"{folder}: has a table.yaml but no row; add a YAML file for each")
    known = {row.key for row in rows}
    orders = {name: tuple(map(tuple, about.get(name, ()))) for name in ("better", "alike")}
    for name, pairs in orders.items():
        for pair in pairs:
            if len(pair) != 2 or not known.issuperset(pair):
                raise ValueError(f"{path}: {name}: {list(pair)} is no pair of {sorted(known)}")
    for label, times in Counter(row.label for row in rows).items():
        if times > 1:
            raise ValueError(f"{folder}: {times} rows have the label {label!r}; tell them apart")
    return Table(folder.name, about["caption"], rows, orders["better"], orders["alike"])


def _row(path: Path, scale: Scale, seeds: Sequence[int], prior: Path | None) -> Row:
    row = _keys(read_config(path), path, ("label", "stages"), ("published",))
    metrics = published_scales()
    for name in row.get("published", {}):
        if name not in metrics:
            raise ValueError(
                f"{path}: published: {name!r} is no metric of the paper; give some of "
                f"{', '.join(metrics)}"
            )
    stages = {seed: _stages(row["stages"], path, scale, seed, prior) for seed in seeds}
    return Row(path.stem, row["label"], row.get("published", {}), stages)


def _stages(
    given: Iterable[Any], path: Path, scale: Scale, seed: int, prior: Path | None
) -> tuple[Stage, ...]:
    known: dict[str, Stage | Path] = {}
    chain: list[Stage] = []
    for number, raw in enumerate(given):
        place = f"{path}: stages[{number}]"
        stage = _keys(raw, place, ("name", "experiment"), ("start", "set"))
        if stage["experiment"] == _PRIOR and prior is not None:
            known[stage["name"]] = prior
            continue
        starts = {}
        for key, before in stage.get("start", {}).items():
            if before not in known:
                raise ValueError(f"{place}: start: no stage before it is called {before!r}")
            starts[key] = known[before]
        found = _stage(stage["experiment"], starts, stage.get("set", {}), place, scale, seed)
        known[stage["name"]] = found[-1]
        chain += [stage for stage in found if stage not in chain]
    if not chain:
        raise ValueError(f"{path}: has no stage to train")
    return tuple(chain)


def _stage(
    experiment: str,
    starts: dict[str, Stage | Path],
    overrides: Mapping[str, Any],
    place: str,
    scale: Scale,
    seed: int,
) -> list[Stage]:
    """A stage after those that its experiment needs before it."""
    if experiment not in scale.experiments:
        raise ValueError(
            f"{place}: the scale {scale.name} has no experiment {experiment!r}; give one of "
            f"{', '.join(scale.experiments)}"
        )
    chain: list[Stage] = []
    for key, before in scale.experiments[experiment].get("start", {}).items():
        chain += _stage(before, {}, {}, place, scale, seed)
        starts = {key: chain[-1], **starts}
    config = merged(scale.config(experiment, seed), overrides)
    identity = {
        key: start.name if isinstance(start, Stage) else _digest(start)
        for key, start in starts.items()
    }
    trained = {key: value for key, value in config.items() if key != "scorer"}
    files = [_digest(path) for path in _weights_in(trained) if path.is_file()]
    text = json.dumps([trained, identity, *files], sort_keys=True)
    digest = hashlib.sha256(text.encode()).hexdigest()[:10]
    return [*chain, Stage(experiment, config, starts, f"{experiment}-{digest}")]


def _weights_in(config: Any) -> list[Path]:
    """Files of weights that a configuration names."""
    if isinstance(config, Mapping | list):
        values = config.values() if isinstance(config, Mapping) else config
        return [path for value in values for path in _weights_in(value)]
    named = isinstance(config, str) and Path(config).suffix in _WEIGHTS
    return [Path(config)] if named else []


def _digest(path: Path) -> str:
    found = path.stat()
    return _digest_of(path, found.st_size, found.st_mtime_ns)


@cache
def _digest_of(path: Path, _size: int, _mtime_ns: int) -> str:
    """Of a file, read once unless it is replaced."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _keys(
    given: Any, place: Path | str, needed: Sequence[str], more: Sequence[str] = ()
) -> dict[str, Any]:
    if not isinstance(given, Mapping):
        raise ValueError(f"{place}: is {given!r}; give the keys {', '.join(needed)}")
    missing = [key for key in needed if key not in given]
    unknown = [key for key in given if key not in (*needed, *more)]
    if missing or unknown:
        raise ValueError(
            f"{place}: lacks the keys {missing} and has the unknown keys {unknown}; "
            f"needed are {list(needed)}, {list(more)} may be given"
        )
    return dict(given)
