from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from PIL import Image

from r3dpa import viz
from r3dpa.geometry import LidarSensor, RingProjection, SphericalProjection, values_at_returns
from r3dpa.viz.figures import ERROR_MAP, ONLY_INPUT, ONLY_RECONSTRUCTION
from r3dpa.viz.pictures import BACKGROUND, CAMERA_EYE_M, CAMERA_TARGET_M
from r3dpa.viz.scenes import COLOURS, classes_sheet

SENSOR = LidarSensor(beams=8, columns=32)
BLUE, RED, GREEN = np.eye(3)[[2, 0, 1]]


def is_background(pixels):
    return (pixels == np.array(BACKGROUND)).all(axis=-1)


def centre_of(picture, colour):
    """Mean row and column of the pixels whose largest channel is that of ``colour``."""
    share = picture.astype(float) / picture.sum(axis=-1, keepdims=True).clip(1)
    return np.argwhere(share @ colour > 0.6).mean(axis=0)


def test_range_image_picture_keeps_rows_and_columns_and_enlarges_them():
    range_m = torch.full((8, 32), -1.0)
    range_m[2, 5] = 10.0
    picture = viz.range_image_picture(range_m, SENSOR, scale=3)
    assert (picture.shape, picture.dtype) == ((24, 96, 3), np.uint8)
    filled = ~is_background(picture)
    assert filled[6:9, 15:18].all()
    assert filled.sum() == 9


def test_range_colours_depend_on_the_sensor_limits_only_and_near_is_brighter():
    near, far = torch.tensor([[1.0, 55.0]]), torch.tensor([[1.0, 20.0]])
    first, second = viz.range_image_picture(near, SENSOR), viz.range_image_picture(far, SENSOR)
    assert (first[0, 0] == second[0, 0]).all()  # not scaled by the content
    assert first[0, 0].sum() > second[0, 1].sum() > first[0, 1].sum()
    beyond = viz.range_image_picture(torch.tensor([[0.5, 90.0]]), SENSOR)
    limits = viz.range_image_picture(torch.tensor([[1.0, 56.0]]), SENSOR)
    assert (beyond == limits).all()


def test_range_images_of_every_float_type_and_empty_where_nan_or_zero():
    picture = viz.range_image_picture(torch.tensor([[float("nan"), 0.0, -1.0, 8.0]]), SENSOR)
    assert is_background(picture).tolist() == [[True, True, True, False]]
    for dtype in (torch.bfloat16, torch.float64):
        range_m = torch.tensor([[torch.nan, 0.0, -1.0, 8.0]], dtype=dtype)
        assert (viz.range_image_picture(range_m, SENSOR) == picture).all()
    with pytest.raises(ValueError, match=r"expected shape \(H, W\), got \(1, 8, 32\)"):
        viz.range_image_picture(torch.ones(1, 8, 32), SENSOR)


def test_encoded_picture_spans_the_bytes_and_rounds_down():
    image = torch.tensor([[-1.3, -1.0, 0.0, 1.0, 1.3]])
    assert viz.encoded_picture(image).tolist() == [[0, 0, 127, 255, 255]]


def test_birds_eye_view_shows_forward_up_and_left_left():
    points = torch.tensor([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [0.0, 20.0, 0.0]])
    colours = torch.tensor(np.stack([RED, GREEN, BLUE]))
    picture = viz.birds_eye_picture(points, extent_m=50, pixels=100, colours=colours)
    assert centre_of(picture, RED).tolist() == [50, 50]
    assert centre_of(picture, GREEN).tolist() == [30, 50]
    assert centre_of(picture, BLUE).tolist() == [50, 30]
    absent = torch.tensor([[50.1, 0.0, 0.0], [0.0, -50.1, 0.0], [1.0, 1.0, float("nan")]])
    assert is_background(viz.birds_eye_picture(absent, extent_m=50)).all()


