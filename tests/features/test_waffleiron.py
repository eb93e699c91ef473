import pickle

import numpy as np
import pytest
import torch

from r3dpa.features import ScaLR, ScanGrid, WaffleIron, collate_scans, prepare_scan

GRID = ScanGrid(
    minimum_m=(-8.0, -8.0, -2.0), maximum_m=(8.0, 8.0, 2.0), cell_m=1.0, num_neighbors=4
)
INTENSITY, X, Y, Z, RADIUS = range(5)


def cloud(num_points, seed=0):
    """Random points, most of them in the field of view of GRID."""
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.randn(num_points, 3, generator=generator) * torch.tensor([4.0, 4.0, 1.0])
    return torch.cat([xyz, torch.rand(num_points, 1, generator=generator)], dim=1)


def prepare(points):
    return prepare_scan(points, GRID)


@pytest.fixture
def network():
    """Small network with random norms and scales, so that no layer is close to nothing."""
    torch.manual_seed(0)
    network = WaffleIron(width=12, depth=4, cells=GRID.cells, head_dim=7)
    with torch.no_grad():
        for name, value in network.state_dict().items():
            if "running_var" in name:
                value.uniform_(0.5, 2.0)
            elif name.endswith("scale") or "running_mean" in name or "norm" in name:
                value.copy_(torch.randn(value.shape))
    return network.eval()


def test_voxel_keeps_its_first_point_and_the_border_is_left_out():
    points = torch.tensor(
        [
            [0.02, 0.0, 0.0, 0.5],
            [-1.0, 0.0, 0.0, 0.1],  # the minimum, from which voxels are counted
            [0.01, 0.0, 0.0, 0.6],  # in the voxel of point 0, which came first
            [7.99995, 0.0, 0.0, 0.2],  # nearer to the border than 0.1 mm
            [9.0, 0.0, 0.0, 0.3],
            [-1.0, 0.5, 0.0, 0.4],
        ]
    )
    scan = prepare(points)
    assert scan.kept.tolist() == [1, 5, 0]
    # The dropped points have the nearest kept one.
    assert scan.upsample.tolist() == [2, 0, 2, 2, 2, 1]
    features = scan.features[1]
    assert features[INTENSITY].item() == pytest.approx((0.4 - 0.294584) / 0.147190, rel=1e-5)
    assert features[[X, Y, Z]].tolist() == [-1.0, 0.5, 0.0]
    assert features[RADIUS].item() == pytest.approx(1.25**0.5)
    # Row and column, counted from (-8, -8, -2) in metres: x and y of 16, z of 4 cells.
    assert scan.cells[:, 1].tolist() == [7 * 16 + 8, 7 * 4 + 2, 8 * 4 + 2]
    # Three points: two neighbours each, the farthest repeated.
    assert scan.neighbors.tolist() == [[1, 2, 2, 2], [0, 2, 2, 2], [0, 1, 1, 1]]


def test_cells_of_unequal_edges():
    """64 x 60 x 8 m in 64 x 48 x 16 cells: planes of 64 x 48, 64 x 16 and 48 x 16."""
    grid = ScanGrid((-32.0, -30.0, -4.0), (32.0, 30.0, 4.0), (1.0, 1.25, 0.5), num_neighbors=1)
    assert grid.cells == (64, 48, 16)
    scan = prepare_scan(np.array([[1.5, -3.0, 0.6, 0.2], [-32.5, 0, 0, 0]]), grid)
    x, y, z = 33, 21, 9  # of 33.5, 27 and 4.6 m from the lowest corner
    assert scan.cells[:, 0].tolist() == [x * 48 + y, x * 16 + z, y * 16 + z]
    network = WaffleIron(4, 3, grid.cells)
    assert network.plane_sizes == [(64, 48), (64, 16), (48, 16)]
    assert network(collate_scans([scan, scan])).shape == (2, 4)


