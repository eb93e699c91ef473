"""``r3dpa fit | validate`` with stages and data modules other than those of range images."""

from __future__ import annotations

import pytest
import torch
import wandb
import yaml
from lightning.pytorch.demos.boring_classes import BoringDataModule, BoringModel

from r3dpa.cli import main

pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args parameter")

BORING = "lightning.pytorch.demos.boring_classes"


class LoggingModel(BoringModel):
    """Says what its loss is."""

    def validation_step(self, batch, batch_idx):
        self.log("held_out_loss", self.step(batch))


class PickyModel(BoringModel):
    """Trains on the batches of one kind of data module."""

    class Data(BoringDataModule):
        """That kind."""

    data_class = Data


def words(model, data, run_dir):
    fixed = ["--trainer.accelerator=cpu", "--trainer.logger=false", "--trainer.max_steps=2"]
    fixed += ["--trainer.enable_progress_bar=false", "--trainer.limit_val_batches=2"]
    return ["--model", model, "--data", data, "--run_dir", str(run_dir), *fixed]


@pytest.fixture
def refused(capsys):
    """``refused(*args)``: what the command line says to a fit that does not start."""

    def run(*args):
        with pytest.raises((SystemExit, ValueError)) as stop:
            main(["fit", *args])
        return str(stop.value) + capsys.readouterr().err

    return run


def test_any_lightning_module_is_trained_resumed_and_evaluated(tmp_path, capsys):
    arguments = words(f"{__name__}.LoggingModel", f"{BORING}.BoringDataModule", tmp_path)
    main(["fit", *arguments])
    last = tmp_path / "checkpoints" / "last.ckpt"
    assert torch.load(last, weights_only=True)["global_step"] == 2
    main(["fit", *arguments, "--trainer.max_steps=4", "--ckpt_path", str(last)])
    assert torch.load(last, weights_only=True)["global_step"] == 4
    capsys.readouterr()
    main(["validate", *arguments, "--ckpt_path", str(last)])
    assert "held_out_loss" in capsys.readouterr().out
    with pytest.raises(ValueError, match="validate needs trained weights: give --ckpt_path"):
        main(["validate", *arguments])


def test_a_stage_of_range_images_needs_batches_of_them(smoke_args, tmp_path):
    arguments = smoke_args("vae_alignment", tmp_path, "--data", f"{BORING}.BoringDataModule")
    with pytest.raises(
        ValueError,
        match=r"data\.class_path: VAEAlignment needs a data module that gives .*LidarBatch.*, "
        r"got BoringDataModule",
    ):
        main(arguments)
    assert not list(tmp_path.rglob("*.ckpt"))


def test_a_stage_names_the_data_modules_that_it_takes(refused, tmp_path):
    picky = f"{__name__}.PickyModel"
    message = refused(*words(picky, f"{BORING}.BoringDataModule", tmp_path / "run"))
    assert "data.class_path: PickyModel needs a" in message
    main(["fit", *words(picky, f"{__name__}.PickyModel.Data", tmp_path / "run")])


@pytest.mark.parametrize(
    ("model", "data", "field"),
    [
        ("r3dpa.modules.Nothing", f"{BORING}.BoringDataModule", "model"),
        (f"{BORING}.BoringDataModule", f"{BORING}.BoringDataModule", "model"),
        (f"{BORING}.BoringModel", f"{BORING}.BoringModel", "data"),
    ],
)
def test_a_class_that_is_none_or_of_the_wrong_kind_is_named(refused, tmp_path, model, data, field):
    message = refused(*words(model, data, tmp_path))
    assert f"r3dpa fit: --{field}: " in message
    assert message.count("\n") == 1
    assert (model if field == "model" else data) in message


def test_presets_are_the_shipped_configurations(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(["fit", "joint", "--preset", "demo", "--trainer.max_steps", "7", "--print_config"])
    config = yaml.safe_load(capsys.readouterr().out)
    assert config["model"]["class_path"] == "r3dpa.modules.JointAlignment"
    assert config["model"]["init_args"]["sit"]["init_args"]["hidden_size"] == 192
    assert config["data"]["init_args"]["root"] == "runs/demo/data"
    assert (config["run_dir"], config["trainer"]["max_steps"]) == ("runs/demo/joint", 7)
    with pytest.raises(ValueError, match=r"there is no experiment 'jointly'; give one of .*joint"):
        main(["fit", "jointly"])
    with pytest.raises(ValueError, match=r"there is no data 'kitti'; give one of .*kitti360"):
        main(["fit", "joint", "--preset", "kitti"])


def test_evaluation_joins_the_wandb_run_of_the_training(tmp_path):
    run_dir = tmp_path / "group" / "run"
    arguments = words(f"{__name__}.LoggingModel", f"{BORING}.BoringDataModule", run_dir)
    arguments[arguments.index("--trainer.logger=false")] = "--trainer.logger=WandbLogger"
    arguments += ["--trainer.logger.offline=true", "--trainer.logger.save_dir=x"]
    main(["fit", *arguments])
    wandb.finish()
    main(["validate", *arguments, "--ckpt_path", "last"])
    wandb.finish()
    wandb.teardown()  # else its settings hold for all tests after this one
    run_id = (run_dir / "wandb_id.txt").read_text()
    runs = list(run_dir.glob(f"wandb/offline-run-*-{run_id}"))
    assert runs
    assert len(list(run_dir.glob("wandb/offline-run-*"))) == len(runs)
