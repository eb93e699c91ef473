"""Which loss reaches which network, clipping per network, and steps that are dropped."""

from __future__ import annotations

import pytest
import torch
from draws import drawn
from lightning.pytorch.callbacks import StochasticWeightAveraging
from lightning.pytorch.plugins import MixedPrecision
from tiny_stages import QUIET, REACH, TinyData, group_of, stage_module, train
from torch import nn

from r3dpa.callbacks import StepGuard
from r3dpa.modules import LossWeights
from r3dpa.modules.stage import frozen

pytestmark = QUIET
CLIP_BY_VALUE = {"gradient_clip_val": 1.0, "gradient_clip_algorithm": "value"}


def separated(stage, **weights):
    module = stage_module(stage, weights=LossWeights(**weights))
    module.separates_losses = True
    return train(module)


@pytest.fixture(scope="module", params=list(REACH))
def observed(request):
    return request.param, separated(request.param)


class TestReach:
    @pytest.mark.numerics("three networks in one graph")
    def test_every_loss_reaches_exactly_its_networks(self, observed):
        stage, module = observed
        found = {
            part: {group_of(name) for name in reached}
            for part, reached in module.reached[0].items()
        }
        assert found == REACH[stage]

    def test_gradients_of_a_step_are_the_sum_over_the_losses(self, observed):
        """One backward for all: no network receives more than the table says."""
        _, module = observed
        for name, total in module.grads[0].items():
            parts = [reached[name] for reached in module.reached[0].values() if name in reached]
            expected = sum(parts, start=torch.zeros_like(total))
            torch.testing.assert_close(total, expected, atol=1e-6, rtol=1e-4)

    @pytest.mark.parametrize("part", ["vae_alignment", "discriminator"])
    @pytest.mark.numerics("discriminator loss that is scaled down")
    def test_a_weight_scales_its_loss_and_its_gradient_alone(self, part):
        once, twice = (separated("joint", **{part: weight}) for weight in (1.5, 3.0))
        for name, value in once.parts[0].items():
            torch.testing.assert_close(twice.parts[0][name], (1 + (name == part)) * value)
        for name, gradient in once.reached[0][part].items():
            torch.testing.assert_close(twice.reached[0][part][name], 2 * gradient)


class TestFrozen:
    def test_both_passes_of_a_network_keep_to_themselves(self):
        """A pass inside and one outside: the parameters get the gradient of the latter alone."""
        layer, inputs = nn.Linear(3, 1), torch.ones(1, 3, requires_grad=True)
        with frozen(layer):
            inside = layer(inputs)
        (5 * inside + layer(2 * inputs)).sum().backward()
        assert layer.weight.grad.tolist() == [[2.0, 2.0, 2.0]]
        torch.testing.assert_close(inputs.grad, 7 * layer.weight.detach())

    def test_an_exception_restores_all_but_permanently_frozen_parameters(self):
        layers = nn.Linear(3, 2), nn.Linear(2, 1)
        layers[1].bias.requires_grad_(False)
        parameters = [p for layer in layers for p in layer.parameters()]
        with pytest.raises(RuntimeError, match="in between"), frozen(*layers):
            raise RuntimeError("in between")
        assert [p.requires_grad for p in parameters] == [True, True, True, False]


def norms_by_network(grads):
    squares = {}
    for name, gradient in grads.items():
        network = name.split(".")[0]
        squares[network] = squares.get(network, 0.0) + gradient.double().square().sum().item()
    return {network: square**0.5 for network, square in squares.items()}


