import pytest
import torch

from r3dpa.metrics.nearest import nearest_images


def test_copies_are_found_at_distance_zero_and_in_any_batch():
    images = 2 + 60 * torch.rand(7, 32, 128, generator=torch.Generator().manual_seed(0))
    found = nearest_images(images[[5, 0]], images.split(3))
    assert found.number.tolist() == [5, 0]
    assert found.distance.tolist() == [0, 0]


def test_twice_as_far_is_a_distance_of_one_and_no_return_counts_as_range_zero():
    images = torch.full((3, 64, 1024), 7.0)  # log2(1 + 7) = 3
    images[1], images[2] = 15, -1
    found = nearest_images(images[:1], [images[1:2], images[2:]])
    assert (found.number.item(), found.distance.item()) == (0, pytest.approx(1))
    assert nearest_images(images[:1], [images[2:]]).distance.item() == pytest.approx(3)


def test_no_reference_is_refused():
    with pytest.raises(ValueError, match="at least one"):
        nearest_images(torch.zeros(1, 8, 8), [])
