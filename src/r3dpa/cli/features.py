"""``r3dpa data features``: the feature grids of a data set, on one machine or many.

``r3dpa data prepare``: whatever a data YAML needs before a training.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from lightning import Trainer

from r3dpa.cli.presets import find_configs, shipped
from r3dpa.cli.stages import StageParser, ignore_harmless_notices, options_of_lightning
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.feature_names import SOURCES
from r3dpa.features.scalr import feature_source
from r3dpa.io import number_of
from r3dpa.modules.feature_extraction import extract_features
from r3dpa.modules.stage import check_trainer


def features(args: list[str]) -> None:
    """Run the command, given its name and the words after it."""
    ignore_harmless_notices()
    parser = features_parser("r3dpa data features")
    config = parser.parse_args(with_data_class(find_configs(args[1:])))
    if config.extractor or config.ckpt:
        config.data.init_args.extractor = feature_source(config.extractor or "scalr", config.ckpt)
    if config.out:
        config.data.init_args.features_dir = str(config.out)
    objects = parser.instantiate(config)
    with options_of_lightning():
        trainer = Trainer(**objects.trainer, logger=False, enable_checkpointing=False)
    check_trainer(trainer)
    data: LidarDataModule = objects.data
    if data.extractor is None or data.features_dir is None:
        raise ValueError(
            f"no feature extractor: give --extractor, one of {', '.join(SOURCES)}, or one in the "
            "data configuration (--data.init_args.extractor)"
        )
    extract_features(data, trainer, config.grid_sizes or [data.grid_size])


def prepare(args: list[str]) -> None:
    """Run ``data prepare``, given its name and the words after it."""
    ignore_harmless_notices()
    parser = StageParser(
        prog="r3dpa data prepare",
        description="Simulate the scans of a data YAML that are missing, and make the feature "
        "grids of its extractor, as a training does before its first step. The same command "
        "completes an interrupted one; a larger number of scans adds what an earlier one lacks.",
    )
    parser.add_argument("--config", action="config", help="data YAML; later ones win")
    parser.add_lightning_class_args(LidarDataModule, "data", subclass_mode=True)
    data: LidarDataModule = parser.instantiate(parser.parse_args(find_configs(args[1:]))).data
    data.prepare_data()
    train, val = data.limited_split()
    grids = (
        "no feature grids" if data.features_dir is None else f"feature grids: {data.features_dir}"
    )
    sys.stdout.write(f"{number_of(len(train), 'scan')} to train, {len(val)} held out; {grids}\n")


def read_data(source: Path, columns: Sequence[str] = ()) -> LidarDataModule:
    """Make the data module of a folder of scans or a data YAML, without features.

    Simulates the scans of a data YAML where they are missing. ``columns`` names the columns of
    files without names.
    """
    parser = features_parser("r3dpa data reference")
    words = with_data_class(["--data", str(source)])
    config = parser.parse_args([*words, f"--columns={','.join(columns)}"] if columns else words)
    config.data.init_args.extractor = config.data.init_args.features_dir = None
    module: LidarDataModule = parser.instantiate(config).data
    if source.is_file():
        module.prepare_data()
    return module


def with_data_class(words: Sequence[str]) -> list[str]:
    """Replace a folder or YAML file after ``--data`` by a class path or ``--config``."""
    replaced: list[str] = []
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if name != "--data":
            replaced.append(word)
            continue
        value = value if equals else next(rest, "")
        source = Path(value)
        if (source / "data_3d_raw").is_dir():
            replaced += ["--data=r3dpa.data.KITTI360DataModule", f"--data.init_args.root={value}"]
        elif source.is_dir():
            replaced += ["--data=r3dpa.data.LidarDataModule", f"--data.init_args.scans={value}"]
        elif source.suffix in (".yaml", ".yml"):
            replaced += ["--config", str(shipped(value))]
        elif len(source.parts) > 1:
            raise ValueError(f"--data {value}: no such folder of scans or data YAML")
        else:  # a class
            replaced += ["--data", value]
    return replaced


def features_parser(prog: str) -> StageParser:
    """Make the parser of the command, also used to read ``--data`` for another ``prog``."""
    parser = StageParser(
        prog=prog,
        description="Write the feature grids of all scans of --data: a folder of scans, in the "
        "KITTI-360 layout or any other, or a data YAML. The same command completes an interrupted "
        "run. Several devices and nodes share the work. --columns names the columns of files "
        "without names, such as x,y,z,intensity,ring.",
    )
    parser.add_argument("--config", action="config", help="YAML, the same as after --data")
    parser.add_lightning_class_args(LidarDataModule, "data", subclass_mode=True)
    sources = f"one of {', '.join(SOURCES)}; default: as in the data, or scalr if --ckpt is given"
    parser.add_argument("--extractor", type=str | None, help=sources)
    parser.add_argument("--ckpt", type=Path | None, help="weights of the extractor")
    sizes = "such as '[[8, 64], [16, 128]]', all from one pass; default: grid_size of the data"
    sizes = f"rows and columns of each grid, {sizes}"
    parser.add_argument("--grid_sizes", type=list[tuple[int, int]] | None, help=sizes)
    out = "folder of the grids, in place of features_dir of the data"
    parser.add_argument("--out", type=Path | None, help=out)
    skipped = {"logger", "enable_checkpointing"}
    parser.add_class_arguments(
        Trainer, "trainer", fail_untyped=False, instantiate=False, skip=skipped
    )
    return parser
