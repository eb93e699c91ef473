"""The copied last blocks of a SiT that predict average velocities."""

from __future__ import annotations

import pytest
import torch
from tiny_networks import SIT_ARGS
from torch import nn

from r3dpa.nn import AverageVelocitySiT, SiT, ThinDecoder

ARGS = SIT_ARGS | {"depth": 3}


def flow():
    torch.manual_seed(0)
    sit = SiT(**ARGS)
    for parameter in sit.parameters():
        nn.init.normal_(parameter, std=0.3)
    return sit


def few_step(average_blocks=1, sit=None):
    network = AverageVelocitySiT(average_blocks, **ARGS)
    network.load_state_dict(network.with_average((sit or flow()).state_dict()))
    return network


@pytest.mark.numerics("target time equal to the time")
@pytest.mark.parametrize("blocks", [1, 2, 3])
def test_before_training_the_average_velocity_is_the_velocity_bit_for_bit(blocks):
    """At r = t, where it has to be, and by its zero weights at all other targets."""
    sit, network = flow(), few_step(blocks)
    x, time = torch.randn(3, 4, 4, 16), torch.tensor([0.2, 0.7, 1.0])
    velocity = sit.velocity(x, time)
    assert velocity.abs().min() > 0
    for target in (time, time / 2, 0 * time):
        assert torch.equal(network.average_velocity(x, time, target), velocity)
    assert torch.equal(network.velocity(x, time), velocity)
    rows = network.average_modulations(time, 0 * time)
    assert torch.equal(network.average_velocity_at(x, rows), velocity)


def test_training_moves_the_average_velocity_alone():
    network = few_step()
    x, time = torch.randn(2, 4, 4, 16), torch.tensor([0.3, 0.9])
    before = network(x, time)
    for parameter in network.average.parameters():
        nn.init.normal_(parameter, std=0.3)
    assert torch.equal(network(x, time).velocity, before.velocity)
    assert torch.equal(network(x, time).features, before.features)
    one, other = (network.average_velocity(x, time, share * time) for share in (0.0, 0.5))
    assert not torch.allclose(one, before.velocity)
    assert not torch.allclose(one, other)


def test_the_embedded_length_of_a_step_is_time_minus_target():
    network, lengths = few_step(), []
    network.average.embedder.register_forward_pre_hook(lambda _, given: lengths.append(given[0]))
    network.average_modulations(torch.tensor([0.75]), torch.tensor([0.25]))
    assert lengths[0].tolist() == [0.5]


def test_the_average_velocity_comes_from_the_copied_output_layer():
    network = few_step()
    x, time = torch.randn(2, 4, 4, 16), torch.tensor([0.3, 0.9])
    average = network.average_velocity(x, time, 0 * time)
    nn.init.zeros_(network.final_layer.linear.weight)
    assert torch.equal(network.average_velocity(x, time, 0 * time), average)
    nn.init.zeros_(network.average.final_layer.linear.weight)
    assert not torch.allclose(network.average_velocity(x, time, 0 * time), average)


def test_blocks_and_their_copies_are_compiled():
    network = few_step(average_blocks=2)
    assert network.compiled_parts == [*network.blocks, *network.average.blocks]
    assert len(network.compiled_parts) == 5


def test_the_length_of_a_step_is_not_rounded_in_half_precision():
    """Blocks in bfloat16; the difference of two times is that of float32."""
    network = few_step().to_bfloat16_()
    nn.init.normal_(network.average.embedder.mlp[2].weight, std=0.3)
    time = torch.full((2,), 0.5)
    target = time - torch.tensor([1e-4, 2e-4])
    rows = network.average_modulations(time, target)
    assert rows.dtype == torch.float32
    assert (rows[0] != rows[1]).any()
    assert network.average_velocity(torch.randn(2, 4, 4, 16), time, target).dtype == torch.float32


@pytest.mark.parametrize("blocks", [0, 4])
def test_copies_of_more_blocks_than_there_are_or_of_none_are_refused(blocks):
    with pytest.raises(
        ValueError, match=rf"average_blocks must lie in 1..depth = 1..3, got {blocks}"
    ):
        AverageVelocitySiT(blocks, **ARGS)


def test_a_thin_decoder_has_no_encoder():
    thin = ThinDecoder(latent_channels=4, channels=32, num_res_blocks=0)
    assert thin.decode(torch.randn(1, 4, 2, 4)).shape == (1, 1, 8, 32)
    assert {name.split(".")[0] for name in thin.state_dict()} == {"decoder", "post_quant_conv"}
    with pytest.raises(ValueError, match="has no encoder: encode with the VAE"):
        thin.encode(torch.zeros(1, 2, 8, 32))
