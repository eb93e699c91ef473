from __future__ import annotations

import pytest
import torch

from r3dpa.flow.editing import pnp_flow_feature, transport_to_time
from r3dpa.flow.solvers import CountingVelocity
from r3dpa.flow.times import ode_times


def latents():
    return torch.randn(2, 3, 4, 6, generator=torch.Generator().manual_seed(0)).double()


def edit_mask():
    mask = torch.zeros(2, 1, 4, 6, dtype=torch.bool)
    mask[:, :, :, 2:4] = True
    return mask


def no_feature(x, time):
    return torch.zeros_like(x)


def still(x, time):
    return torch.zeros_like(x)


def silence(num):
    return torch.zeros(num, 2, 3, 4, 6).double()


def test_transport_goes_forward_from_the_data():
    def velocity(x, time):
        return 2 * time[:, None, None, None].expand_as(x)

    # Left sum of 2 t over 0, 0.2, 0.4 in steps of 0.2.
    moved = transport_to_time(velocity, latents(), 0.6, 3)
    torch.testing.assert_close(moved, latents() + 0.2 * 2 * (0 + 0.2 + 0.4))


@pytest.mark.parametrize(("time", "steps"), [(0.0, 3), (1.2, 3), (0.5, 0)])
def test_impossible_transport_is_refused(time, steps):
    with pytest.raises(ValueError, match="got"):
        transport_to_time(still, latents(), time, steps)


def test_perfect_denoiser_keeps_the_given_region_and_regenerates_the_rest():
    ideal = torch.full((2, 3, 4, 6), 7.0).double()

    def velocity(x, time):
        return (x - ideal) / time.clamp(min=1e-9)[:, None, None, None]

    # Without noise the last time, 0, returns what the step before expects: the ideal.
    counted = CountingVelocity(velocity)
    edited = pnp_flow_feature(counted, no_feature, latents(), edit_mask(), ode_times(4), silence(5))
    torch.testing.assert_close(edited, ideal)
    assert counted.nfe == 5


def test_steps_by_hand():
    times, noise = torch.tensor([1.0, 0.25, 0.0]).double(), silence(3)
    noise[1] = 8.0

    def feature(x, time):
        return torch.ones_like(x)

    edited = pnp_flow_feature(still, feature, latents(), edit_mask(), times, noise, exponent=0.5)
    # t = 1: everything becomes noise, 0. t = 0.25, step 0.5: minus half a feature term, then half
    # way to the latents where they are kept, then 3/4 of it plus a quarter of the noise.
    anew = 0.75 * -0.5 + 2
    kept = 0.75 * (-0.5 + 0.5 * (latents() + 0.5)) + 2
    torch.testing.assert_close(edited, torch.where(edit_mask(), anew, kept))


def test_feature_term_sees_the_estimate_and_its_time():
    seen = []

    def feature(x, time):
        seen.append((time.tolist(), x.clone()))
        return torch.zeros_like(x)

    pnp_flow_feature(still, feature, latents(), edit_mask(), ode_times(2), silence(3))
    assert [time for time, _ in seen] == [[1.0, 1.0], [0.5, 0.5], [0.0, 0.0]]
    assert seen[0][1].abs().max() == 0


def test_edit_that_cannot_run_is_refused():
    with pytest.raises(ValueError, match=r"\(2, 1, 4, 6\), got torch.bool of shape \(2, 3, 4, 6\)"):
        pnp_flow_feature(
            still, no_feature, latents(), edit_mask().expand(2, 3, 4, 6), ode_times(2), silence(3)
        )
    with pytest.raises(ValueError, match=r"got torch.float32"):
        pnp_flow_feature(
            still, no_feature, latents(), edit_mask().float(), ode_times(2), silence(3)
        )
    with pytest.raises(ValueError, match="3 times, 2 draws"):
        pnp_flow_feature(still, no_feature, latents(), edit_mask(), ode_times(2), silence(2))
