"""Hard cases of average velocities: their times, their targets, and how these are learned.

The opponent is the identity that MeanFlow (Geng et al. 2025) trains on, ``u = v - (t - r) du/dt``,
with the derivative of the network itself in its target.
"""

from __future__ import annotations

import pytest
import torch
from tiny_stages import stage_module
from torch import nn

from r3dpa.bench.problems import GaussianMixture
from r3dpa.flow import ab3, average_times, average_velocity_steps, ode_times

MIXTURE = GaussianMixture(torch.tensor([[-1.0], [1.2]]).double(), 0.25, torch.tensor([0.4, 0.6]))
TIMES = average_times(8)


class Network(nn.Sequential):
    """Average velocities of points ``(B, 1)``; a larger spread makes it steeper in time."""

    def __init__(self, spread=1.0):
        torch.manual_seed(0)
        super().__init__(nn.Linear(3, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU())
        self.append(nn.Linear(64, 1))
        for parameter in self.parameters():
            nn.init.normal_(parameter, std=spread * parameter.shape[-1] ** -0.5)

    def average(self, x, time, target):
        return self(torch.cat([x, time[:, None], target[:, None]], dim=1))


def identity_target(average, x, time, target, step=None):
    """Target of the identity; derivative along the path exact, or by a difference."""
    velocity = MIXTURE.velocity(x, time)
    if step is None:
        tangents = velocity, torch.ones_like(time), torch.zeros_like(target)
        slope = torch.func.jvp(average, (x, time, target), tangents)[1]
    else:
        earlier = average(x - step * velocity, time - step, target)
        slope = (average(x, time, target) - earlier) / step
    return (velocity - (time - target)[:, None] * slope).detach()


def trajectories(num=2048):
    """Points ``(B, 9, 1)`` of paths at the times of 8 steps, in float64."""
    points = [torch.randn(num, 1, generator=torch.Generator().manual_seed(0)).double()]

    def keep(x, time, index):
        points.extend([x] if index % 32 == 0 else [])
        return x

    ab3(MIXTURE.velocity, points[0], ode_times(256, shift=2.5), after_step=keep)
    return torch.stack(points, dim=1)


@pytest.mark.numerics("target time equal to the time")
def test_the_quotient_of_a_step_is_not_taken_at_its_start():
    module = stage_module("few_step")
    sit = module.sit
    sit.load_state_dict(sit.with_average(sit.state_dict()))
    nn.init.zeros_(sit.average.embedder.mlp[2].weight)
    nn.init.zeros_(sit.average.embedder.mlp[2].bias)
    x, time = torch.randn(4, 4, 4, 8), torch.tensor([0.0, 1e-7, 0.5, 1.0])
    assert torch.equal(sit.average_velocity(x, time, time), sit.velocity(x, time))
    quotient = (x - x) / (time - time)[:, None, None, None]
    assert quotient.isnan().all()
    for first in range(8):  # no pair of a training step has two equal times
        assert (TIMES[first] - TIMES[first + 1 :] > 0.05).all()


@pytest.mark.numerics("target time zero")
def test_the_last_step_ends_at_the_data():
    """All times are entries of a table; a central difference would ask for times below 0."""
    seen = []

    def average(x, time, target):
        seen.append(target)
        return x

    found = average_velocity_steps(average, torch.ones(2, 1), average_times(8))
    assert (seen[-1] == 0).all()
    assert found.isfinite().all()
    time = TIMES[-2].float() * 1e-4  # a time drawn near the data
    assert time - 1e-3 / 2 < 0


@pytest.mark.numerics("step below the resolution of the points")
def test_targets_of_stored_points_are_exact_enough():
    """Points in float16 are off by up to 2^-11 |x|, and the shortest step between two is 0.054."""
    points = trajectories()
    x, end = points[:, :-1], points[:, 1:]
    length = (TIMES[:-1] - TIMES[1:])[None, :, None]
    exact = (x - end) / length
    stored = (x.half().double() - end.half().double()) / length
    assert (stored - exact).square().mean().sqrt() < 1e-2 * exact.square().mean().sqrt()

    length = 1e-4
    start = points[:, 4]
    velocity = MIXTURE.velocity(start, torch.full((len(start),), float(TIMES[4])).double())
    near = start - length * velocity
    drawn = (start.half().double() - near.half().double()) / length
    assert (drawn - velocity).square().mean().sqrt() > velocity.square().mean().sqrt()


@pytest.mark.numerics("step below the resolution of the points")
def test_the_derivative_by_a_short_difference():
    """The identity in float32 against forward-mode differentiation in float64."""
    x = torch.randn(512, 1, generator=torch.Generator().manual_seed(0))
    time, target = torch.full((512,), 0.8), torch.full((512,), 0.1)
    wide = Network(2.0).double().average
    exact = identity_target(wide, x.double(), time.double(), target.double())
    narrow = Network(2.0).average
    errors = {}
    for step in (1e-3, 1e-7):
        found = identity_target(narrow, x, time, target, step)
        errors[step] = ((found - exact).square().mean() / exact.square().mean()).sqrt().item()
    assert errors[1e-3] < 0.005
    assert errors[1e-7] > 1


def fitted(points, weighted, num_steps=300):
    """Error of each step of a training on pairs of points, and the error of the last ones."""
    network, generator = Network(), torch.Generator().manual_seed(3)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    errors = []
    for _ in range(num_steps):
        each = torch.randint(len(points), (64,), generator=generator)
        pair = torch.rand(64, 9, generator=generator).argsort(dim=1)[:, :2].sort(dim=1).values
        time, target = TIMES.float()[pair].unbind(dim=1)
        x, end = points[each, pair[:, 0]], points[each, pair[:, 1]]
        wanted = (x - end) / (time - target)[:, None]
        error = (network.average(x, time, target) - wanted).square().squeeze(1)
        errors.append(error.mean().item())
        loss = error / (error.detach() + 1e-3) if weighted else error
        optimizer.zero_grad()
        loss.mean().backward()
        optimizer.step()
    return torch.tensor(errors[num_steps // 3 :])


@pytest.mark.numerics("spikes of the loss")
def test_losses_of_trajectories_have_no_spikes():
    """Targets lie within the reach of the paths: no weight has to hold outliers down.

    Published for MeanFlow is ``1 / (error + 1e-3)``. It lets nearly exact pairs pull as hard as
    wrong ones, and the error ends larger.
    """
    points = trajectories().float()
    plain, weighted = fitted(points, False), fitted(points, True)
    assert plain.max() < 8 * plain.median()
    assert weighted.median() > 1.2 * plain.median()


@pytest.mark.numerics("targets that grow with the network")
def test_targets_of_trajectories_do_not_depend_on_the_network():
    """A network that has become steep: the identity's targets follow, and pull it further."""
    x = trajectories()[:, 2].float()
    time, target = torch.full((len(x),), float(TIMES[2])), torch.zeros(len(x))
    lengths = [
        identity_target(Network(steep).average, x, time, target).square().mean().sqrt().item()
        for steep in (1.0, 4.0)
    ]
    assert lengths[1] > 10 * lengths[0]
    module = stage_module("few_step")
    before = module.solve([0, 1])
    with torch.no_grad():
        for parameter in module.sit.average.parameters():
            parameter.mul_(4)
    assert torch.equal(module.solve([0, 1]), before)
