from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from r3dpa import viz
from r3dpa.geometry.projection import SphericalProjection, pool_cells, range_image
from r3dpa.geometry.sensor import LidarSensor
from r3dpa.viz.features import DARKEST_FEATURE, FRAME
from r3dpa.viz.figures import ERROR_MAP, ONLY_INPUT, ONLY_RECONSTRUCTION
from r3dpa.viz.pixels import BACKGROUND
from r3dpa.viz.scans import CAMERA_EYE_M, CAMERA_TARGET_M

SENSOR = LidarSensor(beams=8, columns=32)
BLUE, RED, GREEN = np.eye(3)[[2, 0, 1]]


def is_background(pixels):
    return (pixels == np.array(BACKGROUND)).all(axis=-1)


def centre_of(picture, colour):
    """Mean row and column of the pixels whose largest channel is that of ``colour``."""
    share = picture.astype(float) / picture.sum(axis=-1, keepdims=True).clip(1)
    return np.argwhere(share @ colour > 0.6).mean(axis=0)


# Range images


def test_range_image_picture_keeps_rows_and_columns():
    range_m = torch.full((8, 32), -1.0)
    range_m[2, 5] = 10.0
    picture = viz.range_image_picture(range_m, SENSOR)
    assert picture.shape == (8, 32, 3)
    assert picture.dtype == np.uint8
    assert np.argwhere(~is_background(picture)).tolist() == [[2, 5]]


def test_range_image_picture_enlarges_a_pixel_to_a_square():
    range_m = torch.full((8, 32), -1.0)
    range_m[2, 5] = 10.0
    filled = ~is_background(viz.range_image_picture(range_m, SENSOR, scale=3))
    assert filled.shape == (24, 96)
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


def test_range_that_is_nan_or_zero_is_empty():
    assert is_background(
        viz.range_image_picture(torch.tensor([[float("nan"), 0.0, -1.0]]), SENSOR)
    ).all()


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_range_image_picture_takes_every_float_type(dtype):
    range_m = torch.tensor([[8.0, -1.0]])
    expected = viz.range_image_picture(range_m.numpy(), SENSOR)
    assert (viz.range_image_picture(range_m.to(dtype), SENSOR) == expected).all()


def test_range_image_picture_refuses_a_batch_and_a_scale_of_zero():
    with pytest.raises(ValueError, match=r"expected shape \(H, W\), got \(1, 8, 32\)"):
        viz.range_image_picture(torch.ones(1, 8, 32), SENSOR)
    with pytest.raises(ValueError, match="scale is 0"):
        viz.range_image_picture(torch.ones(8, 32), SENSOR, scale=0)


def test_encoded_picture_spans_the_bytes_and_rounds_down():
    image = torch.tensor([[-1.3, -1.0, 0.0, 1.0, 1.3]])
    assert viz.encoded_picture(image).tolist() == [[0, 0, 127, 255, 255]]


# Points


