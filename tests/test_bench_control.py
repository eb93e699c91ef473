"""The bench of control: its judges against facts known by hand, and a run with tiny networks."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from tiny_networks import SIT_ARGS, tiny_checkpoint, tiny_networks

from r3dpa.bench.control import ControlSettings, Part, control
from r3dpa.bench.control_report import Finding, mean_of, share_of, sheet_of, write_control
from r3dpa.bench.control_scans import CAR, ScanDesk, View, cell_cosine, free_place, points_inside
from r3dpa.cli import main
from r3dpa.data import Scan, kitti360_scans, write_bin
from r3dpa.data.objects import ObjectLibrary, object_library
from r3dpa.editing import EditSettings
from r3dpa.generation import SamplerConfig, SceneGenerator
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection, points_of
from r3dpa.nn import SiT
from r3dpa.nn.backbones import feature_source

SENSOR = LidarSensor(beams=16, columns=64, range_min_m=1.0, range_max_m=50.0)
PROJECTION = SphericalProjection(SENSOR)
GEOMETRY = ScanGeometry(PROJECTION, RangeCodec(), (2, 8))
ROAD, WALL = 7, 11
SETTINGS = ControlSettings(edit=EditSettings(steps=4)).quick()


def street(turn: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Ranges and classes ``(H, W)`` of a road with walls at 20 m, and a car ahead of a column."""
    inclination, azimuth = PROJECTION.ray_angles()
    ground = torch.where(inclination < 0, -1.73 / inclination.sin(), torch.inf)[:, None]
    wall = 20 / inclination.cos()[:, None]
    range_m = torch.minimum(ground, wall).expand(16, 64).clone()
    classes = torch.where(ground < wall, ROAD, WALL).expand(16, 64).clone()
    ahead = (azimuth - turn).cos() > math.cos(math.radians(20))
    car = ahead & ((inclination > math.radians(-15)) & (inclination < math.radians(-2)))[:, None]
    range_m[car], classes[car] = 6.0, CAR
    return range_m.float(), classes


