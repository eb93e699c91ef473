"""``r3dpa fit | validate`` with stages other than those of range images; presets, wandb."""

import csv
import io
import re
import warnings
from contextlib import chdir, redirect_stdout
from pathlib import Path

import pytest
import torch
import wandb
import yaml
from jsonargparse import Namespace
from lightning.pytorch.demos.boring_classes import BoringModel
from lightning.pytorch.utilities import rank_zero_only
from safetensors import safe_open

from r3dpa.cli import main
from r3dpa.cli.features import with_data_class
from r3dpa.cli.presets import conf_folder
from r3dpa.cli.stages import StageCLI, _newest, ignore_harmless_notices
from r3dpa.features import feature_source

CONF = Path(__file__).resolve().parents[2] / "conf"
BORING = "lightning.pytorch.demos.boring_classes"
WEIGHTS = "model.init_args.weights"


class LoggingModel(BoringModel):
    """Says what its loss is."""

    def validation_step(self, batch, batch_idx):
        self.log("held_out_loss", self.step(batch))


def words(model, data, run_dir):
    fixed = ["--trainer.accelerator=cpu", "--trainer.logger=false", "--trainer.max_steps=2"]
    fixed += ["--trainer.enable_progress_bar=false", "--trainer.limit_val_batches=2"]
    fixed += ["--allow_import", __name__]
    return ["--model", model, "--data", data, "--run_dir", str(run_dir), *fixed]


@pytest.mark.parametrize(("name", "shown"), [("val/reconstruction", 0), ("mine", 1)])
def test_means_of_all_processes_need_no_advice(name, shown):
    """Those of Lightning about the means of a single process stay."""
    advice = f"It is recommended to use `self.log({name!r}, ..., sync_dist=True)` when logging on"
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        ignore_harmless_notices()
        warnings.warn(advice, stacklevel=1)
    assert len(found) == shown


def test_any_lightning_module_is_trained_resumed_and_evaluated(tmp_path, capsys):
    arguments = words(f"{__name__}.LoggingModel", f"{BORING}.BoringDataModule", tmp_path)
    main(["fit", *arguments])
    last = tmp_path / "checkpoints" / "last.ckpt"
    assert torch.load(last, weights_only=True)["global_step"] == 2
    main(["fit", *arguments, "--trainer.max_steps=4", "--ckpt_path", str(last)])
    assert torch.load(last, weights_only=True)["global_step"] == 4
    # A run with this configuration is a new one.
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["ckpt_path"] is None
    capsys.readouterr()
    main(["validate", *arguments, "--ckpt_path", str(last)])
    assert "held_out_loss" in capsys.readouterr().out
    arguments.remove("--trainer.logger=false")
    logger = ["--trainer.logger=CSVLogger", "--trainer.logger.save_dir=x"]
    main(["validate", *arguments, *logger, "--ckpt_path", "last"])
    (log,) = tmp_path.rglob("metrics.csv")
    (row,) = csv.DictReader(log.open())
    assert row["step"] == "4"  # of the checkpoint: a row at step 0 would start its curve
    with pytest.raises(ValueError, match="validate needs trained weights: give --ckpt_path"):
        main(["validate", *arguments])


@pytest.fixture(scope="module")
def printed_demo(tmp_path_factory):
    """Configuration of a command line in a folder without configurations, as it is printed."""
    words = "--trainer.limit_val_batches 1 --trainer.limit_train_batches 1.0 --trainer.max_steps 7 "
    words += f"--{WEIGHTS}.adversarial_ratio null --{WEIGHTS}.alignment_release 0.02 "
    words += f"--{WEIGHTS}.alignment_release None"
    shown = io.StringIO()
    folder = tmp_path_factory.mktemp("elsewhere")
    with chdir(folder), redirect_stdout(shown), pytest.raises(SystemExit):
        main(["fit", "joint", "--preset", "demo", *words.split(), "--print_config"])
    return shown.getvalue()


def test_one_batch_is_no_share_of_all(printed_demo):
    """Lightning takes 1 as a number of batches, and 1.0 as all of them."""
    assert "\n  limit_val_batches: 1\n" in printed_demo
    assert "\n  limit_train_batches: 1.0\n" in printed_demo


