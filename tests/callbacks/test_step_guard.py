"""A bad step leaves no trace but a count and a file; collapse stops; processes agree."""

import math
import re
import signal
from dataclasses import asdict
from functools import cache
from types import SimpleNamespace

import lightning as L
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision
from tiny_stages import (
    QUIET,
    NamedData,
    constant_loss,
    guarded,
    huge_latents,
    infinite_image,
    stage_module,
    train,
)

from r3dpa.callbacks import StepGuard, bad_batches
from r3dpa.callbacks.bad_batches import read_bad_batch

pytestmark = [
    *QUIET,
    pytest.mark.filterwarnings("ignore:.*barrier.. using the device"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded, use of fork"),
]

TWO_PROCESSES = {"devices": 2, "strategy": "ddp_fork", "use_distributed_sampler": False}
FAULTS = [
    *((stage, infinite_image) for stage in ("joint", "flow_matching", "few_step")),
    *((stage, constant_loss) for stage in ("vae_alignment", "joint")),
    ("joint", huge_latents),
]


def accumulated(module, data, accumulate):
    """Trains with so many batches a step."""
    steps = len(data.batches) // accumulate
    settings = {"accumulate_grad_batches": accumulate, "gradient_clip_val": 1.0}
    return train(module, data, max_steps=steps, **settings)


@cache
def without_the_middle_step(stage, accumulate):
    """Run of three steps without the batches of the second one, which several faults share."""
    data = NamedData(3 * accumulate, range(accumulate, 2 * accumulate))
    return accumulated(guarded(stage, numbers=data.numbers), data, accumulate)


@pytest.mark.numerics
class TestABadStep:
    @pytest.mark.parametrize(
        ("stage", "fault", "accumulate"),
        [*((*fault, 1) for fault in FAULTS), ("joint", infinite_image, 2)],
    )
    def test_a_skipped_step_leaves_weights_averages_and_moments_alone(
        self, stage, fault, accumulate
    ):
        """Weights, all buffers, averages and moments equal those of a run without its batches.

        With two batches a step the second one of the middle step is broken; both are then lost.
        """
        bad = 2 * accumulate - 1
        with_it = accumulated(guarded(stage, [bad], fault), NamedData(3 * accumulate), accumulate)
        without = without_the_middle_step(stage, accumulate)
        assert (with_it.guard.skipped, without.guard.skipped) == (1, 0)
        assert with_it.trainer.callback_metrics["train/skipped_steps"] == 1
        assert with_it.global_step == without.global_step + 1 == 3
        weights, moments = with_it.states[-1]
        expected, expected_moments = without.states[-1]
        assert weights.keys() == expected.keys()
        for key, value in expected.items():
            assert torch.equal(weights[key], value), key
        for found, state in zip(moments, expected_moments, strict=True):
            for key, value in state.items():
                assert torch.equal(found[key], value), key
        after_bad, before = (with_it.states[index][0] for index in (bad, accumulate - 1))
        for key, value in before.items():
            assert torch.equal(after_bad[key], value), key


class TestTheReport:
    def test_a_skipped_step_names_its_scans_and_saves_the_batch(self, tmp_path):
        module = guarded("joint", [1])
        data = NamedData(3)
        with pytest.warns(UserWarning, match="step 1 was skipped") as caught:
            train(module, data, default_root_dir=tmp_path)
        (message,) = [str(w.message) for w in caught if "was skipped" in str(w.message)]
        assert "drive/1a, drive/1b" in message
        assert re.search(r"reconstruction (nan|inf).*gradient norms vae nan", message)
        (file,) = (tmp_path / "bad_batches").iterdir()
        assert str(file) in message
        saved = read_bad_batch(file)
        assert [saved[k] for k in ("step", "stage")] == [1, "joint"]
        assert torch.equal(saved["batch"]["feature_grid"], data.batches[1]["feature_grid"])
        assert all(map(torch.equal, saved["draws"], module.draw_path(2, 1)))
        assert saved["weights"] == asdict(module.weights) | {"adversarial_start": -1}
        assert not math.isfinite(saved["losses"]["loss"])

    def test_the_broken_one_of_two_batches_of_a_step_is_saved(self, tmp_path):
        train(
            guarded("joint", [1]),
            NamedData(2),
            max_steps=1,
            accumulate_grad_batches=2,
            default_root_dir=tmp_path,
        )
        (file,) = (tmp_path / "bad_batches").iterdir()
        assert file.name == "step_0000000_batch_0000001_rank_0.pt"

    def test_at_most_a_few_bad_batches_are_saved(self, tmp_path):
        module = guarded("joint", range(4))
        train(module, NamedData(5), StepGuard(saved_batches=2), default_root_dir=tmp_path)
        assert module.guard.skipped == 4
        assert len(list((tmp_path / "bad_batches").iterdir())) == 2

    def test_the_error_of_a_stopped_run_is_a_command_for_its_newest_batch(self, tmp_path):
        module = guarded("joint", range(4))
        with pytest.raises(RuntimeError, match="4 steps in a row") as caught:
            train(module, NamedData(4), StepGuard(max_skipped_steps=4), default_root_dir=tmp_path)
        newest = tmp_path / "bad_batches" / "step_0000002_batch_0000002_rank_0.pt"
        assert newest.is_file()
        assert f"Run `r3dpa replay {newest} CKPT`" in str(caught.value)

    def test_a_full_disk_does_not_end_the_training(self, tmp_path, monkeypatch):
        def full(*_):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(bad_batches, "save_bad_batch", full)
        with pytest.warns(UserWarning, match="not saved: .*No space left"):
            train(guarded("joint", [0]), NamedData(2), default_root_dir=tmp_path)

    @pytest.mark.parametrize("content", [b"", b"{}", {}, {"stage": "joint"}])
    def test_a_file_that_is_no_saved_batch_is_refused_by_name(self, content, tmp_path):
        path = tmp_path / "step.pt"
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            torch.save(content, path)
        with pytest.raises(ValueError, match=r"step\.pt is no saved batch"):
            read_bad_batch(path)


def checked(norms, loss=1.0, buffer=1.0, scaler=None, guard=None):
    """A guard after one step of a module with one buffer, which the forward pass moved."""
    guard, kept, logged = guard or StepGuard(), torch.ones(3), {}
    weights = [torch.nn.Parameter(torch.ones(1)) for _ in norms]
    for weight, norm in zip(weights, norms, strict=True):
        weight.grad = torch.tensor([norm])
    optimizer = torch.optim.SGD([{"params": [w], "name": str(i)} for i, w in enumerate(weights)])
    loop = SimpleNamespace(epoch_loop=SimpleNamespace(total_batch_idx=0))
    trainer = SimpleNamespace(
        precision_plugin=SimpleNamespace(scaler=scaler),
        global_step=0,
        default_root_dir="run",
        fit_loop=loop,
    )
    module = SimpleNamespace(
        buffers=lambda: [kept],
        device="cpu",
        logged_losses={"loss": torch.tensor(loss)},
        log=logged.__setitem__,
        trainer=trainer,
        global_step=0,
        global_rank=0,
    )
    guard.on_train_batch_start(trainer, module, {}, 0)
    kept[1] = buffer
    guard.on_after_backward(trainer, module)
    guard.on_before_optimizer_step(trainer, module, optimizer)
    assert logged == {"train/skipped_steps": guard.skipped}
    assert all((weight.grad is None) == module.step_skipped for weight in weights)
    return guard, module.step_skipped, kept.tolist()


@pytest.mark.parametrize(("norms", "idle"), [([0.0, 0.0], True), ([0.0, 1.0], False)])
def test_a_step_without_any_gradient_is_noticed(norms, idle, recwarn):
    _, skipped, _ = checked(norms)
    assert not skipped
    assert any("gradients of a step are 0" in str(one.message) for one in recwarn) == idle


@pytest.mark.parametrize(("value", "after"), [(torch.inf, 1.0), (1e38, 1e38)])
def test_statistics_that_overflow_are_put_back_though_the_gradients_are_finite(value, after):
    _, skipped, kept = checked([1.0, 1.0], buffer=value)
    assert skipped == (after == 1.0)
    assert kept == pytest.approx([1.0, after, 1.0])


class TestScaledLosses:
    """Float16 scales the losses up and looks for a scale at which no gradient overflows."""

    @pytest.mark.parametrize("norms", [[1.0, torch.inf], [torch.nan, 1.0]])
    def test_gradients_that_overflow_by_the_loss_scale_do_not_count_as_bad_in_a_row(self, norms):
        guard, skipped, _ = checked(norms, scaler=SimpleNamespace(get_scale=lambda: 65536.0))
        assert (skipped, guard.skipped, guard.in_a_row) == (True, 1, 0)

    @pytest.mark.parametrize(
        "fault", [{"scale": 1.0}, {"loss": torch.nan}, {"buffer": torch.inf}, {"loss": torch.inf}]
    )
    def test_a_fault_that_no_scale_mends_counts_as_bad_in_a_row(self, fault):
        scale = fault.pop("scale", 65536.0)
        scaler = SimpleNamespace(get_scale=lambda: scale)
        guard, skipped, _ = checked([torch.inf], scaler=scaler, **fault)
        assert (skipped, guard.skipped, guard.in_a_row) == (True, 1, 1)

    @staticmethod
    def fit(num, scale, **kwargs):
        """In float16 on the processor, from a scale at which the gradients overflow."""
        scaler = torch.amp.GradScaler("cpu", init_scale=scale)
        module = guarded("flow_matching", **kwargs)
        plugin = MixedPrecision("16-mixed", "cpu", scaler)
        train(module, NamedData(num), plugins=[plugin], precision=None)
        return module, scaler.get_scale()

    def test_a_fit_finds_its_scale_beyond_the_most_bad_steps_in_a_row(self, recwarn):
        """2^30 is far above what 16 bits hold; it is halved in each step until it fits."""
        module, scale = self.fit(30, 2.0**30)
        assert module.guard.skipped > module.guard.max_skipped_steps
        assert scale == 2.0 ** (30 - module.guard.skipped)
        assert not module.step_skipped
        assert not [w for w in recwarn if "was skipped" in str(w.message)]

    def test_gradients_that_no_scale_mends_stop_it(self):
        """From 8 on the scale takes three steps to 1; then the usual ten in a row."""

        def infinite_gradient(module, batch):
            module.sit.final_layer.linear.bias.register_hook(lambda g: g * torch.inf)

        with pytest.raises(RuntimeError, match=r"10 steps in a row .* at step 12"):
            self.fit(20, 8.0, bad=range(20), fault=infinite_gradient)


def test_a_step_passes_a_stop_signal_on():
    guard = StepGuard()
    for norm in (1.0, torch.nan):
        guard.stop = 15
        assert checked([norm], guard=guard)[0].stop == 15
    guard.stop = 0
    assert checked([1.0], guard=guard)[0].stop == 0


@pytest.mark.ddp
def test_a_bad_batch_of_one_process_skips_the_step_of_all(tmp_path, one_thread):
    """No gradient of any process tells: only the check itself can agree."""

    def only_of_the_second(module, batch):
        if module.global_rank == 1:
            constant_loss(module, batch)

    module = guarded("joint", [1], only_of_the_second)

    def keep(self):
        content = {"guard": self.guard.state_dict(), "weights": self.state_dict()}
        torch.save(content, tmp_path / f"rank_{self.global_rank}.pt")

    type(module).on_fit_end = keep
    train(module, NamedData(3), default_root_dir=tmp_path, **TWO_PROCESSES)
    first, second = (torch.load(tmp_path / f"rank_{rank}.pt") for rank in (0, 1))
    assert first["guard"] == second["guard"] == {"skipped": 1, "in_a_row": 0}
    for key, value in first["weights"].items():
        assert value.isfinite().all(), key
        assert torch.equal(value, second["weights"][key]), key
    ranks = {path.stem[-1] for path in (tmp_path / "bad_batches").iterdir()}
    assert ranks == {"1"}


@pytest.mark.ddp
def test_a_process_with_a_stop_signal_tells_the_other_in_its_step(tmp_path, one_thread):
    """The second process gets a signal in its second step; both know after that step."""

    class Ask(L.Callback):
        def __init__(self):
            self.seen = []

        def on_after_backward(self, trainer, module):
            asked = trainer.global_rank == 1 and trainer.global_step == 1
            module.guard.stop = int(signal.SIGTERM) if asked else 0

        def on_train_batch_end(self, trainer, module, *_):
            self.seen.append(module.guard.stop)
            torch.save(self.seen, tmp_path / f"rank_{trainer.global_rank}.pt")

    train(
        stage_module("flow_matching"),
        NamedData(3),
        default_root_dir=tmp_path,
        **TWO_PROCESSES,
        callbacks=[Ask()],
    )
    for rank in (0, 1):
        assert torch.load(tmp_path / f"rank_{rank}.pt") == [0, 15, 0]
