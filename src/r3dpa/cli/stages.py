"""LightningCLI of the training stages: ``r3dpa fit | validate | test | predict``."""

from __future__ import annotations

import logging
import os
import sys
import uuid
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
import yaml
from lightning import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import Logger, WandbLogger
from lightning.pytorch.utilities import rank_zero_info, rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from r3dpa.bench.dry_run import DryRun, batch_lines
from r3dpa.callbacks import RunCheckpoint, SceneScorer
from r3dpa.checkpoints import Checkpoint, read_checkpoint
from r3dpa.cli.parser import Parser
from r3dpa.cli.presets import expand_preset, find_configs
from r3dpa.io import delete_unfinished, only_writer, source_commit, write_text
from r3dpa.modules import GenerativeModule
from r3dpa.modules.stage import Stage

# What a user can do nothing about, or what is intended: averages and frozen networks stay in
# evaluation mode, feature grids go to disk, a process may have no scan, the means of held-out scans
# are already over all processes, and a stage's name stands for words that are not typed.
_HARMLESS = (
    r"Found \d+ module\(s\) in eval mode",
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    r"The number of training batches .* is smaller than the logging interval",
    r"The '.*_dataloader' does not have many workers",
    r"predict returned None",
    r"It is recommended to use `self\.log\('(val|test)/.*', \.\.\., sync_dist=True\)`",
    r"You have overridden `transfer_batch_to_device`",
    r"Total length of .* across ranks is zero",
    r"LightningCLI's args parameter is intended to run from within Python",
)


_WANDB_ID = "wandb_id.txt"
_TRAIN = "train/"  # in front of the names of losses
_NOTICES = ("GPU available: False", "TPU available:", "HPU available:", "💡 Tip:", "Seed set to")
_NOTICE_LOGGERS = ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.seed")
# What to do after a stage: the command that takes its checkpoint.
_NEXT_COMMANDS = {
    "image_vae": "fit rgb_pretraining{preset} --model.init_args.init_from {ckpt}",
    "rgb_pretraining": "fit vae_alignment{preset} --model.init_args.rgb_weights {ckpt}",
    "vae_alignment": "fit joint{preset} --model.init_args.init_from {ckpt}",
    "lidm_first_stage": "fit lidm{preset} --model.init_args.init_from {ckpt}",
}
_SAMPLE_COMMAND = "sample --ckpt {ckpt} --out {run_dir}/scenes"
# What a stage is without the weights that it starts from: enough to try it.
_WITHOUT_WEIGHTS = {
    "vae_alignment": (
        "rgb_weights",
        "the frozen SiT is random, which is enough to try the stage, not for the paper's numbers",
    ),
    "joint": (
        "init_from",
        "VAE and SiT start from random values; the paper starts from a checkpoint of vae_alignment",
    ),
}


# Instruction sets of processors, as torch names them, with which bfloat16 is computed one by one.
_WITHOUT_BFLOAT16 = ("NO AVX", "DEFAULT", "AVX2")


class StageParser(Parser, LightningArgumentParser):
    """Parser of stages and data modules; ``--columns`` is an option of the data as elsewhere."""

    def parse_args(self, args: Any = None, *others: Any, **settings: Any) -> Any:
        """Parse words, with the place of ``--columns`` among the arguments of the data module."""
        words = []
        for word in sys.argv[1:] if args is None else args:
            name, equals, value = word.partition("=")
            name = "--data.init_args.columns" if name == "--columns" else name
            words.append(f"{name}{equals}{value}")
        return super().parse_args(words, *others, **settings)


def ignore_harmless_notices() -> None:
    """Hide warnings and notices of Lightning about what is intended, or cannot be changed."""
    for message in _HARMLESS:
        warnings.filterwarnings("ignore", message=message)
    for name in _NOTICE_LOGGERS:
        logging.getLogger(name).addFilter(_is_useful)


def _is_useful(record: logging.LogRecord) -> bool:
    return not record.getMessage().startswith(_NOTICES)


def _prefer_whole_numbers(parser: LightningArgumentParser) -> None:
    """Read 1 as one batch where an option is a number of batches or, as 1.0, a share of all.

    Python gives ``int | float`` of Lightning's signature back as ``float | int`` where another
    package has written that first, and the parser takes the first type that fits.
    """
    actions: list[Any] = parser._actions
    for action in actions:
        if getattr(action, "_typehint", None) == int | float | None:
            action._typehint = int | float | None