def test_from_above_forward_is_up_and_left_is_left():
    points = torch.tensor([[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [0.0, 20.0, 0.0]])
    colours = torch.tensor(np.stack([RED, GREEN, BLUE]))
    picture = viz.birds_eye_picture(points, extent_m=50, pixels=100, colours=colours)
    assert centre_of(picture, RED).tolist() == [50, 50]
    assert centre_of(picture, GREEN).tolist() == [30, 50]
    assert centre_of(picture, BLUE).tolist() == [50, 30]


def test_from_above_the_highest_point_shows_in_any_order():
    points = np.array([[3.0, 3.0, 2.0], [3.0, 3.0, -1.0]])
    for order in ([0, 1], [1, 0]):
        picture = viz.birds_eye_picture(points[order], colours=np.stack([RED, BLUE])[order])
        assert picture[~is_background(picture)].tolist() == [[255, 0, 0]]


def test_from_above_points_outside_or_not_finite_are_not_drawn():
    points = torch.tensor([[50.1, 0.0, 0.0], [0.0, -50.1, 0.0], [1.0, 1.0, float("nan")]])
    assert is_background(viz.birds_eye_picture(points, extent_m=50)).all()


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
        picture = viz.scene_3d(np.array([ground, other], float), np.stack([RED, GREEN]))
        row, column = centre_of(picture, GREEN) - centre_of(picture, RED)
        assert (np.sign(np.round(row)), np.sign(np.round(column))) == (rows, columns)


def test_scene_3d_target_of_the_camera_is_in_the_middle():
    picture = viz.scene_3d(np.array([CAMERA_TARGET_M]), RED[None], size=(200, 300))
    assert picture.shape == (200, 300, 3)
    assert centre_of(picture, RED) == pytest.approx([99.5, 149.5], abs=1.0)


def test_scene_3d_near_hides_far_on_the_same_ray_in_any_order():
    eye, target = np.array(CAMERA_EYE_M), np.array(CAMERA_TARGET_M)
    points = np.stack([eye + (target - eye) * 0.5, target])
    for order in ([0, 1], [1, 0]):
        picture = viz.scene_3d(points[order], np.stack([RED, BLUE])[order])
        assert (centre_of(picture, RED) > 0).all()
        assert not (picture[..., 2] > 100).any()


def test_scene_3d_nothing_behind_the_camera_is_drawn():
    behind = 2 * np.array(CAMERA_EYE_M) - np.array(CAMERA_TARGET_M)
    assert is_background(viz.scene_3d(behind[None])).all()
    assert is_background(viz.scene_3d(torch.empty(0, 3))).all()


def test_points_refuse_wrong_columns_and_colours():
    with pytest.raises(ValueError, match="columns x, y, z"):
        viz.birds_eye_picture(torch.ones(4, 2))
    with pytest.raises(ValueError, match="one RGB per point"):
        viz.scene_3d(torch.ones(4, 3), colours=torch.ones(2, 3))


# Figures


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


def test_scenes_sheet_refuses_no_scene_and_foreign_sizes():
    with pytest.raises(ValueError, match="no scene"):
        viz.scenes_sheet([], SphericalProjection(SENSOR))
    with pytest.raises(ValueError, match="range image must be"):
        viz.scenes_sheet([torch.ones(4, 4)], SphericalProjection(SENSOR))


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
    with pytest.raises(ValueError, match="same sensor"):
        viz.reconstruction_figure(before, after[:, :4], SENSOR, 0.0, 1.0)


# Losses

RAGGED = (
    "epoch,step,train/kl,train/flow,val/error,unused\n"
    "0,0,4.0,,,\n"
    "0,0,,-1.5\n"
    "0,50,2.0,nan,,\n"
    "1,100,,,0.25,\n"
    "1,150,1.0"
)


def test_read_metrics_skips_blanks_missing_cells_and_the_unfinished_line(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(RAGGED)
    series = viz.read_metrics(path)
    assert list(series) == ["train/kl", "train/flow", "val/error"]
    assert series["train/kl"] == ([0, 50], [4, 2])
    assert series["val/error"] == ([100], [0.25])
    assert series["train/flow"][0] == [0, 50]
    assert series["train/flow"][1] == pytest.approx([-1.5, float("nan")], nan_ok=True)


def test_read_metrics_reads_what_csv_logger_writes(tmp_path):
    from lightning.pytorch.loggers import CSVLogger

    logger = CSVLogger(tmp_path)
    logger.log_metrics({"train/kl": 3.0}, step=0)
    logger.save()
    logger.log_metrics({"val/error": 0.5}, step=7)  # a new column: the file is written anew
    logger.save()
    series = viz.read_metrics(f"{logger.log_dir}/metrics.csv")
    assert series == {"train/kl": ([0], [3]), "val/error": ([7], [0.5])}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "no column 'step'"),
        ("", "no column 'step'"),
        ("step,loss\n1,2\n3,oops\n", "line 3, column 'loss'"),
        ("step,loss\n,2\n", "line 2, column 'loss'"),
    ],
)
def test_read_metrics_names_what_is_wrong(tmp_path, text, message):
    path = tmp_path / "metrics.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        viz.read_metrics(path)


def test_loss_curves_draws_a_panel_per_quantity_and_logs_where_positive(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(RAGGED)
    figure = viz.loss_curves(path)
    panels = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_title().split("\n")[0] for axes in panels] == ["train/kl", "train/flow"]
    assert panels[0].get_title().endswith("4 → 2")
    assert [axes.get_yscale() for axes in panels] == ["log", "linear"]
    figure.draw_without_rendering()  # with NaN; a single value is no curve


def test_loss_curves_mean_is_centred_and_keeps_gaps():
    values = np.arange(100.0)  # a centred mean does not move a straight line
    values[40] = np.nan
    figure = viz.loss_curves({"loss": (np.arange(100), values)})
    raw, mean = (line.get_ydata() for line in figure.axes[0].lines)
    assert raw == pytest.approx(values, nan_ok=True)
    assert np.isnan(mean[40])
    assert mean[10:30] == pytest.approx(values[10:30])
    assert mean[60:90] == pytest.approx(values[60:90])


def test_loss_curves_refuses_nothing():
    with pytest.raises(ValueError, match="two values or more"):
        viz.loss_curves({})


# Features


