"""Solvers, guidance and editing against ``samplers.npz``, with the network of another case."""

from __future__ import annotations

import pytest
import torch
from recorded_networks import build_sit

from r3dpa.editing.latents import invert
from r3dpa.flow import (
    FeatureGuidance,
    FeatureTarget,
    Interpolant,
    euler,
    euler_maruyama,
    heun,
    ode_times,
    sde_times,
)
from r3dpa.flow.times import batch_time, per_sample


@pytest.fixture(scope="module")
def case(load_case):
    return load_case("samplers")


@pytest.fixture(scope="module")
def sit(case, load_case):
    return build_sit(load_case(case.config["weights_from"].removesuffix(".npz")))


def velocity_of(case, sit):
    """The network in float32 whatever the state, as the official samplers call it."""
    return lambda x, t: sit.velocity(x.float(), t.float(), case["in/y"][: len(x)])


def guidance_of(case, sit, count=None, mask="in/token_mask", config=None):
    """Feature guidance of the first ``count`` samples."""
    return FeatureGuidance(
        velocity_of(case, sit),
        lambda x, t: sit.aligned_pass(x.float(), t.float(), case["in/y"][: len(x)]),
        FeatureTarget(case["in/zs"][:count], case[mask]),
        scale=(config or case.config)["v_feat_scale"],
        legacy=True,
    )


def logs(guidance, prefix):
    return {
        f"{prefix}_corr": torch.stack([record.cosine.mean() for record in guidance.history]),
        f"{prefix}_align": torch.stack([record.energy.sum() for record in guidance.history]),
    }


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
    guidance, later = guidance_of(case, sit), case.config["start_time_extra"]
    result = euler(guidance, start, ode_times(steps))
    shorter = euler(guidance_of(case, sit), start, ode_times(steps, start=later))
    outputs = {"out/euler_cond_feats": result, f"out/euler_cond_feats_start{later}": shorter}
    return outputs | logs(guidance, "out/euler_cond_feats")


def guided_heun(case, sit):
    start, guidance = case["in/latents"].double(), guidance_of(case, sit)
    times = ode_times(case.config["num_steps"])
    result = heun(guidance, start, times, corrector_velocity=guidance.corrector_velocity)
    return {"out/heun_cond_feats": result} | logs(guidance, "out/heun_cond_feats")


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
    first = dict(zip(("diff", "feat"), drifts[0], strict=True))
    outputs = {f"out/em_cond_first_dir_{name}": value for name, value in first.items()}
    outputs["out/euler_maruyama_cond_feats"] = result
    return outputs | logs(guidance, "out/em_cond_feats")


def transport(case, sit):
    time, steps = case.config["transport"]["target_time"], case.config["transport"]["num_steps"]
    times = ode_times(steps, start=time, stop=0.0)
    way = invert(velocity_of(case, sit), case["in/latents"], times, "euler")
    return {f"out/transport_{time}": way.states[0]}


def inpainting(case, sit):
    """Plug-and-play with the flow as denoiser (PnP-Flow, alg. 3), which no command offers."""
    config, latents = case.config["pnp"], case["in/pnp_x"]
    assert config["features"] == f"zs[:{len(latents)}]"
    guidance = guidance_of(case, sit, len(latents), "in/pnp_token_mask", config)
    x = torch.zeros_like(latents)
    times = ode_times(config["num_steps"]).tolist()
    for now, noise in zip(times, case["in/pnp_noises"], strict=True):
        time, step = batch_time(now, x), now ** config["alpha"]
        x = x - step * guidance.term(x, time).to(x.dtype)
        x = torch.where(case["in/pnp_latent_mask"], x, x - step * (x - latents))
        noisy = Interpolant().interpolate(x, noise.to(x), time)
        x = Interpolant().denoise(guidance.velocity(noisy, time), noisy, time).to(x.dtype)
    return {"out/pnp_flow_feature": x}


def scores(case, sit):
    """Scores as the drift of the SDE implies them: ``v - t score``."""
    velocity, x, time = case["in/score_v"], case["in/score_x"], case["in/score_t"]
    results = {}
    for path in ("linear", "cosine"):
        drift = Interpolant(path).sde_drift(velocity, x, time)
        results[f"out/score_{path}"] = (velocity - drift) / per_sample(time, x)
    return results


GROUPS = [time_grids, unguided, guided_euler, guided_heun, guided_sde]
GROUPS += [transport, inpainting, scores]


def test_samplers_outputs(case, sit, compare):
    results = {key: value for group in GROUPS for key, value in group(case, sit).items()}
    exact = {"atol": 1e-10, "rtol": 1e-10}
    compare(case, results, tolerance=lambda key, _: exact if key.startswith("out/score_") else {})
    for key, value in results.items():
        assert value.dtype == case[key].dtype or key.endswith(("_corr", "_align"))
