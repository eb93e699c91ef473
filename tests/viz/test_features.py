"""Features as colours: which rows look alike, which are empty, and where cells are drawn."""

import numpy as np
import pytest
import torch

from r3dpa import viz
from r3dpa.geometry import LidarSensor, SphericalProjection, pool_cells, range_image
from r3dpa.viz.features import DARKEST_FEATURE, FRAME, fit_colours


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


def test_pca_colours_of_constant_empty_and_narrow_features():
    constant = viz.pca_colours(torch.full((20, 8), 0.1))
    assert constant == pytest.approx(np.full((20, 3), (1 + DARKEST_FEATURE) / 2))
    assert (viz.pca_colours(torch.zeros(4, 8)) == 0).all()
    narrow = viz.pca_colours(torch.tensor([[1.0], [2.0], [3.0]]))
    assert narrow[:, 0].tolist() == sorted(narrow[:, 0])
    assert np.ptp(narrow[:, 1:]) == 0


def test_fitted_colours_are_those_of_equal_rows_in_another_set():
    features = np.random.default_rng(0).normal(size=(400, 6)) * [5, 3, 2, 1, 1, 1] + 2
    colours = fit_colours(features)
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
    assert set(colours(1e9 * features).ravel()) == {DARKEST_FEATURE, 1.0}  # clipped


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
    with pytest.raises(ValueError, match=r"cell \(0, 1\) is empty"):
        viz.similarity_picture(torch.tensor([[1.0], [0.0]]), (1, 2), (0, 1))


def test_feature_figure_paints_points_pixels_and_cells_alike():
    generator = np.random.default_rng(0)
    points = generator.uniform(-20, 20, (500, 4)) * [1, 1, 0.02, 0] - [0, 0, 2, 0]
    features = generator.normal(size=(500, 4)) * [4, 3, 2, 1]
    projection = SphericalProjection(LidarSensor(beams=8, columns=32))
    xyz = torch.from_numpy(points[:, :3])
    grid, counts = pool_cells(xyz, torch.from_numpy(features), projection, (2, 8))
    figure = viz.feature_figure(points, torch.from_numpy(features), grid, projection, (2, 8))
    _, _, image, cells = (np.asarray(axes.images[0].get_array()) for axes in figure.axes)
    colours = fit_colours(features)
    _, expected = range_image(xyz, projection, torch.from_numpy(colours(features)))
    assert image == pytest.approx(expected.movedim(0, -1).numpy() * 255, abs=0.5)
    assert cells == pytest.approx(colours(grid).reshape(2, 8, 3) * 255, abs=0.5)
    assert (cells.reshape(-1, 3).any(axis=1) == (counts > 0).numpy()).all()
    figure.draw_without_rendering()


def test_latents_picture_separates_what_the_channels_separate():
    latents = torch.full((4, 3, 5), 0.5)
    latents[:, 1, 2] = 2.0
    picture = viz.latents_picture(latents, scale=2)
    assert picture.shape == (6, 10, 3)
    odd = (picture != picture[0, 0]).any(axis=-1)
    assert odd[2:4, 4:6].all()
    assert odd.sum() == 4
