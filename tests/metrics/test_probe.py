from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.special import log_softmax, softmax

from r3dpa.geometry import LidarSensor, SphericalProjection, pool_cells
from r3dpa.metrics.probe import (
    ProbeScores,
    empty_share,
    linear_probe,
    logistic_regression,
    neighbour_cosine,
    probe_source,
)

CAR, ROAD, TREE = 26, 7, 21


def blobs(num=300, width=5, seed=0):
    """Three overlapping Gaussian classes, float64."""
    generator = torch.Generator().manual_seed(seed)
    centres = torch.randn(3, width, generator=generator, dtype=torch.float64)
    targets = torch.arange(num) % 3
    noise = torch.randn(num, width, generator=generator, dtype=torch.float64)
    return centres[targets] + noise, targets


def test_regression_has_no_gradient_left_by_the_softmax_formula():
    features, targets = blobs()
    features = features * 7 + 3
    weight, bias = logistic_regression(features, targets, 3, ridge=0.01)
    residual = softmax((features @ weight + bias).numpy(), axis=1)
    residual[np.arange(300), targets] -= 1
    # In units of the features: one of 7 changes the loss 7 times as much.
    centred = (features - features.mean(0)).numpy()
    of_weight = centred.T @ residual / 300 + 0.01 * centred.T @ centred / 300 @ weight.numpy()
    assert np.abs(of_weight).max() / 7 < 1e-5
    assert np.abs(residual.mean(0)).max() < 1e-5


def test_regression_agrees_with_scipy_on_the_same_objective():
    features, targets = blobs(width=3)
    ridge, x = 0.05, features.numpy()

    def objective(flat):
        logits = x @ flat[:9].reshape(3, 3)
        picked = log_softmax(logits + flat[9:], axis=1)[np.arange(len(x)), targets]
        return -picked.mean() + ridge / 2 * logits.var(axis=0).sum()

    best = minimize(objective, np.zeros(12), tol=1e-10).x
    expected = softmax(x @ best[:9].reshape(3, 3) + best[9:], axis=1)
    weight, bias = logistic_regression(features, targets, 3, ridge)
    actual = softmax((features @ weight + bias).numpy(), axis=1)
    assert actual == pytest.approx(expected, abs=1e-4)


def test_no_invertible_map_of_the_features_changes_the_predictions():
    features, targets = blobs()
    # Nearly copies of one feature, far from zero: standardising each would not part them.
    mixing = torch.full((5, 5), 100.0, dtype=torch.float64) + torch.diag(torch.arange(1.0, 6.0))
    lifted = torch.cat([features, features @ mixing], dim=1)  # ten features of rank five
    for ridge in (1e-4, 0.1):
        weight, bias = logistic_regression(features, targets, 3, ridge)
        expected = (features @ weight + bias).softmax(1)
        for mapped in (features @ mixing + 5, lifted):
            weight, bias = logistic_regression(mapped, targets, 3, ridge)
            assert ((mapped @ weight + bias).softmax(1) - expected).abs().max() < 1e-4


def test_ridge_alone_gives_the_class_frequencies():
    features, _ = blobs()
    targets = (torch.arange(300) < 75).long()
    weight, bias = logistic_regression(features, targets, 2, ridge=1e3)
    probability = (features @ weight + bias).softmax(1).mean(0)
    assert probability.tolist() == pytest.approx([0.75, 0.25], abs=1e-4)


def test_regression_survives_constant_features_and_runs_without_gradients():
    features, targets = blobs()
    constant = torch.cat([features, torch.full((300, 2), 0.1, dtype=torch.float64)], dim=1).float()
    with torch.inference_mode():
        constant = constant.clone()
    with torch.no_grad():
        weight, _ = logistic_regression(constant, targets, 3)
        again, _ = logistic_regression(constant, targets, 3)
    assert weight.isfinite().all()
    assert weight[5:].abs().max() < 1e-6
    assert torch.equal(weight, again)


def test_class_without_a_training_point_is_never_predicted():
    features, targets = blobs()
    weight, bias = logistic_regression(features, torch.where(targets == 1, 3, targets), 4)
    assert bias[1] == -math.inf
    assert set((features @ weight + bias).argmax(1).tolist()) == {0, 2, 3}