class _LossBar(TQDMProgressBar):
    """Progress bar that shows the last training losses instead of the version of the logger."""

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """Return the losses by name without ``train/``, the total one first."""
        shown = super().get_metrics(trainer, pl_module)
        shown.pop("v_num", None)
        losses = {
            name.removeprefix(_TRAIN): f"{value.item():.3g}"
            for name, value in trainer.callback_metrics.items()
            if name.startswith(_TRAIN) and name != f"{_TRAIN}skipped_steps"
        }
        shown.pop(f"{_TRAIN}loss", None)
        total = {"loss": losses["loss"]} if "loss" in losses else {}
        return total | losses | shown


class _RecordConfig(SaveConfigCallback):
    """Write the configuration of a training to ``run_dir`` and to wandb.

    Both begin with the first step: what data, networks and earlier checkpoints refuse before that
    replaces no configuration and leaves no wandb run behind.
    """

    started = False
    loggers: Sequence[Logger] = ()

    def hold_wandb_back(self, trainer: Trainer) -> None:
        """Take the wandb loggers out of a trainer until :meth:`on_train_start`."""
        self.loggers = list(trainer.loggers)
        trainer.loggers = [logger for logger in self.loggers if not isinstance(logger, WandbLogger)]

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write nothing yet: what is refused later must not replace the file of an earlier run."""

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Write the configuration; not to ``trainer.log_dir``, which would need all processes."""
        config = self.config.clone()
        config.ckpt_path = None  # a run with this file is a new one, with a wandb run of its own
        loggers = config.trainer.logger
        for logger in loggers if isinstance(loggers, list) else [loggers]:
            arguments: Any = getattr(logger, "init_args", {})
            for key, value in _wandb_names(config).items():
                if arguments.get(key) == value:
                    arguments[key] = None
        text = self.parser.dump(config, skip_unset=False, skip_validation=True)
        write_text(Path(trainer.default_root_dir) / self.config_filename, text)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the configuration, and give the wandb loggers back with it.

        They also get the arguments of the module.
        """
        if trainer.is_global_zero:
            self.save_config(trainer, pl_module, "fit")
        if not self.loggers:
            return
        trainer.loggers = list(self.loggers)
        arguments = {k: v for k, v in pl_module.hparams_initial.items() if k != "_class_path"}
        path = Path(trainer.default_root_dir) / self.config_filename
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger) and trainer.is_global_zero:
                config = yaml.safe_load(path.read_text(encoding="utf-8"))
                logger.log_hyperparams(arguments)
                logger.log_hyperparams(config | {"commit": source_commit()})

    def on_train_batch_start(self, *_: Any) -> None:
        self.started = True

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Mark errors of a running training, whose traceback ``cli.main`` shows."""
        exception.during_training = self.started  # type: ignore[attr-defined]


