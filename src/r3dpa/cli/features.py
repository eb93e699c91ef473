"""``r3dpa data features``: the feature grids of a data set, on one machine or many."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from inspect import signature
from pathlib import Path
from typing import Any, Literal, cast

from jsonargparse import Namespace
from lightning import Trainer

from r3dpa.cli.stages import StageParser
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.feature_grids import Extractor, GridPlan, features_lock, plan
from r3dpa.data.scans import Scan
from r3dpa.geometry import Projection
from r3dpa.modules.feature_extraction import FeatureExtraction, MissingScans
from r3dpa.nn.backbones.point_features import SOURCES, feature_source

# Of the trainer's options, those that matter where nothing is trained and every scan counts.
_TRAINER_OPTIONS = {
    *("accelerator", "strategy", "devices", "num_nodes", "precision", "plugins"),
    "enable_progress_bar",
}
_PRECISIONS = ("32-true", "bf16-mixed", "16-mixed")  # others would convert the prepared scans too
# Said by Lightning, and meant that way here: grids go to disk, and a process may have no scan.
_HARMLESS = (
    "predict returned None",
    "You have overridden `transfer_batch_to_device`",
    "Total length of .* across ranks is zero",
    "The '.*_dataloader' does not have many workers",
    "`isinstance.treespec, LeafSpec.` is deprecated",
)


def features(words: Sequence[str]) -> None:
    """Runs the command; see ``r3dpa features --help``.

    Args:
        words: Command line after ``r3dpa features``.

    Raises:
        ValueError: If an argument is missing or out of its range, or a scan or the store cannot be
            used; the message names it.
    """
    for message in _HARMLESS:
        warnings.filterwarnings("ignore", message=message)
    parser = _parser()
    config = parser.parse_args(_with_data_class(words))
    if config.extractor or config.ckpt:
        config.data.init_args.extractor = feature_source(config.extractor or "scalr", config.ckpt)
    if config.out:
        config.data.init_args.features_dir = str(config.out)
    objects = parser.instantiate(config)
    trainer = Trainer(**objects.trainer, logger=False, enable_checkpointing=False)
    if trainer.precision not in _PRECISIONS:
        raise ValueError(
            f"trainer.precision must be one of {', '.join(_PRECISIONS)}, got {trainer.precision}."
        )
    data: LidarDataModule = objects.data
    if data.extractor is None or data.features_dir is None:
        raise ValueError(
            "there is no extractor: give --extractor, one of "
            f"{', '.join(SOURCES)}, or one in the data configuration (data.init_args.extractor)."
        )
    if trainer.num_nodes > 1 and data.prepare_data_per_node:
        raise ValueError(
            "data.init_args.prepare_data_per_node is for disks of the nodes' own, but "
            "trainer.num_nodes > 1 writes one store for all: leave one of them out."
        )
    _extract(data, trainer, config)


def _extract(data: LidarDataModule, trainer: Trainer, config: Namespace) -> None:
    # The data module finds its scans, or simulates them; it must not extract grids itself.
    module, data.extractor = data.extractor, None
    extractor, features_dir = cast(Extractor, module), cast(Path, data.features_dir)
    sizes = config.grid_sizes if config.grid_sizes is not None else [data.grid_size]
    projection: Projection | None = None
    scans: list[Scan] = []
    with ExitStack() as job:
        if trainer.is_global_zero:
            # Before Lightning starts the other processes, which would wait and time out.
            data.prepare_data()
            data.setup("predict")
            assert data.all_set is not None
            projection = data.geometry.projection
            arguments = extractor, projection, sizes, features_dir, config.dtype, trainer.precision
            todo = plan(data.all_set.scans, *arguments)
            if todo.missing:  # complete grids may lie on a read-only disk
                job.enter_context(features_lock(features_dir))
                todo = plan(data.all_set.scans, *arguments)  # another job may have made some
            scans = list(todo.missing)
            _say(_announcement(todo, extractor.name))
        extraction = FeatureExtraction(extractor, projection, sizes, features_dir, config.dtype)
        missing = MissingScans(
            scans,
            extractor,
            data.sensor,
            data.batch_size if config.batch_size is None else config.batch_size,
            data.num_workers,
        )
        started = time.monotonic()
        try:
            trainer.predict(extraction, missing, return_predictions=False)
        except SystemExit as stop:
            if stop.code == 1:  # Lightning turns Ctrl-C into this
                raise KeyboardInterrupt from None
            raise
        finally:
            extraction.close()
    if trainer.is_global_zero:
        rate = len(scans) / (time.monotonic() - started)
        _say(
            f"feature grids: {len(scans)} made, {todo.num_kept} kept, {rate:.3g} scans per second, "
            f"in {', '.join(_stores(todo))}"
        )


def _announcement(todo: GridPlan, name: str) -> str:
    return (
        f"feature grids of {name}: {len(todo.missing)} scans to do, {todo.num_kept} done; "
        f"{todo.num_bytes / 1e9:.3g} GB needed, {todo.free_bytes / 1e9:.3g} GB free, "
        f"in {', '.join(_stores(todo))}"
    )


def _stores(todo: GridPlan) -> list[str]:
    return [str(todo.features_dir / f"{h}x{w}") for h, w in todo.settings]


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()  # into a log file at once


def read_data(source: Path) -> LidarDataModule:
    """Data module of a folder of scans or a data YAML, without features; simulates its scans.

    Raises:
        ValueError: If the path is neither.
    """
    parser = StageParser()
    parser.add_argument("--config", action="config")
    parser.add_lightning_class_args(LidarDataModule, "data", subclass_mode=True)
    config = parser.parse_args(_with_data_class(["--data", str(source)]))
    settings = config.data.init_args
    settings.extractor = settings.features_dir = None
    module: LidarDataModule = parser.instantiate(config).data
    if source.is_file():
        module.prepare_data()
    return module


def _with_data_class(words: Sequence[str]) -> list[str]:
    """The words with a folder or YAML file after ``--data`` as class path or ``--config``.

    Raises:
        ValueError: If a path after ``--data`` is neither.
    """
    found: list[str] = []
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if name != "--data":
            found.append(word)
            continue
        source = value if equals else next(rest, "")
        if Path(source).is_dir():
            in_layout = (Path(source) / "data_3d_raw").is_dir()
            data, key = (
                ("KITTI360DataModule", "root") if in_layout else ("LidarDataModule", "scans")
            )
            found += ["--data", f"r3dpa.data.{data}", f"--data.init_args.{key}", source]
        elif Path(source).suffix in (".yaml", ".yml"):
            found += ["--config", source]
        elif "/" in source:
            raise ValueError(f"--data {source}: is no folder of scans and no data YAML")
        else:
            found += ["--data", source]
    return found


def _parser() -> StageParser:
    parser = StageParser(
        prog="r3dpa data features",
        description="Write the feature grids of all scans of --data: a folder of scans, in the "
        "KITTI-360 layout or any other, or a data YAML. The same command completes an interrupted "
        "run. Several devices and nodes share the work.",
    )
    parser.add_argument("--config", action="config", help="YAML, the same as after --data")
    parser.add_lightning_class_args(LidarDataModule, "data", subclass_mode=True)
    parser.add_argument(
        "--extractor",
        type=str | None,
        help=f"one of {', '.join(SOURCES)}; default: that of the data configuration, "
        "or scalr if --ckpt is given",
    )
    parser.add_argument("--ckpt", type=Path | None, help="weights of the extractor")
    parser.add_argument(
        "--grid_sizes",
        type=list[tuple[int, int]] | None,
        help="rows and columns of each grid, such as '[[8, 64], [16, 128]]', all from one pass; "
        "default: grid_size of the data",
    )
    parser.add_argument(
        "--dtype",
        type=Literal["float16", "int8"],
        default="float16",
        help="int8 takes half the space: 127 steps on either side of zero in each cell",
    )
    parser.add_argument(
        "--batch_size", type=int | None, help="scans per pass; default: that of the data"
    )
    parser.add_argument(
        "--out", type=Path | None, help="folder of the grids, in place of features_dir of the data"
    )
    skipped: Any = set(signature(Trainer).parameters) - _TRAINER_OPTIONS
    parser.add_class_arguments(
        Trainer, "trainer", fail_untyped=False, instantiate=False, sub_configs=True, skip=skipped
    )
    return parser
