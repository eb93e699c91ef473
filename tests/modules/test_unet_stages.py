"""The UNet in the place of the SiT: all stages, who is trained by what, sampling."""

from __future__ import annotations

import pytest
import torch
import yaml
from stage_runs import QUICK
from tiny_stages import QUIET, stage_module, train
from tiny_unet import SIZES, tiny_unet

from r3dpa.cli import main
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.modules import LossWeights

pytestmark = QUIET
# In place of the SiT of conf/smoke.yaml: the same latents, grid and features.
SMOKE = SIZES | {"input_size": [4, 16], "feature_dim": 16, "projector_dim": 32}


VAE_PARTS = {"vae.encoder", "vae.quant_conv"}
DOWN = {"sit.input_blocks", "sit.ape", "sit.time_embed", "sit.label_emb", "sit.middle_block"}
UP, HEAD = {"sit.output_blocks", "sit.out"}, {"sit.projector"}
REACH = {
    "vae_alignment": {"vae_alignment": VAE_PARTS | HEAD | {"sit.input_blocks"}},
    "joint": {"vae_alignment": VAE_PARTS, "denoising": DOWN | UP, "sit_alignment": DOWN | HEAD},
    "flow_matching": {"denoising": DOWN | UP, "sit_alignment": DOWN | HEAD},
}


@pytest.mark.parametrize("stage", REACH)
def test_each_loss_reaches_exactly_its_part_of_the_unet(stage):
    module = stage_module(stage, tiny_unet, weights=LossWeights())
    module.separates_losses = True
    (reached,) = train(module).reached
    for part, expected in REACH[stage].items():
        assert {".".join(name.split(".")[:2]) for name in reached[part]} == expected, part
    trained = {name for name, p in module.sit.named_parameters() if p.requires_grad}
    if stage == "vae_alignment":
        input_layer = {"input_blocks.0.0.weight", "input_blocks.0.0.bias"}
        assert {n for n in trained if not n.startswith("projector.")} == input_layer
    else:
        assert trained == {name for name, _ in module.sit.named_parameters()}


@pytest.fixture(scope="module")
def unet_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("unet") / "unet.yaml"
    path.write_text(yaml.safe_dump({"class_path": "r3dpa.nn.UNet", "init_args": SMOKE}))
    return path


@pytest.fixture(scope="module")
def joint_checkpoint(smoke_args, unet_file, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("unet_joint")
    more = ["--model.init_args.sit", str(unet_file)]
    # Of an untrained network the output is 0, and so is that of its average.
    more += ["--model.init_args.ema_decay", "0", "--model.init_args.optimizer.lr", "0.01"]
    main(smoke_args("joint", run_dir, *more, *QUICK))
    return run_dir / "checkpoints" / "last.ckpt"


def test_a_scene_does_not_depend_on_its_batch(joint_checkpoint):
    scenes = SceneGenerator.from_checkpoint(joint_checkpoint, SamplerConfig("heun", steps=3))
    both, alone = scenes.generate([0, 1], seed=3), scenes.generate([1], seed=3)
    torch.testing.assert_close(alone.latents[0], both.latents[1], atol=1e-5, rtol=0)
    assert both.range_m.shape == (2, 16, 64)
    assert both.latents.isfinite().all()


def test_rgb_weights_are_for_a_sit(smoke_args, unet_file, joint_checkpoint, tmp_path):
    more = ["--model.init_args.sit", str(unet_file), "--trainer.logger=false"]
    more += ["--model.init_args.rgb_weights", str(joint_checkpoint)]
    with pytest.raises(ValueError, match=r"rgb_weights start a SiT, but the network is a UNet"):
        main(smoke_args("joint", tmp_path, *more))
