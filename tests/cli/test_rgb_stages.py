"""Stage 0 through the real command line: image VAE, pretraining, and what may start from it."""

import re
from pathlib import Path

import pytest
import torch
import yaml
from PIL import Image

from r3dpa.checkpoints import read_checkpoint, transfer_rgb
from r3dpa.cli import main
from r3dpa.features import DINOv2
from r3dpa.modules import LossWeights, RGBPretraining
from r3dpa.nn import ImageVAE, LatentNorm, SiT

CONF = Path(__file__).resolve().parents[2] / "conf"
SIT = yaml.safe_load((CONF / "smoke.yaml").read_text())["model"]["init_args"]["sit"]["init_args"]
QUIET = {
    "trainer.accelerator": "cpu",
    "trainer.precision": "32-true",
    "trainer.enable_progress_bar": "false",
    "trainer.enable_model_summary": "false",
    "trainer.logger": "false",
    "trainer.log_every_n_steps": 1,
}
LEAVES = {
    "data.init_args.source.init_args.num_images": 9,
    "data.init_args.image_size": 16,
    "data.init_args.batch_size": 2,
    "data.init_args.num_workers": 0,
    "data.init_args.val_every": 4,
}
VAE = {
    "model.init_args.vae.init_args.channels": "[8, 16]",
    "model.init_args.vae.init_args.num_res_blocks": 1,
    "model.init_args.vae.init_args.norm_groups": 4,
}
TINY = {
    **{f"model.init_args.sit.init_args.{key}": value for key, value in SIT.items()},
    "model.init_args.sit.init_args.input_size": [8, 8],
}


def fit(run_dir, configs, *settings, **more):
    words = [word for name in configs for word in ("--config", str(CONF / f"{name}.yaml"))]
    values = {key: value for setting in (QUIET, *settings) for key, value in setting.items()}
    words += [f"--{key}={value}" for key, value in values.items()]
    words += [f"--{key}={value}" for key, value in more.items()]
    main(["fit", *words, f"--run_dir={run_dir}"])
    return run_dir / "checkpoints" / "last.ckpt"


def steps(number):
    every = {"trainer.val_check_interval": number, "checkpoint.every_n_train_steps": 1}
    return {"trainer.max_steps": number, "checkpoint.save_top_k": -1, **every}


@pytest.fixture(scope="module")
def image_vae(tmp_path_factory):
    configs = ["trainer", "demo/trainer", "data/dead_leaves", "experiment/image_vae"]
    return fit(tmp_path_factory.mktemp("image_vae"), configs, LEAVES, VAE, steps(1))


DEMO = ("trainer", "demo/trainer", "data/dead_leaves")
RGB = (*DEMO, "experiment/rgb_pretraining", "demo/rgb_pretraining")