def write_street(root: Path, drive: str, frame: int, turn: float) -> None:
    range_m, classes = street(turn)
    folder = root / "data_3d_raw" / f"2013_05_28_drive_{drive}_sync" / "velodyne_points"
    for name in ("data", "labels"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    points = torch.zeros(16 * 64, 4)
    points[:, :3] = points_of(range_m, PROJECTION)
    order = PROJECTION.column_order()
    labels = classes[:, order].flatten().numpy().astype(np.uint32)
    # A scan lists its points in any order; their labels go with them.
    shuffled = torch.randperm(len(points), generator=torch.Generator().manual_seed(frame))
    write_bin(folder / "data" / f"{frame:010d}.bin", points[shuffled])
    labels[shuffled.numpy()].tofile(folder / "labels" / f"{frame:010d}.label")


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("control") / "streets"
    for drive, frames in (("0003", 4), ("0000", 4)):
        for frame in range(frames):
            write_street(root, drive, frame, turn=0.3 * frame)
    return root


@pytest.fixture(scope="module")
def networks():
    return tiny_networks(spread=0.05)


@pytest.fixture(scope="module")
def generator(networks):
    return SceneGenerator(*networks, GEOMETRY, SamplerConfig("heun", steps=3))


@pytest.fixture(scope="module")
def desk(generator):
    return ScanDesk(generator, feature_source("geometric", dim=8))


@pytest.fixture(scope="module")
def library(data, desk, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("library") / "objects.safetensors"
    scans = kitti360_scans(data, "train")
    object_library(scans, desk.extractor, PROJECTION, (2, 8), ["car", "road"]).save(path)
    return path


@pytest.fixture(scope="module")
def run(generator, data, library, tmp_path_factory):
    """Folder and text of all parts."""
    out = tmp_path_factory.mktemp("found") / "control"
    return out, control(generator, "geometric", data, library, out, SETTINGS, about={"file": "x"})


class TestJudges:
    def test_cosine_counts_cells_that_both_have_and_that_are_asked_for(self):
        first = torch.tensor([[1.0, 0], [0, 2], [0, 0], [3, 0]])
        second = torch.tensor([[2.0, 0], [5, 0], [1, 0], [-1, 0]])
        assert cell_cosine(first, second) == pytest.approx((1 + 0 - 1) / 3)
        tokens = torch.tensor([True, True, True, False])
        assert cell_cosine(first, second, tokens) == pytest.approx(0.5)
        assert math.isnan(cell_cosine(first, second, torch.tensor([False, False, True, False])))

    def test_body_of_a_car_is_4_2_by_1_8_by_1_3_metres(self):
        centre = (8.0, -2.0, -0.8)
        inside = [[8 + 2.09, -2, -0.8], [8, -2.89, -0.8], [8, -2, -0.8 + 0.64], [6, -1.2, -1.4]]
        outside = [[8 + 2.11, -2, -0.8], [8, -2.91, -0.8], [8, -2, -0.8 + 0.66], [0, 0, 0]]
        found = points_inside(torch.tensor(inside + outside), centre)
        assert found.tolist() == [True] * 4 + [False] * 4

    def test_free_places_are_visible_and_empty(self, generator, desk, data):
        view = desk.read(kitti360_scans(data, "val")[0])
        random = torch.Generator().manual_seed(0)
        for _ in range(5):
            place = free_place(view, random, generator)
            assert not points_inside(view.points[:, :3], place.centre_m).any()
            assert 6 <= math.hypot(*place.centre_m[:2]) <= 14
            azimuth = math.atan2(place.centre_m[1], place.centre_m[0])
            assert abs(azimuth) > math.radians(20)  # there stands the car, at 6 m
            assert place.pixels.sum() >= 8

    def test_behind_a_wall_no_place_is_free(self, generator):
        range_m = torch.full((16, 64), 3.0)
        points = torch.nn.functional.pad(points_of(range_m, PROJECTION), (0, 1))
        view = View(Scan("0000", "0", Path("wall")), points, range_m)
        assert free_place(view, torch.Generator().manual_seed(0), generator) is None

    def test_labels_go_with_the_points_of_the_range_image(self, desk, data):
        for scan in kitti360_scans(data, "val")[:2]:
            points, cars = desk.labelled(scan, CAR)
            ranges = points[:, :3].norm(dim=1)
            assert cars.any()
            assert (ranges[cars] - 6).abs().max() < 1e-4
            lowest = points[:, 2] / ranges
            behind = points[:, 0] < 0
            assert not cars[behind].any()
            assert not cars[lowest > math.sin(math.radians(-1))].any()

    def test_probe_tells_cars_of_these_streets(self, desk, data):
        probe = desk.fit_probe(kitti360_scans(data, "train"))
        for scan in kitti360_scans(data, "val"):
            _, cars = desk.labelled(scan, CAR)
            _, told = desk.classes(desk.read(scan).range_m, probe)
            assert (told == cars).double().mean() > 0.9

    def test_probe_needs_its_class(self, desk, data):
        with pytest.raises(ValueError, match="shows class 24"):
            desk.fit_probe(kitti360_scans(data, "train"), label=24)

    def test_a_scene_without_returns_is_told(self, desk):
        with pytest.raises(ValueError, match="no return"):
            desk.again(torch.full((16, 64), -1.0))


class TestIntervals:
    def test_mean_leaves_unknown_values_out(self):
        found = mean_of([2.0, 2.0, math.nan, 2.0])
        assert (found.value, found.low, found.high) == (2, 2, 2)
        spread = mean_of([0.0, 1.0, 2.0, 3.0])
        assert spread.low < spread.value == 1.5 < spread.high

    def test_share_is_that_of_the_sums(self):
        found = share_of([1.0, 0.0, 3.0], [2.0, 0.0, 8.0])
        assert found.value == pytest.approx(0.4)  # the mean of the shares is 0.4375
        assert found.low <= 0.4 <= found.high
        assert math.isnan(share_of([0.0, 0.0], [0.0, 0.0]).value)

    def test_sheets_show_the_first_eight(self):
        images = [torch.full((2, 2), float(case)) for case in range(10)]
        rows = sheet_of(("scan", images), ("made", images))
        assert [row.name for row in rows[:3]] == ["0: scan", "0: made", "1: scan"]
        assert [row.range_m[0, 0].item() for row in rows[::2]] == list(range(8))


class TestRun:
    def test_every_part_is_written(self, run):
        out, text = run
        content = json.loads((out / "control.json").read_text())
        assert list(content["parts"]) == list(get_args(Part))
        model = {"file": "x", "feature_source": "geometric", "objects": "objects.safetensors"}
        for part in content["parts"].values():
            assert part["model"] == model
            assert {"cpu", "load", "threads"} <= set(part["machine"])
        sheets = {f"control_{part}.png" for part in ("guided", "mix", "inpaint", "complete")}
        assert {path.name for path in out.iterdir()} == sheets | {"control.json", "control.md"}
        assert (out / "control.md").read_text().strip() == text.strip()
        for part in content["parts"].values():
            assert part["title"] in text

    def test_guidance_raises_what_it_asks_for(self, run):
        rows = json.loads((run[0] / "control.json").read_text())["parts"]["guided"]["rows"]
        column = "cosine of projected features"
        difference = rows["guided"][column]["value"] - rows["plain"][column]["value"]
        assert rows["difference"][column]["value"] == pytest.approx(difference, abs=1e-6)
        assert difference > 0

    def test_nothing_changes_outside_the_mask(self, run):
        notes = json.loads((run[0] / "control.json").read_text())["parts"]["inpaint"]["notes"]
        assert any("outside the mask: 0 m" in note for note in notes)

    def test_interpolation_of_this_road_is_better_than_untrained_networks(self, run):
        """Between two beams on flat ground 1 / range is linear in the sine of the inclination."""
        rows = json.loads((run[0] / "control.json").read_text())["parts"]["complete"]["rows"]
        error = {name: values["range MAE (m)"]["value"] for name, values in rows.items()}
        assert error["linear in 1 / range"] < error["bilinear"] < error["nearest beam"]

    def test_cost_of_a_guided_evaluation(self, run):
        """Features apart run the first block, one of three, twice more than one pass does."""
        rows = json.loads((run[0] / "control.json").read_text())["parts"]["cost"]["rows"]
        flop = {name: values["GFLOP"] for name, values in rows.items()}
        assert flop["plain, batch 8"] == pytest.approx(8 * flop["plain, batch 1"])
        for batch in (1, 8):
            plain, guided, apart = (
                flop[f"{name}, batch {batch}"]
                for name in ("plain", "guided", "guided, features apart")
            )
            assert plain < guided < apart < 2.5 * plain

    def test_parts_are_added_to_those_in_the_folder(self, run, tmp_path):
        finding = Finding("Another", {"row": {"a": 1.5, "b": mean_of([1.0, 1.0])}})
        (tmp_path / "control.json").write_text((run[0] / "control.json").read_text())
        text = write_control(tmp_path, "guided", finding, {"command": "again"}, PROJECTION)
        assert "| row | 1.5 | 1 (1..1) |" in text
        parts = json.loads((tmp_path / "control.json").read_text())["parts"]
        assert list(parts) == list(get_args(Part))
        assert (parts["guided"]["title"], parts["guided"]["command"]) == ("Another", "again")
        assert parts["mix"] == json.loads((run[0] / "control.json").read_text())["parts"]["mix"]
        (tmp_path / "control.json").write_text("[]")
        with pytest.raises(ValueError, match="is not of `r3dpa bench control`"):
            write_control(tmp_path, "guided", finding, {}, PROJECTION)

    def test_a_velocity_of_zero_comes_back_from_noise(self, networks, data, library, tmp_path):
        vae, _, norm = networks
        still = SceneGenerator(vae, SiT(**SIT_ARGS), norm, GEOMETRY)  # a fresh SiT stands still
        settings = replace(SETTINGS, parts=("round_trip",))
        control(still, "geometric", data, library, tmp_path, settings)
        content = json.loads((tmp_path / "control.json").read_text())
        rows = content["parts"]["round_trip"]["rows"]
        assert list(rows)[:3] == ["euler, 2 NFE", "euler, 4 NFE", "heun, 1 NFE"]
        for values in rows.values():
            assert values["RMSE of latents"]["value"] == 0
            assert values["range MAE beyond the VAE's (m)"]["value"] == 0


class TestRefusals:
    @pytest.mark.parametrize(
        ("source", "changes", "message"),
        [
            (None, {}, "without 3D features"),
            ("oracle", {}, "cannot be extracted again"),
            ("waffleiron-s", {}, "features of 'geometric'"),
            ("geometric", {"parts": ("mixing",)}, "no part mixing"),
        ],
    )
    def test_what_cannot_be_measured(
        self, generator, data, library, tmp_path, source, changes, message
    ):
        with pytest.raises(ValueError, match=message):
            control(generator, source, data, library, tmp_path, replace(SETTINGS, **changes))

    def test_data_of_one_split(self, generator, library, tmp_path):
        write_street(tmp_path / "one", "0003", 0, 0.0)
        settings = replace(SETTINGS, parts=("guided",))
        with pytest.raises(ValueError, match="0 scans of split val"):
            control(generator, "geometric", tmp_path / "one", library, tmp_path / "out", settings)

    def test_objects_without_a_car(self, generator, data, desk, tmp_path):
        scans = kitti360_scans(data, "train")
        objects = object_library(scans, desk.extractor, PROJECTION, (2, 8), ["road"])
        objects.save(tmp_path / "road.safetensors")
        assert ObjectLibrary.load(tmp_path / "road.safetensors").names == ("road",)
        with pytest.raises(ValueError, match="no 'car'"):
            control(generator, "geometric", data, tmp_path / "road.safetensors", tmp_path, SETTINGS)


def test_command(data, library, tmp_path, capsys):
    ckpt = tiny_checkpoint(
        tmp_path / "tiny.safetensors", GEOMETRY, step=7, feature_source="geometric"
    )
    words = ["--ckpt", ckpt, "--data", data, "--library", library, "--out", tmp_path / "out"]
    main(["bench", "control", *map(str, words), "--quick", "--parts", "[guided]"])
    assert "Scenes after the features" in capsys.readouterr().out
    content = json.loads((tmp_path / "out" / "control.json").read_text())
    assert list(content["parts"]) == ["guided"]
    assert content["parts"]["guided"]["model"]["step"] == 7
