"""Semantic classes of range images, and the class ids of KITTI-360 that they stand for."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

UNKNOWN_CLASS = -1
"""Class of a pixel without a return, or whose return has no label."""


class SemanticClass(NamedTuple):
    """Class that a VAE learns: its name, the KITTI-360 id it is written as, and further ids."""

    name: str
    label: int
    also: tuple[int, ...] = ()

    @property
    def labels(self) -> tuple[int, ...]:
        """All its KITTI-360 ids."""
        return self.label, *self.also


#: Position in this list is the number of a class. Ids that are missing count as unlabelled:
#: unlabeled 0, ego vehicle 1, rectification border 2, out of roi 3, sky 23.
SEMANTIC_CLASSES = (
    SemanticClass("road", 7),
    SemanticClass("sidewalk", 8),
    SemanticClass("other ground", 9, (6, 10)),  # parking; ground, rail track
    SemanticClass("building", 11, (15, 16, 34, 42)),  # bridge, tunnel, garage, construction
    SemanticClass("wall", 12),
    SemanticClass("fence", 13, (14, 35)),  # guard rail, gate
    SemanticClass("pole", 17, (18, 37, 38)),  # pole group, small pole, lamp
    SemanticClass("sign", 20, (19,)),  # traffic light
    SemanticClass("vegetation", 21),
    SemanticClass("terrain", 22),
    SemanticClass("person", 24, (25,)),  # rider
    SemanticClass("car", 26, (29, 30, 43)),  # caravan, trailer, unknown vehicle
    SemanticClass("truck", 27, (28, 31)),  # bus, train
    SemanticClass("two-wheeler", 33, (32,)),  # bicycle; motorcycle
    # unknown object; static, dynamic, stop, trash bin, vending machine, box
    SemanticClass("object", 44, (4, 5, 36, 39, 40, 41)),
)
NUM_CLASSES = len(SEMANTIC_CLASSES)
_NUM_LABELS = 1 << 16  # of a label file, whose upper bits are the object


def _classes_by_label() -> Tensor:
    table = torch.full((_NUM_LABELS,), UNKNOWN_CLASS)
    for number, semantic in enumerate(SEMANTIC_CLASSES):
        table[list(semantic.labels)] = number
    return table


_CLASS_OF_LABEL = _classes_by_label()
_LABEL_OF_CLASS = torch.tensor([0, *(semantic.label for semantic in SEMANTIC_CLASSES)])


def classes_of(labels: Tensor) -> Tensor:
    """Numbers of classes, int64, of KITTI-360 labels of any shape, integers below 2^16."""
    return _CLASS_OF_LABEL[labels.long()]


def labels_of(classes: Tensor) -> Tensor:
    """KITTI-360 labels, int64 on the same device, of numbers of classes; 0 where unknown."""
    return _LABEL_OF_CLASS.to(classes.device)[classes.long() + 1]
