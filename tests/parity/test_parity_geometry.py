"""Golden numbers of the official projection: every recorded output is compared."""

from __future__ import annotations

import hashlib
import json
import re

import numpy as np
import pytest
import torch

from r3dpa import viz
from r3dpa.geometry import (
    EMPTY_RANGE_M,
    LidarSensor,
    RangeCodec,
    SphericalProjection,
    in_range,
    points_of,
    pool_cells,
    range_image,
    unproject,
)


def sensor_of(config, size=None):
    beams, columns = config["size"] if size is None else size
    return LidarSensor(beams, columns, *config["fov"], *config["depth_range"])


def codec_of(config):
    encoding = "log2" if config["log_scale"] else "linear"
    return RangeCodec(encoding, config["depth_scale"], legacy_inverse=True)


def official(sensor):
    return SphericalProjection(sensor, legacy_seam=True)


def sign(mask):
    return torch.where(mask, 1, -1)


def encoded(results, codec, name, range_m, batch="out/"):
    """The image of an official sample and its mask; the first axis is the channel."""
    image = codec.encode(range_m)
    results[f"{batch}image_{name}"] = image
    results[f"{batch}mask_{name}"] = sign(codec.valid_mask(image))


def real_scan(folder, config):
    path = folder / config["scan_file"]
    if not path.is_file():
        pytest.skip(f"the real scan {path} is absent (KITTI, not redistributed)")
    content = path.read_bytes()
    assert hashlib.sha256(content).hexdigest() == config["scan_file_sha256"]
    return torch.from_numpy(np.frombuffer(content, np.float32).reshape(-1, 4).copy())


def pixel_coordinates(points, sensor):
    """Rows and columns as real numbers, by another route than the package: NumPy, degrees."""
    x, y, z = points.double().numpy().T
    top, bottom = sensor.inclination_max_deg, sensor.inclination_min_deg
    inclination = np.degrees(np.arctan2(z, np.sqrt(x * x + y * y)))
    azimuth = np.degrees(np.arctan2(y, x))
    rows = (top - inclination) / (top - bottom) * sensor.beams
    return rows, (180 - azimuth) / 360 * sensor.columns


# Distance to a row or column border, in pixels, within which float32 rounding in the official code
# may put a point next door.
BORDER = (1e-4, 1e-6)


def candidate_pixels(rows, columns, sensor, tolerances):
    """The pixels that points may fall into, four arrays of rows and columns; the seam wraps."""
    for row_shift in (-tolerances[0], tolerances[0]):
        for column_shift in (-tolerances[1], tolerances[1]):
            row = np.floor(rows + row_shift).clip(0, sensor.beams - 1).astype(int)
            yield row, np.floor(columns + column_shift).astype(int) % sensor.columns


def touched_by_border_points(points, sensor, tolerances=BORDER):
    """Pixels on either side of a border that is nearer to a point than so many pixels."""
    rows, columns = pixel_coordinates(points[in_range(points, sensor)], sensor)
    near = np.abs(np.round(rows) - rows) < tolerances[0]
    near |= np.abs(np.round(columns) - columns) < tolerances[1]
    touched = torch.zeros(sensor.beams, sensor.columns, dtype=torch.bool)
    for pixel in candidate_pixels(rows[near], columns[near], sensor, tolerances):
        touched[pixel] = True
    return touched


def nearest_of_pixels(points, range_m, projection):
    """Indices of the points that show in each pixel, several where they tie."""
    row, column = projection.pixel_of(points)
    distance = points.double().norm(dim=-1).float()
    winning = in_range(points, projection.sensor) & (distance == range_m[row, column])
    found: dict[tuple[int, int], list[int]] = {}
    for index in winning.nonzero().flatten().tolist():
        found.setdefault((int(row[index]), int(column[index])), []).append(index)
    return found


def moved_over_border(range_m, expected, points, sensor):
    """Pixels that differ because the official code put a point on a border next door.

    A level point of the second sensor lies exactly on the row border 4.0; the official formula,
    which subtracts from one in float32, puts it into row 3. All other points must agree, and every
    point must show in one of its candidate pixels, unless a nearer one hides it there.
    """
    moved = ~torch.isclose(range_m, expected, atol=1e-5, rtol=1e-5)
    assert not (moved & ~touched_by_border_points(points, sensor)).any()
    points = points[in_range(points, sensor)]
    distance = points.double().norm(dim=-1).float()
    rows, columns = pixel_coordinates(points, sensor)
    recorded = expected.where(expected > 0, torch.inf)
    shown = torch.full_like(distance, torch.inf)
    found = expected == EMPTY_RANGE_M
    for row, column in candidate_pixels(rows, columns, sensor, BORDER):
        shown = shown.minimum(recorded[row, column])
        same = torch.isclose(recorded[row, column], distance, atol=1e-5, rtol=1e-5)
        found[row[same], column[same]] = True
    assert (shown <= distance * (1 + 1e-5) + 1e-5).all()
    assert found.all()
    return moved


