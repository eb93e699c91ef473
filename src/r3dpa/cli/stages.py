"""LightningCLI of the training stages: ``r3dpa fit | validate | test | predict``."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

from lightning import LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback

from r3dpa.callbacks import RunCheckpoint
from r3dpa.checkpoints import read_checkpoint
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


class _SaveFitConfig(SaveConfigCallback):
    """Keeps the configuration of the training: evaluating a run does not replace it."""

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if stage == "fit":
            super().setup(trainer, pl_module, stage)


class StageCLI(LightningCLI):
    """Wires a stage, a data module and a trainer from YAML files.

    ``run_dir`` is the one place a run writes to: checkpoints, loggers and pictures go below it.
    """

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Adds ``run_dir`` and the checkpoint callback that follows it."""
        parser.add_argument(
            "--run_dir", type=str, default="runs/default", help="folder that the run writes to"
        )
        parser.add_lightning_class_args(RunCheckpoint, "checkpoint")
        parser.set_defaults({"checkpoint.save_last": True, "checkpoint.filename": "{step:07d}"})
        parser.link_arguments("run_dir", "trainer.default_root_dir")
        parser.link_arguments(
            "run_dir", "checkpoint.dirpath", compute_fn=lambda run_dir: f"{run_dir}/checkpoints"
        )

    def _parse_ckpt_path(self) -> None:
        """Checks that the file can be read; the model stays the one of the configuration.

        Lightning would replace class and settings of the model by those of the checkpoint without
        a word. Here the stages are compared in ``GenerativeModule.on_load_checkpoint``.
        """
        path = self.config[self.config.subcommand].get("ckpt_path")
        if path and Path(path).is_file():
            read_checkpoint(path)

    def before_fit(self) -> None:
        """Loads the stage before: what does not fit is said before hours of data preparation."""
        if self.config[self.subcommand].ckpt_path is None:
            self.model.load_previous_stage()

    def before_validate(self) -> None:
        """Refuses to evaluate random weights."""
        if self.config[self.subcommand].ckpt_path is None:
            raise ValueError(f"{self.subcommand} needs trained weights: give --ckpt_path")

    before_test = before_validate
    before_predict = before_validate

    def before_instantiate_classes(self) -> None:
        """Points every logger that has a ``save_dir`` at the run's folder."""
        config = self.config[self.subcommand]
        if self.subcommand == "predict" and config.return_predictions is None:
            config.return_predictions = False  # they are on disk; all of KITTI-360 is 20 GB
        checkpoints = Path(config.run_dir) / "checkpoints"
        if self.subcommand == "fit" and config.ckpt_path is None and checkpoints.is_dir():
            raise ValueError(
                f"{checkpoints} holds an earlier run: resume it with --ckpt_path, or give another "
                "--run_dir"
            )
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
        save_config_callback=_SaveFitConfig,
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
    data = parser.instantiate_classes(parser.parse_args(args)).data
    if data.extractor is None:
        raise ValueError(
            "the data configuration has no extractor, so there are no feature grids to write; "
            "give one, for example --data.init_args.extractor r3dpa.nn.backbones.GeometricFeatures"
        )
    data.prepare_data()  # says how many grids it made, and where