class StageCLI(LightningCLI):
    """Wires a stage, a data module and a trainer from YAML files.

    A run writes checkpoints, logs and pictures below ``run_dir``, where one process at a time
    trains. ``--ckpt_path last`` is its newest checkpoint, or none, so that one command starts and
    resumes a job.
    """

    def __init__(
        self, args: list[str], preset: str | None = None, *, dry_run: bool = False
    ) -> None:
        self._command, self._preset, self._dry_run = args[0], preset, dry_run
        self._resumed: Checkpoint | None = None  # without its weights
        super().__init__(
            LightningModule,
            LightningDataModule,
            subclass_mode_model=True,
            subclass_mode_data=True,
            save_config_callback=_RecordConfig,
            save_config_kwargs={"save_to_log_dir": False},
            auto_configure_optimizers=False,
            parser_class=StageParser,
            parser_kwargs={"prog": "r3dpa"},
            # Lightning warns if both the process's own command line and a list are given.
            args=None if args == sys.argv[1:] else args,
        )

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override] # static there
        """Return the given one alone: each has a parser that takes a quarter of a second."""
        return {self._command: LightningCLI.subcommands()[self._command]}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add ``run_dir``, the checkpoint callback that follows it, and the one that scores."""
        _prefer_whole_numbers(parser)
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

    def _dump_config(self) -> None:
        """Keep the configuration for the hyperparameters of model and data.

        As Lightning does, but without checking once more what the parser has accepted, a tenth of a
        second, and without an option that jsonargparse 5 removes.
        """
        if not hasattr(self, "config_dump"):
            text = self.parser.dump(
                self.config,
                format="yaml",
                skip_unset=False,
                skip_validation=True,
                skip_link_targets=False,
            )
            self.config_dump = yaml.safe_load(text)[self.config.subcommand]

    def instantiate_trainer(self, **kwargs: Any) -> Trainer:
        """Show losses in the bar; record the configuration before other callbacks start."""
        trainer: Any = super().instantiate_trainer(**kwargs)
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):  # wandb warns of it, even if it is None
                logger._wandb_init.pop("anonymous", None)
        callbacks = [_LossBar() if type(c) is TQDMProgressBar else c for c in trainer.callbacks]
        trainer.callbacks = sorted(callbacks, key=lambda c: not isinstance(c, _RecordConfig))
        return cast(Trainer, trainer)

    def _parse_ckpt_path(self) -> None:
        """Check the local file, without which Lightning would run what a URL says."""
        config = self.config[self.config.subcommand]
        if config.get("ckpt_path") == "last":
            config.ckpt_path = _newest(Path(config.run_dir))
            if config.ckpt_path is None and self._command == "fit":
                rank_zero_info(f"no checkpoint in {config.run_dir}: training starts at step 0")
        if config.get("ckpt_path"):
            self._resumed = replace(read_checkpoint(config.ckpt_path), networks={})
            if Path(config.ckpt_path).suffix != ".ckpt":  # released or exported
                raise ValueError(
                    f"--ckpt_path {config.ckpt_path} is no .ckpt of a run; scenes of other files "
                    "are made by `r3dpa sample` and scored by `r3dpa evaluate`"
                )
        if config.get("weights_only") is False:
            raise ValueError("weights_only: false would run code of the checkpoint: leave it out")
        config.weights_only = True

    def _run_subcommand(self, subcommand: str) -> None:
        """Run the command, unless another process does the same in ``run_dir``."""
        if self._dry_run:
            sys.stdout.write(f"{DryRun(self.model, self.datamodule, self.trainer).describe()}\n")
            return
        run_dir = Path(self.config[subcommand].run_dir)
        what = f"runs r3dpa {subcommand} in {run_dir}"
        first = cast(Any, rank_zero_only).rank == 0  # known before there is a trainer
        with only_writer(run_dir / f".{subcommand}.lock", what) if first else nullcontext():
            checkpoints = run_dir / "checkpoints"
            if subcommand == "fit" and self._ckpt_path is None and _newest(run_dir) is not None:
                raise ValueError(
                    f"{checkpoints} holds an earlier run: resume it with --ckpt_path last, or give "
                    "another --run_dir"
                )
            if subcommand == "fit" and first:
                delete_unfinished(checkpoints)
            super()._run_subcommand(subcommand)

    def before_fit(self) -> None:
        """Check settings and load the stage before, ahead of hours of data preparation."""
        if isinstance(self.model, Stage):
            self.model.check_before_data(self.trainer, self.datamodule, self._resumed)
        if isinstance(self.model, GenerativeModule) and self._resumed is None:
            option, consequence = _WITHOUT_WEIGHTS.get(self.model.stage, ("", ""))
            if option and getattr(self.model, option) is None and self.model.init_from is None:
                rank_zero_info(f"without --model.init_args.{option} {consequence}")
        for line in batch_lines(self.model, self.datamodule, self.trainer):
            rank_zero_info(line)
        for callback in cast(Any, self.trainer).callbacks:
            if isinstance(callback, _RecordConfig):
                callback.hold_wandb_back(self.trainer)

    def after_fit(self) -> None:
        """Name the checkpoint, and the command that takes it."""
        run_dir = Path(self.config[self.subcommand].run_dir)
        ckpt, stage = _newest(run_dir), getattr(self.model, "stage", None)
        if ckpt is None or stage is None:
            return
        command = _NEXT_COMMANDS.get(stage, _SAMPLE_COMMAND)
        preset = f" --preset {self._preset}" if self._preset else ""
        command = command.format(ckpt=ckpt, run_dir=run_dir, preset=preset)
        rank_zero_info(f"checkpoint: {ckpt}; next: r3dpa {command}")

    def before_predict(self) -> None:
        """Refuse to use random weights."""
        if self._ckpt_path is None:
            raise ValueError(f"{self.subcommand} needs trained weights: give --ckpt_path")

    def before_validate(self) -> None:
        """Refuse random weights, and log at the step of the checkpoint, not at 0."""
        self.before_predict()
        step = 0 if self._resumed is None else self._resumed.step
        self.trainer.fit_loop.epoch_loop._batches_that_stepped = step or 0

    before_test = before_validate

    @property
    def _ckpt_path(self) -> str | None:
        return self.config[self.subcommand].ckpt_path

    def before_instantiate_classes(self) -> None:
        """Choose the precision; point loggers at the run's folder, `test` at the wandb run too."""
        config = self.config[self.subcommand]
        if config.trainer.precision == "bf16-mixed" and _runs_without_bfloat16(config.trainer):
            rank_zero_info(
                "this processor computes bfloat16 tens of times more slowly than float32: "
                "precision 32-true (--trainer.accelerator cpu keeps bf16-mixed)"
            )
            config.trainer.precision = "32-true"
        if self.subcommand == "predict" and config.return_predictions is None:
            config.return_predictions = False  # they are on disk; all of KITTI-360 is 20 GB
        if self._dry_run:
            config.trainer.logger = False
            return
        run_dir = Path(config.run_dir)
        run_dir.mkdir(parents=True, exist_ok=True)
        loggers = config.trainer.logger
        for logger in loggers if isinstance(loggers, list) else [loggers]:
            arguments: Any = getattr(logger, "init_args", {})
            if "save_dir" in arguments:
                arguments.save_dir = config.run_dir
                if logger.class_path.endswith(".WandbLogger"):
                    self._name_wandb_run(arguments, run_dir)

    def _name_wandb_run(self, init_args: Any, run_dir: Path) -> None:
        """Fill what the configuration leaves open; `test` and a resumed `fit` join the run."""
        note = run_dir / _WANDB_ID
        is_first = cast(Any, rank_zero_only).rank == 0
        if self.subcommand == "fit" and is_first and not note.exists():
            write_text(note, uuid.uuid4().hex[:8])
        for key, value in _wandb_names(self.config[self.subcommand]).items():
            if init_args.get(key) is None:
                init_args[key] = value
        if init_args.get("offline"):  # nothing to look at on the web
            os.environ.setdefault("WANDB_SILENT", "true")