def test_nested_values_are_unset_from_the_command_line(printed_demo):
    """jsonargparse hands null on as the text None, which is no number."""
    weights = yaml.safe_load(printed_demo)["model"]["init_args"]["weights"]
    assert weights["adversarial_ratio"] is None
    assert weights["alignment_release"] is None


def test_a_stage_of_range_images_needs_batches_of_them(smoke_args, tmp_path):
    more = ["--data", f"{BORING}.BoringDataModule", "--trainer.logger=false"]
    arguments = smoke_args("vae_alignment", tmp_path, *more)
    with pytest.raises(
        ValueError,
        match=r"--data\.class_path: VAEAlignment needs a data module that gives .*LidarBatch.*, "
        r"got BoringDataModule",
    ):
        main(arguments)
    assert not list(tmp_path.rglob("*.ckpt"))


@pytest.mark.parametrize(
    ("model", "data", "message"),
    [
        (
            "r3dpa.modules.Nothing",
            "BoringDataModule",
            "r3dpa fit: --model: module .r3dpa.modules. has no attribute .Nothing",
        ),
        (f"{BORING}.BoringModel", "BoringModel", "r3dpa fit: --data: .*BoringModel"),
    ],
)
def test_a_class_that_is_none_or_of_the_wrong_kind_is_named(model, data, message, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["fit", *words(model, f"{BORING}.{data}", tmp_path)])
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(message, line)


def test_presets_are_the_shipped_configurations(printed_demo):
    config = yaml.safe_load(printed_demo)
    assert config["model"]["class_path"] == "r3dpa.modules.JointAlignment"
    assert config["model"]["init_args"]["sit"]["init_args"]["hidden_size"] == 192
    assert config["data"]["init_args"]["root"] == "runs/demo/data"
    assert (config["run_dir"], config["trainer"]["max_steps"]) == ("runs/demo/joint", 7)


def test_the_paper_is_kitti360_with_scalr_and_a_global_batch_of_32_on_4_gpus():
    """Features as in the ablations at the scale of the paper; all else as in the default preset."""

    def data_of(name):
        return yaml.safe_load((conf_folder() / f"{name}.yaml").read_text())["data"]

    usual, paper = data_of("data/kitti360"), data_of("data/kitti360_paper")
    ablation = yaml.safe_load((conf_folder() / "ablation/scale/paper.yaml").read_text())
    extractor = ablation["config"]["data"]["init_args"]["extractor"]
    assert paper["init_args"]["extractor"] == extractor
    assert (
        4 * paper["init_args"]["batch_size"]
        == ablation["config"]["data"]["init_args"]["batch_size"]
    )
    usual["init_args"]["extractor"] = extractor
    assert paper == usual


