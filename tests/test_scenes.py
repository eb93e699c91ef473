"""Batches of scenes: parts, files, pages and pictures."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from r3dpa.data import read_scan
from r3dpa.data.scene_writer import SceneWriter
from r3dpa.editing import EditResult
from r3dpa.geometry import LidarSensor, Pixels, SphericalProjection, points_of
from r3dpa.scenes import Scene, SceneBatch, scan_pixels

PROJECTION = SphericalProjection(LidarSensor(beams=16, columns=64))


@pytest.fixture
def labelled():
    """Three scenes with a fifth of the pixels empty."""
    random = torch.Generator().manual_seed(0)
    returns = torch.rand(3, 16, 64, generator=random) > 0.2
    range_m = torch.where(returns, 5 + 20 * torch.rand(3, 16, 64, generator=random), -1.0)
    intensity = torch.where(returns, torch.rand(3, 16, 64, generator=random), 0.0)
    labels = torch.where(returns, 26, 0)
    return SceneBatch(range_m, torch.zeros(3, 4, 4, 16), 8, PROJECTION, intensity, labels)


@pytest.fixture
def edited(labelled):
    return EditResult(labelled.range_m, labelled.latents, 8, PROJECTION, cosine=torch.arange(3.0))


def test_a_batch_is_a_sequence_of_scenes(labelled):
    assert len(labelled) == len(list(labelled)) == 3
    for index, scene in enumerate(labelled):
        assert isinstance(scene, Scene)
        assert scene.points.equal(points_of(labelled.range_m[index], PROJECTION))
        assert scene.points.equal(labelled.points(index))
        assert scene.point_intensity.equal(labelled.point_intensity(index))
        assert scene.point_labels.tolist() == [26] * len(scene.points)
    assert labelled[-1].range_m.equal(labelled.range_m[2])
    with pytest.raises(IndexError):
        labelled[3]


def test_a_slice_has_every_part(labelled, edited):
    assert type(labelled[1:]) is SceneBatch
    assert labelled[1:].labels.equal(labelled.labels[1:])
    assert type(edited[:2]) is EditResult
    assert edited[1:].cosine.tolist() == [1.0, 2.0]
    assert edited[1:].intensity is None


@pytest.mark.parametrize(
    "some", [[2, 0], np.array([2, 0]), torch.tensor([2, 0]), np.array([True, False, True])]
)
def test_some_of_the_scenes_are_a_batch(labelled, some):
    chosen = labelled[some]
    assert type(chosen) is SceneBatch
    assert chosen.range_m.equal(labelled.range_m[torch.as_tensor(some)])
    assert len(chosen.latents) == len(chosen.labels) == 2


def test_a_selection_may_be_empty(labelled):
    for none in ([], np.array([]), slice(0)):
        assert len(labelled[none]) == 0
        assert labelled[none]._repr_png_() is None


@pytest.mark.parametrize("number", [np.int64(1), torch.tensor(1)])
def test_the_number_of_a_scene_may_be_of_numpy_or_torch(labelled, number):
    assert isinstance(labelled[number], Scene)
    assert labelled[number].range_m.equal(labelled.range_m[1])


@pytest.mark.parametrize("wrong", [None, 1.0, "1", (0, 1)])
def test_what_is_no_number_of_a_scene_selects_none(labelled, wrong):
    with pytest.raises(TypeError):
        labelled[wrong]


def test_reprs_are_one_line(labelled, edited):
    assert repr(labelled) == (
        "SceneBatch(3 scenes, 16 x 64 pixels of range, intensity, labels, 8 evaluations each)"
    )
    assert repr(edited) == "EditResult(3 scenes, 16 x 64 pixels of range, 8 evaluations each)"
    assert repr(edited[0]) == f"Scene({len(edited[0].points)} points, 16 x 64 pixels of range)"


@pytest.mark.parametrize("image", [torch.full((16, 64), 7000.0), torch.full((16, 64), -1.0)])
def test_an_image_in_millimetres_or_without_a_return_is_no_scan(image):
    with pytest.raises(ValueError, match=r"no return within 1\.\.56 m; ranges must be metres"):
        scan_pixels(image, PROJECTION)


def test_returns_beyond_the_limits_are_left_out_as_of_points():
    image = torch.full((16, 64), 20.0)
    image[0], image[1], image[2] = 56.0, 1.0, -1.0  # no point at a limit has a pixel
    for scan in (image, Pixels(image)):
        range_m = scan_pixels(scan, PROJECTION).range_m
        assert (range_m[:3] == -1).all()
        assert (range_m[3:] == 20).all()


def test_labels_of_points_are_refused_where_a_scan_has_pixels(labelled):
    image = torch.full((16, 64), 20.0)
    for scan in (image, Pixels(image), labelled[0]):
        with pytest.raises(ValueError, match="labels are of points, but the scan is a range"):
            scan_pixels(scan, PROJECTION, np.full(1024, 26))


def test_scenes_that_are_no_scan_of_these_images(labelled):
    sensor = PROJECTION.sensor
    for wrong, message in (
        (labelled, r"one scene, got 3: give one of them, as scenes\[0\]"),
        (Pixels(torch.full((8, 64), 10.0)), r"must be \(16, 64\), got shape \(8, 64\)"),
        (Scene(torch.full((16, 64), math.nan), PROJECTION), "has NaN or infinite values"),
        (Scene(torch.full((16, 64), -1.0), PROJECTION), f"within {sensor.range_min_m:g}"),
    ):
        with pytest.raises(ValueError, match=message):
            scan_pixels(wrong, PROJECTION)


def test_a_scene_of_another_sensor_is_read_by_its_points():
    """Its rows look 2 degrees higher, more than a row; read as an image, ranges would stay."""
    sensor = replace(PROJECTION.sensor, inclination_max_deg=5.0, inclination_min_deg=-23.0)
    range_m = torch.arange(16.0)[:, None].expand(16, 64) + 10
    labels = torch.full((16, 64), 7)
    scene = Scene(range_m, SphericalProjection(sensor), range_m / 100, labels)
    pixels = scan_pixels(scene, PROJECTION)
    points = torch.cat([scene.points, scene.point_intensity[:, None]], dim=1)
    expected = scan_pixels(points, PROJECTION, scene.point_labels)
    for values, others in zip(pixels, expected, strict=True):
        assert values.equal(others)
    assert not pixels.range_m.equal(range_m)
    assert scan_pixels(replace(scene, projection=PROJECTION), PROJECTION).range_m.equal(range_m)


def test_a_scan_that_looks_beyond_the_field_of_view_is_warned_of(recwarn):
    """Rays 10 degrees above the highest one: a fifth of the points is no reason, a third is."""
    points = points_of(torch.full((16, 64), 10.0), PROJECTION)
    rise = math.radians(PROJECTION.sensor.inclination_max_deg + 10)
    above = torch.tensor([10 * math.cos(rise), 0.0, 10 * math.sin(rise)])
    scan_pixels(torch.cat([points, above.expand(len(points) // 4, 3)]), PROJECTION)
    assert not recwarn.list
    with pytest.warns(UserWarning, match="33% of the points of the scan lie above or below"):
        scan_pixels(torch.cat([points, above.expand(len(points) // 2, 3)]), PROJECTION)


def test_saved_scenes_are_those_of_a_sample(labelled, tmp_path):
    folder = labelled.save(tmp_path / "scenes", ("bin", "npz"))
    assert folder == tmp_path / "scenes"
    assert np.array_equal(np.load(folder / "range_m.npy"), labelled.range_m.numpy())
    points = read_scan(folder / "bin" / "000001.bin")
    assert np.array_equal(points[:, :3], labelled[1].points.numpy())
    assert np.array_equal(points[:, 3], labelled[1].point_intensity.numpy())
    assert (folder / "labels" / "000002.label").stat().st_size == 4 * len(labelled[2].points)
    with pytest.raises(ValueError, match="holds scenes already"):
        labelled.save(folder)
    with pytest.raises(ValueError, match=r"metadata\.json is a file; give a folder"):
        labelled.save(folder / "metadata.json")
    labelled[:1].save(folder, overwrite=True)
    assert len(np.load(folder / "range_m.npy")) == 1
    diverged = replace(labelled, range_m=torch.full_like(labelled.range_m, torch.nan))
    with pytest.raises(ValueError, match="hold NaN"):
        diverged.save(folder, overwrite=True)
    assert len(np.load(folder / "range_m.npy")) == 1


def test_scenes_that_a_killed_call_left_are_replaced(labelled, tmp_path, monkeypatch):
    """Without metadata, they may be of other scenes."""
    with monkeypatch.context() as patched:
        patched.setattr(SceneWriter, "finish", killed)
        with pytest.raises(KeyboardInterrupt):
            labelled.save(tmp_path / "scenes")
    folder = labelled[1:].save(tmp_path / "scenes")
    assert np.array_equal(np.load(folder / "range_m.npy"), labelled.range_m[1:])
    assert not (folder / "bin" / "000002.bin").exists()


def killed(*_):
    raise KeyboardInterrupt


def test_unknown_formats_are_refused_before_anything_is_written(labelled, tmp_path):
    with pytest.raises(ValueError, match="unknown format 'pcd'; choose from bin, ply, npz"):
        labelled.save(tmp_path / "made", formats=("bin", "pcd"))
    assert not (tmp_path / "made").exists()
    labelled.save(tmp_path / "made", formats="ply")
    assert len(list((tmp_path / "made" / "ply").iterdir())) == 3


def test_a_notebook_shows_pictures_and_a_page(labelled, edited):
    assert labelled._repr_png_().startswith(b"\x89PNG")
    for batch in (labelled, edited):
        shown = batch.show().data
        assert "<iframe srcdoc=" in shown
        assert "scene 2" in shown


@pytest.mark.parametrize(
    ("module", "call", "message"),
    [
        ("IPython.display", "show", "needs IPython: pip install ipykernel"),
        ("open3d", "to_open3d", "needs Open3D: pip install open3d"),
    ],
)
def test_absent_packages_are_named(labelled, monkeypatch, module, call, message):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=message):
        getattr(labelled, call)()


def test_open3d_gets_points_and_intensities(labelled, edited, monkeypatch):
    """A stand-in for the package, which is large."""
    utility = SimpleNamespace(Vector3dVector=lambda values: values)
    geometry = SimpleNamespace(PointCloud=SimpleNamespace)
    monkeypatch.setitem(sys.modules, "open3d", SimpleNamespace(utility=utility, geometry=geometry))
    cloud = labelled.to_open3d()[1]
    assert np.array_equal(cloud.points, labelled[1].points.double().numpy())
    assert np.array_equal(cloud.colors[:, 2], labelled[1].point_intensity.double().numpy())
    assert not hasattr(edited.to_open3d()[0], "colors")
