from __future__ import annotations

import pytest
import torch
from einops import rearrange

from r3dpa.flow.guidance import FeatureGuidance
from r3dpa.flow.sde import euler_maruyama
from r3dpa.flow.solvers import euler, heun
from r3dpa.flow.times import ode_times, sde_times


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
    return FeatureGuidance(velocity, features, target(batch), mask, scale=scale, **options)


def times(batch=3):
    return torch.linspace(0.2, 0.8, 8)[:batch]


def energy_of(x, time, goal, mask):
    cosine = torch.cosine_similarity(tokens_of(x[None], time[None])[0], goal, dim=-1)
    return -cosine[mask].mean()


def test_term_is_the_scaled_gradient_of_each_samples_own_energy():
    x, time = latents().double(), times().double()
    term = build()(x, time) - velocity(x, time)
    for index in range(3):
        gradient = torch.func.grad(energy_of)(
            x[index], time[index], target()[index].double(), masks()[index]
        )
        torch.testing.assert_close(term[index], 2 * gradient)
    torch.testing.assert_close(build().term(x, time), term)


@pytest.mark.parametrize("legacy", [False, True])
def test_guided_sampling_ends_nearer_to_the_target(legacy):
    def energy(scale):
        guidance = build(scale=scale, legacy=legacy)
        last = euler(guidance, latents(), ode_times(10))
        probe = build()
        probe(last, torch.zeros(3))
        return probe.history[0].energy

    assert (energy(10.0) < energy(0.0) - 0.05).all()


def test_history_holds_energy_and_cosine_of_every_evaluation():
    x, time, guidance = latents(), times(), build()
    guided = guidance(x, time)
    heun(guidance, x, ode_times(3))
    assert len(guidance.history) == 1 + 5
    energy, cosine = guidance.history[0]
    for index in range(3):
        expected = energy_of(x[index], time[index], target()[index], masks()[index])
        torch.testing.assert_close(energy[index], expected)
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
    assert all(record.energy.abs().max() == 0 for record in guidance.history)
    naive = energy_of(x[0], times()[0], target()[0], mask[0])
    assert naive.isnan()


def test_an_empty_mask_of_one_sample_leaves_the_others_guided():
    mask = masks()
    mask[1] = False
    term, full = build(mask=mask).term(latents(), times()), build().term(latents(), times())
    assert term[1].abs().max() == 0
    assert torch.equal(term[[0, 2]], full[[0, 2]])


@pytest.mark.numerics
@pytest.mark.parametrize("broken", [torch.inf, torch.nan])
def test_a_gradient_that_is_not_finite_is_dropped_and_counted(broken):
    calls = []

    def features(x, time):
        calls.append(None)
        spoil = torch.zeros_like(x)
        if len(calls) == 2:
            spoil[1, 0, 0, 0] = broken
        return tokens_of(x + spoil * x, time)

    guidance, x = build(features=features), latents()
    result = euler(guidance, x, ode_times(4))
    assert result.isfinite().all()
    assert guidance.num_dropped == 1
    untouched = euler(build(), x, ode_times(4))
    torch.testing.assert_close(result[[0, 2]], untouched[[0, 2]])
    assert not torch.equal(result[1], untouched[1])

    leaf = x.clone().requires_grad_()
    calls[:] = [None]  # the next call is the second, which is spoiled
    naive = torch.cosine_similarity(features(leaf, times()), target(), dim=-1).mean()
    assert not torch.autograd.grad(naive, leaf)[0].isfinite().all()


@pytest.mark.numerics
def test_tokens_of_length_zero_have_a_finite_gradient():
    guidance = FeatureGuidance(
        velocity, lambda x, time: rearrange(x, "B C h w -> B (h w) C"), target(), scale=1.0
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


@pytest.mark.numerics
def test_energy_of_half_precision_features_is_computed_in_float32():
    def half(x, time):
        return 300 * tokens_of(x, time).half()

    guidance = build(features=half)
    term = guidance.term(latents(), times())
    assert term.dtype == torch.float32
    assert guidance.num_dropped == 0
    torch.testing.assert_close(term, build().term(latents(), times()), atol=2e-3, rtol=0)
    features = half(latents(), times())
    assert features.square().sum(dim=-1).isinf().any()


@pytest.mark.parametrize("legacy", [False, True])
def test_scale_zero_is_unguided_in_all_solvers(legacy):
    x, guidance = latents(), build(scale=0.0, legacy=legacy)
    draws = torch.randn(3, *x.shape, generator=generator())
    assert torch.equal(euler(guidance, x, ode_times(4)), euler(velocity, x, ode_times(4)))
    assert torch.equal(
        heun(guidance, x, ode_times(4), corrector_velocity=guidance.corrector_velocity),
        heun(velocity, x, ode_times(4)),
    )
    sde = euler_maruyama(
        guidance.sde_velocity, x, sde_times(4), draws, change_drift=guidance.change_drift
    )
    assert torch.equal(sde, euler_maruyama(velocity, x, sde_times(4), draws))


def test_every_evaluation_is_guided_but_those_the_legacy_sampler_leaves_out():
    x, draws = latents(), torch.zeros(3, 3, 5, 2, 3)

    def evaluations(solve, legacy):
        guidance = build(legacy=legacy)
        solve(guidance)
        return len(guidance.history)

    def solve_heun(guidance):
        heun(guidance, x, ode_times(4), corrector_velocity=guidance.corrector_velocity)

    def solve_sde(guidance):
        euler_maruyama(
            guidance.sde_velocity, x, sde_times(4), draws, change_drift=guidance.change_drift
        )

    assert evaluations(solve_heun, legacy=False) == 7
    assert evaluations(solve_heun, legacy=True) == 4
    assert evaluations(solve_sde, legacy=False) == 4
    assert evaluations(solve_sde, legacy=True) == 3


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
        FeatureGuidance(velocity, tokens_of, target()[0], scale=1.0)
    with pytest.raises(ValueError, match=r"\(3, 6\), got torch.float32 of shape \(3, 6\)"):
        build(mask=torch.ones(3, 6))
    with pytest.raises(ValueError, match=r"\(3, 6\), got torch.bool of shape \(2, 6\)"):
        build(mask=masks(2))
    with pytest.raises(ValueError, match=r"\(3, 6, 5\), but .* \(2, 6, 5\)"):
        build()(latents(2), times(2))