def test_shipped_files_are_found_from_everywhere(capsys, tmp_path, monkeypatch):
    """As after an installation of the package; a file of the user with that name goes first."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "trainer.yaml").write_text("trainer: {max_steps: 7}")
    words = ["--config", "conf/trainer.yaml", "--config=conf/data/demo.yaml"]
    with pytest.raises(SystemExit) as ended:
        main(["fit", *words, "--config", "conf/experiment/joint.yaml", "--print_config"])
    assert ended.value.code == 0
    config = yaml.safe_load(capsys.readouterr().out)
    assert config["model"]["class_path"] == "r3dpa.modules.JointAlignment"
    assert config["data"]["init_args"]["root"] == "runs/demo/data"
    assert config["trainer"]["logger"] is None
    assert with_data_class(["--data", "conf/data/kitti360.yaml"])[1].startswith(str(conf_folder()))


def test_evaluation_joins_the_wandb_run_of_the_training(tmp_path):
    run_dir = tmp_path / "group" / "run"
    arguments = words(f"{__name__}.LoggingModel", f"{BORING}.BoringDataModule", run_dir)
    arguments[arguments.index("--trainer.logger=false")] = "--trainer.logger=WandbLogger"
    arguments += ["--trainer.logger.offline=true", "--trainer.logger.save_dir=x"]
    main(["fit", *arguments])
    run = wandb.run
    assert (run.name, run.group, run.job_type) == ("group/run", "group", "LoggingModel")
    wandb.finish()
    main(["validate", *arguments, "--ckpt_path", "last"])
    wandb.finish()
    wandb.teardown()  # else its settings hold for all tests after this one
    run_id = (run_dir / "wandb_id.txt").read_text()
    folders = [path.name for path in run_dir.glob("wandb/offline-run-*")]
    assert folders  # two that begin within one second differ in a number at the end
    assert all(f"-{run_id}" in name for name in folders)
    # A run with this configuration has a wandb run of its own.
    logger = yaml.safe_load((run_dir / "config.yaml").read_text())["trainer"]["logger"]
    names = ("id", "name", "group", "job_type")
    assert [logger["init_args"][name] for name in names] == [None] * 4


def test_the_first_process_names_the_wandb_run(tmp_path, monkeypatch):
    cli = object.__new__(StageCLI)
    cli.subcommand = "fit"
    cli.config = Namespace(fit=Namespace(run_dir=str(tmp_path), model=None))
    for rank, names_it in ((1, False), (0, True)):
        monkeypatch.setattr(rank_zero_only, "rank", rank)
        cli._name_wandb_run({}, tmp_path)
        assert (tmp_path / "wandb_id.txt").exists() == names_it


def test_what_lightning_says_of_its_options_is_one_line(tmp_path):
    arguments = words(f"{__name__}.LoggingModel", f"{BORING}.BoringDataModule", tmp_path)
    with pytest.raises(ValueError, match="limit_train_batches") as raised:
        main(["fit", *arguments, "--trainer.limit_train_batches=1.5"])
    assert len(str(raised.value).splitlines()) == 1


def test_last_of_a_copied_run_has_most_steps(joint_run, tmp_path):
    """Its files may have the times of copying."""
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    assert _newest(tmp_path) is None
    content = torch.load(joint_run / "checkpoints" / "last.ckpt", weights_only=True)
    for name, step in (("last", 4), ("step=0000003", 3)):
        torch.save(content | {"global_step": step}, folder / f"{name}.ckpt")
    assert _newest(tmp_path) == str(folder / "last.ckpt")
    torch.save(content | {"global_step": 5}, folder / "step=0000005.ckpt")
    assert _newest(tmp_path) == str(folder / "step=0000005.ckpt")


SIMULATED = {
    "data.init_args.source.init_args.num_scans": 12,
    "data.init_args.source.init_args.simulation_seed": 0,
}
TEACHER = {
    "data.init_args.source.init_args.limit": 3,
    "data.init_args.batch_size": 1,
    "data.init_args.num_workers": 0,
    "model.init_args.network.init_args.width": 8,
    "model.init_args.network.init_args.depth": 3,
    "model.init_args.network.init_args.cells": "[48, 48, 5]",
    "data.init_args.prepare.init_args.grid.cell_m": 2.4,
    "data.init_args.prepare.init_args.grid.voxel_m": 1.2,
    "trainer.accelerator": "cpu",
    "trainer.enable_progress_bar": "false",
    "trainer.enable_model_summary": "false",
    "trainer.limit_val_batches": 1,
    "trainer.val_check_interval": 1,
    "trainer.log_every_n_steps": 1,
    "trainer.logger": "false",
    "trainer.max_steps": 2,
    "checkpoint.every_n_train_steps": 1,
    "checkpoint.save_top_k": -1,
}


@pytest.fixture(scope="session")
def roots(smoke_root, make_once):
    """Roots of the scans and of the labelled images that teachers learn from."""
    return {"points": smoke_root, "images": make_once("labelled_images", Path.mkdir)}


def trained_teacher(roots, run_dir, *more):
    configs = ["trainer.yaml", "data/points.yaml", "experiment/waffleiron_s.yaml"]
    words = [f"--{key}={value}" for key, value in (TEACHER | SIMULATED).items()]
    words += [f"--data.init_args.source.init_args.root={roots['points']}"]
    return trained(configs, words, run_dir, *more)


def trained_judge(roots, run_dir, *more):
    return trained_with_classes(roots, run_dir, *more, experiment="waffleiron_judge")


def trained_with_classes(roots, run_dir, *more, experiment="waffleiron_s_2"):
    configs = ["trainer.yaml", "r3dpa_s_2/trainer.yaml", "data/labelled_points.yaml"]
    configs.append(f"experiment/{experiment}.yaml")
    words = [f"--{key}={value}" for key, value in (TEACHER | SIMULATED).items()]
    words += [f"--data.init_args.source.init_args.root={roots['images']}"]
    return trained(configs, words, run_dir, *more)


def trained(configs, settings, run_dir, *more):
    words = [word for name in configs for word in ("--config", str(CONF / name))]
    words += [*settings, f"--run_dir={run_dir}"]
    main(["fit", *words, *more])
    return torch.load(run_dir / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


@pytest.mark.parametrize("train", [trained_teacher, trained_with_classes])
def test_the_point_teacher_trains_resumes_exactly_and_gives_a_source(train, roots, tmp_path):
    whole = train(roots, tmp_path / "whole")
    middle = tmp_path / "whole" / "checkpoints" / "step=0000001.ckpt"
    resumed = train(roots, tmp_path / "rest", f"--ckpt_path={middle}")
    for key, value in whole.items():
        # Without targets of geometry, their quantiles stay NaN.
        torch.testing.assert_close(resumed[key], value, rtol=0, atol=0, equal_nan=True, msg=key)
    kind = torch.float16 if train is trained_with_classes else torch.float32
    assert_gives_a_source(tmp_path / "rest", kind)


def test_the_judge_trains_and_gives_a_source(roots, tmp_path):
    """It is of the class of the first teacher, on the images of the second."""
    trained_judge(roots, tmp_path, "--trainer.max_steps=1")
    assert_gives_a_source(tmp_path, torch.float32)


def assert_gives_a_source(run_dir, kind):
    (weights,) = run_dir.glob("*.safetensors")
    name = weights.stem.replace("_", "-")
    features = feature_source(name, weights, dim=16)(torch.rand(50, 4) * 10)
    assert features.shape == (50, 16)
    assert torch.allclose(features.norm(dim=1), torch.ones(50), atol=1e-5)
    with safe_open(weights, "pt") as file:
        kinds = {file.get_tensor(key).dtype for key in file.keys()} - {torch.int64}  # noqa: SIM118
    assert kinds == {kind}


def test_one_command_simulates_then_adds_scans_and_the_grids_of_a_teacher(tmp_path, capsys):
    """The images of conf/r3dpa_s_2 are also what its teacher is trained on."""
    data, labelled, teacher = (
        CONF / name
        for name in ("r3dpa_s_2/data.yaml", "data/labelled_points.yaml", "r3dpa_s_2/teacher.yaml")
    )
    given, source = (
        yaml.safe_load(path.read_text())["data"]["init_args"] for path in (data, labelled)
    )
    source = source["source"]["init_args"]
    assert {key: given[key] for key in source} == source
    words = ["data", "prepare", f"--config={data}", f"--data.init_args.root={tmp_path}"]
    words += [
        "--data.init_args.sensor={beams: 16, columns: 64}",
        "--data.init_args.grid_size=[2, 8]",
    ]
    main([*words, "--data.init_args.num_scans=2"])
    assert "1 scan to train, 1 held out; no feature grids" in capsys.readouterr().out
    words.append("--data.init_args.num_scans=3")
    weights = feature_source("waffleiron-s").shipped
    extractor = f"--data.init_args.extractor.init_args.weights={weights}"
    main([*words, f"--config={teacher}", extractor])
    grids = tmp_path / "feature_grids" / "waffleiron-s-2"
    assert f"2 scans to train, 1 held out; feature grids: {grids}" in capsys.readouterr().out
    counts = [
        sum(len(path.read_text().splitlines()) for path in folder.glob("*.jsonl"))
        for folder in (*tmp_path.glob("labelled_image_*"), grids / "2x8")
    ]
    assert counts == [3, 3]
