"""LightningCLI of the training stages: ``r3dpa fit | validate | test | predict``."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from r3dpa.data.datamodules import LidarDataModule
from r3dpa.modules import GenerativeModule

__all__ = ["StageCLI", "run"]

# Said by Lightning at every start, and meant that way here: averages and frozen networks stay in
# evaluation mode; the rest is Lightning's own use of torch.
_HARMLESS = (
    r"Found \d+ module\(s\) in eval mode",
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    r"The number of training batches .* is smaller than the logging interval",
    r"The '.*_dataloader' does not have many workers",
)


class StageCLI(LightningCLI):
    """Wires a stage, a data module and a trainer from YAML files.

    ``run_dir`` is the one place a run writes to: checkpoints, loggers and pictures go below it.
    """

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Adds ``run_dir`` and the checkpoint callback that follows it."""
        parser.add_argument(
            "--run_dir", type=str, default="runs/default", help="folder that the run writes to"
        )
        parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
        parser.set_defaults({"checkpoint.save_last": True, "checkpoint.filename": "{step:07d}"})
        parser.link_arguments("run_dir", "trainer.default_root_dir")
        parser.link_arguments(
            "run_dir", "checkpoint.dirpath", compute_fn=lambda run_dir: f"{run_dir}/checkpoints"
        )

    def before_instantiate_classes(self) -> None:
        """Points every logger that has a ``save_dir`` at the run's folder."""
        config = self.config[self.subcommand]
        if self.subcommand == "predict" and config.return_predictions is None:
            config.return_predictions = False  # they are on disk; all of KITTI-360 is 20 GB
        Path(config.run_dir).mkdir(parents=True, exist_ok=True)
        loggers = config.trainer.logger
        for logger in loggers if isinstance(loggers, list) else [loggers]:
            if hasattr(logger, "init_args") and "save_dir" in logger.init_args:
                logger.init_args.save_dir = config.run_dir


def run(args: list[str]) -> None:
    """Runs one stage command.

    Args:
        args: Command line after ``r3dpa``, for example ``["fit", "--config", "x.yaml"]``.
    """
    if args[0] == "features":
        _write_features(args[1:])
        return
    for message in _HARMLESS:
        warnings.filterwarnings("ignore", message=message)
    StageCLI(
        GenerativeModule,
        LidarDataModule,
        subclass_mode_model=True,
        subclass_mode_data=True,
        save_config_kwargs={"overwrite": True},
        auto_configure_optimizers=False,
        # Lightning warns where both the process's own command line and a list are given.
        args=None if args == sys.argv[1:] else args,
    )


def _write_features(args: list[str]) -> None:
    parser = LightningArgumentParser(
        prog="r3dpa features", description="Write the feature grids that a data module asks for."
    )
    parser.add_argument("--config", action="config", help="YAML with a `data:` block")
    parser.add_lightning_class_args(LidarDataModule, "data", subclass_mode=True)
    parser.instantiate_classes(parser.parse_args(args)).data.prepare_data()