def _wandb_names(config: Any) -> dict[str, str | None]:
    """Name, group, type and id of the wandb run of a configuration, by its ``run_dir``."""
    run_dir, model = Path(config.run_dir), config.get("model")
    note = run_dir / _WANDB_ID
    return {
        "name": "/".join(run_dir.parts[-2:]),
        "group": run_dir.resolve().parent.name,
        "job_type": model.class_path.rpartition(".")[2] if model else None,
        "id": note.read_text(encoding="utf-8") if note.exists() else None,
    }


def _runs_without_bfloat16(trainer: Any) -> bool:
    """Whether accelerator ``auto`` finds no more than a processor without bfloat16."""
    accelerated = torch.cuda.is_available() or torch.backends.mps.is_available()
    capability = torch.backends.cpu.get_cpu_capability()
    return trainer.accelerator == "auto" and not accelerated and capability in _WITHOUT_BFLOAT16


def _newest(run_dir: Path) -> str | None:
    """Newest checkpoint of a run, if it has one."""
    last = run_dir / "checkpoints" / "last.ckpt"
    checkpoints = last.parent.glob("[!.]*.ckpt")
    newest = max(checkpoints, key=lambda path: path.stat().st_mtime_ns, default=None)
    if newest is None:
        return None
    if newest != last and last.exists():  # a copied folder may have the times of copying
        newest = max(last, newest, key=lambda path: read_checkpoint(path).step or 0)
    return str(newest)


def run(args: list[str]) -> None:
    """Run a stage command: ``["fit", "--config", "x.yaml"]``, ``["fit", "joint"]``.

    ``--dry_run`` prints what a ``fit`` takes, and writes nothing.
    """
    ignore_harmless_notices()
    words, preset = expand_preset([word for word in args[1:] if word != "--dry_run"])
    dry_run = "--dry_run" in args
    with options_of_lightning():
        StageCLI([args[0], *find_configs(words)], preset, dry_run=dry_run)


@contextmanager
def options_of_lightning() -> Iterator[None]:
    """Turn what Lightning says of its options into a line for the user."""
    try:
        yield
    except MisconfigurationException as error:
        if getattr(error, "during_training", False):
            raise
        raise ValueError(" ".join(str(error).split())) from None
