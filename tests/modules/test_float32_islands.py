"""What stays in float32 when the rest of a step is rounded to bfloat16."""

from __future__ import annotations

import pytest
import torch
from tiny_stages import QUIET, NamedData, stage_module, train

from r3dpa import losses
from r3dpa.flow import Interpolant
from r3dpa.modules import GenerativeModule
from r3dpa.nn import LatentNorm, Posterior

pytestmark = QUIET
LAYERS = {
    "vae.decoder.conv_out",  # the range image: 0.1 m at 50 m would be lost
    "sit.t_embedder.mlp.0",  # the time, and what all blocks are modulated by
    "sit.t_embedder.mlp.1",
    "sit.t_embedder.mlp.2",
    "sit.y_embedder.embedding_table",
    "sit.blocks.0.adaLN_modulation.0",
    "sit.blocks.1.adaLN_modulation.0",
    "sit.final_layer.adaLN_modulation.0",
}
LOSSES = ("reconstruction", "generator", "discriminator", "flow_matching", "alignment")
FUNCTIONS = [(losses, f"{name}_loss") for name in LOSSES]
FUNCTIONS += [(Posterior, "sample"), (Posterior, "kl"), (GenerativeModule, "weigh_and_log")]
FUNCTIONS += [(LatentNorm, "normalise"), (LatentNorm, "update")]
FUNCTIONS += [(Interpolant, "interpolate"), (Interpolant, "target")]


@pytest.fixture(scope="module")
def dtypes():
    """Kinds of number of one joint step: of every layer's output, and of these functions."""
    found, module = {}, stage_module("joint", ema_decay=0.5)

    def note(name):
        return lambda layer, inputs, output: found.update({name: output.dtype})

    for network in ("vae", "sit", "discriminator"):
        for name, layer in getattr(module, network).named_modules(prefix=network):
            if not list(layer.children()):
                layer.register_forward_hook(note(name))
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in FUNCTIONS:
            function = getattr(owner, name)

            def noted(*args, function=function, name=name, **kwargs):
                result = function(*args, **kwargs)
                found[name] = result.dtype
                return result

            patch.setattr(owner, name, noted)
        train(module, NamedData(1), precision="bf16-mixed")
    return found, module


@pytest.mark.numerics
class TestIslands:
    def test_dtypes_of_layers(self, dtypes):
        """These and no others: a longer list would be slow, a shorter one imprecise."""
        found, _ = dtypes
        layers = {name: dtype for name, dtype in found.items() if "." in name}
        assert set(layers.values()) == {torch.bfloat16, torch.float32}
        assert {n for n, dtype in layers.items() if dtype == torch.float32} == LAYERS

    @pytest.mark.parametrize("name", [name for _, name in FUNCTIONS])
    def test_dtypes_of_functions(self, dtypes, name):
        assert dtypes[0][name] == torch.float32

    def test_dtypes_of_the_state(self, dtypes):
        """Weights, statistics, averages, gradients and moments."""
        _, module = dtypes
        weights, moments = module.states[-1]
        kept = [*weights.values(), *module.grads[0].values()]
        kept += [value for state in moments for value in state.values()]
        assert {value.dtype for value in kept if value.is_floating_point()} == {torch.float32}
        assert any(name.startswith("ema.") for name in weights)
