from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from r3dpa.nn.sit import SiT, sincos_position_embedding
from r3dpa.nn.velocity_network import time_frequencies

SMALL = {
    "input_size": (4, 8),
    "in_channels": 3,
    "hidden_size": 16,
    "depth": 3,
    "num_heads": 2,
    "alignment_depth": 2,
    "feature_dim": 5,
    "projector_dim": 12,
}


def build(seed=0, **options):
    """Small SiT without zero layers, which would hide most of it."""
    torch.manual_seed(seed)
    sit = SiT(**{**SMALL, **options})
    for parameter in sit.parameters():
        nn.init.normal_(parameter, std=0.2)
    return sit


def inputs(batch=2, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, 3, 4, 8, generator=generator), torch.rand(batch, generator=generator)


def test_a_fresh_network_has_velocity_zero_and_blocks_that_do_nothing():
    sit, (latents, time) = SiT(**SMALL), inputs()
    velocity, features = sit(latents, time)
    assert velocity.abs().max() == 0
    tokens = sit.x_embedder(latents) + sit.pos_embed
    assert torch.equal(features, sit.projector(tokens))
    bound = math.sqrt(6 / (16 + 3 * 16))  # Xavier for the 16 -> 48 layer
    weight = sit.blocks[0].attn.qkv.weight
    assert 0.9 * bound < weight.abs().max() <= bound
    assert sit.blocks[0].attn.qkv.bias.abs().max() == 0
    assert 0.015 < sit.t_embedder.mlp[0].weight.std() < 0.025


def test_tokens_are_patches_in_row_major_order():
    sit = build()
    latents = torch.zeros(1, 3, 4, 8)
    latents[0, :, 2, 5] = 1.0  # patch row 1, column 2
    changed = (sit.x_embedder(latents) - sit.x_embedder(torch.zeros(1, 3, 4, 8))).abs().sum(-1)
    assert changed[0].nonzero().flatten().tolist() == [1 * 4 + 2]


def test_a_token_holds_row_in_patch_then_column_in_patch_then_channel():
    sit, (latents, time) = SiT(**SMALL), inputs(batch=1)
    sit.final_layer.linear.bias.data = torch.arange(12.0)
    velocity = sit.velocity(latents, time)[0]
    for channel, row, column in [(0, 0, 0), (2, 1, 0), (1, 2, 7), (2, 3, 5)]:
        expected = ((row % 2) * 2 + column % 2) * 3 + channel
        assert velocity[channel, row, column] == expected


def test_position_embedding_encodes_the_column_then_the_row():
    code = sincos_position_embedding(8, (2, 3))[0].view(2, 3, 8)
    assert torch.equal(code[0, :, :4], code[1, :, :4])
    assert torch.equal(code[:, 0, 4:], code[:, 2, 4:])
    # Frequencies 1 and 10000^(-1/2) = 0.01; sines before cosines.
    expected = [math.sin(2), math.sin(0.02), math.cos(2), math.cos(0.02)]
    torch.testing.assert_close(code[1, 2, :4], torch.tensor(expected))
    expected = [math.sin(1), math.sin(0.01), math.cos(1), math.cos(0.01)]
    torch.testing.assert_close(code[1, 2, 4:], torch.tensor(expected))


def test_time_frequencies_have_cosines_before_sines():
    features = time_frequencies(torch.tensor([0.0, 0.5], dtype=torch.float64), 4)
    expected = [[1, 1, 0, 0], [math.cos(0.5), math.cos(0.005), math.sin(0.5), math.sin(0.005)]]
    torch.testing.assert_close(features, torch.tensor(expected, dtype=torch.float64))


def test_attention_equals_the_written_out_formula():
    attention = build(qk_norm=True).blocks[0].attn
    tokens = torch.randn(2, 5, 16)
    query, key, value = attention.qkv(tokens).view(2, 5, 3, 2, 8).unbind(2)
    query, key = attention.q_norm(query), attention.k_norm(key)
    weights = (torch.einsum("bihd,bjhd->bhij", query, key) / 8**0.5).softmax(-1)
    mixed = torch.einsum("bhij,bjhd->bihd", weights, value).reshape(2, 5, 16)
    torch.testing.assert_close(attention(tokens), attention.proj(mixed), atol=1e-5, rtol=1e-5)