class TestClipping:
    def test_each_network_is_clipped_by_its_own_norm(self):
        """A limit between the norms: what is below it stays bit for bit, the rest has its norm."""
        module = train(stage_module("joint"))
        before = norms_by_network(module.grads[0])
        low, *_, high = sorted(before.values())
        limit = (low * high) ** 0.5
        module = train(stage_module("joint"), gradient_clip_val=limit)
        after = norms_by_network(module.clipped[0])
        assert set(before) == {"vae", "discriminator", "sit"}
        for network, norm in before.items():
            # Clipping divides by norm + 1e-6.
            assert after[network] == pytest.approx(min(norm, limit), rel=1e-4)
            assert module.trainer.callback_metrics[f"grad_norm/{network}"] == pytest.approx(norm)
        for name, gradient in module.clipped[0].items():
            network = name.split(".")[0]
            expected = module.grads[0][name]
            if before[network] <= limit:
                assert torch.equal(gradient, expected), name
            else:
                expected = expected * limit / before[network]
                torch.testing.assert_close(gradient, expected, atol=1e-7, rtol=1e-4)

    @pytest.mark.parametrize("limit", [None, 0, -1.0])
    def test_no_limit_above_0_means_no_clipping(self, limit):
        """As in Lightning; a factor of 0 would train nothing, one below 0 ascend."""
        module = train(stage_module("joint"), gradient_clip_val=limit)
        torch.testing.assert_close(module.clipped[0], module.grads[0], atol=0, rtol=0)

    @pytest.mark.numerics("clipping of scaled gradients")
    @pytest.mark.filterwarnings("ignore:Detected call of `lr_scheduler")
    def test_the_clipped_norm_does_not_depend_on_the_scale_of_the_loss(self):
        """With float16 the loss is scaled; the norms that are logged and clipped are not."""
        norms = {}
        for scale in (1.0, 1024.0):
            scaler = torch.amp.GradScaler("cpu", init_scale=scale, growth_interval=1000)
            plugin = MixedPrecision("16-mixed", "cpu", scaler)
            module = train(stage_module("joint"), plugins=[plugin], gradient_clip_val=0.1)
            metrics = module.trainer.callback_metrics
            norms[scale] = {k: v.item() for k, v in metrics.items() if k.startswith("grad_norm/")}
            assert scaler.get_scale() == scale  # no step was dropped
        assert norms[1024.0] == pytest.approx(norms[1.0], rel=0.02)
        assert norms[1.0]["grad_norm/sit"] > 0.1

        parameter = nn.Parameter(torch.zeros(100))
        clipped = {}
        for scale in (1.0, 65536.0):
            parameter.grad = scale * drawn(0, 100)
            nn.utils.clip_grad_norm_([parameter], 0.1)
            clipped[scale] = (
                (parameter.grad / scale).norm().item()
            )  # unscaled in the step, too late
        assert clipped[65536.0] < 1e-4 * clipped[1.0]


@pytest.mark.numerics
class TestNonFiniteGradients:
    def test_a_bad_first_step_leaves_no_moments(self):
        module = train(stage_module("joint"), TinyData([True, False]))
        (_, first_moments), (weights, second_moments) = module.states
        assert not first_moments
        assert {int(state["step"]) for state in second_moments} == {1}
        assert all(value.isfinite().all() for value in weights.values())

    def test_too_many_in_a_row_stop_the_training(self):
        """Of max_skipped_steps = 2: bad, good, bad goes on, a second bad one in a row stops."""
        module = stage_module("joint")
        message = r"2 steps in a row had a non-finite loss.*vae nan.*replay.*learning rate"
        with pytest.raises(RuntimeError, match=message):
            train(module, TinyData([True, False, True, True, False]), StepGuard(2))
        assert len(module.states) == 3
        resumed = StepGuard()
        resumed.load_state_dict(module.guard.state_dict())
        assert (resumed.skipped, resumed.in_a_row) == (module.guard.skipped, 2) == (3, 2)
        assert all(value.isfinite().all() for value in module.state_dict().values())


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"precision": "bf16-true"}, "precision bf16-true is not supported.*bf16-mixed"),
        ({"precision": "16-true"}, "precision 16-true is not supported"),
        ({"precision": "64-true"}, "precision 64-true is not supported"),
        ({"reload_dataloaders_every_n_epochs": 1}, "would break the order of a resumed run"),
        (
            {"callbacks": [StochasticWeightAveraging(0.1)]},
            "is not supported.*init_args.ema_decay",
        ),
        (CLIP_BY_VALUE, "by norm per network; .*got 'value'"),
    ],
)
def test_settings_that_the_stages_cannot_train_with(setting, message):
    with pytest.raises(ValueError, match=message):
        train(stage_module("joint"), **setting)