def test_single_points_and_empty_scans(network):
    point = torch.tensor([[1.0, 2.0, 0.5, 0.3]])
    one = prepare(point)
    assert one.neighbors.tolist() == [[0, 0, 0, 0]]
    empty = prepare(cloud(0))
    assert [len(empty.features), len(empty.upsample)] == [0, 0]
    outside = prepare(cloud(5) + 20)
    assert len(outside.features) == 0
    assert outside.upsample.tolist() == [0] * 5  # M = 0: no point to take from
    extractor = ScaLR(network, GRID)
    assert extractor(cloud(0)).shape == (0, 12)
    assert torch.equal(extractor(cloud(5) + 20), torch.zeros(5, 12))
    assert extractor(point).norm().item() == pytest.approx(1)
    # An empty scan changes nothing for the others of its batch.
    other = prepare(cloud(50))
    mixed = network(collate_scans([empty, other, one]))
    torch.testing.assert_close(mixed[:-1], network(collate_scans([other])))
    torch.testing.assert_close(mixed[-1:], network(collate_scans([one])))


def test_refused_input(network):
    points = cloud(3)
    with pytest.raises(ValueError, match=r"must be \(P, 4\).*got \(3, 3\)"):
        prepare(points[:, :3])
    points[1, 3] = torch.nan
    for call, message in (
        (lambda: prepare(points), "1 of 3 points are NaN or infinite"),
        (lambda: ScanGrid(cell_m=0.3), r"whole number of cells of 0\.3 m"),
        (lambda: ScanGrid(cell_m=(1.0, 1.0, 0.3)), "whole number"),
        (lambda: ScanGrid(cell_m=(1.0, 0.0, 1.0)), "cell_m must be positive"),
        (lambda: ScanGrid(voxel_m=0), "voxel_m must be positive, got 0"),
        (lambda: ScaLR(network), r"\(16, 16, 4\), but grid has \(256, 256, 32\)"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_spatial_mixing_agrees_with_matrices(network):
    """Means and copies as products with the N x cells matrix that the network does without."""
    scans = [prepare(cloud(150, seed)) for seed in (0, 1)]
    batch = collate_scans(scans)
    starts = [0, len(scans[0].features), len(batch.features)]
    tokens = torch.randn(len(batch.features), 12, generator=torch.Generator().manual_seed(2))
    for plane, (rows, columns) in enumerate([(16, 16), (16, 4), (16, 4)]):
        layer = network.spatial[plane]
        actual = layer(tokens, network._planes(batch)[plane])
        for i, scan in enumerate(scans):
            own = tokens[starts[i] : starts[i + 1]]
            member = torch.nn.functional.one_hot(scan.cells[plane], rows * columns).float()
            assert member.sum(dim=0).max() > 1
            means = torch.linalg.pinv(member) @ layer.norm(own)
            image = layer.convs(means.T.reshape(1, 12, rows, columns))
            expected = own + layer.scale * (member @ image.reshape(12, -1).T)
            torch.testing.assert_close(
                actual[starts[i] : starts[i + 1]], expected, atol=2e-5, rtol=1e-5
            )


def test_gradients_reach_every_parameter_and_statistics_follow_real_points(network):
    network.train()
    batch = collate_scans([prepare(cloud(100, 0)), prepare(cloud(30, 1))])
    mean = network.embedding.norm.running_mean.clone()
    network.head(network(batch)).square().mean().backward()
    without = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert not without
    assert all(torch.isfinite(p.grad).all() for p in network.parameters())
    torch.testing.assert_close(
        network.embedding.norm.running_mean, 0.9 * mean + 0.1 * batch.features.mean(dim=0)
    )


@torch.no_grad()
def test_neighbours_one_by_one_equal_all_at_once(network):
    """Evaluation takes the maximum over neighbours in a loop, training in one step."""
    scan = prepare(cloud(60))
    expected = network.embedding(scan.features, scan.neighbors)
    for norm in (module for module in network.modules() if hasattr(module, "running_mean")):
        norm.eval()
    network.embedding.training = True  # the norms stay in evaluation mode
    torch.testing.assert_close(network.embedding(scan.features, scan.neighbors), expected)


@torch.no_grad()
def test_bfloat16_keeps_coordinates_and_sums_in_float32(network):
    """Points 12 cm apart at 60 m share their coordinates in bfloat16 (spacing 25 cm)."""
    far = torch.tensor([[60.0, 0.0, 0.0, 0.3, 60.0], [60.12, 0.0, 0.0, 0.3, 60.12]])
    assert far.bfloat16().unique(dim=0).shape[0] == 1
    batch = collate_scans([prepare(cloud(200))])
    tokens = network(batch)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = network(batch)
    assert rounded.dtype == torch.float32
    assert 0 < (rounded - tokens).norm() / tokens.norm() < 0.01
    network.embedding.neighbor.weight.zero_()  # of the two parts that of the point itself
    with torch.autocast("cpu", dtype=torch.bfloat16):
        near, there = network.embedding(far, torch.tensor([[1], [0]]))
    near_exact, there_exact = network.embedding(far, torch.tensor([[1], [0]]))
    torch.testing.assert_close(there - near, there_exact - near_exact)
    assert (there - near).abs().max() > 0.01


@torch.no_grad()
def test_features_of_a_batch_are_those_of_its_scans(network):
    extractor = ScaLR(network, GRID)
    scans = [cloud(200), cloud(5) + 20, cloud(90, 1), cloud(0)]
    passes = []
    network.register_forward_hook(lambda *_: passes.append(1))
    together = extractor.point_features([extractor.prepare(points) for points in scans])
    assert len(passes) == 1
    assert [len(features) for features in together] == [200, 5, 90, 0]
    for points, features in zip(scans, together, strict=True):
        torch.testing.assert_close(features, extractor(points), atol=1e-5, rtol=1e-5)
    assert not together[1].any()
    nowhere = extractor.point_features([extractor.prepare(points) for points in scans[1::2]])
    assert [tuple(features.shape) for features in nowhere] == [(5, 12), (0, 12)]


def test_preparation_goes_to_other_processes_without_weights():
    extractor = ScaLR(WaffleIron(width=64, depth=3, cells=GRID.cells), GRID)
    packed = pickle.dumps(extractor.prepare)
    assert len(packed) < 1000
    points = cloud(30)
    again = pickle.loads(packed)(points)  # noqa: S301 - made above
    for actual, expected in zip(again, prepare(points), strict=True):
        assert torch.equal(actual, expected)


@torch.inference_mode()
def test_no_point_learns_anything_of_a_hidden_one(network):
    """And the hidden ones learn from the visible ones."""
    batch = collate_scans([prepare(cloud(60))])
    tokens = torch.randn(len(batch.features), 12)
    visible = torch.arange(len(tokens)) % 3 > 0
    mixed = network.mix(tokens, batch, visible)
    changed = torch.where(visible[:, None], tokens, torch.randn_like(tokens))
    torch.testing.assert_close(network.mix(changed, batch, visible)[visible], mixed[visible])
    assert not torch.allclose(network.mix(changed, batch)[visible], mixed[visible], atol=1e-2)
    others = torch.where(visible[:, None], torch.randn_like(tokens), tokens)
    assert not torch.allclose(network.mix(others, batch, visible)[~visible], mixed[~visible])


def test_training_and_evaluation_have_the_same_offset_layer_and_gradient(network):
    layer, offsets = network.embedding.offset[1], torch.randn(40, 5)
    outputs, gradients = [], []
    for training in (True, False):
        layer.train(training)
        outputs.append(layer(offsets))
        gradients.append(torch.autograd.grad(outputs[-1].square().sum(), layer.weight)[0])
    torch.testing.assert_close(*outputs)
    torch.testing.assert_close(*gradients)
