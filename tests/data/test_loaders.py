from itertools import chain

import pytest
import torch
from torch.utils.data import Dataset

from r3dpa.data.loaders import training_loader


class Numbers(Dataset):
    def __init__(self, count):
        self.count = count
        self.read = []

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        self.read.append(index)
        return index


def batches(loader, epoch):
    loader.sampler.set_epoch(epoch)
    return [batch.tolist() for batch in loader]


def of_all_ranks(num_replicas, batch_size, count, epoch, state=None):
    """Global batches: position i of rank r is position i * processes + r."""
    ranks = []
    for rank in range(num_replicas):
        loader = training_loader(
            Numbers(count), batch_size // num_replicas, num_replicas=num_replicas, rank=rank
        )
        if state:
            loader.load_state_dict(state)
        ranks.append(batches(loader, epoch))
    return [list(chain(*zip(*parts, strict=True))) for parts in zip(*ranks, strict=True)]


@pytest.mark.parametrize("count", [64, 70, 79])
@pytest.mark.numerics("recompilation at the last batch")
def test_global_batches_do_not_depend_on_the_number_of_processes(count):
    one, two, four = (of_all_ranks(processes, 8, count, epoch=3) for processes in (1, 2, 4))
    assert one == two == four
    assert len(one) == count // 8
    seen = list(chain(*one))
    assert len(set(seen)) == len(seen)


def test_order_is_a_function_of_seed_and_epoch():
    orders = [
        tuple(map(tuple, batches(training_loader(Numbers(32), 4, seed=seed), epoch)))
        for seed in (0, 1)
        for epoch in (0, 1)
    ]
    assert len(set(orders)) == 4  # seed + epoch, the rule of the base class, would give three
    again = training_loader(Numbers(32), 4, seed=1)
    assert tuple(map(tuple, batches(again, 1))) == orders[3]


@pytest.mark.parametrize("workers", [0, 2])
def test_state_counts_what_was_handed_out_not_what_was_prefetched(workers):
    loader = training_loader(Numbers(40), 4, num_workers=workers)
    whole = batches(loader, 0)
    iterator = iter(loader)
    first = [next(iterator).tolist() for _ in range(3)]
    state = loader.state_dict()
    assert (state["epoch"], state["samples"]) == (0, 12)
    data = Numbers(40)
    resumed = training_loader(data, 4, num_workers=workers)
    resumed.load_state_dict(state)
    assert resumed.state_dict() == state
    assert first + batches(resumed, 0) == whole
    if workers == 0:
        assert sorted(data.read) == sorted(chain(*whole[3:]))  # nothing was read to be skipped
    assert batches(resumed, 1) == batches(loader, 1)


def test_an_old_iterator_that_dies_late_does_not_disturb_the_next_pass():
    loader = training_loader(Numbers(40), 4)
    expected = batches(loader, 1)
    loader.sampler.set_epoch(0)
    old = iter(loader)
    next(old)
    loader.sampler.set_epoch(1)
    new = iter(loader)
    old.close()
    assert [batch.tolist() for batch in new] == expected
    assert loader.state_dict()["epoch"] == 2


def test_resume_with_another_number_of_processes_of_the_same_total_batch():
    one = training_loader(Numbers(40), 8)
    whole = batches(one, 0)
    next(iter(one))
    assert of_all_ranks(2, 8, 40, epoch=0, state=one.state_dict()) == whole[1:]


def test_place_in_other_data_or_within_a_batch_is_refused():
    loader = training_loader(Numbers(40), 4)
    iterator = iter(loader)
    next(iterator)
    state = loader.state_dict()
    with pytest.raises(ValueError, match=r"over 40 samples .* this run has 41 samples"):
        training_loader(Numbers(41), 4).load_state_dict(state)
    with pytest.raises(ValueError, match="order of seed 0"):
        training_loader(Numbers(40), 4, seed=1).load_state_dict(state)
    with pytest.raises(ValueError, match=r"after 4 samples .* batch of 8"):
        training_loader(Numbers(40), 8).load_state_dict(state)
    for _ in iterator:
        pass
    # At the border of an epoch other data are fine.
    training_loader(Numbers(41), 8, seed=1).load_state_dict(loader.state_dict())


def test_global_random_state_is_left_alone():
    before = torch.get_rng_state()
    batches(training_loader(Numbers(16), 4, num_workers=2), 0)
    assert torch.equal(torch.get_rng_state(), before)