def test_block_equals_the_written_out_formula():
    block = build().blocks[0].double()
    tokens, conditioning = 1e-3 * torch.randn(2, 5, 16).double(), torch.randn(2, 16).double()
    norm = nn.LayerNorm(16, eps=1e-6, elementwise_affine=False)
    vectors = block.adaLN_modulation[1](conditioning * conditioning.sigmoid())[:, None]
    shift1, scale1, gate1, shift2, scale2, gate2 = vectors.split(16, dim=-1)
    expected = tokens + gate1 * block.attn(norm(tokens) * (1 + scale1) + shift1)
    hidden = block.mlp.fc1(norm(expected) * (1 + scale2) + shift2)
    hidden = 0.5 * hidden * (1 + torch.tanh((2 / math.pi) ** 0.5 * (hidden + 0.044715 * hidden**3)))
    expected = expected + gate2 * block.mlp.fc2(hidden)
    modulation = block.adaLN_modulation(conditioning)
    torch.testing.assert_close(block(tokens, modulation), expected)
    for index in range(2):  # of one row for all samples
        alone = block(tokens, modulation[index : index + 1])[index]
        torch.testing.assert_close(alone, expected[index])


def test_position_embedding_is_a_buffer_unless_it_is_to_be_learned():
    fixed, learned = SiT(**SMALL), SiT(**SMALL, learn_pos_embed=True)
    assert "pos_embed" not in dict(fixed.named_parameters())
    assert learned.get_parameter("pos_embed").requires_grad
    assert set(fixed.state_dict()) == set(learned.state_dict())
    learned.load_state_dict(fixed.state_dict())


def test_the_row_for_no_class_is_the_last_one():
    sit, (latents, time) = build(num_classes=2, class_dropout=True), inputs()
    assert sit.y_embedder.embedding_table.weight.shape == (3, 16)
    no_class = sit.velocity(latents, time, torch.tensor([2, 2]))
    assert not torch.equal(no_class, sit.velocity(latents, time, torch.tensor([0, 1])))
    with pytest.raises(ValueError, match="2 classes needs labels"):
        sit.velocity(latents, time)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"input_size": (4, 7)}, r"4 x 7 do not divide into patches of 2"),
        ({"num_heads": 3}, r"16 is not a multiple of num_heads 3"),
        ({"alignment_depth": 4}, r"1\.\.3, got 4"),
        ({"alignment_depth": 0}, r"1\.\.3, got 0"),
        ({"hidden_size": 6}, r"divisible by 4, got 6"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        SiT(**{**SMALL, **options})


@pytest.mark.numerics
@pytest.mark.parametrize("half_weights", [False, True])
def test_1000_times_have_1000_embeddings_in_half_precision(half_weights):
    embedder = build().t_embedder
    if half_weights:
        embedder = embedder.bfloat16()
    times = torch.linspace(0, 1, 1000)
    with torch.autocast("cpu", torch.bfloat16):
        embeddings = embedder(times)
    assert embeddings.dtype == torch.float32
    assert len(embeddings.unique(dim=0)) == 1000
    wide = embedder.double()
    differences = torch.diff(embeddings.double(), dim=0) * 999
    middles = (times[1:] + times[:-1]).double() / 2
    derivative = torch.func.jvp(wide, (middles,), (torch.ones_like(middles),))[1]
    error = (differences - derivative).norm(dim=1) / derivative.norm(dim=1)
    assert error.max() < 0.01
    assert len(times.bfloat16().unique()) < 600  # the times themselves would coincide


@pytest.mark.numerics
def test_token_norm_of_constant_tokens_is_finite():
    sit = build()
    nn.init.zeros_(sit.x_embedder.proj.weight)
    nn.init.zeros_(sit.x_embedder.proj.bias)
    sit.pos_embed.zero_()
    latents, time = inputs()
    latents.requires_grad_()
    output = sit(latents, time)
    output.velocity.sum().backward()
    assert output.velocity.isfinite().all()
    assert latents.grad.isfinite().all()
    tokens = torch.zeros(8, 16)
    assert (tokens / tokens.std(dim=1, keepdim=True)).isnan().all()  # without eps


@pytest.mark.parametrize("qk_norm", [False, True])
def test_half_weights_leave_float32_islands(qk_norm):
    """Closer to float32 than half of everything, which rounds the token stream in every block."""
    sit, half, all_half = (build(qk_norm=qk_norm) for _ in range(3))
    half.halve_()
    narrow = {name for name, p in half.named_parameters() if p.dtype == torch.bfloat16}
    assert {name.split(".")[2] for name in narrow} == {"attn", "mlp"}
    latents, time = inputs(batch=16)
    expected = sit.velocity(latents, time)
    error = (half.velocity(latents, time) - expected).square().mean().sqrt()
    naive = all_half.bfloat16().velocity(latents.bfloat16(), time).float()
    assert 0 < error < 0.02 * expected.std()
    assert error < 0.7 * (naive - expected).square().mean().sqrt()
