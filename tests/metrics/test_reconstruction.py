from __future__ import annotations

import pytest
import torch

from r3dpa.geometry import Pixels
from r3dpa.metrics.reconstruction import (
    LabelQuality,
    ReconstructionQuality,
    class_confusion,
    class_iou,
    edge_pixels,
    flying_pixels,
)

# A wall at 10 m with a pole at 4 m in columns 3 and 4, and a pixel without a return.
SCAN = torch.tensor([[10.0, 10.0, 10.0, 4.0, 4.0, 10.0, -1.0, 10.0]])


def test_edges_are_on_both_sides_and_wrap_around():
    assert edge_pixels(SCAN).tolist() == [[False, False, True, True, True, True, False, False]]
    seam = torch.tensor([[5.0, 10.0, 10.0, 10.0]])
    assert edge_pixels(seam).tolist() == [[True, True, False, True]]
    rows = torch.tensor([[10.0], [10.0], [5.0]])  # the first row is not above the last
    assert edge_pixels(rows).tolist() == [[False], [True], [True]]


def test_a_pixel_between_near_and_far_flies():
    ramp = SCAN.clone()
    ramp[0, 2] = 7.0
    assert flying_pixels(ramp).tolist() == [[False, False, True] + 5 * [False]]
    assert not flying_pixels(SCAN).any()
    ramp[0, 2] = 9.5  # within 0.6 m of the wall
    assert not flying_pixels(ramp).any()


def test_figures_by_hand():
    found = SCAN.clone()
    found[0, 2], found[0, 0], found[0, 7], found[0, 6] = 7.0, 10.1, -1.0, 10.0
    quality = ReconstructionQuality()
    quality.update(SCAN, found)
    figures = quality.compute()
    assert figures["range_error_m"] == pytest.approx(3.1 / 6, rel=1e-6)
    assert figures["median_error_m"] == pytest.approx(0.0005)
    assert figures["edge_error_m"] == pytest.approx(3.0 / 4)
    assert figures["return_iou"] == pytest.approx(6 / 8)
    assert figures["missing_iou"] == 0
    assert figures["flying"] == pytest.approx(1 / 7)
    assert figures["flying_scans"] == 0


def test_merged_states_equal_one_update():
    scans = 20 * torch.rand(4, 8, 32, generator=torch.Generator().manual_seed(0)) - 1
    found = scans + 0.3 * torch.randn(scans.shape, generator=torch.Generator().manual_seed(1))
    whole, first, second = (ReconstructionQuality() for _ in range(3))
    whole.update(scans, found)
    first.update(scans[:1], found[:1])
    second.update(scans[1:], found[1:])
    first.merge_state(second)
    assert first.compute() == pytest.approx(whole.compute())


# Road 0, car 11; -1 without a label.
CLASSES = torch.tensor([[0, 0, 0, 11, 11, -1]])
RECONSTRUCTED = torch.tensor([[0, 0, 11, 11, -1, 0]])


def test_iou_of_classes_by_hand():
    """Road: 2 hits, 1 taken for a car. Car: 1 hit, 1 without a return, 1 false alarm."""
    confusion = class_confusion(CLASSES, RECONSTRUCTED)
    assert confusion.sum() == 5  # the pixel without a label does not count
    assert (confusion[0, 0], confusion[0, 11], confusion[11, -1]) == (2, 1, 1)
    iou = class_iou(confusion)
    assert (iou[0].item(), iou[11].item()) == (pytest.approx(2 / 3), pytest.approx(1 / 3))
    assert iou.isnan().sum() == len(iou) - 2


def test_iou_is_the_jaccard_index_of_torchmetrics():
    from torchmetrics.functional.classification import multiclass_jaccard_index

    generator = torch.Generator().manual_seed(0)
    classes, reconstructed = torch.randint(-1, 15, (2, 3, 8, 64), generator=generator)
    counted = classes != -1
    # Class 0 is no class there; it counts only as a miss of the others.
    theirs = multiclass_jaccard_index(
        reconstructed[counted] + 1, classes[counted] + 1, num_classes=16, average=None
    )
    ours = class_iou(class_confusion(classes, reconstructed))
    torch.testing.assert_close(ours.float(), theirs[1:])


def test_label_quality_of_known_channels_in_any_batches():
    range_m = torch.full((1, 6), 10.0)
    lost_m = torch.tensor([[10.0, 10.0, 10.0, 10.0, -1.0, 10.0]])
    intensity = torch.linspace(0, 1, 6)[None]
    scans = Pixels(range_m, intensity, CLASSES)
    quality = LabelQuality()
    quality.update(scans, Pixels(lost_m, intensity + 0.1, RECONSTRUCTED))
    quality.update(scans, Pixels(range_m, intensity - 0.3, None))
    assert quality.compute() == {
        "miou": pytest.approx(1 / 2),
        "iou road": pytest.approx(2 / 3),
        "iou car": pytest.approx(1 / 3),
        "intensity_error": pytest.approx((5 * 0.1 + 6 * 0.3) / 11),
    }
    ranges_alone = LabelQuality()
    ranges_alone.update(Pixels(range_m), Pixels(lost_m))
    assert ranges_alone.compute() == {}
