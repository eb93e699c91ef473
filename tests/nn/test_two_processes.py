"""Batch statistics of two processes (gloo) against those of one process with both batches."""

from __future__ import annotations

import copy

import pytest
import torch
import torch.distributed as dist
from torch import nn

from r3dpa.nn import LatentNorm
from r3dpa.nn.layers import SyncedBatchNorm2d

pytestmark = pytest.mark.ddp
OFFSETS = (0, 3000)


def batches(offset):
    """What each process gets: batches of different sizes and distributions."""
    generator = torch.Generator().manual_seed(3)
    narrow = torch.randn(2, 3, 4, 5, generator=generator)
    wide = 2 * torch.randn(3, 3, 4, 5, generator=generator) + 1
    return [narrow + offset, wide + offset]


def run(layer, image):
    """Output, input gradient, state and weight gradient of a loss that is a sum over the pixels."""
    image.requires_grad_()
    is_norm = isinstance(layer, LatentNorm)
    if not is_norm:
        nn.init.constant_(layer.weight, 1.5)
    output = layer.update(image) if is_norm else layer(image)
    (output.sin() * torch.linspace(0, 1, 5)).sum().backward()
    weight_grad = None if is_norm else layer.weight.grad
    return output.detach(), image.grad, copy.deepcopy(layer.state_dict()), weight_grad


def run_process(rank, folder):
    dist.init_process_group("gloo", f"file://{folder}/rendezvous", rank=rank, world_size=2)
    norm, own = LatentNorm(3), batches(0)[rank]
    results = {"norm": run(norm, own.clone())}
    own[0, 0, 0, 0] = torch.nan if rank == 1 else 0.0
    norm.update(own)  # a broken latent in one process leaves the statistics of both alone
    results["after_nan"] = copy.deepcopy(norm.state_dict())
    for offset in OFFSETS:
        results[offset] = run(SyncedBatchNorm2d(3), batches(offset)[rank])
    results["evaluated"] = SyncedBatchNorm2d(3).eval()(batches(0)[rank])
    torch.save(results, f"{folder}/{rank}.pt")
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def processes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two_processes")
    # A fork starts at once, but cannot run a backward pass where a GPU has threads for it.
    method = "spawn" if torch.cuda.is_available() else "fork"
    torch.multiprocessing.start_processes(
        run_process, (str(folder),), nprocs=2, start_method=method
    )
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


def test_latent_norm(processes):
    output, gradient, state, _ = run(LatentNorm(3), torch.cat(batches(0)))
    parts = [part["norm"] for part in processes]
    for index, expected in enumerate((output, gradient)):
        actual = torch.cat([part[index] for part in parts])
        torch.testing.assert_close(actual, expected, atol=1e-6, rtol=1e-5)
    for part, process in zip(parts, processes, strict=True):
        torch.testing.assert_close(part[2], state)
        torch.testing.assert_close(process["after_nan"], part[2], atol=0, rtol=0)


@pytest.mark.numerics
@pytest.mark.parametrize(("offset", "tolerance"), [(OFFSETS[0], 1e-6), (OFFSETS[1], 1e-3)])
def test_synced_batch_norm(processes, offset, tolerance):
    first, second = (part[offset] for part in processes)
    image = torch.cat(batches(offset)).double()
    output, image_grad, state, weight_grad = run(nn.BatchNorm2d(3).double(), image)
    for index, expected in enumerate((output, image_grad)):
        actual = torch.cat([first[index], second[index]]).double()
        torch.testing.assert_close(actual, expected, atol=tolerance, rtol=tolerance)
    summed = (first[3] + second[3]).double()
    torch.testing.assert_close(summed, weight_grad, atol=10 * tolerance, rtol=1e-5)
    for key, value in state.items():
        for result in (first, second):
            ours = result[2][key].to(value.dtype)
            torch.testing.assert_close(ours, value, atol=1e-6, rtol=1e-6)
    values = image.detach().float().transpose(0, 1).flatten(1)
    one_pass = values.square().mean(1) - values.mean(1).square()
    off = (one_pass / values.var(1, correction=0) - 1).abs().max()
    assert offset == 0 or off > 0.01


def test_evaluation_uses_the_running_statistics(processes):
    expected = nn.BatchNorm2d(3).eval()(batches(0)[0])
    torch.testing.assert_close(processes[0]["evaluated"], expected)
