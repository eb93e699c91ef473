import pytest
import torch
from label_quality import LabelQuality, class_confusion, class_iou

from r3dpa.geometry import Pixels

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
