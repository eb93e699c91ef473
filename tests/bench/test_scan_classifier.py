import pytest
import torch
from scan_classifier import classifier_accuracy, evidence_of, train_classifier

from r3dpa.geometry import RangeCodec


def scenes(count, seed, speckle=0.0):
    """Smooth walls of random depth; with ``speckle`` a share of pixels is somewhere else."""
    generator = torch.Generator().manual_seed(seed)
    depth = 5 + 40 * torch.rand(count, 1, 1, generator=generator)
    image = depth.expand(count, 16, 64).clone()
    noise = torch.rand(image.shape, generator=generator)
    return torch.where(noise < speckle, 50 * noise / max(speckle, 1e-6) + 2, image)


def test_equal_sets_cannot_be_told_apart_and_speckled_ones_can():
    equal = classifier_accuracy(scenes(60, 0), scenes(60, 1), epochs=3)
    assert equal == classifier_accuracy(scenes(60, 0), scenes(60, 1), epochs=3)
    assert abs(equal.value - 0.5) < 4 * 0.083
    assert equal.standard_error == pytest.approx((equal.value * (1 - equal.value) / 36) ** 0.5)
    speckled = classifier_accuracy(scenes(60, 0), scenes(60, 1, 0.05), epochs=12)
    assert speckled.value > 0.9


def test_few_images_train_it_too():
    near, far = (torch.full((10, 16, 64), distance_m) for distance_m in (5.0, 40.0))
    assert classifier_accuracy(near, far, epochs=12).value == 1


def test_sets_that_cannot_be_compared_are_refused():
    with pytest.raises(ValueError, match="one size"):
        classifier_accuracy(scenes(8, 0), scenes(8, 1)[:, :8])
    with pytest.raises(ValueError, match="at least 4"):
        classifier_accuracy(scenes(8, 0), scenes(3, 1))


def test_evidence_of_the_cells_averages_to_the_logit_and_lies_where_the_speckle_is():
    real, speckled = scenes(60, 0), scenes(60, 1, 0.05)
    half = torch.cat([scenes(60, 1)[..., :32], speckled[..., 32:]], dim=-1)
    trained = train_classifier(real, half, epochs=12)
    evidence = evidence_of(trained.network, trained.generated_m)
    logits = trained.network(RangeCodec("log2", return_channel=True).to_image(trained.generated_m))
    assert evidence.shape == (18, 1, 4)
    torch.testing.assert_close(evidence.mean((1, 2)), logits[:, 0].detach())
    assert evidence[..., 2:].mean() > evidence[..., :2].mean() + 0.3
