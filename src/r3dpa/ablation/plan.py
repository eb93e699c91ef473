"""Plan of an ablation: tables of rows of training stages, each stage identified by its content.

A table is a folder with ``table.yaml`` and one YAML file per row::

    # table.yaml
    caption: What the table shows.
    better: [[3_joint, 2_vanilla]]    # orders found in the paper: the first is better
    alike: [[2_vanilla, 1_none]]      # neither is clearly better

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
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, reduce
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from r3dpa.metrics.results import published_scales

_PRIOR = "rgb_pretraining"  # the experiment that a file of RGB-pretrained weights replaces
_WEIGHTS = re.compile(r'"([^"]+\.(?:pt|pth|ckpt|safetensors))"')
_SEED_KEYS = ("seed_everything", "model.init_args.seed", "data.init_args.seed", "scorer.seed")


def read_config(path: Path) -> dict[str, Any]:
    """A YAML file, with names of other YAML files (relative to it) replaced by their content.

    Raises:
        ValueError: If a file is no YAML, or holds no mapping.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
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


def _merged_files(folder: Path, names: Iterable[Any]) -> dict[str, Any]:
    return reduce(merged, (read_config(folder / str(name)) for name in names), {})


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


def _with_item(config: Mapping[str, Any], item: tuple[str, Any]) -> dict[str, Any]:
    return with_value(config, *item)


class Scale(NamedTuple):
    """Data and scorer of all stages; experiments as in the file, and their merged ``config``."""

    name: str
    about: str
    data: dict[str, Any]
    scorer: dict[str, Any]
    experiments: dict[str, dict[str, Any]]


class Stage(NamedTuple):
    """A training run, shared by all rows in which its configuration is the same.

    ``config`` is for ``r3dpa fit``, without devices and loggers, and holds the checkpoints of the
    stages before. ``name``, also of the folder, is the experiment and a hash of the configuration
    and of the files of weights in it.
    """

    experiment: str
    config: dict[str, Any]
    on_scans: bool
    name: str

    @property
    def before(self) -> tuple[str, ...]:
        """Names of the stages that must be run first."""
        return tuple(re.findall(r"{out}/stages/([^/]+)/", json.dumps(self.config)))


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
    """Tables to be made at a scale, for some seeds."""

    scale: Scale
    seeds: tuple[int, ...]
    tables: list[Table]

    @property
    def chains(self) -> list[list[Stage]]:
        """The stages of each row and seed."""
        return [c for table in self.tables for row in table.rows for c in row.stages.values()]

    @property
    def stages(self) -> list[Stage]:
        """All stages, each once, after those that they start from."""
        return list({stage.name: stage for chain in self.chains for stage in chain}.values())

    @property
    def tested(self) -> list[Stage]:
        """Stages whose scenes are compared with real scans, each once."""
        return list({chain[-1].name: chain[-1] for chain in self.chains}.values())

    @property
    def missing_weights(self) -> list[Path]:
        """Files of weights that stages and their tests need, and that do not exist."""
        named = {path for stage in self.stages for path in _weights_in(stage.config)}
        return sorted(path for path in named if not path.is_file())


def read_scale(path: Path) -> Scale:
    """Reads a scale.

    Raises:
        ValueError: If there is no such scale, or a key is missing or unknown.
    """
    if not path.is_file():
        known = sorted(other.stem for other in path.parent.glob("*.yaml"))
        raise ValueError(f"{path}: there is no such scale; give one of {', '.join(known) or '-'}")
    found = _keys(read_config(path), path, ("about", "common", "data", "set", "experiments"))
    data, change = found["data"], found["set"]
    common = _merged_files(path.parent, found["common"])
    experiments = {}
    for name, raw in found["experiments"].items():
        optional = ("set", "start", "scans", "seeded")
        given = _keys(raw, f"{path}: experiments.{name}", ("configs",), optional)
        layers = [common, _merged_files(path.parent, given["configs"]), given.get("set", {})]
        if given.get("scans", True):
            layers = [common, data, layers[1], change, layers[2]]
        experiments[name] = given | {"config": reduce(merged, layers)}
    block = merged(data, {"data": change.get("data", {})})
    scorer = merged(common, change).get("scorer", {})
    return Scale(path.stem, found["about"], block, scorer, experiments)


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
    tables = [_table(path, scale, seeds, rgb_weights) for path in folders]
    return Plan(scale, tuple(seeds), tables)


