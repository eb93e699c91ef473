"""Hard cases of feature guidance."""

from __future__ import annotations

import weakref

import pytest
import torch
from tiny_networks import aligned_velocity

from r3dpa.bench.problems import GaussianMixture
from r3dpa.flow import (
    FeatureGuidance,
    FeatureTarget,
    euler,
    euler_maruyama,
    heun,
    ode_times,
    sde_times,
)

DTYPES = [torch.float32, torch.bfloat16, torch.float16]
DATA = GaussianMixture(torch.zeros(1, 32), 1.0, torch.ones(1))  # so the state has deviation 1


def noise(batch=4, dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    return torch.randn(batch, 32, generator=generator).to(dtype)


def outward_tokens(x, time):
    """8 tokens (x1, x2^2 + ..., 1) whose likeness to (0, 1, 0) grows as the state does."""
    tokens = x.unflatten(-1, (8, 4))
    length = tokens.square().sum(dim=-1)
    return torch.stack([tokens[..., 0], length, torch.ones_like(length)], dim=-1)


OUTWARD = torch.tensor([0.0, 1.0, 0.0])


def guidance_of(scale, tokens=outward_tokens, batch=4, mask=None, length=1.0, **options):
    target = FeatureTarget(length * OUTWARD.expand(batch, 8, 3), mask)
    aligned = aligned_velocity(DATA.velocity, tokens)
    return FeatureGuidance(DATA.velocity, aligned, target, scale=scale, **options)


def solve(kind, guidance, x):
    if kind == "euler":
        return euler(guidance, x, ode_times(50))
    if kind == "heun":
        return heun(guidance, x, ode_times(25), corrector_velocity=guidance.corrector_velocity)
    generator = torch.Generator().manual_seed(1)
    return euler_maruyama(
        guidance.sde_velocity, x, sde_times(50), generator, change_drift=guidance.change_drift
    )


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", ["euler", "heun", "sde"])
@pytest.mark.numerics("gradient far longer than the velocity")
def test_a_huge_scale_cannot_carry_the_state_away(kind, dtype):
    x = noise(dtype=dtype)
    guidance = guidance_of(1e6)
    result = solve(kind, guidance, x)
    assert result.dtype == dtype
    assert result.abs().max() < 10
    assert guidance.num_dropped == 0
    assert not torch.equal(result, solve(kind, guidance_of(0.0), x))

    unlimited = solve(kind, guidance_of(1e6, max_ratio=torch.inf), x.float()).abs().max()
    assert unlimited > 100


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("gradient far longer than the velocity")
def test_the_term_is_shortened_per_sample_and_keeps_its_direction(dtype):
    """Sample 0 has a gradient 1e30 times longer than that of sample 1, which is left alone."""

    def steep(x, time):
        steepness = torch.tensor([1e30, 1.0]).reshape(-1, 1)
        return outward_tokens(x * steepness - (x * steepness).detach() + x.detach(), time)

    x, time = noise(2, dtype), torch.full((2,), 0.9)
    velocity = DATA.velocity(x.float(), time)
    free = guidance_of(1e-3, steep, batch=2, max_ratio=torch.inf)(x, time) - velocity
    for ratio in (0.25, 1.0):
        term = guidance_of(1e-3, steep, batch=2, max_ratio=ratio)(x, time) - velocity
        lengths = term.double().norm(dim=1) / velocity.double().norm(dim=1)
        assert lengths[0].item() == pytest.approx(ratio, rel=1e-5)
        torch.testing.assert_close(term[1], free[1])
        direction = torch.cosine_similarity(term[0].double(), free[0].double(), dim=0)
        assert direction.item() == pytest.approx(1, abs=1e-5)
    assert free[0].norm().isinf()  # squared in float32
    whole = velocity.norm() / free.norm() * free
    assert (whole == 0).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("gradient far longer than the velocity")
def test_a_term_of_few_tokens_is_limited_by_the_velocity_of_few_tokens(dtype):
    """One token of 8: what one token of a full mask gets, not all of the velocity."""
    x, time = noise(dtype=dtype), torch.full((4,), 0.9)
    mask = torch.zeros(4, 8, dtype=torch.bool)
    mask[:, 3] = True
    velocity = DATA.velocity(x.float(), time)
    for options in ({"scale": 1e6}, {"scale": 1.0, "relative": True}):
        term = guidance_of(mask=mask, **options)(x, time) - velocity
        ratio = term.norm(dim=1) / velocity.norm(dim=1)
        torch.testing.assert_close(ratio, torch.full((4,), 8**-0.5), rtol=1e-4, atol=0)
    pushed = (velocity.norm(dim=1) / velocity[:, 12:16].norm(dim=1)).max().item()
    assert pushed > 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.numerics("gradient far longer than the velocity")
def test_scale_times_a_steep_gradient_may_be_beyond_float32(dtype):
    def steep(x, time):
        return outward_tokens(x * 1e34 - (x * 1e34).detach() + x.detach(), time)

    x, time = noise(2, torch.float32), torch.full((2,), 0.9)
    velocity = DATA.velocity(x.to(dtype).float(), time)
    term = guidance_of(1e6, steep, batch=2)(x.to(dtype), time) - velocity
    lengths = term.norm(dim=1) / velocity.norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(2), rtol=1e-4, atol=0)
    gradient = guidance_of(1.0, steep, batch=2).term(x, time)
    assert gradient.isfinite().all()
    assert (1e6 * gradient).isinf().any()


