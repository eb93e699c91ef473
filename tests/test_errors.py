"""What a user can get wrong before training: each gives one error that names what and where.

All through the real command line, and all before a step is taken: no checkpoint appears.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from tiny_networks import SIT_ARGS, VAE_ARGS, tiny_networks

from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.cli import main

pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args parameter")

NO_FEATURES = [
    "--data.init_args.extractor=null",
    "--model.init_args.weights={vae_alignment: 0, sit_alignment: 0}",
]


@pytest.fixture
def folder(tmp_path):
    """Four small scans."""
    generator = np.random.default_rng(0)
    points = generator.uniform(2, 20, (4, 200, 4)).astype(np.float32)
    (tmp_path / "scans").mkdir()
    for index, scan in enumerate(points):
        (tmp_path / "scans" / f"{index:06d}.bin").write_bytes(scan.tobytes())
    return tmp_path / "scans"


def data_args(folder, *more):
    """Scans of a folder in place of the simulated ones of conf/smoke.yaml."""
    kind = ["--data.class_path", "r3dpa.data.LidarDataModule", "--data.init_args.scans", folder]
    return [str(word) for word in (*kind, "--data.init_args.val_every", "null", *more)]


def write_grids(folder, features_dir):
    """2 x 8 grids of width 16 for every scan of a folder, as conf/smoke.yaml wants them."""
    geometric = {"class_path": "r3dpa.nn.backbones.GeometricFeatures", "init_args": {"dim": 16}}
    values = {
        "class_path": "r3dpa.data.LidarDataModule",
        "init_args.scans": folder,
        "init_args.sensor": "{beams: 16, columns: 64}",
        "init_args.grid_size": "[2, 8]",
        "init_args.extractor": json.dumps(geometric),
        "init_args.features_dir": features_dir,
    }
    main(["features", *(f"--data.{key}={value}" for key, value in values.items())])
    return ["--data.init_args.features_dir", str(features_dir)]


@pytest.fixture
def refused(smoke_args, tmp_path):
    """``refused(stage, *args)``: message of the one error that training ends with."""

    def run(stage, *more, error=ValueError):
        run_dir = tmp_path / "run"
        fixed = ["--trainer.logger=false", "--trainer.limit_val_batches=0"]
        with pytest.raises(error) as caught:
            main(smoke_args(stage, run_dir, *fixed, *map(str, more)))
        assert not list(run_dir.rglob("*.ckpt"))
        return str(caught.value)

    return run


BROKEN = {
    "truncated": (lambda data: data[:-3], "has 3197 bytes, not a multiple of 16"),
    "nan": (
        lambda data: np.float32(np.nan).tobytes() + data[4:],
        "NaN or infinite values in 1",
    ),
}


class TestScans:
    @pytest.mark.parametrize(
        ("kind", "features"),
        [*((kind, []) for kind in BROKEN), ("truncated", NO_FEATURES)],
        ids=[*BROKEN, "truncated_without_grids"],
    )
    def test_corrupted_scan_is_named(self, kind, features, folder, refused):
        """While grids are made; or, where there are none, in the first batch that holds it."""
        change, reason = BROKEN[kind]
        for path in folder.iterdir():
            if path.stem != "000002" and features:
                path.unlink()  # the bad scan is in the first batch
        path = folder / "000002.bin"
        path.write_bytes(bytes(change(path.read_bytes())))
        few = ["--data.init_args.batch_size", 1]
        message = refused("joint", *data_args(folder), *features, *few)
        assert message.startswith(f"{path}: ")
        assert reason in message

    def test_folder_without_scans(self, tmp_path, refused):
        assert f"No scan found in {tmp_path}" in refused("joint", *data_args(tmp_path))

    def test_folder_without_a_split_of_kitti360(self, tmp_path, refused):
        kitti = ["--data.class_path", "r3dpa.data.KITTI360DataModule"]
        message = refused("joint", *kitti, "--data.init_args.root", tmp_path)
        assert f"No scan of the train split in {tmp_path}" in message
        assert "r3dpa check" in message


class TestFeatureGrids:
    def test_no_grids_at_all(self, folder, tmp_path, refused):
        empty = ["--data.init_args.features_dir", tmp_path / "grids"]
        message = refused("joint", *data_args(folder), "--data.init_args.extractor=null", *empty)
        assert str(tmp_path / "grids") in message
        assert "r3dpa features" in message

    def test_the_scan_without_a_grid_is_named(self, folder, tmp_path, refused):
        features = write_grids(folder, tmp_path / "grids")
        (folder / "000009.bin").write_bytes((folder / "000000.bin").read_bytes())
        message = refused("joint", *data_args(folder), "--data.init_args.extractor=null", *features)
        assert f"No feature grids of {folder / '000009.bin'}" in message
        assert "r3dpa features" in message

    def test_grids_of_another_size(self, folder, tmp_path, refused):
        """Grids of 2 x 8, and a SiT with patches of 1 that wants 4 x 16."""
        features = write_grids(folder, tmp_path / "grids")
        other = [
            "--data.init_args.grid_size=[4, 16]",
            "--model.init_args.sit.init_args.patch_size=1",
        ]
        no_extractor = "--data.init_args.extractor=null"
        message = refused("joint", *data_args(folder), no_extractor, *features, *other)
        assert "grid_size [2, 8]" in message
        assert "grid_size [4, 16]" in message
        assert str(tmp_path / "grids") in message


@pytest.mark.parametrize(
    ("option", "named"),
    [
        ("--model.init_args.sit.init_args.dpeth=3", "dpeth"),
        ("--trainer.max_stepz=3", "max_stepz"),
        ("data: {init_args: {bacth_size: 3}}", "bacth_size"),
        ("optimiser: {lr: 3}", "optimiser"),
        ("--data.init_args.batch_size=many", "batch_size"),
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
            "model.init_args.sit.init_args.input_size=[4, 8]",
            "(16, 64) range image gives (4, 16) latents, but sit.input_size is (4, 8); "
            "set sit.input_size to (4, 16)",
        ),
        (
            "data.init_args.grid_size=[4, 16]",
            "feature grids are (4, 16), but the SiT has (2, 8) tokens",
        ),
        (
            "model.init_args.sit.init_args.feature_dim=20",
            "features have width 16, but sit.feature_dim is 20",
        ),
        (
            "model.init_args.sit.init_args.in_channels=8",
            "sit.in_channels is 8, but the VAE has 4 latent channels",
        ),
    ],
)
def test_networks_and_data_that_do_not_fit(option, message, folder, refused):
    assert message in refused("joint", *data_args(folder), f"--{option}")


class TestCheckpoints:
    @pytest.mark.parametrize("command", ["fit", "test"])
    def test_resuming_the_checkpoint_of_another_stage(
        self, command, smoke_args, vae_checkpoint, tmp_path
    ):
        more = ["--trainer.logger=false", "--ckpt_path", str(vae_checkpoint)]
        args = smoke_args("joint", tmp_path, *more)
        with pytest.raises(ValueError, match=r"is of stage 'vae_alignment', this is 'joint'"):
            main([command, *args[1:]])
        assert not list(tmp_path.rglob("*.ckpt"))

    def test_resuming_keeps_the_given_settings(self, smoke_args, vae_checkpoint, tmp_path):
        """The command line decides, not the checkpoint, and config.yaml says what ran."""
        more = ["--trainer.logger=false", "--trainer.limit_val_batches=0"]
        more += ["--ckpt_path", str(vae_checkpoint), "--trainer.max_steps=4"]
        more += ["--model.init_args.ema_decay=0.7"]
        main(smoke_args("vae_alignment", tmp_path, *more))
        assert "ema_decay: 0.7" in (tmp_path / "config.yaml").read_text()

    def test_missing_file_is_named(self, refused, tmp_path):
        path = tmp_path / "nothing.ckpt"
        for option in ("--ckpt_path", "--model.init_args.init_from"):
            assert str(path) in refused("joint", option, path, error=FileNotFoundError)

    @pytest.mark.parametrize("option", ["--ckpt_path", "--model.init_args.init_from"])
    def test_damaged_file_is_named(self, option, vae_checkpoint, refused, tmp_path):
        path = tmp_path / "half.ckpt"
        data = vae_checkpoint.read_bytes()
        path.write_bytes(data[: len(data) // 2])
        message = refused("joint", option, path)
        assert str(path) in message
        assert "damaged" in message

    def test_joint_stage_from_a_checkpoint_without_discriminator(self, refused, tmp_path):
        networks = zip(
            ("vae", "sit", "latent_norm"),
            tiny_networks(),
            (VAE_ARGS, SIT_ARGS, {"channels": 4}),
            strict=True,
        )
        states = {name: NetworkState.of(network, args) for name, network, args in networks}
        flow = save_checkpoint(
            Checkpoint(tmp_path, "flow_matching", states), tmp_path / "flow.safetensors"
        )
        message = refused("joint", "--model.init_args.init_from", flow)
        assert str(flow) in message
        assert "stage 'flow_matching' and has no discriminator" in message
        assert "joint needs: vae, discriminator, sit, latent_norm" in message

    def test_vae_of_another_width(self, vae_checkpoint, refused):
        width = "--model.init_args.vae.init_args.channels=64"
        message = refused("joint", "--model.init_args.init_from", vae_checkpoint, width)
        assert (
            "vae: shape of encoder.conv_in.weight: checkpoint (32, 1, 3, 3), network (64, 1, 3, 3)"
            in message
        )
        assert "more" in message

    def test_setting_that_no_shape_tells(self, vae_checkpoint, refused):
        heads = "--model.init_args.sit.init_args.num_heads=4"
        message = refused("joint", "--model.init_args.init_from", vae_checkpoint, heads)
        assert "sit: num_heads: checkpoint 2, network 4" in message

    def test_flow_matching_without_a_vae(self, folder, refused):
        message = refused("flow_matching", *data_args(folder))
        assert "give model.init_from a checkpoint of stage vae_alignment or joint" in message


@pytest.mark.parametrize(
    ("stage", "option"),
    [("vae_alignment", "--ckpt_path"), ("joint", "--model.init_args.init_from")],
)
def test_range_images_of_another_encoding(stage, option, vae_checkpoint, refused):
    """A checkpoint knows the range images it was trained on."""
    other = "--data.init_args.codec={encoding: log2}"
    message = refused(stage, other, option, vae_checkpoint)
    assert "encoding='linear'" in message
    assert "encoding='log2'" in message
    assert stage == "vae_alignment" or str(vae_checkpoint) in message
