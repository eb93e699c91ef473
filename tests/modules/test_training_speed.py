"""What makes training faster changes no number: layouts, fused steps, caches, skipped losses."""

from __future__ import annotations

from dataclasses import asdict
from types import SimpleNamespace

import pytest
import torch
from stage_runs import QUICK, load
from tiny_stages import QUIET, REACH, TinyData, stage_module, train
from torch.utils._python_dispatch import TorchDispatchMode

from lidarsim.weather import WeatherPrior
from r3dpa.checkpoints import read_checkpoint, save_checkpoint
from r3dpa.cli import main
from r3dpa.data import Augmentation, LidarDataModule
from r3dpa.modules import LossWeights, flow_matching
from r3dpa.nn import Posterior

pytestmark = QUIET
CHANNELS_LAST = {"memory_format": torch.channels_last}


def passes_through(network):
    """Grows by one with each pass through a network."""
    calls = []
    network.register_forward_hook(lambda *_: calls.append(1))
    return calls


class TestCachedLatents:
    @pytest.mark.parametrize("rotate", [pytest.param(False, marks=pytest.mark.slow), True])
    def test_steps_with_cached_latents_are_those_with_the_encoder(
        self, rotate, smoke_args, vae_checkpoint, tmp_path, monkeypatch
    ):
        """Three steps with the same draws, without rotation to the last bit but for batching.

        The convolutions of the encoder may sum in another order where scans come in other batches
        or rotated: 1e-6 of a latent, which AdamW (eps 1e-3) keeps as small.
        """
        more = [*QUICK, "--model.init_args.init_from", str(vae_checkpoint)]
        more += ["--model.init_args.optimizer", "{lr: 1.0e-2, eps: 1.0e-3}"]
        more += [f"--data.init_args.augmentation.rotate={str(rotate).lower()}"]
        read = []
        monkeypatch.setattr(
            flow_matching, "Posterior", lambda moments: read.append(moments) or Posterior(moments)
        )
        for cached in ("true", "false"):
            words = [*more, "--model.init_args.cache_latents", cached]
            main(smoke_args("flow_matching", tmp_path / cached, *words))
        assert len(read) == 3  # the steps of the first run
        assert list((tmp_path / "true" / "latents").glob("posterior_*/shard_00000.rows"))
        assert not (tmp_path / "false" / "latents").exists()
        found = read_checkpoint(tmp_path / "true/checkpoints/last.ckpt")
        assert found.augmentation == asdict(Augmentation(rotate=rotate))
        ours = save_checkpoint(found, tmp_path / "ours.safetensors")
        assert read_checkpoint(ours).augmentation == found.augmentation
        cached, plain = (load(tmp_path / name)["state_dict"] for name in ("true", "false"))
        torch.testing.assert_close(cached, plain, atol=2e-5, rtol=1e-4)
        before = torch.load(vae_checkpoint, weights_only=True)["state_dict"]
        blocks = [key for key in plain if key.startswith("sit.blocks")]
        assert max((before[key] - plain[key]).abs().max() for key in blocks) > 1e-3

    @pytest.mark.slow
    def test_cached_latents_are_not_rounded_in_mixed_precision(
        self, smoke_args, vae_checkpoint, tmp_path
    ):
        """Bit for bit those of float32, in a folder of the same name."""
        more = ["--trainer.max_steps=1", "--model.init_args.init_from", str(vae_checkpoint)]
        more += ["--model.init_args.cache_latents=true", "--trainer.precision"]
        rows = []
        for name in ("32-true", "bf16-mixed"):
            main(smoke_args("flow_matching", tmp_path / name, *more, name))
            (path,) = (tmp_path / name).glob("latents/posterior_*/shard_00000.rows")
            rows.append((path.parent.name, path.read_bytes()))
        assert rows[0] == rows[1]

    def test_mirrored_scans_are_refused_at_once(self, smoke_args, vae_checkpoint, tmp_path):
        more = [*QUICK, "--model.init_args.init_from", str(vae_checkpoint)]
        more += ["--data.init_args.augmentation.flip=true"]
        with pytest.raises(ValueError, match=r"mirroring.*--model.init_args.cache_latents false"):
            main(smoke_args("flow_matching", tmp_path, *more))

    def test_weather_is_refused_before_scans_are_encoded(
        self, smoke_args, vae_checkpoint, tmp_path, monkeypatch
    ):
        stormy = property(lambda _: WeatherPrior(), lambda *_: None)
        monkeypatch.setattr(LidarDataModule, "weather_prior", stormy)
        more = [*QUICK, "--model.init_args.init_from", str(vae_checkpoint)]
        with pytest.raises(ValueError, match=r"weather.*--model.init_args.cache_latents false"):
            main(smoke_args("flow_matching", tmp_path, *more))
        assert not (tmp_path / "latents").exists()


