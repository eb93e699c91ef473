"""Hard cases of optimisation, of several processes, and of going on after a stop."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.distributed as dist
from lightning.pytorch.overrides.distributed import UnrepeatedDistributedSampler
from lightning.pytorch.plugins import MixedPrecision
from tiny import batch_of, drawn, fit, module, vae_losses
from torch import nn
from torch._dynamo.testing import CompileCounter
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Dataset, DistributedSampler

from r3dpa.data.augmentation import Augmentation
from r3dpa.data.loaders import training_loader
from r3dpa.metrics.functional import Moments, frechet_distance, merge_packed
from r3dpa.modules import LossWeights
from r3dpa.modules.stage import frozen
from r3dpa.nn.layers import SyncedBatchNorm2d

pytestmark = pytest.mark.filterwarnings("ignore:Attribute '.*' is an instance of `nn.Module`")


@pytest.fixture
def one_process(tmp_path):
    """A process group of this process alone."""
    dist.init_process_group("gloo", f"file://{tmp_path}/rendezvous", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


@pytest.mark.numerics("clipping of scaled gradients")
@pytest.mark.filterwarnings("ignore:Detected call of `lr_scheduler")
def test_the_clipped_norm_does_not_depend_on_the_scale_of_the_loss():
    """With float16 the loss is scaled; the norms that are logged and clipped are not."""
    norms, weights = {}, {}
    for scale in (1.0, 1024.0):
        scaler = torch.amp.GradScaler("cpu", init_scale=scale, growth_interval=1000)
        plugin = MixedPrecision("16-mixed", "cpu", scaler)
        made = fit(module(), [batch_of(0)], plugins=[plugin], gradient_clip_val=0.1)
        metrics = made.trainer.callback_metrics
        norms[scale] = {k: v.item() for k, v in metrics.items() if k.startswith("grad_norm/")}
        weights[scale] = nn.utils.parameters_to_vector(made.sit.parameters()).detach()
        assert scaler.get_scale() == scale  # no step was dropped
    assert norms[1024.0] == pytest.approx(norms[1.0], rel=0.02)
    assert norms[1.0]["grad_norm/sit"] > 0.1

    parameter = nn.Parameter(torch.zeros(100))
    clipped = {}
    for scale in (1.0, 65536.0):
        parameter.grad = scale * drawn(0, 100)
        nn.utils.clip_grad_norm_([parameter], 0.1)
        clipped[scale] = (parameter.grad / scale).norm().item()  # unscaled in the step, too late
    assert clipped[65536.0] < 1e-4 * clipped[1.0]


@pytest.mark.numerics("three networks in one graph")
def test_the_step_of_the_generator_leaves_the_discriminator_without_gradient():
    made, image = module(), batch_of(0)["range_image"]

    def gradient_of_the_discriminator(parts):
        made.zero_grad(set_to_none=True)
        sum(parts.values()).backward()
        return [p.grad for p in made.discriminator.parameters()]

    _, parts = vae_losses(made, image)
    assert "adversarial" in parts
    assert not any(grad is not None for grad in gradient_of_the_discriminator(parts))
    assert all(p.grad is not None for p in made.vae.decoder.parameters())
    logits = made.discriminator(made.vae.decode(made.vae.encode(image).mean))
    leaked = gradient_of_the_discriminator({"adversarial": -logits.mean()})
    assert nn.utils.get_total_norm(leaked) > 0


@pytest.mark.parametrize(
    "weights",
    [{}, {"denoising": 0.0}, {"sit_alignment": 0.0}, {"reconstruction": 0.0, "adversarial": 0.0}],
    ids=str,
)
@pytest.mark.numerics("parameters a pass does not use")
def test_every_trained_parameter_takes_part_in_every_step(weights, one_process):
    """Three steps under DDP, which waits for the gradient of each parameter."""
    made = module(weights=LossWeights(**weights, adversarial_start=1))
    made.log_dict = lambda *args, **kwargs: None
    draws = made.vae.latent_channels, 4, 8

    class Step(nn.Module):
        def __init__(self):
            super().__init__()
            self.made = made

        def forward(self, number, align_only):
            image, features = (batch_of(number)[k] for k in ("range_image", "feature_grid"))
            path = type("Draws", (), {"time": torch.rand(2), "noise": drawn(9, 2, *draws)})
            posterior = made.vae.encode(image)
            latents = posterior.sample(drawn(8, 2, *draws))
            if align_only:
                return made.vae_alignment_losses(latents, features, path)["vae_alignment"]
            reconstruction = made.vae.decode(latents)
            parts = made.vae_losses(image, posterior, reconstruction)
            with frozen(made.sit):
                parts |= made.vae_alignment_losses(latents, features, path)
            parts |= made.discriminator_losses(image, reconstruction)
            normalised = made.latent_norm.update(latents.detach())
            parts |= made.flow_losses(normalised, features, path)
            return made.weigh_and_log(parts)

    for parameter in made.parameters():  # what the stage does not train is not waited for
        parameter.requires_grad_(False)
    for network in made.trainable().values():
        network.requires_grad_(True)
    made.sit.projector.requires_grad_(made.weights.sit_alignment != 0)
    parallel = DistributedDataParallel(Step())
    for number in range(3):
        parallel(number, False).backward()
    for network in made.trainable().values():
        assert all(p.grad is not None for p in network.parameters() if p.requires_grad)
    parallel(0, True).backward()
    with pytest.raises(RuntimeError, match="not used in producing loss"):
        parallel(1, True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.numerics("uneven last batch")
def test_101_samples_on_two_processes_are_101_samples(dtype):
    """Held-out scans are dealt out without repeats, and moments are merged by their counts."""
    features, real = drawn(0, 101, 8).to(dtype), Moments.of(drawn(1, 200, 8))
    features[0] += 20  # a sample that counts, and that padding repeats

    def distance(sampler_class):
        samplers = [sampler_class(features, 2, rank, shuffle=False) for rank in range(2)]
        parts = [Moments.of(features[list(sampler)]).pack() for sampler in samplers]
        merged = Moments.unpack(merge_packed(torch.stack(parts)))
        gaussian = real.mean, real.covariance(), merged.mean, merged.covariance()
        return int(merged.count), frechet_distance(*gaussian).item()

    whole = Moments.of(features)
    expected = frechet_distance(real.mean, real.covariance(), whole.mean, whole.covariance()).item()
    count, found = distance(UnrepeatedDistributedSampler)
    assert count == 101
    assert found == pytest.approx(expected, rel=1e-9)
    padded_count, padded = distance(DistributedSampler)
    assert padded_count == 102
    assert abs(padded / expected - 1) > 0.01


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.numerics("synchronised batch norm in one process")
def test_one_process_has_the_plain_batch_norm(dtype, one_process):
    ours, plain, image = SyncedBatchNorm2d(3), nn.BatchNorm2d(3), drawn(0, 2, 3, 4, 5).to(dtype)
    assert torch.equal(ours(image), plain(image))
    assert all(torch.equal(ours.state_dict()[k], value) for k, value in plain.state_dict().items())
    with pytest.raises((ValueError, RuntimeError), match="SyncBatchNorm expected input tensor"):
        nn.SyncBatchNorm(3)(image)


@pytest.mark.numerics("resume in the middle")
def test_draws_of_a_step_do_not_depend_on_what_was_drawn_before():
    """Steps 0 to 5 in one run, or 3 to 5 in another: each step has its own key."""

    def ours(steps):
        made = module()
        made._trainer = type("Alone", (), {"world_size": 1, "global_rank": 0})()
        torch.manual_seed(len(steps))  # the global state of a new process
        return {step: made.draw_path(2, step) for step in steps}

    def of_the_global_state(steps):
        torch.manual_seed(0)  # as the script does when it starts, and does again on resume
        return {step: torch.randn(3) for step in steps}

    whole, resumed = ours(range(6)), ours(range(3, 6))
    for step, draws in resumed.items():
        for one, other in zip(draws, whole[step], strict=True):
            assert torch.equal(one, other)
    assert not torch.equal(whole[3].noise, whole[0].noise)
    plain, again = of_the_global_state(range(6)), of_the_global_state(range(3, 6))
    assert torch.equal(again[3], plain[0])
    assert not any(torch.equal(again[step], plain[step]) for step in again)


class Draws(Dataset):
    """Draws of a sample by our key, and by a generator that lives in the data set."""

    def __init__(self):
        self.generator = np.random.default_rng(0)

    def __len__(self):
        return 8

    def __getitem__(self, index):
        view = Augmentation(rotate=True).draw(0, 0, index, 1024)
        return view.columns, int(self.generator.integers(1024))


@pytest.mark.filterwarnings("ignore:This DataLoader will create 4 worker processes")
@pytest.mark.numerics("seeds of loader processes")
def test_draws_do_not_depend_on_the_number_of_workers(one_thread):
    ours, naively = {}, {}
    for workers in (0, 1, 4):
        context = "fork" if workers else None
        loader = DataLoader(Draws(), num_workers=workers, multiprocessing_context=context)
        pairs = [(int(a), int(b)) for a, b in loader]
        ours[workers], naively[workers] = zip(*pairs, strict=True)
    assert ours[0] == ours[1] == ours[4]
    assert len(set(ours[0])) == 8
    assert naively[4][:4] == (naively[4][0],) * 4


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.numerics("recompilation at the last batch")
def test_all_batches_have_one_shape():
    """Five scans in batches of two, for two epochs, through a compiled layer."""

    def compilations(loader):
        torch._dynamo.reset()
        counter = CompileCounter()
        layer = torch.compile(nn.Linear(3, 2), backend=counter, dynamic=False)
        for _ in range(2):
            for batch in loader:
                layer(batch)
        return counter.frame_count

    scans = drawn(0, 5, 3)
    assert compilations(training_loader(scans, 2)) == 1
    assert compilations(DataLoader(scans, batch_size=2)) == 2