def test_projection_tiny(load_case, compare):
    case = load_case("projection_tiny")
    points, intensity = case["in/points"], case["in/intensity"]
    linear = case.config["linear"]
    sensors = {"": sensor_of(linear)}
    number = r"-?\d+(?:\.\d+)?"
    pattern = re.compile(rf"out/range(_(\d+)x(\d+)_fov({number})_({number})_depth({number}))")
    for match in filter(None, map(pattern.fullmatch, case.keys("out/"))):
        beams, columns = map(int, match.groups()[1:3])
        top, bottom, farthest = map(float, match.groups()[3:])
        nearest = linear["depth_range"][0]
        sensors[match.group(1)] = LidarSensor(beams, columns, top, bottom, nearest, farthest)

    results, exempt = {}, {}
    for suffix, sensor in sensors.items():
        projection, key = official(sensor), f"out/intensity{suffix}"
        range_m, values = range_image(points, projection, intensity[:, None])
        results |= {f"out/range{suffix}": range_m, key: values[0]}
        for pixel, tied in nearest_of_pixels(points, range_m, projection).items():
            assert results[key][pixel] in intensity[tied]
            if case[key][pixel] in intensity[tied]:  # take any of those that tie
                results[key][pixel] = case[key][pixel]
        moved = moved_over_border(range_m, case[f"out/range{suffix}"], points, sensor)
        exempt |= {f"out/range{suffix}": moved, key: moved}
    range_m, moved = results["out/range"], exempt["out/range"]
    results["out/remission_variant"] = torch.where(
        range_m == EMPTY_RANGE_M, EMPTY_RANGE_M, results["out/intensity"]
    )
    exempt["out/remission_variant"] = moved
    for name, config in case.config.items():
        codec = codec_of(config)
        encoded(results, codec, name, range_m[None])
        encoded(results, codec, name, case["in/special_ranges"][None], batch="out/special_")
        exempt |= {f"out/image_{name}": moved, f"out/mask_{name}": moved}
    decoded = codec_of(linear).decode(case["out/image_linear"][0], sensors[""])
    results["out/reproj_linear_all"] = points_of(
        decoded.double(), official(sensors[""]), corner=True
    )
    compare(case, results, exempt)


def test_projection_scan(load_case, real_scans_dir, close, compare):
    case = load_case("projection_scan")
    scan = real_scan(real_scans_dir, case.config)
    points, intensity = scan[:, :3], scan[:, 3:]
    assert len(scan) == case["in/n_points"]
    close(points.double().mean(dim=0), case["in/points_mean"])

    sensor = sensor_of(case.config["linear"])
    projection = official(sensor)
    near_border, tied = case["out/near_border_mask"], case["out/intensity_tie_mask"]
    range_m, values = range_image(points, projection, intensity)
    results = {"out/range": range_m, "out/intensity": values[0]}
    exempt = {"out/range": near_border, "out/intensity": near_border | tied}

    for name, codec in ((name, codec_of(case.config[name])) for name in ("linear", "log")):
        encoded(results, codec, name, range_m[None])
        exempt |= {f"out/image_{name}": near_border, f"out/mask_{name}": near_border}
        results[f"out/depth_thresh_{name}"] = torch.tensor(codec.threshold)
        # From here on the recorded image is the input, so that no pixel need be exempt.
        image = case[f"out/image_{name}"][0]
        decoded = codec.decode(image, sensor).double()
        cloud = points_of(decoded, projection, corner=True)
        prefix = f"out/reproj_{name}"
        index = case[f"{prefix}_index"]
        results |= {
            f"{prefix}_count": torch.tensor(len(cloud)),
            f"{prefix}_mean": cloud.mean(dim=0),
            f"{prefix}_std": cloud.std(dim=0, correction=0),
            f"{prefix}_index": index[(index >= 0) & (index < len(cloud))],
            f"{prefix}_points": cloud[index],
        }
        xyz = unproject(decoded, projection, corner=True)
        xyz = torch.where((decoded == EMPTY_RANGE_M)[..., None], EMPTY_RANGE_M, xyz)
        rows, columns = case["in/range2xyz_rows"], case["in/range2xyz_cols"]
        prefix = f"out/range2xyz_{name}"
        results[f"{prefix}_sub"] = xyz[rows][:, columns].permute(2, 0, 1)
        results[f"{prefix}_mean"] = xyz.mean(dim=(0, 1))
        results[f"{prefix}_depth_mean"] = codec.to_range(image).double().mean()

    # The masks follow from the points: certainly those within 1e-4 of a border (a float32
    # rounding error), and nothing farther than one pixel from a point within 2e-3.
    certain = touched_by_border_points(points, sensor, (1e-4, 1e-4))
    possible = touched_by_border_points(points, sensor, (2e-3, 2e-3))
    possible = torch.nn.functional.max_pool2d(possible[None].float(), 3, 1, 1)[0].bool()
    results["out/near_border_mask"] = (near_border | certain) & possible
    results["out/intensity_tie_mask"] = torch.zeros_like(tied)
    for pixel, indices in nearest_of_pixels(points, range_m, projection).items():
        results["out/intensity_tie_mask"][pixel] = tied[pixel] & (len(indices) > 1)
    compare(case, results, exempt)