@pytest.fixture(scope="module")
def rgb(image_vae, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("rgb")
    start = {"model.init_args.init_from": image_vae}
    return fit(run_dir, RGB, LEAVES, VAE, TINY, steps(2), start)


def test_the_vae_is_frozen_and_the_sit_trained_and_resumed_exactly(image_vae, rgb, tmp_path):
    before = torch.load(image_vae, weights_only=True)["state_dict"]
    content = torch.load(rgb, weights_only=True)
    after = content["state_dict"]
    for key, value in before.items():
        assert torch.equal(after[key], value), key
    assert content["r3dpa"]["stage"] == "rgb_pretraining"
    assert after["latent_norm.num_batches_tracked"] == 1  # measured once, and fixed
    assert after["sit.final_layer.linear.weight"].abs().max() > 0
    (group,) = content["optimizer_states"][0]["param_groups"]
    projector = [key for key in after if key.startswith("sit.projector.")]
    sit = [key for key in after if key.startswith("sit.") and key != "sit.pos_embed"]
    assert len(group["params"]) == len(sit) - len(projector)
    start = {"model.init_args.init_from": image_vae}
    start["ckpt_path"] = rgb.with_name("step=0000001.ckpt")
    resumed = torch.load(fit(tmp_path, RGB, LEAVES, VAE, TINY, steps(2), start), weights_only=True)
    assert after.keys() == resumed["state_dict"].keys()
    for key, value in after.items():
        assert torch.equal(value, resumed["state_dict"][key]), key


def test_vae_alignment_starts_from_an_rgb_model(rgb, smoke_args, tmp_path, caplog):
    """With the blocks, on another grid; the projector is fresh."""
    more = ["--model.init_args.optimizer.lr=0", "--model.init_args.keep_projector=false"]
    more += [f"--model.init_args.rgb_weights={rgb}", "--trainer.logger=false"]
    more += ["--trainer.limit_val_batches=0", "--trainer.callbacks=[]"]
    main(smoke_args("vae_alignment", tmp_path, *more))
    state = torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    source = read_checkpoint(rgb).network("sit").state_dict
    kept = ("blocks.", "t_embedder.", "y_embedder.")
    fresh = [key for key in source if re.match(r"projector.*\.weight", key)]
    assert fresh
    for key, value in source.items():
        if key.startswith(kept) or key in fresh:
            assert torch.equal(state[f"sit.{key}"], value) != (key in fresh), key
    assert all(word in caplog.text for word in ("resized", "fresh", "kept"))


def test_the_prior_of_r3dpa_s_has_the_blocks_of_its_sit(image_vae, tmp_path):
    folder = CONF / "r3dpa_s_2"
    configs = ("trainer", "r3dpa_s_2/trainer", "data/dead_leaves", "experiment/rgb_pretraining")
    sit_file = CONF / "r3dpa_s/sit.yaml"
    prior = {"model.init_args.sit": sit_file, "config": folder / "rgb_prior.yaml"}
    start = {"model.init_args.init_from": image_vae}
    size = {"model.init_args.sit.init_args.input_size": [8, 8]}
    path = fit(tmp_path, configs, prior, LEAVES, VAE, size, steps(1), start)
    sit = SiT(**yaml.safe_load(sit_file.read_text())["init_args"])
    rows = transfer_rgb(read_checkpoint(path), sit, LatentNorm(8), keep_projector=True)
    found = {row.group: row.result for row in rows}
    assert found.pop("pos_embed") == "resized"
    fresh = {"x_embedder", "final_layer.linear", "latent_norm"}
    assert {group for group, result in found.items() if result == "fresh"} == fresh
    assert {result for group, result in found.items() if group not in fresh} == {"kept"}


def test_images_of_a_folder_are_aligned_with_a_teacher(image_vae, tmp_path):
    torch.manual_seed(0)
    for index in range(6):
        path = tmp_path / "imagenet" / f"{index}.png"
        path.parent.mkdir(exist_ok=True)
        Image.new("RGB", (20, 24), (40 * index, 100, 20)).save(path)
    sizes = {"dim": 16, "depth": 1, "num_heads": 2, "grid_size": 2}
    torch.save(DINOv2(**sizes).state_dict(), tmp_path / "dino.pth")
    teacher = {f"model.init_args.teacher.init_args.{key}": value for key, value in sizes.items()}
    folder = {
        "data.init_args.source.init_args.root": tmp_path / "imagenet",
        "data.init_args.mirrored": "true",
        **{key: value for key, value in LEAVES.items() if "source" not in key},
    }
    start = {"model.init_args.init_from": image_vae}
    configs = ("trainer", "data/images", "experiment/rgb_pretraining")
    settings = (folder, VAE, TINY, teacher, steps(1), start)
    with pytest.raises(ValueError, match=r"random weights: give .*teacher\.init_args\.weights"):
        fit(tmp_path / "run", configs, *settings)
    weights = {"model.init_args.teacher.init_args.weights": tmp_path / "dino.pth"}
    path = fit(tmp_path / "run", configs, *settings, weights)
    content = torch.load(path, weights_only=True)
    assert not any("teacher" in key or "cls_token" in key for key in content["state_dict"])
    moments = content["optimizer_states"][0]["state"]
    (group,) = content["optimizer_states"][0]["param_groups"]
    assert len(moments) == len(group["params"])  # the projector too has gradients


def test_a_teacher_is_moved_to_the_images():
    """Also where no fit starts, as in `r3dpa test`."""
    sit = SiT(
        input_size=(8, 8), hidden_size=16, depth=1, num_heads=2, alignment_depth=1, feature_dim=16
    )
    vae = ImageVAE(sit.in_channels, channels=(8, 16), norm_groups=4)
    teacher = DINOv2(dim=16, depth=1, num_heads=2, grid_size=2)
    module = RGBPretraining(vae, sit, teacher, weights=LossWeights(sit_alignment=0.5))
    features = module._features({"image": torch.empty(1, 3, 16, 16, device="meta")})
    assert features.device.type == "meta"


def test_a_teacher_and_its_weight_go_together():
    sit = SiT(
        input_size=(8, 8), hidden_size=16, depth=1, num_heads=2, alignment_depth=1, feature_dim=16
    )
    vae = ImageVAE(sit.in_channels, channels=(8, 16), norm_groups=4)
    with pytest.raises(ValueError, match="go together"):
        RGBPretraining(vae, sit, weights=LossWeights(sit_alignment=0.5))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "give --model.init_args.init_from a checkpoint of stage image_vae"),
        ({"data.init_args.image_size": 32}, r"give \(16, 16\) latents"),
    ],
)
def test_settings_that_do_not_fit_are_said(settings, message, tmp_path, capsys):
    with pytest.raises((ValueError, SystemExit)) as stop:
        fit(tmp_path, RGB, LEAVES, VAE, TINY, steps(1), settings)
    assert re.search(message, str(stop.value) + capsys.readouterr().err)