def _table(folder: Path, scale: Scale, seeds: Sequence[int], prior: Path | None) -> Table:
    path = folder / "table.yaml"
    about = _keys(read_config(path), path, ("caption",), ("better", "alike"))
    rows = []
    for file in sorted(set(folder.glob("*.yaml")) - {path}):
        row = _keys(read_config(file), file, ("label", "stages"), ("published",))
        published = row.get("published", {})
        if unknown := published.keys() - published_scales().keys():
            raise ValueError(
                f"{file}: published: {min(unknown)!r} is no metric of the paper; give some of "
                f"{', '.join(published_scales())}"
            )
        stages = {seed: _stages(row["stages"], file, scale, seed, prior) for seed in seeds}
        rows.append(Row(file.stem, row["label"], published, stages))
    if not rows:
        raise ValueError(f"{folder}: has a table.yaml but no row; add a YAML file for each")
    known = {row.key for row in rows}
    orders = [(name, *pair) for name in ("better", "alike") for pair in about.get(name, ())]
    for name, *pair in orders:
        if len(pair) != 2 or not known.issuperset(pair):
            raise ValueError(f"{path}: {name}: {pair} is no pair of {sorted(known)}")
    (label, times), *_ = Counter(row.label for row in rows).most_common(1)
    if times > 1:
        raise ValueError(f"{folder}: {times} rows have the label {label!r}; give different labels")
    return Table(folder.name, about["caption"], rows, orders)


def _stages(
    given: Iterable[Any], path: Path, scale: Scale, seed: int, prior: Path | None
) -> list[Stage]:
    """Stages of a row, each after those that its experiment needs at this scale."""
    weights: dict[str, str] = {}  # by the names in this row
    chain: dict[str, Stage] = {}

    def add(experiment: str, starts: dict[str, str], change: Any, place: str) -> str:
        """Adds a stage; returns its checkpoint."""
        if experiment not in scale.experiments:
            raise ValueError(
                f"{place}: the scale {scale.name} has no experiment {experiment!r}; give one of "
                f"{', '.join(scale.experiments)}"
            )
        own = scale.experiments[experiment]
        values = dict.fromkeys(_SEED_KEYS if own.get("seeded", True) else (), seed)
        config = merged(reduce(_with_item, values.items(), own["config"]), change)
        needed = {key: add(before, {}, {}, place) for key, before in own.get("start", {}).items()}
        config = reduce(_with_item, (needed | starts).items(), config)
        trained = {key: value for key, value in config.items() if key != "scorer"}
        files = [_digest(path) for path in _weights_in(trained) if path.is_file()]
        text = json.dumps([trained, *files], sort_keys=True)
        name = f"{experiment}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"
        chain.setdefault(name, Stage(experiment, config, own.get("scans", True), name))
        return f"{{out}}/stages/{name}/checkpoints/last.ckpt"

    for number, raw in enumerate(given):
        place = f"{path}: stages[{number}]"
        stage = _keys(raw, place, ("name", "experiment"), ("start", "set"))
        starts = stage.get("start", {})
        if lost := [before for before in starts.values() if before not in weights]:
            raise ValueError(f"{place}: start: no stage before it is called {lost[0]!r}")
        if stage["experiment"] == _PRIOR and prior is not None:
            weights[stage["name"]] = str(prior)
            continue
        begun = {key: weights[before] for key, before in starts.items()}
        weights[stage["name"]] = add(stage["experiment"], begun, stage.get("set", {}), place)
    if not chain:
        raise ValueError(f"{path}: has no stage to train")
    return list(chain.values())


def _weights_in(config: Any) -> list[Path]:
    """Files of weights from elsewhere."""
    found = _WEIGHTS.findall(json.dumps(config))
    return [Path(name) for name in found if not name.startswith("{out}")]


def _digest(path: Path) -> str:
    return _digest_of(path, path.stat().st_mtime_ns)


@cache
def _digest_of(path: Path, _mtime_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _keys(
    given: Any, place: Path | str, needed: Sequence[str], more: Sequence[str] = ()
) -> dict[str, Any]:
    missing = [key for key in needed if key not in given]
    unknown = [key for key in given if key not in (*needed, *more)]
    if missing or unknown or not isinstance(given, Mapping):
        raise ValueError(
            f"{place}: lacks the keys {missing} and has the unknown keys {unknown}; "
            f"needed are {list(needed)}, {list(more)} may be given"
        )
    return dict(given)