def test_birds_eye_view_shows_the_highest_point_in_any_order():
    points = np.array([[3.0, 3.0, 2.0], [3.0, 3.0, -1.0]])
    for order in ([0, 1], [1, 0]):
        picture = viz.birds_eye_picture(points[order], colours=np.stack([RED, BLUE])[order])
        assert picture[~is_background(picture)].tolist() == [[255, 0, 0]]


def test_birds_eye_view_axes_are_metres_with_equal_scale():
    figure = viz.birds_eye_view(torch.tensor([[20.0, 10.0, 0.0, 0.5]]), extent_m=50)
    axes = figure.axes[0]
    assert axes.get_xlim() == (50, -50)  # +y to the left
    assert axes.get_ylim() == (-50, 50)
    assert axes.get_aspect() == 1.0
    picture = axes.images[0].get_array()
    row, column = np.argwhere(~is_background(picture))[0]
    # A pixel is 0.2 m wide; the picture is stretched over the limits of the axes.
    assert (50 - 0.2 * row, 50 - 0.2 * column) == pytest.approx((20, 10), abs=0.2)


def test_scene_3d_left_is_left_up_is_up_and_forward_is_farther_up():
    ground, left, above, ahead = (5, 0, -1.7), (5, 8, -1.7), (5, 0, 2), (30, 0, -1.7)
    for other, rows, columns in ((left, 0, -1), (above, -1, 0), (ahead, -1, 0)):
        points = np.array([ground, other], float)
        picture = viz.scene_3d(points, np.stack([RED, GREEN]), size=(180, 320))
        row, column = centre_of(picture, GREEN) - centre_of(picture, RED)
        assert (np.sign(np.round(row)), np.sign(np.round(column))) == (rows, columns)


def test_scene_3d_near_hides_far_on_the_same_ray_in_any_order():
    eye, target = np.array(CAMERA_EYE_M), np.array(CAMERA_TARGET_M)
    points = np.stack([eye + (target - eye) * 0.5, target])
    for order in ([0, 1], [1, 0]):
        picture = viz.scene_3d(points[order], np.stack([RED, BLUE])[order], size=(180, 320))
        assert (centre_of(picture, RED) > 0).all()
        assert not (picture[..., 2] > 100).any()
        assert centre_of(picture, RED) == pytest.approx([89.5, 159.5], abs=4)


def test_scene_3d_nothing_behind_the_camera_is_drawn():
    behind = 2 * np.array(CAMERA_EYE_M) - np.array(CAMERA_TARGET_M)
    assert is_background(viz.scene_3d(behind[None], size=(90, 160))).all()
    assert is_background(viz.scene_3d(torch.empty(0, 3), size=(90, 160))).all()


def test_points_refuse_other_columns_and_colours():
    for points, colours in ((torch.ones(4, 2), None), (torch.ones(4, 3), torch.ones(2, 3))):
        with pytest.raises(ValueError, match="give x, y, z and one RGB"):
            viz.birds_eye_picture(points, colours=colours)


def test_scenes_sheet_has_a_row_of_three_pictures_per_scene():
    ranges = [torch.full((8, 32), 5.0 + number) for number in range(3)]
    figure = viz.scenes_sheet(ranges, SphericalProjection(SENSOR))
    pictured = [axes for axes in figure.axes if axes.images]
    assert len(pictured) == 9
    for number, range_m in enumerate(ranges):
        shown = pictured[3 * number].images[0].get_array()
        assert (shown == viz.range_image_picture(range_m, SENSOR)).all()
    figure.draw_without_rendering()
    boxes = [axes.get_tightbbox() for axes in figure.axes]
    overlaps = [a for i, a in enumerate(boxes) for b in boxes[:i] if a.overlaps(b)]
    assert not overlaps


