"""What a user can get wrong before training: each gives one error that names what and where.

All through the real command line, and all before a step is taken: no checkpoint appears.
"""

from __future__ import annotations

import re
from functools import partial

import lightning as L
import numpy as np
import pytest
import torch
from tiny_stages import FEATURE_DIM, SENSOR, SILENT, TinyData, stage_module, tiny_sit, train

from r3dpa.cli import main
from r3dpa.data import SimulatedDataModule
from r3dpa.features import GeometricFeatures
from r3dpa.geometry import RangeCodec
from r3dpa.modules import OptimizerConfig

SIT = "model.init_args.sit.init_args"
pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args parameter")


def data_args(folder, *more):
    """Scans of a folder in place of the simulated ones of conf/smoke.yaml."""
    kind = ["--data.class_path", "r3dpa.data.LidarDataModule", "--data.init_args.scans", folder]
    return [str(word) for word in (*kind, "--data.init_args.val_every", "null", *more)]


@pytest.fixture
def refused(smoke_args, tmp_path):
    """``refused(stage, *args)``: message of the one error that training ends with."""

    def run(stage, *more, error=ValueError):
        run_dir = tmp_path / "run"
        fixed = ["--trainer.logger=false", "--trainer.limit_val_batches=0"]
        fixed += ["--trainer.callbacks=[]"]
        with pytest.raises(error) as caught:
            main(smoke_args(stage, run_dir, *fixed, *map(str, more)))
        assert not list(run_dir.rglob("*.ckpt"))
        return str(caught.value)

    return run


def test_a_corrupted_scan_is_named_while_grids_are_made(own_scans, refused):
    for path in own_scans.iterdir():
        if path.stem != "000002":
            path.unlink()  # the bad scan is in the first batch
    path = own_scans / "000002.bin"
    path.write_bytes(np.float32(np.nan).tobytes() + path.read_bytes()[4:])
    message = refused("joint", *data_args(own_scans), "--data.init_args.batch_size", 1)
    assert message.startswith(f"{path}: has NaN or infinite values in 1")


def test_a_folder_without_a_split_of_kitti360(tmp_path, refused):
    kitti = ["--data.class_path", "r3dpa.data.KITTI360DataModule"]
    message = refused("joint", *kitti, "--data.init_args.root", tmp_path)
    assert f"no scan of the train split in {tmp_path}" in message
    assert "r3dpa data check" in message


@pytest.mark.parametrize(
    ("option", "named"),
    [
        ("data: {init_args: {bacth_size: 3}}", "bacth_size"),
        ("optimiser: {lr: 3}", "optimiser"),
        ("--scorer.batch_size=0", "--scorer.batch_size: expected a number above 0, got 0"),
    ],
)
def test_an_option_or_key_that_cannot_be_is_named(option, named, tmp_path, refused, capsys):
    if not option.startswith("--"):
        (tmp_path / "extra.yaml").write_text(option)
        option = f"--config={tmp_path / 'extra.yaml'}"
    assert refused("joint", option, error=SystemExit) == "2"
    assert named in capsys.readouterr().err.split("error:")[-1]


@pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")
@pytest.mark.parametrize(
    ("data", "sit", "message"),
    [
        ({"features_dir": None}, {}, "joint aligns with 3D features, but the data module has none"),
        ({"feature_dim": 16}, {"feature_dim": 20}, "width 16, but the SiT has feature_dim 20"),
        ({}, {"input_size": [4, 8], "patch_size": 4}, "grids are .2, 4., but the SiT has .1, 2. t"),
        ({}, {"in_channels": 8}, "the SiT has in_channels 8, but the VAE has 4 latent channels"),
    ],
)
def test_networks_and_data_that_do_not_fit(data, sit, message):
    given = TinyData()
    vars(given).update(data)
    with pytest.raises(ValueError, match=message):
        train(stage_module("joint", partial(tiny_sit, **sit)), given)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--trainer.precision=64-true", "--trainer.precision 64-true is not supported"),
        (
            f"--{SIT}.input_size=[4,8]",
            "(16, 64) pixels give (4, 16) latents, but the SiT has input_size (4, 8)",
        ),
    ],
)
def test_a_mistake_is_reported_before_scans_are_simulated(words, message, tmp_path, refused):
    root = f"--data.init_args.root={tmp_path / 'scans'}"
    assert message in refused("joint", root, words)
    assert not (tmp_path / "scans").exists()


