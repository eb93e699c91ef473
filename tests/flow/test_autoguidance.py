"""Autoguidance: its formula, when it evaluates what, and weak models of other normalisations.

Where the exact velocity of a distribution is needed, each channel of the data has two values: what
is expected of them given a noisy sample is a tanh, so no linear shortcut can pass.
"""

from __future__ import annotations

import math
from unittest.mock import Mock

import pytest
import torch

from r3dpa.flow import Interpolant, heun, ode_times
from r3dpa.flow.autoguidance import autoguided, renormalised

MEANS = torch.tensor([0.3, -0.8], dtype=torch.float64)
SHIFT = torch.tensor([0.7, -0.2], dtype=torch.float64)


def strong(x, time):
    return 3 * x + time[:, None]


def weak(x, time):
    return x - 1


def points(batch=3):
    return torch.randn(batch, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def constant(time, batch=3):
    return torch.full((batch,), time, dtype=torch.float64)


@pytest.mark.parametrize("scale", [1.5, 4.0])
def test_autoguidance_adds_scale_minus_one_differences(scale):
    x, time = points(), torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    difference = strong(x, time) - weak(x, time)
    expected = strong(x, time) + (scale - 1) * difference
    torch.testing.assert_close(autoguided(strong, weak, scale)(x, time), expected)


def test_autoguidance_of_scale_one_is_the_model_and_never_runs_the_weak_one():
    counted = Mock(wraps=weak)
    x = points()
    result = heun(autoguided(strong, counted, 1.0), x, ode_times(4))
    assert torch.equal(result, heun(strong, x, ode_times(4)))
    assert counted.call_count == 0


def test_each_model_counts_its_own_evaluations():
    """Eight Euler-like times 1, 7/8, ..., 0; those in [0.25, 0.75] are five, bounds included."""
    counts = Mock(wraps=strong), Mock(wraps=weak)
    guided = autoguided(*counts, 2.0, (0.25, 0.75))
    for time in ode_times(8).tolist():
        x = points().float()
        found = guided(x, constant(time).float())
        inside = 0.25 <= time <= 0.75
        assert torch.equal(found, strong(x, constant(time).float())) != inside
    assert [counted.call_count for counted in counts] == [9, 5]


def test_a_bound_that_float32_rounds_still_belongs_to_the_interval():
    time = torch.full((3,), 0.7, dtype=torch.float32)
    assert time.double()[0] < 0.7
    x = points().float()
    assert not torch.equal(autoguided(strong, weak, 2.0, (0.7, 1.0))(x, time), strong(x, time))


def test_samples_of_one_batch_may_have_their_own_times():
    x, time = points(), torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    found = autoguided(strong, weak, 3.0, (0.4, 0.6))(x, time)
    assert torch.equal(found[[0, 2]], strong(x, time)[[0, 2]])
    everywhere = autoguided(strong, weak, 3.0)(x, time)
    assert torch.equal(found[1], everywhere[1])


def test_a_difference_of_bfloat16_models_is_magnified_in_float32():
    """1 + 2^-7 and 1 are neighbours in bfloat16; 1 + 3 * 2^-8 lies between two of its numbers."""
    near = lambda x, time: torch.full_like(x, 1 + 2**-7, dtype=torch.bfloat16)  # noqa: E731
    one = lambda x, time: torch.ones_like(x, dtype=torch.bfloat16)  # noqa: E731
    found = autoguided(near, one, 1.5)(points().float(), constant(0.5).float())
    assert found.dtype == torch.float32
    assert (found == 1 + 1.5 * 2**-7).all()


def test_scales_intervals_and_shapes_that_do_not_fit_are_refused():
    for scale in (0.99, 0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match=f"1 or more, got {scale}"):
            autoguided(strong, weak, scale)
    for interval in ((0.5, 0.5), (0.6, 0.4), (-0.1, 1.0), (0.0, 1.1)):
        with pytest.raises(ValueError, match=f"got {interval[0]} and {interval[1]}"):
            autoguided(strong, weak, 2.0, interval)
    with pytest.raises(ValueError, match=r"\(3, 1\).*\(3, 2\)"):
        autoguided(strong, lambda x, time: x[:, :1], 2.0)(points(), constant(0.5))
    with pytest.raises(ValueError, match=r"\(3,\), got \(2,\)"):
        autoguided(lambda x, time: x, weak, 2.0)(points(), constant(0.5, batch=2))
    for scale in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="positive and finite"):
            renormalised(weak, scale, SHIFT)
    with pytest.raises(ValueError, match=r"\(2, 1\)"):
        renormalised(weak, 1.0, SHIFT[:, None])


def exact_velocity(means, spread, interpolant):
    """Of data that take ``means - spread`` or ``means + spread`` in each channel."""

    def velocity(x, time):
        path = interpolant.coefficients(time.reshape(-1, *[1] * (x.dim() - 1)))
        centre = means.reshape(-1, *[1] * (x.dim() - 2))
        argument = spread * path.alpha * (x - path.alpha * centre) / path.sigma**2
        data = centre + spread * torch.tanh(argument)
        noise = (x - path.alpha * data) / path.sigma
        return path.d_alpha * data + path.d_sigma * noise

    return velocity


@pytest.mark.parametrize("path", ["linear", "cosine"])
@pytest.mark.parametrize("scale", [0.5, 1.0, 1.7])
@pytest.mark.parametrize("axes", [(), (3, 2)], ids=["points", "images"])
def test_another_normalisation_gives_the_velocity_of_the_same_data(path, scale, axes):
    """In float64 the two sides differ by rounding, most near t = 0, where the test divides by t."""
    interpolant = Interpolant(path)
    here = exact_velocity(MEANS, 0.9, interpolant)
    there = exact_velocity(scale * MEANS + SHIFT, scale * 0.9, interpolant)
    converted = renormalised(there, scale, SHIFT, interpolant)
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(5, 2, *axes, generator=generator, dtype=torch.float64)
    time = torch.tensor([0.05, 0.3, 0.5, 0.8, 1.0], dtype=torch.float64)
    torch.testing.assert_close(converted(x, time), here(x, time), rtol=1e-9, atol=1e-9)
    assert not torch.allclose(there(x, time), here(x, time), atol=0.1)


@pytest.mark.parametrize("path", ["linear", "cosine"])
def test_a_renormalised_model_is_finite_at_both_ends(path):
    """At t = 1 nothing is left of the data: the weak model sees the same noise at time 1."""
    seen = []

    def there(x, time):
        seen.append((x, time))
        return torch.ones_like(x)

    converted = renormalised(there, 2.0, SHIFT, Interpolant(path))
    x = points()
    for time in (0.0, 1.0):
        assert converted(x, constant(time)).isfinite().all()
    (data, at_data), (noise, at_noise) = seen
    torch.testing.assert_close(data, 2 * x + SHIFT)
    torch.testing.assert_close(noise, x)
    torch.testing.assert_close(torch.stack([at_data[0], at_noise[0]]), torch.arange(2.0).double())


def test_a_model_of_the_same_normalisation_is_left_alone():
    assert renormalised(weak, 1.0, torch.zeros(2)) is weak
    assert renormalised(weak, 1.0, SHIFT) is not weak