@pytest.mark.numerics("gradient far longer than the velocity")
def test_published_guidance_is_not_limited():
    x, time = noise(), torch.full((4,), 0.9)
    assert torch.equal(guidance_of(1e6, max_ratio=0.0)(x, time), DATA.velocity(x, time))
    legacy = guidance_of(1e6, legacy=True)(x, time) - DATA.velocity(x, time)
    assert (legacy.norm(dim=1) > 100 * DATA.velocity(x, time).norm(dim=1)).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("guidance of the last step")
def test_every_step_of_ode_and_sde_is_guided_alike(dtype):
    """Without noise the SDE is the ODE, guided or not; the published one is so only unguided."""
    x, times = noise(dtype=dtype), sde_times(6, last=0.2)

    def both(scale, legacy):
        ode, sde = (guidance_of(scale, legacy=legacy) for _ in range(2))
        silence, options = torch.zeros(5, *x.shape), {"eta": 0.0, "change_drift": sde.change_drift}
        end = euler_maruyama(sde.sde_velocity, x, times, silence, **options)
        return euler(ode, x, times), end, len(ode.history), len(sde.history)

    tolerance = 16 * torch.finfo(dtype).eps
    ode, sde, ode_count, sde_count = both(2.0, legacy=False)
    torch.testing.assert_close(sde, ode, atol=tolerance, rtol=tolerance)
    assert (ode_count, sde_count) == (6, 6)
    unguided = euler(DATA.velocity, x, times)
    assert (ode - unguided).abs().max() > 0.1
    for legacy in (False, True):
        ode, sde, *_ = both(0.0, legacy)
        assert torch.equal(ode, unguided)
        torch.testing.assert_close(sde, unguided, atol=tolerance, rtol=tolerance)
    ode, sde, ode_count, sde_count = both(2.0, legacy=True)
    assert (ode_count, sde_count) == (6, 5)
    assert (ode - sde).abs().max() > 0.01


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("gradient that is not finite")
def test_an_infinite_gradient_is_dropped_for_one_sample_and_step(dtype):
    """Through a block in half precision; sample 1 overflows in the third evaluation."""
    calls = []

    def tokens(x, time):
        calls.append(None)
        spoil = torch.zeros(len(x), 1, dtype=dtype)
        spoil[1] = torch.finfo(dtype).max
        return outward_tokens(x.to(dtype) * (1 + spoil * (len(calls) == 3)), time).to(dtype)

    guidance = guidance_of(2.0, tokens)
    result = euler(guidance, noise(dtype=dtype), ode_times(6))
    assert result.isfinite().all()
    assert guidance.num_dropped == 1
    plain = guidance_of(2.0, lambda x, time: outward_tokens(x.to(dtype), time).to(dtype))
    untouched = euler(plain, noise(dtype=dtype), ode_times(6))
    torch.testing.assert_close(result[[0, 2, 3]], untouched[[0, 2, 3]])
    leaf = noise().requires_grad_()
    calls[:] = [None, None]
    cosine = torch.cosine_similarity(tokens(leaf, None), OUTWARD.to(dtype), dim=-1)
    (gradient,) = torch.autograd.grad(cosine.sum(), leaf)
    assert not gradient[1].isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.numerics("gradient that is not finite")
def test_features_whose_squares_are_infinite_still_guide(dtype):
    """A power of two times as large, tokens have the same directions and the same term."""
    x, time = noise(), torch.full((4,), 0.5)

    def tokens(x, time):
        return outward_tokens(x, time).to(dtype)

    def large(x, time):
        return tokens(x, time) * 2.0**70

    term = guidance_of(1.0, tokens).term(x, time)
    assert (term.flatten(1).norm(dim=1) > 0.01).all()
    torch.testing.assert_close(guidance_of(1.0, large).term(x, time), term, atol=1e-4, rtol=1e-3)
    far_target = guidance_of(1.0, tokens, length=2.0**70)
    torch.testing.assert_close(far_target.term(x, time), term, atol=1e-4, rtol=1e-3)
    squares = large(x, time).float().square().sum(dim=-1, keepdim=True)
    assert (large(x, time).float() * squares.rsqrt() == 0).all()


@pytest.mark.numerics("memory of the evaluations")
def test_no_evaluation_keeps_what_its_backward_pass_needed():
    """Counted are the tensors saved for a backward pass that are still alive."""
    alive = weakref.WeakSet()

    class Saved:
        def __init__(self, tensor):
            self.tensor = tensor
            alive.add(self)

    def alive_after(evaluate, evaluations=20):
        kept = []
        with torch.autograd.graph.saved_tensors_hooks(Saved, lambda saved: saved.tensor):
            for _ in range(evaluations):
                kept.append(evaluate(noise(), torch.full((4,), 0.5)))
        return len(alive)

    guidance = guidance_of(1.0)
    assert alive_after(guidance) == 0
    assert len(guidance.history) == 20
    assert not any(record.energy.requires_grad for record in guidance.history)

    def energy_with_graph(x, time):
        return torch.cosine_similarity(outward_tokens(x.requires_grad_(), time), OUTWARD, dim=-1)

    one = alive_after(energy_with_graph, 1)
    alive.clear()
    assert alive_after(energy_with_graph) >= 20 * one > 0
