import pickle

import pytest
import torch

from r3dpa.checkpoints import leaks_labels
from r3dpa.data import find_scans, read_beside, read_scan
from r3dpa.nn.backbones import GeometricFeatures, OracleFeatures
from r3dpa.nn.backbones.oracle import CLASS_IDS
from r3dpa.simulation import Semantic, simulate

ROAD, BUILDING, CAR = Semantic.ROAD, Semantic.BUILDING, Semantic.CAR


def grid_of_points(count=400):
    """Points of a level square 10 m ahead."""
    side = torch.arange(count**0.5) * 0.1
    x, y = torch.meshgrid(10 + side, side, indexing="ij")
    values = [x.flatten(), y.flatten(), torch.full((count,), -1.7), torch.full((count,), 0.3)]
    return torch.stack(values, dim=1)


def labels_of(semantic, instance=0, count=400):
    return torch.full((count,), semantic | instance << 16)


@pytest.fixture(scope="module")
def extractor():
    return OracleFeatures()


@pytest.fixture(scope="module")
def simulated_scans(tmp_path_factory):
    """Points and labels of two scans of streets."""
    root = tmp_path_factory.mktemp("simulated")
    simulate(root, scans=2)
    return [
        (
            torch.from_numpy(read_scan(scan.path)),
            torch.from_numpy(read_beside(scan.path, "labels").astype("int64")),
        )
        for scan in find_scans(root)
    ]


def test_its_classes_are_those_of_the_simulator():
    surfaces = set(Semantic) - {Semantic.UNLABELED, Semantic.EGO_VEHICLE}
    assert set(CLASS_IDS) == surfaces
    assert len(CLASS_IDS) == 15  # and one for all others


def test_its_name_is_known_to_leak(extractor):
    assert extractor.needs_labels
    assert leaks_labels(extractor.name)
    assert not leaks_labels(GeometricFeatures(dim=2).name)


def test_class_counts_most_then_the_object(extractor):
    """Inner products are a Gaussian kernel exp(-d^2 / 8), up to 1 / sqrt(2 * 128) = 0.06.

    Of two classes d^2 = 2 / 0.233^2, and of two objects d^2 = k / 2 / 0.9^2, where k of the 8 signs
    of their hashes differ: a step of 2 / sqrt(8) in each.
    """
    points = grid_of_points()
    features = {
        key: extractor(points, labels_of(*key))
        for key in ((ROAD, 0), (BUILDING, 0), (CAR, 1), (CAR, 2), (BUILDING, 1), (40, 0), (0, 0))
    }

    def kernel(one, other):
        return (features[one] * features[other]).sum(dim=1).mean().item()

    assert kernel((CAR, 1), (CAR, 1)) == pytest.approx(1, abs=1e-5)
    assert kernel((ROAD, 0), (BUILDING, 0)) == pytest.approx(0.01, abs=0.15)
    assert kernel((CAR, 1), (BUILDING, 1)) == pytest.approx(0.01, abs=0.15)
    assert 0.4 < kernel((CAR, 1), (CAR, 2)) < 0.99
    assert kernel((40, 0), (0, 0)) == pytest.approx(1, abs=1e-5)  # both are other classes


def test_features_follow_the_kernel_of_all_values(extractor, simulated_scans):
    points, labels = simulated_scans[0]
    values = extractor.prepare(points, labels)
    rows = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:300]
    features = extractor(points, labels)[rows]
    torch.testing.assert_close(features.norm(dim=1), torch.ones(300))
    standard = (values[rows] - extractor.centres) / extractor.spreads
    expected = torch.exp(-(torch.cdist(standard, standard) ** 2) / (2 * 2.0**2))
    assert (features @ features.T - expected).square().mean().sqrt() < 0.0625