def test_probe_of_separable_features_is_perfect_and_of_noise_is_the_most_frequent_class():
    labels = torch.tensor([CAR, ROAD, TREE, ROAD] * 50)
    one_hot = torch.eye(30)[labels]
    scores = linear_probe(one_hot, labels, [(one_hot, labels)] * 2, (ROAD, CAR, TREE))
    assert scores.mean_iou == 1.0
    assert scores.accuracy == 1.0
    assert int(scores.confusion.sum()) == 400  # both scans
    noise = torch.zeros(200, 4)
    scores = linear_probe(noise, labels, [(noise, labels)], (ROAD, CAR, TREE))
    assert scores.iou == {ROAD: 0.5, CAR: 0.0, TREE: 0.0}
    assert scores.accuracy == 0.5


def test_probe_leaves_out_other_labels_in_fit_and_test():
    labels = torch.tensor([CAR, ROAD, 0, 1] * 20)
    one_hot = torch.eye(30)[labels]
    misleading = one_hot.clone()
    misleading[2::4] = one_hot[0]  # unlabelled points that look like cars
    scores = linear_probe(misleading, labels, [(misleading, labels)], (CAR, ROAD))
    assert scores.accuracy == 1.0
    assert int(scores.confusion.sum()) == 40


def test_probe_takes_half_precision_features():
    features, targets = blobs()
    half = features.to(torch.bfloat16)
    full = linear_probe(features, targets, [(features, targets)], (0, 1, 2))
    assert linear_probe(half, targets, [(half, targets)], (0, 1, 2)).accuracy == pytest.approx(
        full.accuracy, abs=0.02
    )


def test_probe_refuses_what_it_cannot_fit():
    features, targets = blobs()
    with pytest.raises(ValueError, match="no labelled point"):
        linear_probe(features, targets, [], (5, 6))
    with pytest.raises(ValueError, match="twice"):
        linear_probe(features, targets, [], (0, 0))
    features[3, 2] = torch.nan
    with pytest.raises(ValueError, match="NaN or infinite"):
        linear_probe(features, targets, [], (0, 1))


def test_scores_by_hand():
    # Truth: 8 road, 2 car, no tree; two road points are taken for cars, one for a tree.
    scores = ProbeScores((ROAD, CAR, TREE), torch.tensor([[5, 2, 1], [0, 2, 0], [0, 0, 0]]))
    assert scores.iou[ROAD] == pytest.approx(5 / 8)
    assert scores.iou[CAR] == pytest.approx(2 / 4)
    assert math.isnan(scores.iou[TREE])  # no test point: not in the mean
    assert scores.mean_iou == pytest.approx((5 / 8 + 2 / 4) / 2)
    assert scores.accuracy == pytest.approx(7 / 10)
    assert scores.shares == pytest.approx({ROAD: 0.8, CAR: 0.2, TREE: 0.0})
    nothing = ProbeScores((ROAD,), torch.zeros(1, 1, dtype=torch.int64))
    assert math.isnan(nothing.mean_iou)
    assert math.isnan(nothing.accuracy)


# Cells


def test_neighbour_cosine_by_hand():
    along, across = torch.tensor([2.0, 0.0]), torch.tensor([0.0, 0.5])
    diagonal, empty = torch.tensor([3.0, 3.0]), torch.zeros(2)
    grid = torch.stack([along, diagonal, across, empty, along, diagonal, empty, empty])
    # Row 0: along-diagonal and diagonal-across; the empty cell has no neighbour. Row 1: one pair.
    # Columns 0 and 1: equal cells. (2 x 4 cells; nothing wraps as the last column is empty.)
    assert neighbour_cosine(grid, (2, 4)) == pytest.approx((3 * math.sqrt(0.5) + 2) / 5)
    assert empty_share(grid) == 3 / 8


