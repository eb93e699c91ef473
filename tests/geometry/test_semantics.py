from __future__ import annotations

import torch

from lidarsim import Semantic
from r3dpa.data.labels import CLASS_NAMES
from r3dpa.geometry.semantics import (
    NUM_CLASSES,
    SEMANTIC_CLASSES,
    UNKNOWN_CLASS,
    classes_of,
    labels_of,
)

WITHOUT_CLASS = {0, 1, 2, 3, 23}  # unlabelled, ego vehicle, border, out of roi, sky


def test_each_label_of_kitti_360_is_of_one_class_at_most():
    labels = [label for c in SEMANTIC_CLASSES for label in c.labels]
    assert sorted(labels) == sorted(set(range(45)) - WITHOUT_CLASS)
    classes = classes_of(torch.arange(45))
    assert {int(label) for label in torch.nonzero(classes == UNKNOWN_CLASS)} == WITHOUT_CLASS
    assert set(classes.tolist()) == {UNKNOWN_CLASS, *range(NUM_CLASSES)}
    assert (classes_of(torch.tensor([45, 252, 65535])) == UNKNOWN_CLASS).all()


def test_a_class_is_written_as_a_label_that_is_read_as_this_class():
    classes = torch.arange(UNKNOWN_CLASS, NUM_CLASSES)
    assert torch.equal(classes_of(labels_of(classes)), classes)
    assert labels_of(torch.tensor(UNKNOWN_CLASS)) == 0


def test_classes_have_the_names_of_their_labels():
    for semantic in SEMANTIC_CLASSES:
        own = CLASS_NAMES[semantic.label]
        renamed = {"other ground": "parking", "two-wheeler": "bicycle", "object": "unknown object"}
        assert renamed.get(semantic.name, semantic.name) == own


def test_everything_that_the_simulator_labels_has_a_class():
    labels = {int(label) for label in Semantic} - {Semantic.UNLABELED, Semantic.EGO_VEHICLE}
    assert (classes_of(torch.tensor(sorted(labels))) != UNKNOWN_CLASS).all()
