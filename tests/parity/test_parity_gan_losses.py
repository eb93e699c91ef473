"""Discriminator and the losses of the VAE stage against ``gan_losses.npz``."""

from __future__ import annotations

import math

import pytest
import torch

from r3dpa.losses import discriminator_loss, generator_loss, reconstruction_loss
from r3dpa.nn.discriminator import PatchDiscriminator
from r3dpa.nn.vae import Posterior


@pytest.fixture(scope="module")
def case(load_case):
    return load_case("gan_losses")


def fresh_discriminator(case, mode):
    config = case.config["discriminator"]
    network = PatchDiscriminator(config["input_nc"], config["ndf"], config["n_layers"])
    network.load_state_dict(case.weights("w/discriminator."))
    return network.train(mode == "train")


def statistics(case, network, prefix):
    """Those buffers of the network that were recorded under ``prefix``."""
    buffers = dict(network.named_buffers())
    return {key: buffers[key.removeprefix(prefix)] for key in case.keys(prefix)}


def logits(case):
    outputs = {}
    with torch.no_grad():
        evaluated = fresh_discriminator(case, "eval")
        for kind in ("real", "fake"):
            outputs[f"out/logits_eval_{kind}"] = evaluated(case[f"in/{kind}"])
        trained = fresh_discriminator(case, "train")
        outputs["out/logits_train_real"] = trained(case["in/real"])
    return outputs | statistics(case, trained, "out/after_train_forward/")


def started_factor(case):
    """Factor of both adversarial losses: 0 before the discriminator's first step."""
    weights = case.config["loss_config"]["losses"]
    started = case.config["global_step"] >= weights["discriminator_start"]
    return weights["discriminator_factor"] if started else 0.0


def generator_terms(case, network, fake):
    weights = case.config["loss_config"]["losses"]
    error = reconstruction_loss(fake, case["in/real"], weights["reconstruction_loss"])
    posterior = Posterior(case["in/posterior_parameters"])
    adversarial = generator_loss(network(fake))
    factor, d_weight = started_factor(case), weights["discriminator_weight"]
    return {
        "reconstruction_loss": weights["reconstruction_weight"]
        * error
        / math.exp(weights["logvar_init"]),
        "kl_loss": float(weights["kl_weight"]) * posterior.kl().mean(),
        "gan_loss": adversarial,
        "weighted_gan_loss": d_weight * factor * adversarial,
        "discriminator_factor": factor,
        "d_weight": d_weight,
        "perceptual_loss": 0.0,  # the official configuration turns it off: not computed here
    }


def training_step(case, mode):
    """Generator, then discriminator loss on one copy, as one step of the official loop."""
    network = fresh_discriminator(case, mode)
    fake = case["in/fake"].requires_grad_()
    terms = generator_terms(case, network, fake)
    total = terms["reconstruction_loss"] + terms["kl_loss"] + terms["weighted_gan_loss"]
    (grad_fake,) = torch.autograd.grad(total, fake)
    terms |= {"loss": total, "total_loss": total, "grad_fake": grad_fake}
    outputs = {f"out/{mode}/generator/{name}": value for name, value in terms.items()}

    real_logits, fake_logits = network(case["in/real"]), network(case["in/fake"])
    loss = started_factor(case) * discriminator_loss(real_logits, fake_logits)
    loss.backward()
    terms = {
        "loss": loss,
        "discriminator_loss": loss,
        "logits_real": real_logits.mean(),
        "logits_fake": fake_logits.mean(),
        "lecam_loss": 0.0,  # turned off likewise
    }
    prefix = f"out/{mode}/discriminator/"
    outputs |= {prefix + name: value for name, value in terms.items()}
    for key in case.keys(prefix + "grad/"):
        outputs[key] = network.get_parameter(key.removeprefix(prefix + "grad/")).grad
    return outputs | statistics(case, network, f"out/{mode}/discriminator_bn_after_gen_and_disc/")


def before_start(case):
    """Before its first step the discriminator neither judges nor learns: both factors are 0."""
    network = fresh_discriminator(case, "train")
    terms = generator_terms(case, network, case["in/fake"])
    hinge = discriminator_loss(network(case["in/real"]), network(case["in/fake"]))
    return {
        "out/before_start/generator_loss": terms["reconstruction_loss"] + terms["kl_loss"],
        "out/before_start/discriminator_loss": 0.0 * hinge,
    }


def test_gan_losses_outputs(case, compare):
    """Gradients and weighted terms lie below 1e-5: the tolerance follows their size."""
    results = logits(case) | before_start(case)
    results |= training_step(case, "train") | training_step(case, "eval")

    def tolerance(_, expected):
        return {"atol": min(1e-5, 1e-4 * float(expected.abs().max()) + 1e-12)}

    compare(case, results, tolerance=tolerance)
