"""What a user can get wrong before training: each gives one error that names what and where.

All through the real command line, and all before a step is taken: no checkpoint appears.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch

from r3dpa.cli import main

SIT = "model.init_args.sit.init_args"
pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args parameter")


@pytest.fixture
def folder(tmp_path):
    """Four small scans."""
    generator = np.random.default_rng(0)
    folder = tmp_path / "scans"
    folder.mkdir()
    for index in range(4):
        points = generator.uniform(2, 20, (200, 4)).astype(np.float32)
        (folder / f"{index:06d}.bin").write_bytes(points.tobytes())
    return folder


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


def test_a_corrupted_scan_is_named_while_grids_are_made(folder, refused):
    for path in folder.iterdir():
        if path.stem != "000002":
            path.unlink()  # the bad scan is in the first batch
    path = folder / "000002.bin"
    path.write_bytes(np.float32(np.nan).tobytes() + path.read_bytes()[4:])
    message = refused("joint", *data_args(folder), "--data.init_args.batch_size", 1)
    assert message.startswith(f"{path}: has NaN or infinite values in 1")


def test_a_folder_without_a_split_of_kitti360(tmp_path, refused):
    kitti = ["--data.class_path", "r3dpa.data.KITTI360DataModule"]
    message = refused("joint", *kitti, "--data.init_args.root", tmp_path)
    assert f"No scan of the train split in {tmp_path}" in message
    assert "r3dpa check" in message


@pytest.mark.parametrize(
    ("option", "named"),
    [
        ("--model.init_args.sit.init_args.dpeth=3", "dpeth"),
        ("data: {init_args: {bacth_size: 3}}", "bacth_size"),
        ("optimiser: {lr: 3}", "optimiser"),
        ("--data.init_args.batch_size=many", "batch_size"),
        ("--scorer.batch_size=0", "--scorer.batch_size: Not of type PositiveInt: 0"),
        ("--config=conf/nothing.yaml", "conf/nothing.yaml"),
    ],
)
def test_an_option_or_key_that_cannot_be_is_named(option, named, tmp_path, refused, capsys):
    if not option.startswith("--"):
        (tmp_path / "extra.yaml").write_text(option)
        option = f"--config={tmp_path / 'extra.yaml'}"
    assert refused("joint", option, error=SystemExit) == "2"
    assert named in capsys.readouterr().err.split("error:")[-1]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("data.init_args.extractor=null", "joint aligns with 3D features, but the data module has"),
        (
            f"{SIT}.input_size=[4, 8]",
            "(16, 64) pixels give (4, 16) latents, but sit.input_size is (4, 8); set it to the",
        ),
        (
            "data.init_args.grid_size=[4, 16]",
            "feature grids are (4, 16), but the SiT has (2, 8) tokens",
        ),
        (f"{SIT}.feature_dim=20", "features have width 16, but sit.feature_dim is 20"),
        (f"{SIT}.in_channels=8", "sit.in_channels is 8, but the VAE has 4 latent channels"),
    ],
)
def test_networks_and_data_that_do_not_fit(option, message, folder, refused):
    assert message in refused("joint", *data_args(folder), f"--{option}")


class TestCheckpoints:
    def test_resuming_the_checkpoint_of_another_stage(self, vae_checkpoint, refused):
        message = refused("joint", "--ckpt_path", vae_checkpoint)
        assert "is of stage 'vae_alignment', this is 'joint'" in message

    def test_resuming_keeps_the_given_settings(self, smoke_args, vae_checkpoint, tmp_path):
        """The command line decides, not the checkpoint, and config.yaml says what ran."""
        more = ["--trainer.logger=false", "--trainer.limit_val_batches=0"]
        more += ["--ckpt_path", str(vae_checkpoint), "--trainer.max_steps=4"]
        more += ["--model.init_args.ema_decay=0.7", "--trainer.callbacks=[]"]
        main(smoke_args("vae_alignment", tmp_path, *more))
        assert "ema_decay: 0.7" in (tmp_path / "config.yaml").read_text()

    @pytest.mark.parametrize("option", ["--ckpt_path", "--model.init_args.init_from"])
    def test_a_missing_file_is_named(self, option, refused, tmp_path):
        path = tmp_path / "none.ckpt"
        assert str(path) in refused("joint", option, path, error=FileNotFoundError)

    @pytest.mark.parametrize("command", ["fit", "predict"])
    def test_a_url_or_a_setting_makes_none_run_code(self, command, smoke_args, tmp_path):
        class Evil:
            def __reduce__(self):
                return (tmp_path / "ran").touch, ()

        torch.save({"state_dict": {}, "evil": Evil()}, tmp_path / "evil.ckpt")
        for path in (f"file://{tmp_path}/evil.ckpt", "http://127.0.0.1:9/evil.ckpt"):
            words = smoke_args("joint", tmp_path / "run", "--ckpt_path", path)
            with pytest.raises(FileNotFoundError, match=r"evil\.ckpt"):
                main([command, *words[1:], "--weights_only=false"])
        words = smoke_args("joint", tmp_path / "run", "--weights_only=false")
        with pytest.raises(ValueError, match="would run code of the checkpoint: leave it out"):
            main([command, *words[1:]])
        assert not (tmp_path / "ran").exists()

    @pytest.mark.parametrize(
        ("stage", "option"),
        [("vae_alignment", "--ckpt_path"), ("joint", "--model.init_args.init_from")],
    )
    def test_range_images_of_another_encoding(self, stage, option, vae_checkpoint, refused):
        """A checkpoint knows the range images it was trained on."""
        other = "--data.init_args.codec={encoding: log2}"
        message = refused(stage, other, option, vae_checkpoint)
        assert "encoding='linear'" in message
        assert "encoding='log2'" in message
        assert stage == "vae_alignment" or str(vae_checkpoint) in message
