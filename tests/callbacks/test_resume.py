"""A run that was stopped and resumed equals one that was not, bit for bit."""

import lightning as L
import pytest
import torch
from tiny_stages import QUIET, NamedData, stage_module, train
from torch.utils.data import DataLoader, default_collate

from r3dpa.callbacks import RunCheckpoint
from r3dpa.data.loaders import training_loader

pytestmark = QUIET
WHOLE = 8  # steps


class Shuffled(NamedData):
    """Ten scans in five shuffled batches an epoch."""

    def __init__(self):
        super().__init__(5)
        self.scans = [
            {key: value[index] for key, value in batch.items()}
            for batch in self.batches
            for index in (0, 1)
        ]

    def val_dataloader(self):
        mask = torch.ones_like(self.batches[0]["range_image"], dtype=torch.bool)
        more = {"valid_mask": mask, "index": torch.arange(2)}
        return DataLoader([self.batches[0] | more], batch_size=None)

    def train_dataloader(self):
        return training_loader(self.scans, 2, collate_fn=default_collate)


class Seen(L.Callback):
    """Names of the scans of each step."""

    def __init__(self):
        self.names = []

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        self.names.append(batch["name"])


def fit(folder, steps, ckpt=None, every=3, val_every=3):
    """Scans of each step, and the last checkpoint."""
    seen = Seen()
    saver = RunCheckpoint(folder, save_last=True, every_n_train_steps=every, save_top_k=-1)
    train(
        stage_module("joint", ema_decay=0.5),
        Shuffled(),
        callbacks=[seen, saver],
        ckpt_path=ckpt,
        max_steps=steps,
        max_epochs=-1,
        enable_checkpointing=True,
        limit_val_batches=1,
        check_val_every_n_epoch=None,  # as in conf/trainer.yaml
        val_check_interval=val_every,
        num_sanity_val_steps=0,
    )
    return seen.names, torch.load(folder / "last.ckpt", weights_only=False)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return fit(tmp_path_factory.mktemp("whole"), WHOLE)


@pytest.mark.parametrize(
    ("stop", "every", "val_every"),
    [
        *(pytest.param(stop, 3, 3, marks=pytest.mark.slow) for stop in (3, 4, 6)),
        *((5, 3, 3), (5, 5, 5000)),
    ],
)
@pytest.mark.numerics("resume in the middle")
def test_a_resumed_run_is_exact_also_at_the_end_of_an_epoch(
    stop, every, val_every, whole, tmp_path
):
    """An epoch has five batches; a checkpoint is written in its last step, or after it."""
    names, expected = whole
    first, stopped = fit(tmp_path, stop, None, every, val_every)
    assert stopped["global_step"] == stop  # saved at the end, whatever the interval
    second, found = fit(tmp_path, WHOLE, tmp_path / "last.ckpt", every, val_every)
    assert first + second == names
    assert len({tuple(batch) for batch in names}) > 5  # another order in the second epoch
    assert found["global_step"] == expected["global_step"] == WHOLE
    for key, value in expected["state_dict"].items():
        assert torch.equal(found["state_dict"][key], value), key
    states = (run["optimizer_states"][0]["state"] for run in (expected, found))
    for before, after in zip(*(state.values() for state in states), strict=True):
        for key, value in before.items():
            assert torch.equal(after[key], value), key


def test_last_is_the_newest_in_a_folder_that_was_moved(tmp_path):
    """Lightning would write last-v1.ckpt beside the stale last.ckpt."""
    fit(tmp_path / "run", 2)
    (tmp_path / "run").rename(tmp_path / "moved")
    for steps in (3, 4):
        _, last = fit(tmp_path / "moved", steps, tmp_path / "moved" / "last.ckpt")
        assert last["global_step"] == steps
    assert not list((tmp_path / "moved").glob("last-*"))
