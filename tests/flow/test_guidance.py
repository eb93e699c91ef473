from __future__ import annotations

import pytest
import torch
from einops import rearrange
from tiny_networks import aligned_velocity

from r3dpa.bench.measure import flop_of
from r3dpa.flow.guidance import FeatureGuidance, FeatureTarget
from r3dpa.flow.sde import euler_maruyama
from r3dpa.flow.solvers import euler, heun, ode_solver
from r3dpa.flow.times import ode_times, sde_times
from r3dpa.nn.sit import SiT


def velocity(x, time):
    return 0.3 * x + time[:, None, None, None]


def tokens_of(x, time):
    """A token is a pixel, its feature the channels; bent so that energies are not quadratic."""
    return torch.tanh(rearrange(x, "B C h w -> B (h w) C")) + 0.1 * time[:, None, None]


def generator():
    return torch.Generator().manual_seed(0)


def latents(batch=3):
    return torch.randn(8, 5, 2, 3, generator=generator())[:batch]


def target(batch=3):
    return 2 * torch.randn(8, 6, 5, generator=torch.Generator().manual_seed(1))[:batch]


def masks(batch=3):
    mask = torch.rand(8, 6, generator=torch.Generator().manual_seed(2)) > 0.4
    mask[:, 0] = True
    return mask[:batch]


def build(batch=3, mask=None, scale=2.0, features=tokens_of, **options):
    mask = masks(batch) if mask is None else mask
    aligned = aligned_velocity(velocity, features)
    goal = FeatureTarget(target(batch), mask)
    return FeatureGuidance(velocity, aligned, goal, scale=scale, **options)


def times(batch=3):
    return torch.linspace(0.2, 0.8, 8)[:batch]


def energy_of(x, time, goal, mask):
    cosine = torch.cosine_similarity(tokens_of(x[None], time[None])[0], goal, dim=-1)
    return -cosine[mask].mean()


def test_term_is_the_scaled_gradient_of_each_samples_own_energy():
    x, time = latents().double(), times().double()
    term = build(max_ratio=torch.inf)(x, time) - velocity(x, time)
    for index in range(3):
        gradient = torch.func.grad(energy_of)(
            x[index], time[index], target()[index].double(), masks()[index]
        )
        torch.testing.assert_close(term[index], 2 * gradient)
    torch.testing.assert_close(build().term(x, time), term)


def test_history_holds_energy_and_cosine_of_every_evaluation():
    x, time, guidance = latents(), times(), build()
    guided = guidance(x, time)
    heun(guidance, x, ode_times(3))
    assert len(guidance.history) == 1 + 5
    energy, cosine = guidance.history[0]
    for index in range(3):
        expected = energy_of(x[index], time[index], target()[index], masks()[index])
        torch.testing.assert_close(energy[index], expected)
        torch.testing.assert_close(guidance.energy(x, time)[index], expected)
        direction, term = velocity(x, time)[index], (guided - velocity(x, time))[index]
        expected = torch.cosine_similarity(direction.flatten(), term.flatten(), dim=0)
        torch.testing.assert_close(cosine[index], expected)


@pytest.mark.numerics
def test_strength_does_not_depend_on_the_batch():
    alone = build(1).term(latents(1), times(1))
    together = build(8).term(latents(8), times(8))
    torch.testing.assert_close(together[:1], alone)
    naive_alone = build(1, legacy=True).term(latents(1), times(1))
    naive_together = build(8, legacy=True).term(latents(8), times(8))
    assert naive_together[0].norm() < 0.5 * naive_alone[0].norm()


@pytest.mark.numerics
@pytest.mark.parametrize("legacy", [False, True])
def test_an_empty_mask_means_no_guidance(legacy):
    mask = torch.zeros(3, 6, dtype=torch.bool)
    guidance, x = build(mask=mask, legacy=legacy), latents()
    assert torch.equal(heun(guidance, x, ode_times(4)), heun(velocity, x, ode_times(4)))
    assert guidance.num_dropped == 0
    assert guidance.history == []
    naive = energy_of(x[0], times()[0], target()[0], mask[0])
    assert naive.isnan()


@pytest.mark.numerics
def test_tokens_of_length_zero_have_a_finite_gradient():
    guidance = build(
        features=lambda x, time: rearrange(x, "B C h w -> B (h w) C"),
        mask=torch.ones(3, 6, dtype=torch.bool),
        scale=1.0,
    )
    term = guidance.term(torch.zeros(3, 5, 2, 3), times())
    assert term.isfinite().all()
    assert term.abs().max() <= 1e6  # 1 / eps
    assert guidance.num_dropped == 0
    leaf = torch.zeros(3, 6, 5, requires_grad=True)
    naive = torch.nn.functional.normalize(leaf, dim=-1) * torch.nn.functional.normalize(
        target(), dim=-1
    )
    (gradient,) = torch.autograd.grad(naive.sum(), leaf)
    assert gradient.abs().max() > 1e9


