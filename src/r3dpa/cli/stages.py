"""LightningCLI of the training stages: ``r3dpa fit | validate | test | predict``."""

from __future__ import annotations

import sys
import uuid
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from importlib.resources import files
from pathlib import Path
from typing import Any, cast

import yaml
from lightning import LightningDataModule, LightningModule, Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from r3dpa.callbacks import RunCheckpoint, SceneScorer
from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli.parser import Parser
from r3dpa.io import delete_unfinished, only_writer, source_commit, write_text
from r3dpa.modules import GenerativeModule

_STAGES = ("experiment", "baseline")  # folders of their configurations
# Intended here: averages and frozen networks stay in evaluation mode, feature grids go to disk, a
# process may have no scan, and the means of held-out scans are already those of all processes.
_HARMLESS = (
    r"Found \d+ module\(s\) in eval mode",
    r"`isinstance\(treespec, LeafSpec\)` is deprecated",
    r"The number of training batches .* is smaller than the logging interval",
    r"The '.*_dataloader' does not have many workers",
    r"predict returned None",
    r"It is recommended to use `self\.log\('(val|test)/.*', \.\.\., sync_dist=True\)`",
    r"You have overridden `transfer_batch_to_device`",
    r"Total length of .* across ranks is zero",
)


class StageParser(Parser, LightningArgumentParser):
    """Parser of stages and data modules."""


def ignore_harmless_warnings() -> None:
    """Hides warnings of Lightning about what is intended here."""
    for message in _HARMLESS:
        warnings.filterwarnings("ignore", message=message)


def conf_folder() -> Path:
    """Folder of the shipped configurations, in a checkout and in an installed package alike."""
    return Path(str(files("r3dpa") / "conf"))


def shipped(path: str | Path) -> Path:
    """The file, or the one of the package where ``conf/...`` does not exist here."""
    of_package = conf_folder().parent / path
    is_shipped = not Path(path).exists() and of_package.exists()
    return of_package if is_shipped else Path(path)


def _with_shipped(words: Sequence[str]) -> list[str]:
    """The words with the files after ``--config`` as :func:`shipped` finds them."""
    found: list[str] = []
    for word in words:
        name, _, value = word.partition("=")
        if name == "--config" and value.startswith("conf/"):
            word = f"--config={shipped(value)}"
        elif found[-1:] == ["--config"] and word.startswith("conf/"):
            word = str(shipped(word))
        found.append(word)
    return found


def _prefer_whole_numbers(parser: LightningArgumentParser) -> None:
    """Read 1 as one batch where an option is a number of batches or, as 1.0, a share of all.

    Python gives ``int | float`` of Lightning's signature back as ``float | int`` where another
    package has written that first, and the parser takes the first type that fits.
    """
    actions: list[Any] = parser._actions
    for action in actions:
        if getattr(action, "_typehint", None) == int | float | None:
            action._typehint = int | float | None


