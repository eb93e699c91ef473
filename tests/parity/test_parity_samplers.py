"""Solvers, guidance and editing against ``samplers.npz``, with the network of another case."""

from __future__ import annotations

import pytest
import torch
from official_sit import build_sit

from r3dpa.flow import (
    FeatureGuidance,
    FeatureTarget,
    Interpolant,
    euler,
    euler_maruyama,
    heun,
    invert,
    ode_times,
    pnp_flow_feature,
    sde_times,
)


@pytest.fixture(scope="module")
def case(load_case):
    return load_case("samplers")


@pytest.fixture(scope="module")
def sit(case, load_case):
    return build_sit(load_case(case.config["weights_from"].removesuffix(".npz")))


def velocity_of(case, sit):
    """The network in float32 whatever the state, as the official samplers call it."""
    return lambda x, t: sit.velocity(x.float(), t.float(), case["in/y"][: len(x)])


def guidance_of(case, sit):
    return FeatureGuidance(
        velocity_of(case, sit),
        lambda x, t: sit.aligned_pass(x.float(), t.float(), case["in/y"][: len(x)]),
        [FeatureTarget(case["in/zs"], case["in/token_mask"])],
        scale=case.config["v_feat_scale"],
        legacy=True,
    )


def logs(guidance):
    corr = torch.stack([record.cosine.mean() for record in guidance.history])
    align = torch.stack([record.energy.sum() for record in guidance.history])
    return corr, align


def time_grids(case, sit):
    steps = case.config["num_steps"]
    return {"out/t_steps_ode": ode_times(steps), "out/t_steps_sde": sde_times(steps)}


def unguided(case, sit):
    velocity, start = velocity_of(case, sit), case["in/latents"].double()
    steps = case.config["num_steps"]
    return {
        "out/euler": euler(velocity, start, ode_times(steps)),
        "out/heun": heun(velocity, start, ode_times(steps)),
        "out/euler_maruyama": euler_maruyama(
            velocity, start, sde_times(steps), case["in/em_noises"], last="mean"
        ),
    }


def guided_euler(case, sit):
    start, steps = case["in/latents"].double(), case.config["num_steps"]
    guidance = guidance_of(case, sit)
    result = euler(guidance, start, ode_times(steps))
    corr, align = logs(guidance)
    later = case.config["start_time_extra"]
    return {
        "out/euler_cond_feats": result,
        "out/euler_cond_feats_corr": corr,
        "out/euler_cond_feats_align": align,
        f"out/euler_cond_feats_start{later}": euler(
            guidance_of(case, sit), start, ode_times(steps, start=later)
        ),
    }


def guided_heun(case, sit):
    start, guidance = case["in/latents"].double(), guidance_of(case, sit)
    result = heun(
        guidance,
        start,
        ode_times(case.config["num_steps"]),
        corrector_velocity=guidance.corrector_velocity,
    )
    corr, align = logs(guidance)
    return {
        "out/heun_cond_feats": result,
        "out/heun_cond_feats_corr": corr,
        "out/heun_cond_feats_align": align,
    }


def guided_sde(case, sit):
    start, guidance, drifts = case["in/latents"].double(), guidance_of(case, sit), []

    def change_drift(drift, x, time):
        drifts.append((drift, guidance.term(x, time)))
        return guidance.change_drift(drift, x, time)

    result = euler_maruyama(
        guidance.sde_velocity,
        start,
        sde_times(case.config["num_steps"]),
        case["in/em_cond_noises"],
        last="mean",
        change_drift=change_drift,
    )
    corr, align = logs(guidance)
    return {
        "out/euler_maruyama_cond_feats": result,
        "out/em_cond_feats_corr": corr,
        "out/em_cond_feats_align": align,
        "out/em_cond_first_dir_diff": drifts[0][0],
        "out/em_cond_first_dir_feat": drifts[0][1],
    }


def transport(case, sit):
    time, steps = case.config["transport"]["target_time"], case.config["transport"]["num_steps"]
    times = ode_times(steps, start=time, stop=0.0)
    way = invert(velocity_of(case, sit), case["in/latents"], times, "euler")
    return {f"out/transport_{time}": way.states[0]}


def inpainting(case, sit):
    config, latents = case.config["pnp"], case["in/pnp_x"]
    assert config["features"] == f"zs[:{len(latents)}]"
    guidance = FeatureGuidance(
        velocity_of(case, sit),
        lambda x, t: sit.aligned_pass(x, t, case["in/y"][: len(x)]),
        [FeatureTarget(case["in/zs"][: len(latents)], case["in/pnp_token_mask"])],
        scale=config["v_feat_scale"],
        legacy=True,
    )
    edited = pnp_flow_feature(
        guidance.velocity,
        guidance.term,
        latents,
        case["in/pnp_latent_mask"],
        ode_times(config["num_steps"]),
        case["in/pnp_noises"],
        exponent=config["alpha"],
    )
    return {"out/pnp_flow_feature": edited}


def scores(case, sit):
    inputs = case["in/score_v"], case["in/score_x"], case["in/score_t"]
    return {f"out/score_{path}": Interpolant(path).score(*inputs) for path in ("linear", "cosine")}


GROUPS = [
    time_grids,
    unguided,
    guided_euler,
    guided_heun,
    guided_sde,
    transport,
    inpainting,
    scores,
]


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: f"samplers-{group.__name__}")
def test_samplers_outputs(case, sit, close, group):
    tolerance = 1e-10 if group is scores else 1e-5
    for key, value in group(case, sit).items():
        close(value, case[key], atol=tolerance, rtol=tolerance)
        assert value.dtype == case[key].dtype or key.endswith(("_corr", "_align"))


def test_samplers_every_recorded_output_is_compared(case, sit):
    compared = set().union(*(group(case, sit) for group in GROUPS))
    assert compared == set(case.keys("out/"))


def test_samplers_drift_without_division_is_that_of_the_recorded_score(case, close):
    velocity, x, time = case["in/score_v"], case["in/score_x"], case["in/score_t"]
    for path in ("linear", "cosine"):
        divided = velocity - time[:, None, None, None] * case[f"out/score_{path}"]
        drift = Interpolant(path).sde_drift(velocity, x, time)
        close(drift, divided, atol=1e-10, rtol=1e-10)
