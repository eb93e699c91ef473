"""LiDM against recorded numbers: first stage, U-Net, diffusion, and the released layout."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
import torch
from lidm_discriminators import LiDARDiscriminator
from recorded_networks import count, scaled, under, weights_of, with_outputs

from r3dpa.baselines.diffusion_paths import StepPath, inpaint
from r3dpa.baselines.lidm import LiDM, ReleasedDDIM, released_times
from r3dpa.baselines.lidm_first_stage import LiDMFirstStage
from r3dpa.baselines.lidm_networks import LiDMUNet, VQAutoencoder
from r3dpa.baselines.lidm_reader import from_lidm
from r3dpa.checkpoints import read_checkpoint
from r3dpa.cli import main
from r3dpa.flow.sde import ancestral, ancestral_step
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection
from r3dpa.losses import generator_loss
from r3dpa.nn import PatchDiscriminator
from r3dpa.nn.velocity_network import time_frequencies
from r3dpa.stages import scene_generator

CALLBACK_MODULE = "pytorch_lightning.callbacks.model_checkpoint"
# Factors that cases.json does not list, of the released configuration.
ADVERSARIAL, START, DEPTH_SCALE = 0.6, 1, 5.84


# --- U-Net and diffusion ---


@pytest.fixture(scope="module")
def unet_case(baseline_case):
    return baseline_case("lidm_unet")


@pytest.fixture(scope="module")
def lidm(unet_case):
    config = unet_case.config
    reductions = [2**level for level in range(len(config["channel_mult"]))]
    unet = LiDMUNet(
        input_size=tuple(config["image_size"]),
        in_channels=config["in_channels"],
        channels=config["model_channels"],
        channel_multipliers=config["channel_mult"],
        num_res_blocks=config["num_res_blocks"],
        head_channels=config["num_head_channels"],
        attention_resolutions=[r for r in reductions if r in config["attention_resolutions"]],
    )
    unet.load_state_dict(unet_case.weights())
    sizes = {"latent_channels": config["in_channels"], "channels": 32, "num_codes": 4}
    betas = {"first_beta": config["linear_start"], "last_beta": config["linear_end"]}
    return LiDM(unet, VQAutoencoder(**sizes), **betas)


def of_network(case, lidm) -> dict:
    unet, x, time = lidm.network, case["in/x"], case["in/t"]
    names = [key.removeprefix("out/act/") for key in case.keys("out/act/")]
    modules = {f"act/{name}": unet.get_submodule(name) for name in names}
    with torch.no_grad():
        y, seen = with_outputs(modules, lambda: unet(x, time))
        stride = 2 ** (len(case.config["channel_mult"]) - 1)
        turned = [
            (unet(x.roll(by, -1), time).roll(-by, -1) - y).abs().max().item() for by in (1, stride)
        ]
    # By the total stride the network commutes to rounding; by 1 it does not, by as much.
    assert turned[1] < 2e-5
    return seen | {
        "y": y,
        "t_emb": time_frequencies(time.float(), unet.channels),
        "roll_max_err": torch.tensor([turned[0], case["out/roll_max_err"][1].item()]),
        "n_parameters": count(unet),
    }


def of_losses(case, lidm) -> dict:
    unet, path = lidm.network, lidm.interpolant
    data, noise, step = case["in/x_0"], case["in/noise"], case["in/loss_t"]
    time = (step + 0.5) / path.num_steps  # a step begins at its time
    results = {"q_sample": path.interpolate(data, noise, step / path.num_steps)}
    for norm in ("l2", "l1"):
        lidm.norm = norm
        errors = lidm.errors(unet, data, time, noise)
        loss = errors.mean()
        results[f"loss_{norm}"] = results[f"loss_{norm}_simple"] = loss
        results[f"loss_{norm}_vlb"] = (bound_weights(path)[step] * errors).mean()
        if norm == "l2":
            unet.zero_grad()
            loss.backward()
    lidm.norm = "l2"
    for key in case.keys("out/grad/"):
        name = key.removeprefix("out/grad/")
        results[f"grad/{name}"] = unet.get_parameter(name).grad
    norms = [p.grad.norm() for p in unet.parameters() if p.grad is not None]
    return results | {"grad_norm": torch.stack(norms).norm()}


def bound_weights(path):
    """Weights of the squared errors in the bound of the likelihood, logged by the official code."""
    before = torch.cat([torch.ones(1).double(), path.signal[:-1]])
    posterior = path.betas * (1 - before) / (1 - path.signal)
    weights = path.betas.square() / (2 * posterior * (1 - path.betas) * (1 - path.signal))
    weights[0] = weights[1]
    return weights


def of_schedule(case, lidm) -> dict:
    """The posterior is what our ancestral step makes of a unit of data, state or noise."""
    path, index = lidm.interpolant, case["out/schedule_index"]
    one, none = torch.ones(len(index), 1, dtype=torch.float64), torch.zeros(len(index), 1).double()
    here, there = index.double() / path.num_steps, (index.double() - 1) / path.num_steps
    first = (index == 0)[:, None]

    def posterior(data, x, draw):
        stepped = ancestral_step(data, x, here, there.clamp(min=0), draw, interpolant=path)
        return torch.where(first, data, stepped)[:, 0]  # before step 0 there is the data alone

    variance = posterior(none, none, one).square()
    signal = path.signal
    before = torch.cat([torch.ones(1).double(), signal[:-1]])
    return {
        "schedule_index": index,
        "schedule/betas": path.betas[index],
        "schedule/alphas_cumprod": signal[index],
        "schedule/alphas_cumprod_prev": before[index],
        "schedule/posterior_variance": variance,
        "schedule/posterior_log_variance_clipped": variance.clamp(min=1e-20).log(),
        "schedule/posterior_mean_coef1": posterior(one, none, none),
        "schedule/posterior_mean_coef2": posterior(none, one, none),
        "schedule/lvlb_weights": bound_weights(path)[index],
        "schedule/sqrt_recipm1_alphas_cumprod": (1 / signal[index] - 1).sqrt(),
    }


def of_samplers(case, lidm) -> dict:
    path, unet = lidm.interpolant, lidm.network

    def velocity(x, time):
        with torch.no_grad():
            return lidm.velocity(unet, x, time)

    x, step = case["in/step_x"], case["in/t"]
    here = step / path.num_steps
    data = path.denoise(velocity(x, here), x, here)
    results = {}
    for name, clean in (("p_sample", data), ("p_sample_clipped", data.clamp(-1, 1))):
        there = ((step - 1) / path.num_steps).clamp(min=0)
        draw = case["in/step_noise"]
        stepped = ancestral_step(clean, x, here, there, draw, interpolant=path)
        results[name] = torch.where((step == 0)[:, None, None, None], clean, stepped)
    for key in case.keys("out/ddim_timesteps_"):
        name = key.removeprefix("out/ddim_timesteps_")
        num, eta = int(name[1 : name.index("_")]), float(name[name.index("eta") + 3 :])
        times = released_times(num)
        steps = (times * path.num_steps).round().long()
        a_t, a_s = path.signal[steps[:-1]], path.signal[steps[1:]]
        sigma = eta * ((1 - a_s) / (1 - a_t) * (1 - a_t / a_s)).sqrt()
        results[f"ddim_timesteps_{name}"] = steps[:-1].flip(0)
        results[f"ddim_alphas_{name}"] = a_t.flip(0)
        results[f"ddim_alphas_prev_{name}"] = a_s.flip(0)
        results[f"ddim_sigmas_{name}"] = sigma.flip(0)
        draws = iter(case[f"in/ddim_draws_{name}"]) if eta else ()
        found = [case["in/ddim_x_T"]]
        options = {"eta": eta, "interpolant": path}
        for index in range(num):
            found.append(ancestral(velocity, found[-1], times[index : index + 2], draws, **options))
        results[f"ddim_{name}"] = found[-1]
        if f"out/ddim_states_{name}" in case:
            results[f"ddim_states_{name}"] = torch.stack(found)
    results["ddim_masked"] = inpaint(
        velocity,
        case["in/ddim_x_T"],
        case["in/ddim_mask_x0"],
        case["in/ddim_mask"],
        released_times(len(case["in/ddim_masked_q_noises"])),
        iter(case["in/ddim_masked_q_noises"]),
        path,
    )
    return results


def of_average(case, lidm) -> dict:
    average, weight = case["in/ema_before"], case["in/ema_model"]
    results = {"ema_num_updates": 2}
    for step in range(2):
        average = torch.lerp(average, weight, 1 - lidm.ema.decay(step))
        results[f"ema_after_{step + 1}"] = average
    return results


def test_unet(unet_case, lidm, compare):
    results = {}
    for part in (of_network, of_losses, of_schedule, of_samplers, of_average):
        results |= part(unet_case, lidm)
    compare(
        unet_case,
        under("out/", results),
        tolerance=scaled(2e-5),
    )


@pytest.mark.parametrize(("asked", "taken"), [(4, 4), (16, 17), (64, 67), (128, 143), (250, 250)])
def test_steps_of_ddim(asked, taken):
    assert len(released_times(asked)) == taken + 1
    assert (released_times(asked) * 1000).round()[-2:].tolist() == [1, 0]


@pytest.mark.parametrize("asked", [3, 256])
def test_steps_that_crash_officially_are_refused(asked):
    with pytest.raises(ValueError, match=f"cannot take {asked} of 1000 steps.*give a divisor"):
        released_times(asked)


# --- first stage ---


@pytest.fixture(scope="module")
def stage_case(baseline_case):
    return baseline_case("lidm_first_stage")


def autoencoder_of(config) -> VQAutoencoder:
    given = config["ddconfig"]
    return VQAutoencoder(
        num_codes=config["n_embed"],
        mask=config["use_mask"],
        channels=given["ch"],
        in_channels=given["in_channels"],
        latent_channels=config["embed_dim"],
        z_channels=given["z_channels"],
        channel_multipliers=tuple(given["ch_mult"]),
        strides=tuple(map(tuple, given["strides"])),
        num_res_blocks=given["num_res_blocks"],
        attention_levels=tuple(given["attn_levels"]),
    )


def stage_of(case, variant) -> LiDMFirstStage:
    options = case.config["loss_variants"][variant]
    weights = case.weights(f"w_{variant}/discriminator.")
    sizes = {
        "in_channels": options["disc_in_channels"],
        "channels": len(weights["main.0.weight"]),
        "num_layers": options["disc_num_layers"],
    }
    if options["disc_version"] == "v0":
        discriminator = PatchDiscriminator(**sizes)
    else:
        discriminator = LiDARDiscriminator(**sizes, wide=options["disc_version"] == "v2")
    discriminator.load_state_dict(weights)
    network = autoencoder_of(case.config)
    network.load_state_dict(case.weights())
    stage = LiDMFirstStage(
        network,
        discriminator,
        mask_factor=options["mask_factor"],
        geometry_factor=options["geo_factor"],
        adversarial=ADVERSARIAL,
        adversarial_start=START,
        curve_length=options["curve_length"],
    )
    stage.geometry = geometry_of(case.config)
    return stage


def geometry_of(config) -> ScanGeometry:
    sensor = LidarSensor(*config["size"], *config["fov"])
    codec = RangeCodec("log2", DEPTH_SCALE, legacy_inverse=True)
    return ScanGeometry(SphericalProjection(sensor), codec, (2, 4))


def of_variant(case, variant) -> dict:
    image, returns = case["in/x"], case["in/mask"]
    results = {}
    for step in range(3):
        stage = stage_of(case, variant)
        network = stage.network
        quantised = network.quantize(network.encode(image).mean)
        prediction = network.predict(quantised.latents)
        parts = stage.reconstruction(image, prediction, returns)
        error = torch.stack(list(parts.values())).sum()
        weight, loss = stage.adversarial_loss(prediction, error)
        factor = float(stage.is_adversarial(step))
        total = error + weight * factor * loss + quantised.loss
        total.backward()
        found = {
            f"gen_{name}_rec_loss": parts.get(ours, torch.zeros(())) * len(parts)
            for name, ours in (("pix", "reconstruction"), ("geo", "geometry"), ("mask", "mask"))
        }
        found |= {
            "gen_total_loss": total,
            "gen_quant_loss": quantised.loss,
            "gen_rec_loss": error,
            "gen_d_weight": weight,
            "gen_disc_factor": factor,
            "gen_g_loss": loss,
        }
        for key in case.keys(f"out/{variant}/step{step}/grad/"):
            name = key.rpartition("/")[2]
            found[f"grad/{name}"] = network.get_parameter(name).grad
        assert all(p.grad is None for p in stage.discriminator.parameters())
        penalty = factor * stage.discriminator_loss(image, prediction, returns)
        penalty.backward()
        if step == 0:  # its recorder did not clear what the generator's backward pass left here
            (weight * factor * generator_loss(stage.logits(prediction.detach()))).backward()
        more = (returns,) if stage.mask_factor else ()
        found |= {
            "disc_disc_loss": penalty,
            "disc_logits_real": stage.logits(image, *more).mean(),
            "disc_logits_fake": stage.logits(prediction).mean(),
            "disc_grad_first": stage.discriminator.main[0].weight.grad,
        }
        results |= {f"{variant}/step{step}/{name}": value for name, value in found.items()}
    return results | {
        f"{variant}/rec_scale": len(parts),
        f"{variant}/coord_of_input": stage.coordinates(image),
    }


def test_first_stage(stage_case, compare):
    case = stage_case
    network = autoencoder_of(case.config)
    network.load_state_dict(case.weights())
    latents = network.encode(case["in/x"]).mean
    quantised = network.quantize(latents)
    # The recorded margins are of the codes: how far the second-best code is.
    codes, pixels = network.quantize.embedding.weight.double(), {}
    for name, values in (("index_margin", latents), ("z_index_margin", case["in/z"])):
        distance = torch.cdist(values.double().movedim(1, -1).flatten(0, 2), codes)
        best, second = distance.topk(2, largest=False).values.unbind(1)
        pixels[name] = (second - best).min()
    results = pixels | {
        "prequant": latents,
        "quant": quantised.latents,
        "quant_loss": quantised.loss,
        "indices": quantised.indices.flatten(),
        "rec": network.predict(quantised.latents),
        "interface_decode": network.decode(case["in/z"]),
        "interface_decode_no_quantize": network.image_of(network.predict(case["in/z"])),
        "n_parameters": count(network),
    }
    for variant in case.config["loss_variants"]:
        results |= of_variant(case, variant)
    stage = stage_of(case, "released")
    for length in (1, 4):
        stage.curve_length = length
        results[f"geo_curve{length}"] = stage.coordinates(case["in/x"])
    results["geo_bev"] = results["geo_curve1"][:, :2]

    def tolerance(key, expected):
        of_weight = key.endswith(("d_weight", "total_loss")) or "/grad/" in key
        return scaled(1e-4 if of_weight else 1e-5)(key, expected)

    compare(case, under("out/", results), tolerance=tolerance)


def test_geometry_as_meant_reads_empty_pixels_as_the_least_range(stage_case):
    stage, empty = stage_of(stage_case, "geometry"), torch.full((1, 1, 16, 64), -1.0)
    nearest = stage.coordinates(empty).norm(dim=1)
    assert nearest.mean().item() == pytest.approx(2 ** (DEPTH_SCALE / 2 * 1) - 1, rel=1e-4)
    stage.released_geometry = False
    assert stage.coordinates(empty).norm(dim=1).mean().item() == pytest.approx(1.0, rel=1e-4)


def test_the_codebook_as_meant_swaps_the_weights(stage_case):
    network = autoencoder_of(stage_case.config)
    network.load_state_dict(stage_case.weights())
    codebook, latents = network.quantize, stage_case["out/prequant"]
    released = codebook(latents).loss
    codes = torch.autograd.grad(released, codebook.embedding.weight)[0]
    codebook.legacy = False
    meant = codebook(latents).loss
    torch.testing.assert_close(meant, released)
    assert torch.allclose(torch.autograd.grad(meant, codebook.embedding.weight)[0], 4 * codes)


# --- released files ---


def released(listing) -> dict:
    """Content of a Lightning 1.4 file with the listed keys, and those of its average."""
    shapes = dict(listing["state_dict"])
    parameters = [key for key in shapes if key.startswith("model.diffusion_model.")]
    for key in parameters:
        name = key.removeprefix("model.").replace(".", "")
        shapes[f"model_ema.{name}"] = shapes[key]
    shapes |= {"model_ema.decay": [], "model_ema.num_updates": []}
    assert listing["groups"]["model"] == len(parameters)
    assert listing["groups"]["model_ema"] == sum(key.startswith("model_ema.") for key in shapes)
    return {"pytorch-lightning_version": "1.4.2", "state_dict": weights_of(shapes)}


def test_released_layout_is_read_strictly(baseline_listing, tmp_path):
    listing = baseline_listing("lidm_uncond_state_dict")
    content = released(listing)
    checkpoint = from_lidm(content, tmp_path / "model.ckpt")
    sizes = {
        name: sum(v.numel() for v in state.state_dict.values())
        for name, state in checkpoint.networks.items()
    }
    unet, first = listing["param_count_unet"], listing["param_count_first_stage"]
    assert sizes == {"network": unet, "ema_network": unet, "first_stage": first}
    arguments = checkpoint.network("network").init_args
    params = listing["config"]["params"]["unet_config"]["params"]
    assert arguments["input_size"] == params["image_size"]
    assert arguments["head_channels"] == params["num_head_channels"]
    assert arguments["channel_multipliers"] == params["channel_mult"]
    given = listing["config"]["params"]["first_stage_config"]["params"]
    assert checkpoint.network("first_stage").init_args["num_codes"] == given["n_embed"]
    weights = content["state_dict"]
    key = "input_blocks.4.0.emb_layers.1.weight"
    flat = f"model_ema.diffusion_model{key.replace('.', '')}"
    assert checkpoint.network("ema_network").state_dict[key] is weights[flat]
    for name, message in (
        ("model.diffusion_model.out.2.bias", "missing in the checkpoint: out.2.bias"),
        ("first_stage_model.quant_conv.bias", "missing in the checkpoint: quant_conv.bias"),
    ):
        fewer = {k: v for k, v in weights.items() if k != name}
        with pytest.raises(ValueError, match=message):
            from_lidm({"state_dict": fewer}, tmp_path / "model.ckpt")
    more = weights | {"cond_stage_model.weight": weights["betas"]}
    with pytest.raises(ValueError, match=r"cond_stage_model\.weight is no weight of LiDM without"):
        from_lidm({"state_dict": more}, tmp_path / "model.ckpt")


class ModelCheckpoint:
    """Stands for the class of Lightning 1.4."""


def test_a_converted_file_makes_scenes(tmp_path, monkeypatch):
    torch.manual_seed(0)
    unet = LiDMUNet(channels=160, channel_multipliers=(1,), num_res_blocks=1)
    first = VQAutoencoder(num_codes=16, channels=32, num_res_blocks=1, channel_multipliers=(1,) * 4)
    state = {f"model.diffusion_model.{k}": v for k, v in unet.state_dict().items()}
    state |= {f"first_stage_model.{k}": v for k, v in first.state_dict().items()}
    for key, value in unet.state_dict().items():
        state[f"model_ema.diffusion_model{key.replace('.', '')}"] = value + 0.01
    state["betas"] = StepPath().betas.float()
    monkeypatch.setattr(ModelCheckpoint, "__module__", CALLBACK_MODULE)
    holder = SimpleNamespace(ModelCheckpoint=ModelCheckpoint)
    monkeypatch.setitem(sys.modules, CALLBACK_MODULE, holder)
    content = {"pytorch-lightning_version": "1.4.2", "state_dict": state, "global_step": 7}
    torch.save(
        content | {"callbacks": {ModelCheckpoint: {"monitor": None}}}, tmp_path / "model.ckpt"
    )
    main(["convert", str(tmp_path / "model.ckpt"), str(tmp_path / "ours.safetensors")])
    checkpoint = read_checkpoint(tmp_path / "ours.safetensors")
    assert (checkpoint.stage, checkpoint.step) == ("lidm", 7)
    generator = scene_generator(checkpoint, device="cpu")
    assert generator.sampler == ReleasedDDIM("ddpm", 250)
    scenes = generator.with_sampler(ReleasedDDIM("ddim", 2)).generate(1)
    assert (scenes.range_m.shape, scenes.nfe) == ((1, 64, 1024), 2)
    mean = checkpoint.network("ema_network").state_dict["out.0.weight"]
    assert torch.equal(mean, unet.state_dict()["out.0.weight"] + 0.01)
    assert torch.equal(generator.network.get_parameter("out.0.weight"), mean)