@pytest.mark.parametrize("kind", [SphericalProjection, RingProjection])
def test_classes_sheet_shows_the_class_of_each_return_in_its_pixel(kind):
    inclinations_deg = tuple(np.linspace(2.0, -24.0, SENSOR.beams))
    projection = kind(SENSOR, inclinations_deg) if kind is RingProjection else kind(SENSOR)
    random = torch.Generator().manual_seed(0)
    size = SENSOR.beams, SENSOR.columns
    range_m = torch.where(torch.rand(size, generator=random) > 0.3, 5.0, -1.0)
    image = torch.tensor([7, 21, 26])[torch.randint(3, size, generator=random)]  # road, leaves, car
    labels = values_at_returns(image, range_m, projection).numpy().astype(np.uint32) | 5 << 16
    figure = classes_sheet([(range_m, labels)], projection)
    shown = [axes for axes in figure.axes if axes.images][1].images[0].get_array()
    names = {7: "ROAD", 21: "VEGETATION", 26: "CAR"}
    for (row, column), number in np.ndenumerate(image.numpy()):
        known = (range_m[row, column] > 0).item()
        colour = to_rgb(COLOURS[names[number]]) if known else (0, 0, 0)
        assert np.allclose(shown[row, column] / 255, colour, atol=0.01)
    entries = [text.get_text() for text in figure.legends[0].get_texts()]
    assert entries == ["road", "vegetation", "car"]


@pytest.mark.parametrize(("count", "cells"), [(1, 1), (5, 6)])
def test_sheets_hold_every_scan_once_with_its_name_as_it_is(count, cells):
    scans = {f"$\\scan_{number}$ of ${count}": torch.eye(3) * 5 for number in range(count)}
    sheet = viz.birds_eye_sheet(scans)
    assert len(sheet.axes) == cells + 1
    shown = [axes for axes in sheet.axes[:-1] if axes.get_visible()]
    assert [axes.get_title(loc="left") for axes in shown] == list(scans)
    assert all(axes.images for axes in shown)
    strips = viz.range_strips(scans, SphericalProjection(SENSOR))
    assert [axes.get_title(loc="left") for axes in strips.axes[:-1]] == list(scans)
    sheet.draw_without_rendering()
    strips.draw_without_rendering()


def test_reconstruction_figure_tells_errors_from_wrong_returns():
    before = torch.tensor([[10.0, 10.0, -1.0, -1.0, 10.0]])
    after = torch.tensor([[10.0, -1.0, 10.0, -1.0, 15.0]])
    figure = viz.reconstruction_figure(before, after, SENSOR, 2.5, 0.6)
    shown = np.asarray(figure.axes[2].images[0].get_array())[0] / 255
    expected = [
        ERROR_MAP(0.0)[:3],
        ONLY_INPUT,
        ONLY_RECONSTRUCTION,
        np.array(BACKGROUND) / 255,
        ERROR_MAP(1.0)[:3],  # 5 m is beyond the scale
    ]
    assert shown == pytest.approx(np.array(expected), abs=1 / 255)
    assert "0.6" not in figure.get_suptitle()
    assert "2.500 m" in figure.get_suptitle()
    assert "60.0 %" in figure.get_suptitle()


EDITED = SphericalProjection(LidarSensor(beams=8, columns=16))
RANGE_M = torch.full((8, 16), 10.0)


def contours(parts):
    """Places ``(x, y)`` of the outline of parts; pixel centres have whole numbers."""
    sheet = viz.edit_sheet([viz.EditRow("after", RANGE_M, outline=parts)], ("kept", "new"), EDITED)
    found = [c for c in sheet.axes[0].collections if isinstance(c, ContourSet)]
    return {
        tuple(place) for c in found for path in c.get_paths() for place in path.vertices.tolist()
    }


def test_the_outline_of_one_pixel_goes_around_it():
    parts = np.zeros((8, 16), np.uint8)
    parts[3, 5] = 1
    assert contours(parts) == {(4.5, 3), (5.5, 3), (5, 2.5), (5, 3.5)}


def test_no_outline_hides_a_picture_of_dropped_beams():
    parts = np.zeros((8, 16), np.uint8)
    parts[1::2] = 1
    assert not contours(parts)


