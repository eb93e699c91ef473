"""LightningCLI of the training stages: ``r3dpa fit | validate | test | predict``."""

from __future__ import annotations

import sys
import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

from lightning import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.utilities import rank_zero_only

from r3dpa.callbacks import RunCheckpoint, SceneScorer
from r3dpa.checkpoints import read_checkpoint
from r3dpa.io import atomic_path, delete_unfinished, only_writer
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

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Writes it whole; not to ``trainer.log_dir``, for which the other processes are asked."""
        text = self.parser.dump(self.config, skip_none=False)
        path = Path(trainer.default_root_dir) / self.config_filename
        with atomic_path(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


class StageCLI(LightningCLI):
    """Wires a stage, a data module and a trainer from YAML files.

    ``run_dir`` is the one place a run writes to: checkpoints, loggers and pictures go below it. One
    process at a time trains there, and one tests. ``--ckpt_path last`` means its newest checkpoint,
    or none where there is none yet, so that one command starts a job and goes on with it.
    A stage is a LightningModule; one whose batches only some data modules make names their class as
    ``data_class``.
    """

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Adds ``run_dir``, the checkpoint callback that follows it, and the one that scores."""
        parser.add_argument(
            "--run_dir", type=str, default="runs/default", help="folder that the run writes to"
        )
        parser.add_lightning_class_args(RunCheckpoint, "checkpoint")
        parser.add_lightning_class_args(SceneScorer, "scorer")
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
        config = self.config[self.config.subcommand]
        if config.get("ckpt_path") == "last":
            config.ckpt_path = _newest(Path(config.run_dir))
        path = config.get("ckpt_path")
        if path and Path(path).is_file():
            read_checkpoint(path)

    def _run_subcommand(self, subcommand: str) -> None:
        """Runs the command, unless another process does the same in ``run_dir``."""
        run_dir = Path(self.config[subcommand].run_dir)
        alone = only_writer(
            run_dir / f".{subcommand}.lock", f"runs r3dpa {subcommand} in {run_dir}"
        )
        first = cast(Any, rank_zero_only).rank == 0  # known before there is a trainer
        with alone if first else nullcontext():
            if subcommand == "fit" and first:
                self._refuse_earlier_run()
                delete_unfinished(run_dir / "checkpoints")
            super()._run_subcommand(subcommand)

    def instantiate_classes(self) -> None:
        """Builds stage, data module and trainer; checks that the first two belong together.

        Raises:
            ValueError: If the stage cannot use batches of the data module; both are named.
        """
        super().instantiate_classes()
        expected = getattr(self.model, "data_class", LightningDataModule)
        if not isinstance(self.datamodule, expected):
            stage, data = type(self.model).__name__, type(self.datamodule).__name__
            raise ValueError(
                f"data.class_path: {stage} needs a {expected.__module__}.{expected.__name__} or a "
                f"subclass of it, got {data}; give another data.class_path or model.class_path"
            )

    def before_fit(self) -> None:
        """Loads the stage before: what does not fit is said before hours of data preparation."""
        if isinstance(self.model, GenerativeModule) and self._ckpt_path is None:
            self.model.load_previous_stage()

    def before_predict(self) -> None:
        """Refuses to use random weights."""
        if self._ckpt_path is None:
            raise ValueError(f"{self.subcommand} needs trained weights: give --ckpt_path")

    before_validate = before_test = before_predict

    @property
    def _ckpt_path(self) -> str | None:
        return self.config[self.subcommand].ckpt_path

    def before_instantiate_classes(self) -> None:
        """Points every logger that has a ``save_dir`` at the run's folder."""
        config = self.config[self.subcommand]
        if self.subcommand == "predict" and config.return_predictions is None:
            config.return_predictions = False  # they are on disk; all of KITTI-360 is 20 GB
        if self.subcommand == "fit":
            self._refuse_earlier_run()
        Path(config.run_dir).mkdir(parents=True, exist_ok=True)
        loggers = config.trainer.logger
        for logger in loggers if isinstance(loggers, list) else [loggers]:
            if hasattr(logger, "init_args") and "save_dir" in logger.init_args:
                logger.init_args.save_dir = config.run_dir

    def _refuse_earlier_run(self) -> None:
        run_dir = Path(self.config[self.subcommand].run_dir)
        if self._ckpt_path is None and _newest(run_dir) is not None:
            raise ValueError(
                f"{run_dir / 'checkpoints'} holds an earlier run: resume it with --ckpt_path last, "
                "or give another --run_dir"
            )


def _newest(run_dir: Path) -> str | None:
    """The checkpoint of a run that was written last; None if there is none."""
    found = (run_dir / "checkpoints").glob("*.ckpt")
    whole = [path for path in found if not path.name.startswith(".")]
    return str(max(whole, key=lambda path: path.stat().st_mtime_ns)) if whole else None


def run(args: list[str]) -> None:
    """Runs one stage command.

    Args:
        args: Command line after ``r3dpa``, for example ``["fit", "--config", "x.yaml"]``.
    """
    for message in _HARMLESS:
        warnings.filterwarnings("ignore", message=message)
    StageCLI(
        LightningModule,
        LightningDataModule,
        subclass_mode_model=True,
        subclass_mode_data=True,
        save_config_callback=_SaveFitConfig,
        save_config_kwargs={"overwrite": True},
        auto_configure_optimizers=False,
        # Lightning warns where both the process's own command line and a list are given.
        args=None if args == sys.argv[1:] else args,
    )