def test_neighbour_cosine_wraps_columns_and_not_rows():
    row = torch.eye(3)[[0, 1, 2, 0]]
    assert neighbour_cosine(row, (1, 4)) == pytest.approx(1 / 4)  # last and first
    assert neighbour_cosine(row, (4, 1)) == 0.0
    assert neighbour_cosine(row[:2], (1, 2)) == 0.0
    assert neighbour_cosine(torch.ones(2, 3), (1, 2)) == pytest.approx(1.0)


def test_neighbour_cosine_without_a_pair_is_unknown():
    assert math.isnan(neighbour_cosine(torch.zeros(6, 2), (2, 3)))
    assert math.isnan(neighbour_cosine(torch.ones(1, 2), (1, 1)))
    with pytest.raises(ValueError, match="5 cells do not fill a grid of 2 x 3"):
        neighbour_cosine(torch.ones(5, 2), (2, 3))


# Sources


class ClassOfThePoint:
    """Features that tell the class (by label), or only the intensity."""

    name = "toy"

    def __init__(self, needs_labels):
        self.needs_labels = needs_labels

    def prepare(self, points, labels=None):
        if labels is None:
            return points[:, 3:]
        assert (labels >> 16).any()  # instances arrive, too
        return torch.eye(30)[labels & 0xFFFF]

    def point_features(self, prepared):
        return list(prepared)


class Lifted(ClassOfThePoint):
    def lift(self, values):
        return torch.cat([values, torch.ones(len(values), 1)], dim=1)


def labelled_scan(seed, num=400):
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(num, 4, generator=generator) * torch.tensor([20.0, 20.0, 1.0, 1.0]) - 5
    semantic = torch.tensor([CAR, ROAD, TREE, 0])[torch.randint(0, 4, (num,), generator=generator)]
    return points, semantic | torch.arange(num) % 9 << 16


def test_source_that_knows_the_class_is_perfect_and_one_that_does_not_is_poor():
    train, test = [labelled_scan(0), labelled_scan(1)], [labelled_scan(2)]
    classes = (CAR, ROAD, TREE)
    knows = probe_source(ClassOfThePoint(True), train, test, classes, points_per_scan=100)
    assert knows.scores.mean_iou == 1.0
    assert knows.train_points == 200
    labels = test[0][1] & 0xFFFF
    assert int(knows.scores.confusion.sum()) == int((labels != 0).sum())
    assert knows.ms_per_scan > 0
    guesses = probe_source(ClassOfThePoint(False), train, test, classes)
    assert guesses.scores.accuracy < 0.5
    assert guesses.train_points == sum(int((coded & 0xFFFF != 0).sum()) for _, coded in train)


def test_source_statistics_are_those_of_its_lifted_grids():
    sensor = LidarSensor(beams=16, columns=64)
    projection = SphericalProjection(sensor)
    test = [labelled_scan(2), labelled_scan(3)]
    probe = probe_source(
        Lifted(True), [labelled_scan(0)], test, (CAR, ROAD), projection, grid_size=(4, 8)
    )
    expected = []
    for points, coded in test:
        one_hot = torch.eye(30)[coded & 0xFFFF]
        grid, counts = pool_cells(points[:, :3], one_hot, projection, (4, 8))
        grid = torch.cat([grid, (counts > 0).float()[:, None]], dim=1)
        assert (counts == 0).any()
        expected.append((float((counts == 0).float().mean()), neighbour_cosine(grid, (4, 8))))
    means = np.mean(expected, axis=0)
    assert (probe.empty_share, probe.neighbour_cosine) == pytest.approx(tuple(means))


def test_source_with_bad_features_or_without_scans_is_refused():
    class Broken(ClassOfThePoint):
        def point_features(self, prepared):
            return [part * torch.nan for part in prepared]

    scan = labelled_scan(0)
    with pytest.raises(ValueError, match="'toy' hold NaN"):
        probe_source(Broken(False), [scan], [scan], (CAR,))
    with pytest.raises(ValueError, match="no scan to fit"):
        probe_source(ClassOfThePoint(False), [], [scan], (CAR,))
    with pytest.raises(ValueError, match="no scan to test"):
        probe_source(ClassOfThePoint(False), [scan], [], (CAR,))