def test_a_linear_map_finds_nearly_every_label(extractor, simulated_scans):
    """On the points of another street; without labels it finds far fewer."""
    geometric = GeometricFeatures()
    shares = {}
    for name, features_of in {
        "oracle": lambda points, labels: extractor.point_features(
            [extractor.prepare(points, labels)]
        ),
        "geometric": lambda points, _: geometric.point_features([geometric.prepare(points)]),
    }.items():
        (seen, labels), (unseen, expected) = (
            (features_of(points, labels)[0][::7].double(), labels[::7] & 0xFFFF)
            for points, labels in simulated_scans
        )
        one_hot = torch.nn.functional.one_hot(labels, 64).double()
        ridge = 1e-3 * torch.eye(seen.shape[1], dtype=torch.float64)
        weights = torch.linalg.solve(seen.T @ seen + ridge, seen.T @ one_hot)
        shares[name] = ((unseen @ weights).argmax(dim=1) == expected).double().mean().item()
    assert shares["oracle"] > 0.97
    assert shares["geometric"] < 0.8


def test_rotated_and_mirrored_scans_have_the_same_features(extractor):
    points, labels = grid_of_points(), labels_of(CAR, 3)
    mirrored = points * torch.tensor([1.0, -1.0, 1.0, 1.0])
    quarter = points[:, [1, 0, 2, 3]] * torch.tensor([-1.0, 1.0, 1.0, 1.0])
    for seen in (mirrored, quarter):
        similarity = (extractor(seen, labels) * extractor(points, labels)).sum(dim=1)
        assert similarity.quantile(0.05) > 0.99
    assert extractor.mirror_invariant
    assert extractor.num_headings == GeometricFeatures.num_headings


def test_noise_is_that_of_the_scan_and_the_seed():
    points, labels = grid_of_points(), labels_of(CAR, 3)
    clean, noisy, other = (
        OracleFeatures(seed=seed, noise=noise) for seed, noise in ((0, 0.0), (0, 0.1), (1, 0.1))
    )
    values = noisy.prepare(points, labels)
    assert torch.equal(values, noisy.prepare(points.clone(), labels))
    assert not torch.equal(values, other.prepare(points, labels))
    added = (values - clean.prepare(points, labels)) / noisy.spreads
    assert added.std().item() == pytest.approx(0.1, rel=0.05)  # 12,000 draws
    moved = points + torch.tensor([0.01, 0, 0, 0])
    again = (noisy.prepare(moved, labels) - clean.prepare(moved, labels)) / noisy.spreads
    assert (again - added).abs().max() > 0.1
    assert (noisy(points, labels) * clean(points, labels)).sum(dim=1).mean() < 0.99
    # Another view of a scan has other noise, so that grids are not those of the view.
    assert (noisy.num_headings, noisy.mirror_invariant) == (0, False)
    settings = [extractor.settings for extractor in (clean, noisy, other)]
    assert all(settings.count(each) == 1 for each in settings)


def test_scans_of_a_batch_and_preparation_elsewhere(extractor):
    scans = [(grid_of_points(), labels_of(CAR, 1)), (grid_of_points(100), labels_of(ROAD, 0, 100))]
    # As for a loader process.
    prepare = pickle.loads(pickle.dumps(extractor.prepare))  # noqa: S301
    together = extractor.point_features([prepare(*scan) for scan in scans])
    for scan, features in zip(scans, together, strict=True):
        assert torch.equal(extractor.lift(features), extractor(*scan))
    assert extractor(torch.zeros(0, 4), labels_of(CAR, 1, 0)).shape == (0, 768)


def test_refused_input(extractor):
    with pytest.raises(ValueError, match=r"400 points need as many labels, got \(399,\)"):
        extractor(grid_of_points(), labels_of(CAR)[1:])
    with pytest.raises(ValueError, match="noise must be 0 or greater, got -1"):
        OracleFeatures(noise=-1)
    with pytest.raises(ValueError, match="dim must be even"):
        OracleFeatures(dim=7)