def test_pca_colours_of_axis_aligned_features_follow_the_variances():
    generator = np.random.default_rng(0)
    spread = generator.uniform(-1, 1, (500, 3))
    features = np.zeros((500, 6))
    features[:, [4, 0, 2]] = spread * [9.0, 3.0, 1.0]
    colours = viz.pca_colours(features)
    for component in range(3):  # the sign is that of the feature: brighter means more of it
        correlation = np.corrcoef(colours[:, component], spread[:, component])[0, 1]
        assert correlation > 0.99
    assert colours.min() == DARKEST_FEATURE
    assert colours.max() == 1.0


def test_pca_colours_are_not_moved_by_an_outlier_or_by_empty_cells():
    features = np.random.default_rng(0).normal(size=(1000, 3)) * [3.0, 2.0, 1.0]
    with_empty = np.concatenate([np.zeros((300, 3)), features])
    colours = viz.pca_colours(with_empty)
    assert (colours[:300] == 0).all()
    assert colours[300:] == pytest.approx(viz.pca_colours(features))
    features[0] *= 30
    moved = viz.pca_colours(features)[1:]
    assert np.abs(moved - colours[301:]).mean() < 0.05


def test_pca_colours_do_not_change_with_the_order_of_rows():
    features = np.random.default_rng(1).normal(size=(200, 10)) * np.arange(1, 11)
    assert viz.pca_colours(features[::-1])[::-1] == pytest.approx(viz.pca_colours(features))


def test_pca_colours_of_constant_empty_and_narrow_features():
    constant = viz.pca_colours(torch.full((20, 8), 0.1))
    assert constant == pytest.approx(np.full((20, 3), (1 + DARKEST_FEATURE) / 2))
    assert (viz.pca_colours(torch.zeros(4, 8)) == 0).all()
    narrow = viz.pca_colours(torch.tensor([[1.0], [2.0], [3.0]]))
    assert narrow[:, 0].tolist() == sorted(narrow[:, 0])
    assert np.ptp(narrow[:, 1:]) == 0


def test_pca_colours_refuse_nan():
    with pytest.raises(ValueError, match="1 of 6 features are not finite"):
        viz.pca_colours(torch.tensor([[1.0, 2.0], [3.0, float("nan")], [0.0, 1.0]]))


def test_feature_grid_picture_puts_cells_row_by_row():
    grid = torch.zeros(6, 4)
    grid[4] = 1.0  # second row, second column of 2 x 3
    filled = viz.feature_grid_picture(grid, (2, 3), scale=2).any(axis=-1)
    assert filled.shape == (4, 6)
    assert filled[2:4, 2:4].all()
    assert filled.sum() == 4
    with pytest.raises(ValueError, match="6 cells do not fill a grid of 3 x 3"):
        viz.feature_grid_picture(grid, (3, 3))


def test_fitted_colours_are_those_of_equal_rows_in_another_set():
    features = np.random.default_rng(0).normal(size=(400, 6)) * [5, 3, 2, 1, 1, 1] + 2
    colours = viz.FeatureColours.fit(features)
    expected = viz.pca_colours(features)
    assert colours(features[100:200]) == pytest.approx(expected[100:200])
    # Refitted to the part, the same rows would get other colours.
    assert np.abs(viz.pca_colours(features[100:200]) - expected[100:200]).max() > 0.02
    # Components are linear: between the colours of two rows lies that of their mean.
    inside = ((expected > DARKEST_FEATURE) & (expected < 1)).all(axis=1)
    one, other = np.flatnonzero(inside)[:2]
    middle = colours(features[[one, other]].mean(axis=0, keepdims=True))[0]
    assert middle == pytest.approx(expected[[one, other]].mean(axis=0))
    assert (colours(np.zeros((1, 6))) == 0).all()


def test_fitted_colours_clip_what_lies_beyond_and_refuse_other_widths():
    features = np.random.default_rng(0).normal(size=(400, 3)) * [3.0, 2.0, 1.0]
    colours = viz.FeatureColours.fit(features)
    far = colours(np.diag([100.0, 100.0, -100.0]) + 0.001)
    assert far.diagonal() == pytest.approx([1.0, 1.0, DARKEST_FEATURE])
    with pytest.raises(ValueError, match="features are 4 wide but the components 3"):
        colours(np.ones((2, 4)))


def test_pca_colours_of_single_precision_agree_with_double():
    features = np.random.default_rng(0).normal(size=(2000, 40)) * np.arange(1, 41) + 50
    single = viz.pca_colours(torch.from_numpy(features).float())
    assert single == pytest.approx(viz.pca_colours(features), abs=1e-3)
    # A plane in 40 dimensions has no third component, however it is rounded.
    plane = torch.from_numpy(features[:, :2] @ features[:2]).float()
    assert np.ptp(viz.pca_colours(plane)[:, 2]) == 0