def test_azimuths_stand_below_their_columns():
    """16 columns of 22.5 degrees from 180 down: 0 degrees is the border before column 8."""
    sheet = viz.edit_sheet([viz.EditRow("scan", RANGE_M)], (), EDITED)
    axes = sheet.axes[0]
    places = dict(
        zip([t.get_text() for t in axes.get_xticklabels()], axes.get_xticks(), strict=True)
    )
    assert places["0°"] == pytest.approx(7.5, abs=0.5)
    assert places["135°"] == pytest.approx(1.5, abs=0.5)
    assert places["-90°"] == pytest.approx(11.5, abs=0.5)


def shown_columns(first, last):
    """Columns that a sheet shows of 1,024, if a part covers those from first to last."""
    projection = SphericalProjection(LidarSensor(beams=8, columns=1024))
    parts = np.zeros((8, 1024), np.uint8)
    parts[3:5, first : last + 1] = 1
    rows = [viz.EditRow("mask", torch.ones(8, 1024), parts), viz.EditRow("a", torch.ones(8, 1024))]
    sheet = viz.edit_sheet(rows, ("kept", "new"), projection)
    limits = {axes.get_xlim() for axes in sheet.axes[:2]}
    ticks = sheet.axes[1].get_xticks()
    ((left, right),) = limits
    tall = sheet.get_figheight() > 2 * 2 * 1.2
    assert tall == (right - left < 1023)
    assert ((ticks >= left) & (ticks <= right)).all()
    return left, right


@pytest.mark.parametrize(
    ("part", "expected"),
    [
        ((500, 600), (400, 700)),  # as much on both sides
        ((500, 501), (436, 565)),  # but a 16th of the turn at least
        ((10, 20), (0, 84)),  # not over the seam
        ((100, 300), (-0.5, 1023.5)),  # with its surroundings more than half of the turn
        ((0, 1023), (-0.5, 1023.5)),
    ],
)
def test_a_small_part_is_shown_with_its_surroundings(part, expected):
    assert shown_columns(*part) == expected


def test_parts_differ_in_colour_as_long_as_there_are_colours():
    names = [f"part {number}" for number in range(14)]
    assert len(set(viz.figures.part_colours(names[:12]))) == 12
    assert len(viz.figures.part_colours(names)) == 14


def test_a_mask_is_drawn_on_grey_and_colours_its_part_alone():
    parts = np.zeros((8, 16), np.uint8)
    parts[:, 8:] = 1
    sheet = viz.edit_sheet([viz.EditRow("mask", RANGE_M, parts)], ("kept", "new"), EDITED)
    picture = np.asarray(sheet.axes[0].images[0].get_array(), int)
    assert (np.ptp(picture[:, :8], axis=-1) <= 1).all()
    assert (picture[:, 8:, 0] > picture[:, 8:, 1] + 20).all()


def test_saved_pictures_keep_every_pixel_and_figures_their_size(tmp_path):
    generator = np.random.default_rng(0)
    for shape in ((5, 7, 3), (5, 7)):
        pixels = generator.integers(0, 256, shape, dtype=np.uint8)
        path = viz.save(pixels, tmp_path / "new" / "folder" / "picture.png")
        assert (np.asarray(Image.open(path)) == pixels).all()
    assert [found.name for found in path.parent.iterdir()] == ["picture.png"]
    figure = viz.birds_eye_view(torch.zeros(1, 3))
    assert Image.open(viz.save(figure, tmp_path / "figure.png")).size == (740, 640)


def test_save_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    path = viz.save(np.zeros((2, 2, 3), np.uint8), tmp_path / "picture.png")
    old = path.read_bytes()

    class Broken(Figure):
        def savefig(self, fname, **kwargs):
            fname.write_bytes(b"half")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        viz.save(Broken(), path)
    with pytest.raises(ValueError, match="unknown"):
        viz.save(np.zeros((2, 2, 3), np.uint8), tmp_path / "picture.unknown")
    assert path.read_bytes() == old
    assert [found.name for found in tmp_path.iterdir()] == ["picture.png"]


def test_viz_leaves_the_global_pyplot_alone():
    """Its state is that of the user's own figures."""
    sources = Path(viz.__file__).parent.glob("*.py")
    assert not [path.name for path in sources if "pyplot" in path.read_text()]
