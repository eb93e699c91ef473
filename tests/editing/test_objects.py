from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from lidarsim import Semantic
from lidarsim.clouds import read_cloud
from lidarsim.conversion import convert
from lidarsim.sweep import Origin
from lidarsim.weather import ADDED_CLASS
from r3dpa.data import Scan, ScanError, write_bin
from r3dpa.data.labels import (
    CLASS_NAMES,
    classes_as_of_cloud,
    find_labels,
    labels_of_cloud,
    read_labels,
)
from r3dpa.editing import EditResult, most_like_first
from r3dpa.editing.objects import ObjectClass, ObjectLibrary, object_library
from r3dpa.geometry import (
    SEMANTIC_CLASSES,
    LidarSensor,
    Pixels,
    RingProjection,
    SphericalProjection,
)
from r3dpa.scenes import scan_pixels

CAR, ROAD = 26, 7
SENSOR = LidarSensor(beams=4, columns=8, inclination_max_deg=20, inclination_min_deg=-20)
PROJECTION = SphericalProjection(SENSOR)


def write_scan(root, frame, points, labels):
    folder = root / "velodyne_points"
    path = folder / "data" / f"{frame}.bin"
    write_bin(path, np.asarray(points, dtype=np.float32))
    (folder / "labels").mkdir(exist_ok=True)
    (folder / "labels" / f"{frame}.label").write_bytes(np.array(labels, "<u4").tobytes())
    return Scan("drive", frame, path)


def test_names_are_those_of_the_simulator():
    unnamed = (Semantic.UNLABELED, Semantic.EGO_VEHICLE)
    for semantic in set(Semantic) - set(unnamed):
        name = semantic.name.lower().replace("_", "")
        assert CLASS_NAMES[semantic].replace(" ", "") == name


def test_semantic_kitti_becomes_kitti_360(tmp_path):
    scan = tmp_path / "velodyne" / "000001.bin"
    path = tmp_path / "labels" / "000001.label"
    path.parent.mkdir()
    # A car, one that moves, a trunk, a lane marking, an outlier.
    path.write_bytes(np.array([10 | 5 << 16, 252, 71, 60, 1], dtype="<u4").tobytes())
    labels = read_labels(scan, 5)
    assert (labels >> 16).tolist() == [5, 0, 0, 0, 0]
    names = [CLASS_NAMES.get(label) for label in (labels & 0xFFFF).tolist()]
    assert names == ["car", "car", "vegetation", "road", None]

    path.write_bytes(np.array([10, 10, 10, 10, 12], dtype="<u4").tobytes())
    with pytest.raises(ScanError, match=r"000001\.label holds \[12\], which are no classes"):
        read_labels(scan, 5)
    path.write_bytes(bytes(12))
    with pytest.raises(ScanError, match=r"000001\.label: holds 3 labels but .* 5 points"):
        read_labels(scan, 5)


def test_classes_go_back_to_the_ids_of_their_file(tmp_path):
    scan, car = tmp_path / "velodyne" / "000001.bin", 26
    write_bin(scan, [[10, 0, 0, 0.5], [0, 10, 0, 0.5], [0, -10, 0, 0.5]])
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "000001.label").write_bytes(np.array([10, 40, 50], "<u4").tobytes())
    cloud = read_cloud(scan)
    labels = labels_of_cloud(cloud)
    assert [CLASS_NAMES[label] for label in labels] == ["car", "road", "building"]
    assert classes_as_of_cloud(labels, cloud).tolist() == [10, 40, 50]
    assert classes_as_of_cloud(np.array([0, 38, car]), cloud).tolist() == [0, 0, 10]  # 38: a lamp
    seen = scan_pixels(scan, PROJECTION).classes.unique().tolist()
    assert {SEMANTIC_CLASSES[n].name for n in seen if n >= 0} == {"car", "road", "building"}


def test_labels_of_semantic_kitti_keep_their_meaning_in_another_format_and_in_weather(tmp_path):
    scan, rain = tmp_path / "velodyne" / "000001.bin", ADDED_CLASS + Origin.RAIN
    write_bin(scan, np.ones((18, 4)))
    (tmp_path / "labels").mkdir()
    ids = np.array([10, 48, rain] * 6, "<u4")
    (tmp_path / "labels" / "000001.label").write_bytes(ids.tobytes())
    convert(scan, tmp_path / "ply" / "1.ply")
    for path in (scan, tmp_path / "ply" / "1.ply"):
        cloud = read_cloud(path)
        assert labels_of_cloud(cloud).tolist() == [26, 8, rain] * 6  # a car, a sidewalk
        assert classes_as_of_cloud(np.array([26, 8]), cloud).tolist() == [10, 48]
    # 45 and 46 are ids of neither, 12 one of KITTI-360 alone.
    for ids in ([7, 8, rain], [10, 45, 46], [10, 48, 12]):
        (tmp_path / "ply" / "1.label").write_bytes(np.array(ids, "<u4").tobytes())
        assert find_labels(tmp_path / "ply" / "1.ply", 3).tolist() == ids


