import pytest
import torch
from teacher_gap import explained_variance, mean_iou, ridge

from r3dpa.geometry.semantics import NUM_CLASSES


def test_ridge_shrinks_as_derived_by_hand():
    """Inputs -1 and 1 are standardised already; targets 4 and 8 are 6 + 2 x.

    The weight minimises (2 - w)^2 + p w^2, so w = 2 / (1 + p): 1.6 at p = 0.25. Its predictions
    6 -+ 1.6 miss by 0.4, of a spread of 2: 1 - 0.16 / 4 = 0.96 is explained.
    """
    inputs, targets = torch.tensor([[-1.0], [1.0]]), torch.tensor([[4.0], [8.0]])
    predict = ridge(inputs, targets, penalty=0.25)
    assert predict(inputs)[:, 0].tolist() == pytest.approx([4.4, 7.6])
    assert explained_variance(predict(inputs), targets).item() == pytest.approx(0.96)
    assert ridge(inputs * 10 + 3, targets, 0.25)(torch.tensor([[23.0]])).item() == pytest.approx(
        9.2
    )


def test_constant_targets_explain_nothing():
    constant = torch.ones(4, 1)
    assert explained_variance(constant, constant).isnan().all()


def test_mean_iou_counts_the_classes_that_occur():
    """One of two is found of class 0; the other is false in class 1: 1 / 2 and 2 / 3."""
    classes = torch.tensor([0, 0, 1, 1])
    predicted = torch.tensor([0, 1, 1, 1])
    score, each = mean_iou(predicted, classes)
    assert each[0].item() == pytest.approx(1 / 2)
    assert each[1].item() == pytest.approx(2 / 3)
    assert each[2:].isnan().all()
    assert len(each) == NUM_CLASSES
    assert score == pytest.approx((1 / 2 + 2 / 3) / 2)