def test_generate_postprocess(load_case, parity_dir, compare):
    case = load_case("generate_postprocess")
    # The case refers to the configuration of the scan case in the same file.
    cases = json.loads((parity_dir / "cases.json").read_text())
    configs = cases.get("projection_scan", cases["projection_tiny"])["config"]
    decoded = case["in/decoded"][:, 0]
    sensor = sensor_of(
        configs["linear"] | {"depth_range": case.config["eval_depth_range"]}, decoded.shape[1:]
    )
    projection = official(sensor)
    pictures = np.stack([viz.encoded_picture(image) for image in decoded])
    results = {"out/png_uint8": torch.from_numpy(pictures)[:, None]}
    for name in ("linear", "log"):
        codec = codec_of(configs[name])
        range_m = codec.decode(decoded, sensor)
        empty = range_m == EMPTY_RANGE_M
        xyz = unproject(range_m, projection, corner=True).movedim(-1, 1)
        xyz = torch.where(empty[:, None], EMPTY_RANGE_M, xyz)
        zeros = torch.zeros_like(range_m)[:, None]
        results[f"out/{name}/dxyzi"] = torch.cat(
            [codec.to_range(decoded)[:, None], xyz, zeros], dim=1
        )
        results[f"out/{name}/eval_range_images"] = torch.cat([range_m[:, None], zeros], dim=1)
        for index, clipped in enumerate(codec.decode(decoded.clamp(-1, 1), sensor)):
            results[f"out/{name}/pcd_txt_{index}"] = points_of(
                clipped.double(), projection, corner=True
            )
            results[f"out/{name}/eval_pcd_{index}"] = points_of(
                range_m[index], projection, corner=True
            )
    compare(case, results)


def grid_sensor(config):
    """Sensor whose cells are 8 x 16 pixels, as in R3DPA."""
    grid_rows, grid_columns = config["grid_size"]
    return LidarSensor(8 * grid_rows, 16 * grid_columns, *config["fov"])


def test_feature_grid(load_case, compare):
    case = load_case("feature_grid")
    points, features = case["in/points"], case["in/features"]
    grid_rows, grid_columns = case.config["grid_size"]
    projection = official(grid_sensor(case.config))

    def tokens(points):
        row, column = projection.pixel_of(points)
        return row // 8, column // 16

    token_y, token_x = tokens(points)
    extra_y, extra_x = tokens(case["in/extra_points"])
    means, counts = pool_cells(
        points, features, projection, (grid_rows, grid_columns), range_filter=False
    )
    results = {
        "out/token_x": token_x,
        "out/token_y": token_y,
        "out/token_index": token_y * grid_columns + token_x,
        "out/extra_token_x": extra_x,
        "out/extra_token_y": extra_y,
        "out/count_per_cell": counts,
    }
    # float32 rounding may put a point on a cell border next door, and change those two cells.
    expected = case["out/token_index"]
    moved = results["out/token_index"] != expected
    rows, columns = pixel_coordinates(
        points[moved], LidarSensor(grid_rows, grid_columns, *case.config["fov"])
    )
    to_border = np.minimum(np.abs(rows - np.round(rows)), np.abs(columns - np.round(columns)))
    assert (to_border < 1e-4).all()
    cells = torch.zeros(grid_rows * grid_columns, dtype=torch.bool)
    cells[results["out/token_index"][moved]] = True
    cells[expected[moved]] = True
    exempt = {f"out/token_{key}": moved for key in ("x", "y", "index")}
    exempt["out/count_per_cell"] = cells
    results["out/grid"] = torch.where(cells[:, None], case["out/grid"], means.double())
    compare(case, results, exempt)
