"""Neighbourhood attention on the tokens of a 64 x 1024 image, against a mask over all tokens."""

import resource
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest
import torch
import torch.nn.functional as F

from r3dpa.baselines.neighbourhood import neighbourhood_attention

pytestmark = [pytest.mark.bench, pytest.mark.benchmark(min_rounds=3, warmup=False)]

ROWS, COLUMNS, HEADS, WIDTH = 64, 256, 2, 64  # of the first level of HDiT
KERNEL = (3, 9)


def inputs():
    generator = torch.Generator().manual_seed(0)
    shape = (1, ROWS, COLUMNS, HEADS, WIDTH)
    return [torch.randn(shape, generator=generator) for _ in range(3)]


def windows():
    return neighbourhood_attention(*inputs(), KERNEL, wrap_columns=True)


def dense():
    """All 16384 x 16384 products, of which a mask keeps the 27 of a window."""
    row, column = torch.arange(ROWS), torch.arange(COLUMNS)
    first = (row - KERNEL[0] // 2).clamp(0, ROWS - KERNEL[0])
    rows = (row >= first[:, None]) & (row < first[:, None] + KERNEL[0])
    away = (column - column[:, None]).remainder(COLUMNS)
    columns = torch.minimum(away, COLUMNS - away) <= KERNEL[1] // 2
    mask = (rows[:, None, :, None] & columns[None, :, None, :]).reshape(ROWS * COLUMNS, -1)
    query, key, value = (x.flatten(1, 2).transpose(1, 2) for x in inputs())
    mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=mask, scale=1.0)
    return mixed.transpose(1, 2).view(1, ROWS, COLUMNS, HEADS, WIDTH)


WAYS = {"windows": windows, "dense": dense}


def peak_megabytes(name):
    """Growth of the peak memory of a fresh process."""
    torch.set_num_threads(1)
    neighbourhood_attention(*(x[:, :4, :16] for x in inputs()), KERNEL)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with torch.inference_mode():
        WAYS[name]()
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024


@pytest.mark.parametrize("name", WAYS)
@pytest.mark.benchmark(group="neighbourhood attention, 64 x 1024")
def bench_attention(benchmark, name, alone):
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        benchmark.extra_info["peak MB"] = round(pool.submit(peak_megabytes, name).result())
    found = benchmark(WAYS[name])
    torch.testing.assert_close(found, windows(), atol=1e-5, rtol=1e-5)
