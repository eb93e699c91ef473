"""Scans as images of R2DM and R2Flow, against numbers of their released code."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from recorded_networks import check

from r3dpa.baselines.efficient_unet import hdl64e_angles
from r3dpa.geometry import (
    LidarSensor,
    RangeCodec,
    RingProjection,
    SphericalProjection,
    in_range,
    range_image,
    unproject,
)


@pytest.fixture(scope="module")
def lidar(baseline_case):
    case = baseline_case("r2dm_r2flow_lidar")
    config = case.config
    limits = config["min_depth"], config["max_depth"]
    return case, LidarSensor(config["H"], config["W"], 3.0, -25.0, *limits)


def test_r2dm_r2flow_lidar_projections(lidar):
    case, sensor = lidar
    points = case["in/points"]
    distance = points[:, :3].norm(dim=1, keepdim=True)
    inside = in_range(points[:, :3], sensor)[:, None].float()
    values = torch.cat([points, distance, inside], dim=1)
    rings = RingProjection(sensor, (0.0,) * sensor.beams, legacy_rows=True, legacy_hiding=True)
    spherical = SphericalProjection(sensor, legacy_hiding=True)
    for name, projection in (("spherical", spherical), ("unfolding", rings)):
        range_m, image = range_image(points[:, :3], projection, values)
        decided = torch.ones(sensor.beams, sensor.columns, dtype=torch.bool)
        if name == "spherical":
            decided = ~pixels_decided_by_rounding(points[:, :3], sensor)
        recorded = case[f"out/{name}_raw"].permute(2, 0, 1)[:, decided]
        torch.testing.assert_close(image[:, decided], recorded, atol=1e-5, rtol=1e-6)
        recorded = case[f"out/{name}"][:, decided]
        torch.testing.assert_close((image * image[5])[:, decided], recorded, atol=1e-5, rtol=1e-6)
        assert torch.equal(range_m > 0, image[5] == 1)


def pixels_decided_by_rounding(points, sensor):
    """Pixels ``(H, W)`` that take or lose a point by the float32 angles of the official code.

    Its arcsin and arctan2 are those of NumPy in float32, which differ between processors in the
    last digit: a point that close to the border of two pixels belongs to either.
    """
    last_digits = 1e-6  # radians
    points = points.double()
    inclination = torch.atan2(points[:, 2], points[:, :2].norm(dim=1))
    azimuth = torch.atan2(points[:, 1], points[:, 0])
    height = sensor.field_of_view_rad / sensor.beams
    width = 2 * math.pi / sensor.columns
    undecided = torch.zeros(sensor.beams, sensor.columns, dtype=torch.bool)
    rows, columns = (
        torch.stack([((start - angle + side) / pitch).floor().long() for side in sides])
        for start, angle, pitch, sides in (
            (sensor.inclination_max_rad, inclination, height, (-last_digits, last_digits)),
            (math.pi, azimuth, width, (-last_digits, last_digits)),
        )
    )
    rows, columns = rows.clamp(0, sensor.beams - 1), columns % sensor.columns
    either = (rows[0] != rows[1]) | (columns[0] != columns[1])
    for row in rows:
        for column in columns:
            undecided[row[either], column[either]] = True
    return undecided


@pytest.mark.parametrize(("up", "down"), [(3, -25), (2, -24.8), (15, -15)])
def test_spherical_projection_of_rings_on_row_borders(up, down):
    """float32 decides where a ring lies on the border of two rows, and nowhere else."""
    sensor = LidarSensor(16, 64, up, down, 1.45, 80.0)
    border = math.radians(up - (up - down) / 4)  # between rows 3 and 4
    inclination = np.linspace(border, border - sensor.field_of_view_rad / 2, 8).repeat(80)
    azimuth = np.tile(np.linspace(0, 2 * np.pi, 80, endpoint=False) + 0.01, 8)
    distance = np.random.default_rng(0).uniform(2, 70, inclination.size)
    x = distance * np.cos(inclination) * np.cos(azimuth)
    y = distance * np.cos(inclination) * np.sin(azimuth)
    points = np.stack([x, y, distance * np.sin(inclination)], axis=1).astype(np.float32)
    height = np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)) - math.radians(down)
    row = np.floor((1 - height / math.radians(up - down)) * 16).clip(0, 15).astype(int)
    column = np.floor((-np.arctan2(points[:, 1], points[:, 0]) / np.pi + 1) / 2 % 1 * 64).astype(
        int
    )
    rows, columns = SphericalProjection(sensor).pixel_of(torch.from_numpy(points))
    differs = (rows.numpy() != row) | (columns.numpy() != column)
    undecided = pixels_decided_by_rounding(torch.from_numpy(points), sensor)
    assert 0 < differs.sum() < 2 * 80
    assert undecided[row[differs], column[differs]].all()
    assert undecided[rows, columns].numpy()[differs].all()
    assert undecided.float().mean() < 0.3


def codecs(sensor):
    """By names in R2DM and R2Flow."""
    farthest = torch.tensor(sensor.range_max_m + 1.0).double().log2().item()
    return {
        ("log_depth", "logscale"): RangeCodec("log2", farthest, offset_m=0.0),
        ("inverse_depth", "inverse"): RangeCodec("inverse", sensor.range_min_m),
        ("depth", "metric"): RangeCodec("linear", sensor.range_max_m),
    }


def test_r2dm_r2flow_lidar_codecs(lidar):
    """Values in [0, 1] of R2DM and in [-1, 1] of R2Flow, at all pixels and at the limits."""
    case, sensor = lidar
    scan = case["out/spherical"][None, 4:5]

    def valid(metric):
        inside = (metric > sensor.range_min_m) & (metric < sensor.range_max_m)
        return torch.where(inside, metric, -1.0)

    for (r2dm, r2flow), codec in codecs(sensor).items():
        for edge, metric, images in (
            ("", scan, None),
            ("edge_", case["in/edge_metric"], 2 * case["in/edge_normalized"] - 1),
        ):
            encoded = codec.encode(valid(metric))
            check(case, f"out/r2dm_{edge}convert_{r2dm}", (encoded + 1) / 2)
            check(case, f"out/r2flow_{edge}convert_{r2flow}", encoded)
            image = encoded if images is None else images
            back = codec.decode(image, sensor).clamp(min=0)
            check(case, f"out/r2dm_{edge}revert_{r2dm}", back)
            check(case, f"out/r2flow_{edge}restore_{r2flow}", back)
    check(case, "out/r2dm_mask", (valid(scan) > 0).float())


def test_r2dm_r2flow_lidar_rays(lidar):
    case, sensor = lidar
    projection = SphericalProjection(sensor)
    angles = torch.stack(torch.meshgrid(*projection.ray_angles(corner=True), indexing="ij"))
    check(case, "out/r2dm_ray_angles", angles[None])
    check(case, "out/r2dm_ray_angles", hdl64e_angles((sensor.beams, sensor.columns)))
    fine = hdl64e_angles((64, 2048))
    size = sensor.beams, sensor.columns
    resized = F.interpolate(fine, size=size, mode="nearest-exact")
    check(case, "out/ray_angles_resized_from_64x2048", resized)
    full = hdl64e_angles((64, 1024))[0][:, [0, 1, 63]][..., [0, 1, 512, 1023]]
    check(case, "out/hdl64e_angles_64x1024_rows0_1_63_cols0_1_512_1023", full)
    scan = case["out/spherical"][4]
    inside = (scan > sensor.range_min_m) & (scan < sensor.range_max_m)
    xyz = unproject(torch.where(inside, scan, -1.0), projection, corner=True).permute(2, 0, 1)
    check(case, "out/r2dm_to_xyz", xyz[None])
    check(case, "out/r2flow_convert_cartesian", xyz[None])
    check(case, "out/r2flow_restore_cartesian", xyz.norm(dim=0)[None, None] * inside)


# Checkpoints, average