class _RecordConfig(SaveConfigCallback):
    """Writes the configuration of a training to ``run_dir`` and to wandb."""

    started = False

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if stage == "fit":  # evaluating a run does not replace its configuration
            super().setup(trainer, pl_module, stage)

    def save_config(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Not to ``trainer.log_dir``, which would need all processes."""
        text = self.parser.dump(self.config, skip_unset=False, skip_validation=True)
        path = Path(trainer.default_root_dir) / self.config_filename
        write_text(path, text)
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                logger.log_hyperparams(yaml.safe_load(text) | {"commit": source_commit()})

    def on_train_batch_start(self, *_: Any) -> None:
        self.started = True

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Marks errors of a running training, whose traceback ``cli.main`` shows."""
        exception.during_training = self.started  # type: ignore[attr-defined]


class StageCLI(LightningCLI):
    """Wires a stage, a data module and a trainer from YAML files.

    A run writes checkpoints, logs and pictures below ``run_dir``, where one process at a time
    trains. ``--ckpt_path last`` is its newest checkpoint, or none, so that one command starts and
    resumes a job.
    """

    def __init__(self, args: list[str]) -> None:
        self._command = args[0]
        self._ckpt_step: int | None = None
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
        """The given one alone: each has a parser that takes a quarter of a second to build."""
        return {self._command: LightningCLI.subcommands()[self._command]}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Adds ``run_dir``, the checkpoint callback that follows it, and the one that scores."""
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

    def _parse_ckpt_path(self) -> None:
        """Checks the local file, without which Lightning would run what a URL says."""
        config = self.config[self.config.subcommand]
        if config.get("ckpt_path") == "last":
            config.ckpt_path = _newest(Path(config.run_dir))
        if config.get("ckpt_path"):
            self._ckpt_step = read_checkpoint(config.ckpt_path).step
            if Path(config.ckpt_path).suffix != ".ckpt":  # released or exported
                raise ValueError(
                    f"--ckpt_path {config.ckpt_path} is no .ckpt of a run; scenes of other files "
                    "are made by `r3dpa sample` and scored by `r3dpa evaluate`"
                )
        if config.get("weights_only") is False:
            raise ValueError("weights_only: false would run code of the checkpoint: leave it out")
        config.weights_only = True

    def _run_subcommand(self, subcommand: str) -> None:
        """Runs the command, unless another process does the same in ``run_dir``."""
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
        """Loads the stage before: what does not fit is said before hours of data preparation."""
        if isinstance(self.model, GenerativeModule) and self._ckpt_path is None:
            self.model.load_previous_stage()

    def before_predict(self) -> None:
        """Refuses to use random weights."""
        if self._ckpt_path is None:
            raise ValueError(f"{self.subcommand} needs trained weights: give --ckpt_path")

    def before_validate(self) -> None:
        """Refuses to use random weights, and logs at the step of the checkpoint, not at 0."""
        self.before_predict()
        self.trainer.fit_loop.epoch_loop._batches_that_stepped = self._ckpt_step or 0

    before_test = before_validate

    @property
    def _ckpt_path(self) -> str | None:
        return self.config[self.subcommand].ckpt_path

    def before_instantiate_classes(self) -> None:
        """Points loggers at the run's folder; `test` and a resumed `fit` join the wandb run."""
        config = self.config[self.subcommand]
        if self.subcommand == "predict" and config.return_predictions is None:
            config.return_predictions = False  # they are on disk; all of KITTI-360 is 20 GB
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
        """Fills what the configuration leaves open; `test` and a resumed `fit` join the run."""
        model, note = self.config[self.subcommand].get("model"), run_dir / "wandb_id.txt"
        if self.subcommand == "fit" and not note.exists():
            write_text(note, uuid.uuid4().hex[:8])
        names = {
            "name": "/".join(run_dir.parts[-2:]),
            "group": run_dir.resolve().parent.name,
            "job_type": model.class_path.rpartition(".")[2] if model else None,
            "id": note.read_text(encoding="utf-8") if note.exists() else None,
        }
        for key, value in names.items():
            if init_args.get(key) is None:
                init_args[key] = value


def _newest(run_dir: Path) -> str | None:
    found = list((run_dir / "checkpoints").glob("[!.]*.ckpt"))
    return str(max(found, key=lambda path: path.stat().st_mtime_ns)) if found else None


def _with_preset(words: list[str]) -> list[str]:
    """``STAGE [--preset NAME]`` after the command as the shipped configurations."""
    if not words or words[0].startswith("-"):
        return words
    stage, preset, rest = words[0], "kitti360", words[1:]
    if "--preset" in rest[:-1]:
        place = rest.index("--preset")
        preset = rest[place + 1]
        del rest[place : place + 2]
    conf, demo = conf_folder(), preset == "demo"
    stages = {p.stem: f"{k}/{p.stem}" for k in _STAGES for p in sorted((conf / k).glob("*.yaml"))}
    presets = [path.stem for path in sorted((conf / "data").glob("*.yaml"))]
    for kind, name, known in (("stage", stage, stages), ("data", preset, presets)):
        if name not in known:
            raise ValueError(f"there is no {kind} {name!r}; give one of {', '.join(known)}")
    data = "dead_leaves" if demo and stage in ("image_vae", "rgb_pretraining") else preset
    names = ["trainer", *(["demo/trainer"] if demo else []), f"data/{data}", stages[stage]]
    if demo and (conf / "demo" / f"{stage}.yaml").is_file():
        names.append(f"demo/{stage}")
    configs = [word for name in names for word in ("--config", str(conf / f"{name}.yaml"))]
    return [*configs, "--run_dir", f"runs/{preset}/{stage}", *rest]


def run(args: list[str]) -> None:
    """Runs a stage command: ``["fit", "--config", "x.yaml"]``, ``["fit", "joint"]``."""
    ignore_harmless_warnings()
    StageCLI([args[0], *_with_shipped(_with_preset(args[1:]))])