@pytest.mark.parametrize("place", ["", "labels", "../labels"])
def test_labels_lie_in_the_folder_of_a_scan_or_in_one_for_labels(tmp_path, place):
    scan, folder = tmp_path / "bin" / "0.bin", tmp_path / "bin" / place
    write_bin(scan, np.ones((2, 4)))
    assert find_labels(scan, 2) is None
    folder.mkdir(exist_ok=True)
    (folder / "0.label").write_bytes(np.array([26, 7], "<u4").tobytes())
    assert find_labels(scan, 2).tolist() == read_labels(scan, 2).tolist() == [26, 7]


# Ahead, left, and right of the sensor; one behind that is out of range.
AHEAD, LEFT, RIGHT, FAR = (10, 1, 0, 0.5), (-1, 10, 0, 0.25), (1, -20, 0, 1.0), (-99, 1, 0, 0.0)


@pytest.fixture
def library(tmp_path, scaled_points):
    points = [AHEAD, AHEAD, AHEAD, AHEAD, LEFT, FAR, RIGHT]
    labels = [CAR | 1 << 16, CAR, CAR, ROAD, CAR | 2 << 16, CAR, 0]
    scans = [write_scan(tmp_path, "0", points, labels)]
    return object_library(scans, scaled_points(gain=2.0), PROJECTION, (2, 4))


class _Images:
    """One image: cars in the front half, road in the back half."""

    projection = PROJECTION

    def read(self, scan):
        classes = torch.full((4, 8), 11)
        classes[:, :2] = classes[:, 6:] = 0
        return Pixels(torch.full((4, 8), 10.0), torch.full((4, 8), 0.5), classes)


def test_a_library_of_cached_images_is_of_the_points_at_their_pixels(scaled_points):
    scan = Scan("drive", "0", Path("no file"))
    library = object_library([scan], scaled_points(), PROJECTION, (2, 4), _Images())
    assert library.names == ("road", "car")
    road, car = library.feature("road"), library.feature("car")
    assert (car[0] > 0) & (road[0] < 0)  # ahead and behind
    assert car[3].item() == road[3].item() == 0.5
    assert [entry.num_points for entry in library.classes] == [16, 16]


def test_everyday_names_of_classes_are_known(library):
    with pytest.raises(ValueError, match="unknown class 'person'; choose from road, car"):
        library.feature("pedestrian")


def test_a_cell_counts_by_the_share_of_its_points_that_are_of_the_class(library):
    ahead, left = 2 * torch.tensor(AHEAD), 2 * torch.tensor(LEFT)
    assert library.names == ("road", "car")
    # Three of four points ahead are of the car, and the only one to the left.
    expected = (0.75 * ahead + left) / 1.75
    torch.testing.assert_close(library.feature("car"), expected)
    torch.testing.assert_close(library.feature("road"), ahead)
    cosine = torch.nn.functional.cosine_similarity
    near = 0.75 * cosine(ahead, expected, dim=0) + cosine(left, expected, dim=0)
    road, car = library.classes
    assert (car.num_scans, car.num_cells, car.num_points) == (1, 2, 4)
    assert car.spread == pytest.approx(1 - near.item() / 1.75, abs=1e-6)
    assert (road.num_scans, road.num_cells, road.num_points) == (1, 1, 1)
    assert road.spread == pytest.approx(0, abs=1e-6)


def test_scans_add_up(tmp_path, scaled_points):
    scans = [
        write_scan(tmp_path, "0", [AHEAD, LEFT], [CAR | 3 << 16, ROAD]),
        write_scan(tmp_path, "1", [RIGHT, RIGHT], [CAR, CAR]),
    ]
    assert read_labels(scans[0].path, 2).tolist() == [CAR | 3 << 16, ROAD]
    library = object_library(scans, scaled_points(), PROJECTION, (2, 4))
    expected = (torch.tensor(AHEAD) + torch.tensor(RIGHT)) / 2
    torch.testing.assert_close(library.feature("car"), expected)
    assert library.names == ("road", "car")
    assert (library.classes[1].num_scans, library.classes[1].num_points) == (2, 3)