class TestLayout:
    def test_channels_last_trains_the_same_and_saves_the_usual_layout(self):
        """Two steps; a convolution may sum in another order."""
        plain = train(stage_module("joint"), TinyData([False] * 2))
        other = train(stage_module("joint", channels_last=True), TinyData([False] * 2))
        kernel = other.vae.encoder.down[0].block[0].conv1.weight
        assert kernel.is_contiguous(**CHANNELS_LAST)
        assert not kernel.is_contiguous()
        for one, two in zip(plain.parts, other.parts, strict=True):
            torch.testing.assert_close(two, one, atol=1e-5, rtol=1e-4)
        checkpoint = {"state_dict": other.state_dict()}
        other.on_save_checkpoint(checkpoint)
        saved = checkpoint["state_dict"]
        assert list(saved) == list(plain.state_dict())
        assert all(value.is_contiguous() for value in saved.values())

    @pytest.mark.parametrize("fused", [False, True])
    def test_optimizer_moments_have_the_layout_of_their_weights(self, fused):
        weight = torch.nn.Parameter(torch.randn(4, 3, 2, 2).to(**CHANNELS_LAST))
        optimizer = torch.optim.AdamW([weight])
        weight.grad = torch.randn(4, 3, 2, 2)
        optimizer.step()
        state = optimizer.state[weight]
        state["exp_avg"] = state["exp_avg"].contiguous()
        before = state["exp_avg"].clone()
        module = stage_module("joint")
        module.optimizers = lambda **_: optimizer
        module._trainer = SimpleNamespace(precision="32-true" if fused else "16-mixed")
        module.on_train_start()
        assert state["exp_avg"].stride() == weight.stride()
        assert torch.equal(state["exp_avg"], before)
        assert optimizer.param_groups[0]["fused"] == fused

    def test_compiled_networks_keep_their_names(self, monkeypatch):
        """Compiled but not run; the backend is torch's own business."""
        compiled = []
        monkeypatch.setattr(
            torch.nn.Module, "compile", lambda self, **kwargs: compiled.append(type(self).__name__)
        )
        module = stage_module("joint", compile=True)
        names = list(module.state_dict())
        train(module)
        assert compiled == ["Encoder", "Decoder", "PatchDiscriminator", "SiTBlock", "SiTBlock"]
        assert list(module.state_dict()) == names

    @pytest.mark.slow
    def test_compiled_steps_are_the_same(self):
        """Fused kernels round otherwise."""
        plain = train(stage_module("joint"), TinyData([False] * 2))
        other = train(stage_module("joint", compile=True), TinyData([False] * 2))
        assert list(other.state_dict()) == list(plain.state_dict())
        for one, two in zip(plain.parts, other.parts, strict=True):
            torch.testing.assert_close(two, one, atol=1e-4, rtol=1e-3)


class TestWorkLeftOut:
    def test_the_discriminator_rests_before_its_start(self):
        """And is moved as by a loss of factor 0: by the weight decay alone."""
        weights = LossWeights(adversarial_start=1)
        module = stage_module("joint", weights=weights)
        calls = passes_through(module.discriminator)
        weight = module.discriminator.main[0].weight.detach().clone()
        train(module, TinyData([False] * 2))
        assert len(calls) == 3  # of the second step: generator, real, fake
        first, _ = module.states
        config = module.optimizer_config
        expected = weight * (1 - config.lr * config.weight_decay)
        torch.testing.assert_close(first[0]["discriminator.main.0.weight"], expected)
        assert ["adversarial" in parts for parts in module.parts] == [False, True]
        grads = [g for n, g in module.grads[0].items() if n.startswith("discriminator")]
        assert len(grads) == len(list(module.discriminator.parameters()))
        assert not any(g.count_nonzero() for g in grads)

    @pytest.mark.numerics("loss of weight zero")
    def test_a_discriminator_of_weight_0_is_not_called(self):
        weights = LossWeights(adversarial=0.0, discriminator=0.0)
        module = stage_module("joint", weights=weights)
        calls = passes_through(module.discriminator)
        train(module)
        assert not calls

    @pytest.mark.numerics("parameters a pass does not use")
    @pytest.mark.parametrize(
        "names",
        [{"reconstruction"}, {"kl"}, {"adversarial", "vae_alignment", "sit_alignment"}],
    )
    def test_losses_of_weight_0_are_not_computed(self, names):
        weights = LossWeights(**dict.fromkeys(names, 0.0))
        module = train(stage_module("joint", weights=weights))
        assert module.parts[0].keys() == REACH["joint"].keys() - names
        trained = {name for name, p in module.named_parameters() if p.requires_grad}
        assert set(module.grads[0]) == trained  # DDP waits for the gradient of each
        projector = any(name.startswith("sit.projector") for name in trained)
        assert projector == ("sit_alignment" not in names)

    def test_without_denoising_the_last_blocks_rest(self):
        module = stage_module("joint", weights=LossWeights(denoising=0.0))
        calls = passes_through(module.sit.blocks[-1])
        train(module)
        assert not calls
        assert module.parts[0]["denoising"] == 0
        assert module.parts[0]["sit_alignment"] != 0
        assert all(p.grad is not None or not p.requires_grad for p in module.sit.parameters())


class Syncs(TorchDispatchMode):
    """Counts reads of a value by the host, each of which makes it wait for a GPU."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += func is torch.ops.aten._local_scalar_dense.default
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("stage", ["vae_alignment", "joint", "flow_matching"])
def test_a_step_waits_for_the_device_once(stage, monkeypatch):
    """For the check that the gradients are finite."""
    module, syncs = stage_module(stage), Syncs()
    counts, tolist = [], torch.Tensor.tolist

    def counted_tolist(values):  # copies all values to the host at once
        syncs.count += 1
        return tolist(values)

    monkeypatch.setattr(torch.Tensor, "tolist", counted_tolist)

    def around(step):
        def run(*args, **kwargs):
            syncs.count = 0
            with syncs:
                result = step(*args, **kwargs)
            counts.append(syncs.count)
            return result

        return run

    # From the losses to the averages: Lightning calls the first two within the third.
    module.optimizer_step = around(module.optimizer_step)
    train(module, TinyData([False] * 3))
    assert counts == [1, 1, 1]
