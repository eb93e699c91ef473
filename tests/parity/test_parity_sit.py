"""SiT, latent norm and losses against ``sit.npz``."""

from __future__ import annotations

import pytest
import torch
from recorded_networks import build_norm, build_sit, our_name, training_pass, under

from r3dpa.flow import FeatureGuidance, FeatureTarget, Interpolant
from r3dpa.losses import alignment_loss
from r3dpa.nn.sit import sincos_position_embedding
from r3dpa.nn.velocity_network import time_frequencies


@pytest.fixture(scope="module")
def case(load_case):
    return load_case("sit")


def embeddings(case):
    width, frequencies = case.config["hidden_size"], case["out/t_freq"].shape[1]
    return {
        "out/pos_embed_init": sincos_position_embedding(width, build_sit(case).grid_size),
        "out/t_freq": time_frequencies(case["in/time_input"].flatten(), frequencies),
    }


def evaluation(case):
    latents, outputs = build_norm(case).normalise(case["in/x"]), {}
    for name, path in (("eval", case.config["path_type"]), ("eval_cosine", "cosine")):
        found = training_pass(case, build_sit(case), latents, Interpolant(path))
        outputs |= under(f"out/{name}/", found)
    return outputs


def training(case):
    sit, norm = build_sit(case), build_norm(case)
    latents = norm.update(case["in/x"])
    outputs = training_pass(case, sit, latents, Interpolant(case.config["path_type"]))
    loss = outputs["denoising_loss"].mean()
    loss = loss + case.config["proj_coeff"] * outputs["proj_loss"].mean()
    loss.backward()
    gradients = [p.grad for p in sit.parameters() if p.grad is not None]
    outputs |= {f"bn.{key}": value for key, value in norm.state_dict().items()}
    outputs |= {"loss": loss, "grad_total_norm": torch.cat([g.flatten() for g in gradients]).norm()}
    for name in case.weights("out/train/grad/"):
        outputs[f"grad/{name}"] = sit.get_parameter(our_name(name)).grad
    return under("out/train/", outputs)


def alignment_only(case):
    (gradient_key,) = case.keys("out/eval_align_only/grad_x_of_")
    coefficient = float(gradient_key.split("_of_")[1].split("_")[0])
    raw, time = case["in/x"].requires_grad_(), case["in/time_input"].flatten()
    latents = build_norm(case).normalise(raw)
    noisy = Interpolant(case.config["path_type"]).interpolate(latents, case["in/noises"], time)
    features = build_sit(case).project_features(noisy, time, case["in/y"])
    loss = alignment_loss(features, case["in/zs"])
    (coefficient * loss.mean()).backward()
    outputs = under("out/eval_align_only/", {"zs_tilde": features, "proj_loss": loss})
    return outputs | {gradient_key: raw.grad}


def broken_latent(case):
    raw = case["in/x"]
    raw[1, 2, 1, 3] = torch.nan
    latents = build_norm(case, replace_non_finite=True).normalise(raw)
    outputs = training_pass(case, build_sit(case), latents, Interpolant(case.config["path_type"]))
    return {"out/eval_nan_latent/denoising_loss": outputs["denoising_loss"]}


def inference(case):
    sit, norm = build_sit(case), build_norm(case, legacy_inverse=True)
    x, time, labels = case["in/inference_x"], case["in/inference_t"], case["in/y"]
    unit = torch.ones(1, case.config["in_channels"], 1, 1)
    shift = norm.denormalise(0 * unit)
    return {
        "out/inference/v": sit.velocity(x, time, labels),
        "out/forward_feats": sit.project_features(x, time, labels),
        "out/latents_scale": (1 / (norm.denormalise(unit) - shift)).flatten(),
        "out/latents_bias": shift.flatten(),
    }


def feature_guidance(case):
    sit, outputs = build_sit(case), {}
    x, time, labels = case["in/inference_x"], case["in/inference_t"], case["in/y"]
    for name, mask in (("nomask", None), ("mask", case["in/token_mask"])):
        guidance = FeatureGuidance(
            lambda x, t: sit.velocity(x, t, labels),
            lambda x, t: sit.aligned_pass(x, t, labels),
            FeatureTarget(case["in/zs"], mask),
            scale=case.config["v_feat_scale"],
            legacy=True,
        )
        guidance(x, time)
        outputs |= {
            f"out/cond_feats_{name}/v": guidance.velocity(x, time),
            f"out/cond_feats_{name}/v_feat": guidance.term(x, time),
            f"out/cond_feats_{name}/proj_loss": guidance.history[0].energy.sum(),
        }
    return outputs


GROUPS = [embeddings, evaluation, training, alignment_only]
GROUPS += [broken_latent, inference, feature_guidance]


def test_sit_outputs(case, compare):
    compare(case, {key: value for group in GROUPS for key, value in group(case).items()})