def test_rings_are_found_in_whole_scans(tmp_path, scaled_points):
    """Of the points of one class alone, the rows could not be told."""
    rings = RingProjection(SENSOR, (15.0, 5.0, -5.0, -15.0))
    inclination, azimuth = np.meshgrid(
        np.deg2rad(rings.ring_inclinations_deg), np.linspace(0.01, 6.27, 40), indexing="ij"
    )
    x, y = np.cos(inclination) * np.cos(azimuth), np.cos(inclination) * np.sin(azimuth)
    points = 10 * np.stack([x, y, np.sin(inclination), 0 * x], axis=-1)
    labels = np.full((4, 40), ROAD)
    labels[2, :5] = CAR
    scan = write_scan(tmp_path, "0", points.reshape(-1, 4), labels.ravel())
    library = object_library([scan], scaled_points(), rings, (4, 1))
    # A cell is a ring; of that of the car, an eighth is car.
    torch.testing.assert_close(
        library.feature("car"), torch.from_numpy(points[2, :5].mean(axis=0)).float()
    )
    assert {entry.name: entry.num_cells for entry in library.classes} == {"car": 1, "road": 4}


class Lifted(torch.nn.Module):
    """Lifts its features to twice their width."""

    name, dim, settings = "lifted", 4, {"pair": (1, 2)}

    def prepare(self, points):
        return points[:, :2]

    def point_features(self, prepared):
        return prepared

    def lift(self, values):
        return torch.cat([values, -values], dim=1)


def test_the_linear_step_is_taken(tmp_path):
    scan = write_scan(tmp_path, "0", [AHEAD], [CAR | 2 << 16])
    library = object_library([scan], Lifted(), PROJECTION, (2, 4))
    assert library.feature("car").tolist() == [*AHEAD[:2], *(-value for value in AHEAD[:2])]
    assert library.source == "lifted"
    assert library.extractor["settings"] == {"pair": [1, 2]}  # as it comes back from a file


def test_features_may_be_targets_of_a_backward_pass(library):
    weight = torch.ones(4, requires_grad=True)
    (library.feature("car") * weight).sum().backward()
    assert weight.grad.equal(library.feature("car"))


class Distances(torch.nn.Module):
    """Feature of a point: its distance, and 10 m."""

    def prepare(self, points):
        return points

    def point_features(self, prepared):
        distances = [points[:, :3].norm(dim=1) for points in prepared]
        return [torch.stack([each, torch.full_like(each, 10.0)], dim=1) for each in distances]


def test_the_draw_most_like_the_object_comes_first():
    projection = SphericalProjection(LidarSensor(beams=4, columns=8))
    range_m = torch.full((4, 4, 8), 30.0)
    mask = torch.zeros(4, 8, dtype=torch.bool)
    mask[2:, 4:6] = True
    for draw, metres in enumerate([5.0, 12.0, 9.0, -1.0]):  # the last one has no return there
        range_m[draw, mask] = metres
    edits = EditResult(range_m, torch.arange(4.0), 2, projection, cosine=torch.arange(4.0))
    ordered = most_like_first(edits, mask, torch.tensor([1.0, 1.0]), Distances(), (2, 4))
    assert ordered.draws.tolist() == [2, 1, 0, 3]
    assert ordered.range_m.equal(range_m[[2, 1, 0, 3]])
    assert ordered.cosine.tolist() == ordered.latents.tolist() == [2, 1, 0, 3]
    cosine = torch.nn.functional.cosine_similarity(torch.tensor([9.0, 10.0]), torch.ones(2), dim=0)
    assert ordered.likeness[0] == pytest.approx(cosine.item())
    assert ordered.likeness[3] == 0


def test_draws_that_miss_the_box_come_last():
    """The first draw is most like the feature, but in front of the box; so is most of the third."""
    projection = SphericalProjection(LidarSensor(beams=4, columns=8))
    mask = torch.zeros(4, 8, dtype=torch.bool)
    mask[2:, 4:6] = True
    range_m = torch.full((3, 4, 8), 30.0)
    range_m[0, mask], range_m[1, mask], range_m[2, mask] = 10.0, 15.0, 10.0
    range_m[2, 2, 4] = 15.0
    edits = EditResult(range_m, torch.arange(3.0), 2, projection)
    arguments = edits, mask, torch.tensor([1.0, 1.0]), Distances(), (2, 4)
    assert most_like_first(*arguments).draws.tolist() == [0, 2, 1]
    assert most_like_first(*arguments).points_inside is None
    box = {"inside": lambda points: (points.norm(dim=1) > 12) & (points.norm(dim=1) < 20)}
    ordered = most_like_first(*arguments, **box)
    assert ordered.draws.tolist() == [1, 0, 2]
    assert ordered.points_inside.tolist() == [4, 0, 1]
    assert ordered.likeness.argmax() == 1


