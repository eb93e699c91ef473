"""Steps by average velocities, against a mixture of Gaussians whose flow map is known."""

from __future__ import annotations

import copy
from itertools import pairwise

import pytest
import torch
from quantile_flow import MIXTURE, average_velocity, flow_map
from torch import nn

from r3dpa.flow import ab3, average_times, average_velocity_steps, heun, ode_times
from r3dpa.flow.average_velocity import AVERAGE_STEPS

NOISE = torch.randn(256, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def rmse(a, b):
    return (a.double() - b.double()).square().mean().sqrt().item()


def test_the_quantiles_are_those_of_the_flow():
    """Heun's method on the exact velocity, an independent way, to an error of order 1 / 1000^2."""
    ends = flow_map(NOISE, torch.ones(256), torch.zeros(256))
    assert rmse(heun(MIXTURE.velocity, NOISE, ode_times(1000)), ends) < 1e-5


@pytest.mark.numerics("target time zero")
@pytest.mark.parametrize("steps", AVERAGE_STEPS)
def test_exact_average_velocities_reach_the_end_in_any_number_of_steps(steps):
    ends = flow_map(NOISE, torch.ones(256), torch.zeros(256))
    calls = []

    def average(x, time, target):
        calls.append((time[0].item(), target[0].item()))
        return average_velocity(x, time, target)

    found = average_velocity_steps(average, NOISE, average_times(steps))
    assert rmse(found, ends) < 1e-8  # of the bisection
    assert len(calls) == steps
    assert (calls[0][0], calls[-1][1]) == (1, 0)
    assert rmse(ab3(MIXTURE.velocity, NOISE, average_times(steps)), ends) > 1e-3


def test_times_of_fewer_steps_are_among_those_of_more():
    """A network that is trained on the times of 8 steps has seen all pairs that it is asked for."""
    most = average_times(AVERAGE_STEPS[-1]).tolist()
    for steps in AVERAGE_STEPS:
        assert average_times(steps).tolist() == most[:: AVERAGE_STEPS[-1] // steps]


class Network(nn.Sequential):
    """Average velocities of points ``(B, 1)``."""

    def __init__(self):
        sizes = [3, 64, 64, 64]
        hidden = [layer for i, o in pairwise(sizes) for layer in (nn.Linear(i, o), nn.SiLU())]
        super().__init__(*hidden, nn.Linear(64, 1))

    def average(self, x, time, target):
        return self(torch.cat([x, time[:, None], target[:, None]], dim=1))


def learned(num_steps=800, num_paths=4096):
    """A network trained on pairs of points of AB3 trajectories, as stage few_step does."""
    generator = torch.Generator().manual_seed(1)
    torch.manual_seed(0)
    points = [torch.randn(num_paths, 1, generator=generator)]

    def keep(x, time, index):
        points.extend([x] if index % 2 == 0 else [])
        return x

    ab3(MIXTURE.velocity, points[0], ode_times(16, shift=2.5), after_step=keep)
    path, times = torch.stack(points, dim=1), average_times(8).float()
    network = Network()
    averaged = copy.deepcopy(network)
    optimizer = torch.optim.Adam(network.parameters())
    for step in range(num_steps):
        optimizer.param_groups[0]["lr"] = 3e-3 * (1 - step / num_steps)
        each = torch.randint(num_paths, (256,), generator=generator)
        pair = torch.rand(256, 9, generator=generator).argsort(dim=1)[:, :2].sort(dim=1).values
        time, target = times[pair].unbind(dim=1)
        x, end = path[each, pair[:, 0]], path[each, pair[:, 1]]
        wanted = (x - end) / (time - target)[:, None]
        loss = (network.average(x, time, target) - wanted).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            for average, weight in zip(averaged.parameters(), network.parameters(), strict=True):
                average.lerp_(weight, 0.02)
    return averaged


def test_a_network_learns_the_average_velocity_from_trajectories():
    """Against the analytic one at all pairs of times, and its scenes against AB3 of the same cost.

    The trajectories of 16 AB3 steps are off by 0.02 themselves.
    """
    network, ones = learned(), torch.ones(256)
    with torch.no_grad():
        for steps in (1, 2, 4):
            times = average_times(steps).float()
            found = average_velocity_steps(network.average, NOISE.float(), times)
            ends = flow_map(NOISE, ones, 0 * ones)
            error = rmse(found, ends)
            assert error < 0.2
            assert error < rmse(ab3(MIXTURE.velocity, NOISE, average_times(steps)), ends) / 2
        for now, then in ((1.0, 0.0), (0.6, 0.0), (1.0, 0.6)):
            x = flow_map(NOISE, ones, now * ones)
            exact = average_velocity(x, now * ones, then * ones)
            assert rmse(network.average(x.float(), now * ones, then * ones), exact) < 0.25