@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode])
def test_guidance_works_where_gradients_are_off_and_trains_no_network(context):
    network = torch.nn.Linear(5, 5)

    def features(x, time):
        return network(tokens_of(x, time))

    expected = build(features=features).term(latents(), times())
    with context():
        x, time = latents(), times()
        guidance = build(features=features)
        term = guidance.term(x, time)
        guidance(x, time)
    assert torch.equal(term, expected)
    assert guidance(latents(), times()).requires_grad is False
    assert all(p.grad is None for p in network.parameters())


def test_features_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"\(B, N, F\), got \(6, 5\)"):
        FeatureTarget(target()[0])
    with pytest.raises(ValueError, match=r"\(3, 6\), got torch.float32 of shape \(3, 6\)"):
        build(mask=torch.ones(3, 6))
    with pytest.raises(ValueError, match=r"\(3, 6\), got torch.bool of shape \(2, 6\)"):
        build(mask=masks(2))
    with pytest.raises(ValueError, match=r"\(3, 6, 5\), but .* \(2, 6, 5\)"):
        build()(latents(2), times(2))
    with pytest.raises(ValueError, match="no term without a velocity"):
        build(scale=0.5, relative=True).term(latents(), times())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scale": -1.0}, "scale of the guidance must be 0 or above, got -1"),
        ({"scale": torch.nan}, "got nan"),
        ({"max_ratio": -1.0}, "max_ratio of the guidance must be 0 or above, got -1"),
        ({"interval": (0.5, 0.5)}, "got 0.5 and 0.5"),
        ({"interval": (0.2, 1.2)}, "got 0.2 and 1.2"),
        ({"relative": True, "scale": 1.5}, r"at most max_ratio \(1.0\), got .* scale 1.5"),
        ({"relative": True, "scale": 0.5, "legacy": True}, "got legacy=True"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        build(**options)


def test_relative_strength_is_the_length_of_the_term_in_velocities_of_the_guided_tokens():
    x, time, mask = latents(), times(), torch.zeros(3, 6, dtype=torch.bool)
    mask[0], mask[1, :3], mask[2, 0] = True, True, True
    plain = velocity(x, time)
    term = build(mask=mask, scale=0.25, relative=True)(x, time) - plain
    ratio = term.flatten(1).norm(dim=1) / plain.flatten(1).norm(dim=1)
    torch.testing.assert_close(ratio, 0.25 * torch.tensor([1, 1 / 2, 1 / 6]).sqrt())
    gradient = build(mask=mask).term(x, time)
    cosine = torch.cosine_similarity(term.flatten(1), gradient.flatten(1))
    torch.testing.assert_close(cosine, torch.ones(3))


def test_outside_of_the_interval_no_gradient_is_computed():
    asked = []

    def features(x, time):
        asked.append(time[0].item())
        return tokens_of(x, time)

    guidance, x = build(features=features, interval=(0.25, 0.75)), latents()
    euler(guidance, x, ode_times(8))
    assert asked == [0.75, 0.625, 0.5, 0.375, 0.25]
    assert len(guidance.history) == 5
    mixed = torch.tensor([0.1, 0.5, 0.9])
    term = guidance(x, mixed) - velocity(x, mixed)
    assert term[[0, 2]].abs().max() == 0
    whole = build()(x, mixed) - velocity(x, mixed)
    assert torch.equal(term[1], whole[1])


@pytest.mark.parametrize("legacy", [False, True])
def test_the_sde_is_guided_inside_of_the_interval_only(legacy):
    guidance = build(interval=(0.4, 0.6), legacy=legacy)
    noises = iter(lambda: torch.zeros_like(latents()), None)
    euler_maruyama(
        guidance.sde_velocity,
        latents(),
        sde_times(10),
        noises,
        change_drift=guidance.change_drift,
    )
    inside = (sde_times(10)[:-1] >= 0.4) & (sde_times(10)[:-1] <= 0.6)
    assert len(guidance.history) == inside.sum() > 0
    if legacy:
        drift, mixed = torch.zeros_like(latents()), torch.tensor([0.1, 0.5, 0.9])
        term = guidance.change_drift(drift, latents(), mixed)
        assert term[[0, 2]].abs().max() == 0
        assert term[1].abs().max() > 0


def test_cells_of_the_target_without_points_are_not_selected():
    goal, mask, x, time = target(), masks(), latents(), times()
    goal[:, 0] = 0
    without = mask.clone()
    without[:, 0] = False

    def guided(mask, **options):
        aligned = aligned_velocity(velocity, tokens_of)
        guidance = FeatureGuidance(
            velocity, aligned, FeatureTarget(goal, mask), scale=0.5, **options
        )
        return guidance(x, time)

    for relative in (False, True):
        assert torch.equal(guided(mask, relative=relative), guided(without, relative=relative))
    assert not torch.equal(guided(mask, legacy=True), guided(without, legacy=True))


def test_stitched_features_by_hand():
    left = torch.tensor([[[2.0, 0.0], [4.0, 0.0], [0.0, 0.0], [0.0, 0.0]]])
    right = torch.tensor([[[0.0, 1.0], [0.0, 1e6], [0.0, 5.0], [0.0, 0.0]]])
    weights = torch.tensor([[1.0, 0.5, 0.5, 1.0], [0.0, 0.5, 0.5, 0.0]])
    stitched = FeatureTarget.stitched([left, right], weights)
    # The seam is half of both whatever their lengths; an empty cell has no say.
    expected = torch.tensor([[[1.0, 0.0], [0.5, 0.5], [0.0, 0.5], [0.0, 0.0]]])
    torch.testing.assert_close(stitched.features, expected)
    with pytest.raises(ValueError, match=r"\(S, N\), got .* weights \(4, 2\)"):
        FeatureTarget.stitched([left, right], weights.T)
    with pytest.raises(ValueError, match="one shape"):
        FeatureTarget.stitched([left, right[:, :3]], weights)
    with pytest.raises(ValueError, match="0 or above"):
        FeatureTarget.stitched([left, right], -weights)


def network(**options):
    """Small SiT without zero layers, which would hide most of it."""
    torch.manual_seed(0)
    sizes = {"input_size": (4, 8), "in_channels": 3, "hidden_size": 16, "depth": 3, "num_heads": 2}
    head = {"alignment_depth": 2, "feature_dim": 5, "projector_dim": 12}
    sit = SiT(**{**sizes, **head, **options})
    for parameter in sit.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return sit.eval()


def noise(batch=3):
    return torch.randn(8, 3, 4, 8, generator=generator())[:batch]


def guidance_of(sit, mask=None, batch=3, factor=1.0, **options):
    goal = torch.randn(8, 8, 5, generator=torch.Generator().manual_seed(3))[:batch]
    target = FeatureTarget(factor * goal, mask)
    return FeatureGuidance(sit.velocity, sit.aligned_pass, target, **options)


def solve(solver, velocity, x):
    """The sampler of that name with the draws of each sample its own."""
    generators = [torch.Generator().manual_seed(seed) for seed in range(len(x))]

    def draws():
        while True:
            yield torch.stack([torch.randn(x.shape[1:], generator=g) for g in generators])

    if solver == "euler_maruyama":
        return euler_maruyama(velocity, x, sde_times(5), draws())
    return ode_solver(solver)(velocity, x, ode_times(5))


SAMPLERS = ["heun", "ab2", "unipc", "euler_maruyama"]


@pytest.mark.parametrize("solver", SAMPLERS)
def test_a_network_without_guidance_is_the_unguided_sampler_bit_by_bit(solver):
    sit, x, nothing = network(), noise(), torch.zeros(3, 8, dtype=torch.bool)
    plain = solve(solver, sit.velocity, x)
    for options in ({"scale": 0.0}, {"scale": 0.5, "relative": True, "mask": nothing}):
        assert torch.equal(solve(solver, guidance_of(sit, **options), x), plain)
    partly = nothing.clone()
    partly[0] = True
    guided = solve(solver, guidance_of(sit, partly, scale=0.5, relative=True), x)
    assert torch.equal(guided[1:], plain[1:])
    assert (guided[0] - plain[0]).abs().max() > 0.01


def test_first_blocks_run_forward_and_back_and_the_others_forward():
    """FLOP of a guided evaluation by formula: backward passes give gradients of inputs only."""
    D, N, rows, depth, head = 32, 8, 2, 6, (64, 5)
    sit = network(hidden_size=D, depth=depth, projector_dim=head[0])
    linear = 2 * N * 12 * D * D  # q, k, v, output, and the MLP of ratio 4
    attention = 2 * 2 * N * N * D
    block, patches = linear + attention, 2 * N * 12 * D  # 12 numbers in a patch of 3 channels
    times_ = 2 * (256 * D + D * D + (6 * depth + 2) * D * D)
    plain = 2 * patches + times_ + depth * block
    projector = 2 * N * (D * head[0] + head[0] ** 2 + head[0] * head[1])
    back = rows * (linear + 2 * attention) + patches + projector
    x, time = noise(1), torch.tensor([0.5])
    guidance = guidance_of(sit.requires_grad_(False), batch=1, scale=1.0)
    with torch.no_grad():
        assert flop_of(lambda: sit.velocity(x, time)) == plain
        assert flop_of(lambda: guidance(x, time)) == plain + projector + back