class Recogniser(Distances):
    """Takes points beyond 13 m for class 11."""

    class_head = torch.nn.Identity()

    def classes(self, points):
        return torch.where(points[:, :3].norm(dim=1) > 13, 11, 2)


def test_draws_in_which_the_object_is_recognised_come_before_others_that_fill_the_box():
    """Likeness falls from draw to draw; the last one is recognised, but misses the box."""
    projection = SphericalProjection(LidarSensor(beams=4, columns=8))
    mask = torch.zeros(4, 8, dtype=torch.bool)
    mask[2:, 4:6] = True
    range_m = torch.full((4, 4, 8), 30.0)
    for draw, metres in enumerate([12.5, 15.0, 15.5, 25.0]):
        range_m[draw, mask] = metres
    range_m[1, 2:, 4] = 12.5
    range_m[2, 2, 4:6] = range_m[2, 3, 4] = 12.5
    edits = EditResult(range_m, torch.arange(4.0), 2, projection)
    arguments = edits, mask, torch.tensor([1.0, 1.0]), Recogniser(), (2, 4)

    def inside(points):
        return (points.norm(dim=1) > 12) & (points.norm(dim=1) < 20)

    ordered = most_like_first(*arguments, inside, 11)
    assert ordered.draws.tolist() == [1, 0, 2, 3]
    assert ordered.points_inside.tolist() == [4, 4, 4, 0]
    assert ordered.points_of_class.tolist() == [2, 0, 1, 0]
    unasked = most_like_first(*arguments, inside)
    assert unasked.draws.tolist() == [0, 2, 1, 3]
    assert unasked.points_of_class is None


def test_the_class_of_an_object_is_a_place_in_the_semantic_classes(library):
    assert SEMANTIC_CLASSES[library.semantic_class("car")].name == "car"
    with pytest.raises(ValueError, match="unknown class 'vegetation'; choose from"):
        library.semantic_class("tree")


def test_library_comes_back_from_its_file(tmp_path, library):
    path = tmp_path / "new" / "objects.safetensors"
    library.save(path)
    loaded = ObjectLibrary.load(path)
    assert loaded.features.equal(library.features)
    assert replace(loaded, features=library.features) == library
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_other_objects_and_features_of_another_source_are_refused(library):
    with pytest.raises(ValueError, match="unknown class 'tram'; choose from road, car"):
        library.feature("tram")
    library.check_source("scaled", 4)
    for source, dim in (("scalr", 4), (None, 4), ("scaled", 768)):
        with pytest.raises(ValueError, match=f"'scaled' of width 4, .* with {source!r} of width"):
            library.check_source(source, dim)


def test_objects_that_no_scan_shows_are_refused(tmp_path, scaled_points):
    scans = [write_scan(tmp_path, "0", [AHEAD, FAR], [CAR, ROAD])]

    def make(extractor=None):
        object_library(scans, extractor or scaled_points(), PROJECTION, (2, 4))

    with pytest.raises(ValueError, match=r"0\.bin: extractor scaled gave NaN or infinite"):
        make(scaled_points(gain=float("nan")))
    scans = [write_scan(tmp_path, "1", [AHEAD], [0])]
    with pytest.raises(ValueError, match="no labelled point within range"):
        make()
    scans[0].path.parents[1].joinpath("labels", "1.label").unlink()
    with pytest.raises(ScanError, match=r"1\.bin has no labels: looked for 1\.label in its folder"):
        make()


def test_parts_that_do_not_fit_are_refused(library):
    car = ObjectClass("car", 1, 1, 1, 0.0)
    with pytest.raises(ValueError, match="different classes"):
        replace(library, classes=(car, car))
    with pytest.raises(ValueError, match="different classes"):
        replace(library, classes=(car,))
    with pytest.raises(ValueError, match="NaN"):
        replace(library, features=library.features * torch.nan)


def test_a_file_of_something_else_is_named(tmp_path, library):
    path = tmp_path / "objects.safetensors"
    library.save(path)
    for data in (path.read_bytes()[:40], b"no library"):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"objects\.safetensors holds no objects"):
            ObjectLibrary.load(path)
    for metadata in (None, {"r3dpa_objects": "{}"}, {"r3dpa_objects": '{"version": 2}'}):
        save_file({"features": torch.ones(1, 2)}, path, metadata)
        with pytest.raises(ValueError, match="holds no objects"):
            ObjectLibrary.load(path)