SIZES = {"sensor": SENSOR, "grid_size": (2, 4), "extractor": GeometricFeatures(dim=FEATURE_DIM)}
DECAYING = {"optimizer": OptimizerConfig(decay_steps=2)}
TO_THE_LATTER = "set --data.init_args.grid_size to the latter"


@pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")
@pytest.mark.parametrize(
    ("data", "sit", "module", "message"),
    [
        ({}, {}, DECAYING, "optimizer.decay_steps and optimizer.cosine need the last step"),
        ({}, {"in_channels": 8}, {}, "has in_channels 8, but the VAE has 4 latent channels"),
        ({}, {"feature_dim": 20}, {}, "features have width 6"),
        ({"codec": RangeCodec(return_channel=True)}, {}, {}, "the VAE is for images with"),
        ({"grid_size": (4, 8)}, {}, {}, TO_THE_LATTER),
        # Their inclinations are not known yet.
        ({"projection": "rings", "grid_size": (4, 8)}, {}, {}, TO_THE_LATTER),
        (
            {"grid_size": (3, 16)},
            {},
            {},
            "set --data.init_args.grid_size, or beams and columns of --data.init_args.sensor",
        ),
    ],
)
def test_checks_that_need_no_scan(data, sit, module, message, tmp_path):
    """Called before data are prepared, as the test above shows."""
    scans = SimulatedDataModule(str(tmp_path / "scans"), **SIZES | data)
    stage = stage_module("joint", partial(tiny_sit, **sit), **module)
    trainer = L.Trainer(**SILENT, max_steps=-1)
    with pytest.raises(ValueError, match=re.escape(message)):
        stage.check_before_data(trainer, scans, None)


def test_settings_that_fit_pass_the_checks(tmp_path):
    scans = SimulatedDataModule(str(tmp_path / "scans"), **SIZES)
    stage_module("joint", **DECAYING).check_before_data(
        L.Trainer(**SILENT, max_steps=9), scans, None
    )


def test_a_fit_in_python_is_told_to_give_a_datamodule():
    trainer = L.Trainer(**SILENT, max_steps=1)
    with pytest.raises(ValueError, match=r"in Python, give trainer\.fit a datamodule"):
        trainer.fit(stage_module("joint"), train_dataloaders=TinyData().train_dataloader())


class TestCheckpoints:
    def test_resuming_the_checkpoint_of_another_stage(self, vae_checkpoint, tmp_path, refused):
        root = f"--data.init_args.root={tmp_path / 'scans'}"
        message = refused("joint", root, "--ckpt_path", vae_checkpoint)
        assert "is of stage 'vae_alignment', this is 'joint'" in message
        assert not (tmp_path / "scans").exists()

    def test_a_url_or_a_setting_makes_none_run_code(self, smoke_args, tmp_path):
        class Evil:
            def __reduce__(self):
                return (tmp_path / "ran").touch, ()

        torch.save({"state_dict": {}, "evil": Evil()}, tmp_path / "evil.ckpt")
        for path in (f"file://{tmp_path}/evil.ckpt", "http://127.0.0.1:9/evil.ckpt"):
            words = smoke_args("joint", tmp_path / "run", "--ckpt_path", path)
            with pytest.raises(FileNotFoundError, match=r"evil\.ckpt"):
                main([*words, "--weights_only=false"])
        words = smoke_args("joint", tmp_path / "run", "--weights_only=false")
        with pytest.raises(ValueError, match="would run code of the checkpoint: leave it out"):
            main(["predict", *words[1:]])
        assert not (tmp_path / "ran").exists()

    @pytest.mark.parametrize(
        ("stage", "option"),
        [("vae_alignment", "--ckpt_path"), ("joint", "--model.init_args.init_from")],
    )
    def test_range_images_of_another_encoding(
        self, stage, option, vae_checkpoint, tmp_path, refused
    ):
        """A checkpoint knows the range images it was trained on; no scan is needed to compare."""
        other = "--data.init_args.codec={encoding: log2}"
        root = f"--data.init_args.root={tmp_path / 'scans'}"
        message = refused(stage, root, other, option, vae_checkpoint)
        assert not (tmp_path / "scans").exists()
        assert "encoding='linear'" in message
        assert "encoding='log2'" in message
        assert stage == "vae_alignment" or str(vae_checkpoint) in message
