"""The image VAE against numbers that the released one is known by, and its files."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import save_file

from r3dpa.checkpoints import read_checkpoint
from r3dpa.nn import ImageVAE

SMALL = {"channels": (8, 16), "num_res_blocks": 1, "norm_groups": 4}
OLD_NAMES = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}


@pytest.fixture
def vae():
    torch.manual_seed(0)
    return ImageVAE(**SMALL)


def saved(state, folder):
    """File as diffusers writes it."""
    (folder / "config.json").write_text(json.dumps({"norm_num_groups": 4}))
    save_file(state, folder / "diffusion_pytorch_model.safetensors")
    return folder / "diffusion_pytorch_model.safetensors"


def test_the_default_has_the_size_of_stable_diffusions_vae():
    with torch.device("meta"):
        state = ImageVAE().state_dict()
    assert (len(state), sum(value.numel() for value in state.values())) == (248, 83_653_863)
    for key, shape in {
        "encoder.down_blocks.1.resnets.0.conv_shortcut.weight": (256, 128, 1, 1),
        "encoder.mid_block.attentions.0.to_out.0.weight": (512, 512),
        "decoder.up_blocks.0.upsamplers.0.conv.bias": (512,),
        "quant_conv.weight": (8, 8, 1, 1),
    }.items():
        assert tuple(state[key].shape) == shape
    assert not any("downsamplers" in key and "blocks.3" in key for key in state)


def test_sides_of_latents_and_back(vae):
    posterior = vae.encode(torch.rand(2, 3, 12, 20) * 2 - 1)
    assert posterior.mean.shape == (2, 4, *vae.latent_size((12, 20))) == (2, 4, 6, 10)
    assert vae.decode(posterior.mean).shape == (2, 3, 12, 20)
    with pytest.raises(ValueError, match=r"must be a multiple of \(2, 2\)"):
        vae.encode(torch.zeros(1, 3, 9, 8))


@torch.no_grad()
def test_a_stride_looks_down_and_right_alone(vae):
    """Padding of the released weights: with a symmetric one, row 0 would see no row 2."""
    layer = vae.encoder.down_blocks[0].downsamplers[0]
    image = torch.zeros(1, 8, 6, 6)
    image[0, 0, 2, 2] = 1
    changed = (layer(image) - layer(torch.zeros_like(image))).abs().amax(dim=1)[0] > 0
    assert torch.nonzero(changed).tolist() == [[0, 0], [0, 1], [1, 0], [1, 1]]


@pytest.mark.parametrize("old", [False, True], ids=["names of today", "names of 2022"])
def test_a_file_of_diffusers_is_read_whole(vae, tmp_path, old):
    state = dict(vae.state_dict())
    for new, name in OLD_NAMES.items() if old else ():
        state = {k.replace(f"attentions.0.{new}", f"attentions.0.{name}"): state[k] for k in state}
    assert any("proj_attn" in key for key in state) == old
    twin = read_checkpoint(saved(state, tmp_path)).network("vae").build()
    image = torch.rand(1, 3, 8, 8)
    assert torch.equal(twin.encode(image).mean, vae.encode(image).mean)


def test_a_file_of_diffusers_that_does_not_fit_is_refused(vae, tmp_path):
    state, key, extra = vae.state_dict(), "decoder.conv_in.weight", "decoder.conv_extra.weight"
    for named, wrong in (
        (key, {name: value for name, value in state.items() if name != key}),
        (key, state | {key: state[key][:, :3].contiguous()}),
        (extra, state | {extra: torch.zeros(1)}),
    ):
        with pytest.raises(ValueError, match=named):
            read_checkpoint(saved(wrong, tmp_path))
