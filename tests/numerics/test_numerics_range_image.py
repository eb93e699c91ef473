"""Hard cases of points, range images and feature grids."""

from __future__ import annotations

import math
from contextlib import nullcontext

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from r3dpa.geometry import (
    EMPTY_RANGE_M,
    LidarSensor,
    RangeCodec,
    RingProjection,
    SphericalProjection,
    points_of,
    pool_cells,
    range_image,
    unproject,
)
from r3dpa.nn.vae import VAE

DTYPES = [torch.float32, torch.bfloat16]
exhaustive = settings(derandomize=True, max_examples=25, deadline=None)


def vae_of(**options):
    torch.manual_seed(0)
    sizes = {"num_res_blocks": 1, "attention_levels": (2,)}
    return VAE(1, 4, 32, (1, 1, 2, 2), **sizes, **options).requires_grad_(False)


@pytest.fixture(scope="module")
def vae():
    return vae_of()


def autocast(dtype):
    return nullcontext() if dtype == torch.float32 else torch.autocast("cpu", dtype)


@pytest.mark.numerics("rows of equal pitch and real beams")
def test_nominal_beams_leave_rows_of_equal_pitch_empty():
    """HDL-64E: 32 beams of 1/3 degree pitch from +2 down, 32 of 1/2 degree from -8.83 down.

    0.01 degrees are taken off, so that no beam meets the border of a row.
    """
    upper, lower = 2 - torch.arange(32) / 3, -8.83 - torch.arange(32) / 2
    inclinations = torch.cat([upper, lower]).double() - 0.01
    azimuth = (torch.arange(2083).double() + 0.5) * (2 * math.pi / 2083)
    up = inclinations.deg2rad()[:, None]
    xyz = up.cos() * azimuth.cos(), up.cos() * azimuth.sin(), up.sin().expand(64, 2083)
    points = (20 * torch.stack(xyz, dim=-1)).reshape(-1, 3).float()  # ring after ring, as a file

    sensor = LidarSensor()
    hit = range_image(points, SphericalProjection(sensor))[0] > 0
    pitch = 28 / 64
    expected = {math.floor((3 - angle) / pitch) for angle in inclinations.tolist()}
    assert set(hit.any(dim=1).nonzero().flatten().tolist()) == expected
    assert len(expected) == 56
    assert hit[hit.any(dim=1)].all()  # a row is either full or empty: nothing was dropped
    by_ring = range_image(points, RingProjection(sensor, tuple(inclinations.tolist())))[0] > 0
    assert by_ring.all()

    assert hit.any(dim=1).sum() < len(inclinations)  # "each beam has its row"
    survive = hit.sum() / len(points)
    assert survive == pytest.approx(0.43, abs=0.005)


FEW_POINTS = [[], [[10.0, 0.0, 0.0]], [[10.0, 0.0, 0.0], [0.0, -20.0, -1.0]]]


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("scans of 0, 1 and 2 points")
def test_scans_of_few_points_pass_through_images_grids_and_networks(dtype, vae):
    """Padded with NaN to one length, as a batch; none is lost, whichever is the last."""
    sensor = LidarSensor(beams=16, columns=64)
    projection, codec = SphericalProjection(sensor), RangeCodec("log2")
    order = [2, 1, 0]
    batch = torch.full((3, 2, 3), math.nan)
    for index, count in enumerate(order):
        batch[index, :count] = torch.tensor(FEW_POINTS[count]).reshape(-1, 3)
    range_m, _ = range_image(batch, projection)
    assert (range_m > 0).flatten(1).sum(dim=1).tolist() == order
    alone = [range_image(batch[i, :count], projection)[0] for i, count in enumerate(order)]
    assert torch.equal(torch.stack(alone), range_m)
    for count in order:
        points = torch.tensor(FEW_POINTS[count]).reshape(-1, 3)
        means, counts = pool_cells(points, points.to(dtype), projection, (2, 8))
        assert counts.sum() == count
        assert means.isfinite().all()
        assert (means[counts == 0] == 0).all()

    image = codec.encode(range_m)[:, None]
    with autocast(dtype):
        posterior = vae.encode(image)
        decoded = vae.decode(posterior.mean)
    assert posterior.mean.isfinite().all()
    assert posterior.kl().isfinite().all()
    assert decoded.isfinite().all()
    scenes = codec.decode(decoded.float()[:, 0], sensor)
    assert all(points_of(scene, projection).isfinite().all() for scene in scenes)
    assert len(points_of(codec.decode(image[2, 0], sensor), projection)) == 0

    places = torch.repeat_interleave(torch.tensor(order))  # the list form: scan of each point
    assert places.max() + 1 == 2
    with pytest.raises(RuntimeError, match="numel"):
        batch[2, :0].min()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.numerics("interpolation at the seam")
def test_rotated_latents_decode_to_a_rotated_image(dtype, vae):
    latents = torch.randn(1, 4, 4, 8, generator=torch.Generator().manual_seed(0))

    def error(network):
        with autocast(dtype):
            still, turned = (network.decode(latents.roll(k, -1)).float() for k in (0, 3))
        return ((turned - still.roll(24, -1)).norm() / still.norm()).item()

    legacy = vae_of(legacy_upsample=True)
    # In bfloat16 sums of another order may round to another number, layer after layer.
    assert error(vae) < (1e-5 if dtype == torch.float32 else 3e-2)
    assert error(legacy) > 0.1


@st.composite
def sensors(draw):
    low = draw(st.floats(-85, 60))
    return LidarSensor(
        beams=draw(st.integers(1, 40)),
        columns=draw(st.integers(1, 200)),
        inclination_max_deg=low + draw(st.floats(1, 25)),
        inclination_min_deg=low,
        range_max_m=draw(st.floats(2, 500)),
    )


@pytest.mark.numerics
@exhaustive
@given(sensor=sensors(), seed=st.integers(0, 2**32))
def test_an_image_comes_back_from_its_points(sensor, seed):
    """Centres of pixels lie in their pixels, whatever the sensor; ranges to float32 rounding."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(sensor.beams, sensor.columns, generator=generator)
    width = sensor.range_max_m - sensor.range_min_m
    range_m = sensor.range_min_m + width * (0.001 + 0.998 * share)
    range_m[torch.rand(range_m.shape, generator=generator) < 0.3] = EMPTY_RANGE_M
    projection = SphericalProjection(sensor)
    again, _ = range_image(points_of(range_m, projection), projection)
    torch.testing.assert_close(again, range_m, rtol=3e-7, atol=0)
    whole = unproject(range_m.clamp(min=2), projection)
    row, column = projection.pixel_of(whole)
    assert torch.equal(row, torch.arange(sensor.beams)[:, None].expand_as(row))
    assert torch.equal(column, torch.arange(sensor.columns).expand_as(column))