def test_similarity_picture_is_bright_where_the_direction_is_that_of_the_cell():
    grid = torch.tensor([[1.0, 0.0], [5.0, 0.0], [0.0, 1.0], [0.0, 0.0], [-1.0, 0.0], [1.0, 1.0]])
    picture = viz.similarity_picture(grid, (2, 3), (0, 0), scale=4)
    middles = picture[2::4, 2::4].reshape(6, 3)
    same, across, opposed, between = middles[1], middles[2], middles[4], middles[5]
    assert (middles[0] == same).all()  # the length of a feature does not count
    assert (across == opposed).all()
    assert same.sum() > between.sum() > across.sum()
    assert (middles[3] == 0).all()
    framed = (picture == FRAME).all(axis=-1)
    assert framed.sum() == 4 * 3
    assert framed[:4, :4].sum() == 4 * 3


def test_similarity_picture_refuses_empty_and_missing_cells():
    grid = torch.tensor([[1.0], [0.0]])
    with pytest.raises(ValueError, match=r"cell \(0, 1\) is empty"):
        viz.similarity_picture(grid, (1, 2), (0, 1))
    with pytest.raises(ValueError, match=r"cell \(1, 0\) is none of a grid of 1 x 2"):
        viz.similarity_picture(grid, (1, 2), (1, 0))


def test_feature_figure_paints_points_pixels_and_cells_alike():
    generator = np.random.default_rng(0)
    points = generator.uniform(-20, 20, (500, 4)) * [1, 1, 0.02, 0] - [0, 0, 2, 0]
    features = generator.normal(size=(500, 4)) * [4, 3, 2, 1]
    projection = SphericalProjection(SENSOR)
    xyz = torch.from_numpy(points[:, :3])
    grid, counts = pool_cells(xyz, torch.from_numpy(features), projection, (2, 8))
    figure = viz.feature_figure(points, torch.from_numpy(features), grid, projection, (2, 8))
    _, _, image, cells = (np.asarray(axes.images[0].get_array()) for axes in figure.axes)
    colours = viz.FeatureColours.fit(features)
    _, expected = range_image(xyz, projection, torch.from_numpy(colours(features)))
    assert image == pytest.approx(expected.movedim(0, -1).numpy() * 255, abs=0.5)
    assert cells == pytest.approx(colours(grid).reshape(2, 8, 3) * 255, abs=0.5)
    assert (cells.reshape(-1, 3).any(axis=1) == (counts > 0).numpy()).all()
    figure.draw_without_rendering()
    with pytest.raises(ValueError, match="16 cells do not fill a grid of 8 x 64"):
        viz.feature_figure(points, features, grid, projection)


def test_latents_picture_separates_what_the_channels_separate():
    latents = torch.full((4, 3, 5), 0.5)
    latents[:, 1, 2] = 2.0
    picture = viz.latents_picture(latents, scale=2)
    assert picture.shape == (6, 10, 3)
    odd = (picture != picture[0, 0]).any(axis=-1)
    assert odd[2:4, 4:6].all()
    assert odd.sum() == 4


# Files


def test_save_picture_keeps_every_pixel(tmp_path):
    generator = np.random.default_rng(0)
    for shape in ((5, 7, 3), (5, 7)):
        pixels = generator.integers(0, 256, shape, dtype=np.uint8)
        path = viz.save(pixels, tmp_path / "new" / "folder" / "picture.png")
        assert (np.asarray(Image.open(path)) == pixels).all()
    assert [found.name for found in path.parent.iterdir()] == ["picture.png"]


def test_save_figure(tmp_path):
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
    assert path.read_bytes() == old
    assert [found.name for found in tmp_path.iterdir()] == ["picture.png"]


def test_save_refuses_pixels_that_are_not_bytes_and_unknown_formats(tmp_path):
    with pytest.raises(ValueError, match="float64"):
        viz.save(np.zeros((2, 2, 3)), tmp_path / "picture.png")
    with pytest.raises(ValueError, match="unknown"):
        viz.save(np.zeros((2, 2, 3), np.uint8), tmp_path / "picture.unknown")
    with pytest.raises(ValueError, match="unknown"):
        viz.save(Figure(), tmp_path / "figure.unknown")
    assert list(tmp_path.iterdir()) == []


def test_viz_leaves_the_global_pyplot_alone():
    """Its state is that of the user's own figures."""
    sources = Path(viz.__file__).parent.glob("*.py")
    assert not [path.name for path in sources if "pyplot" in path.read_text()]
