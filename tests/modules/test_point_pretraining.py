from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lightning import Trainer
from point_clouds import GRID, cloud
from tiny_stages import SILENT

from r3dpa.data import LidarDataModule, PointDataModule, write_bin
from r3dpa.data.datasets import DrawnPoints
from r3dpa.features import Masking, WaffleIron, WaffleIronS, collate_scans
from r3dpa.modules import PointPretraining


@pytest.fixture
def module():
    torch.manual_seed(0)
    module = PointPretraining(WaffleIron(16, 3, GRID.cells))
    with torch.no_grad():
        module.hidden_token.normal_()
        module.edges.copy_(torch.linspace(-1, 1, 7).expand_as(module.edges))
        for layer in (*module.network.spatial, *module.network.channel):
            layer.scale.fill_(1.0)
    return module


@pytest.fixture
def masked():
    return [Masking(GRID)(cloud(seed), np.random.default_rng(seed)) for seed in (1, 2)]


def test_nothing_is_learnt_from_hidden_points(module, masked):
    """All that is hidden may change, but for the cells: no token does, in training mode either."""
    batch = collate_scans([each.scan for each in masked])
    hidden = torch.cat([each.hidden for each in masked])
    assert 0.1 < hidden.float().mean() < 0.9
    features = batch.features.clone()
    features[hidden] = torch.randn(int(hidden.sum()), features.shape[1])
    neighbors = batch.neighbors.clone()
    neighbors[hidden] = 0
    for mode in (True, False):
        module.train(mode)
        tokens = module.tokens(batch, hidden)
        changed = module.tokens(batch._replace(features=features, neighbors=neighbors), hidden)
        assert torch.equal(tokens, changed)
    visible = torch.nonzero(~hidden)[0]
    features = batch.features.clone()
    features[visible, 0] += 1
    changed = module.tokens(batch._replace(features=features), hidden)
    assert (changed - tokens)[hidden].abs().max() > 1e-4  # hidden points do read from the others


def test_tokens_without_hidden_points_are_those_of_the_network(module, masked):
    module.eval()
    batch = collate_scans([each.scan for each in masked])
    nothing = torch.zeros(len(batch.features), dtype=torch.bool)
    expected = module.norm(module.network(batch))
    assert torch.allclose(module.tokens(batch, nothing), expected, atol=1e-5)


def test_loss_is_the_cross_entropy_of_the_quantiles(module, masked):
    """With a head that always tells the frequencies, it is their entropy."""
    values = torch.cat([each.targets for each in masked])
    levels = torch.linspace(0, 1, 9)[1:-1]
    with torch.no_grad():
        module.edges.copy_(torch.quantile(values, levels, dim=0).T)
        module.head.weight.zero_()
        counts = torch.stack(
            [
                torch.bincount(torch.bucketize(column.contiguous(), edges), minlength=8)
                for column, edges in zip(values.T, module.edges, strict=True)
            ]
        )
        share = counts / counts.sum(dim=1, keepdim=True)
        module.head.bias.copy_(share.clamp_min(1e-12).log().flatten())
    entropy = -(share * share.clamp_min(1e-12).log()).sum(dim=1).mean()
    losses = module.losses(masked)
    assert losses["loss"].item() == pytest.approx(entropy.item(), rel=1e-5)
    hidden = torch.cat([each.hidden for each in masked]).float().mean()
    mixed = losses["visible"] * (1 - hidden) + losses["hidden"] * hidden
    assert mixed.item() == pytest.approx(entropy.item(), rel=1e-5)


def test_a_scan_without_hidden_points_has_no_hidden_loss(module):
    masked = [Masking(GRID, max_hidden=0)(cloud(), np.random.default_rng(0))]
    losses = module.losses(masked)
    assert losses["hidden"].item() == 0
    assert losses["loss"].item() == pytest.approx(losses["visible"].item())


@pytest.fixture
def data(tmp_path):
    """Data module of four random scans, three to train on."""
    for seed in range(4):
        write_bin(tmp_path / "scans" / f"{seed}.bin", cloud(seed))
    source = LidarDataModule(str(tmp_path / "scans"), val_every=4)
    return PointDataModule(source, Masking(GRID), batch_size=1)


def test_training_learns_and_writes_weights_that_extract_the_same(tmp_path, module, data):
    module.edges.fill_(torch.nan)
    module.optimizer_config = replace(module.optimizer_config, warmup_steps=2, lr=1e-2)
    trainer = Trainer(max_steps=30, num_sanity_val_steps=0, default_root_dir=tmp_path, **SILENT)
    trainer.fit(module, data)
    assert module.edges.isfinite().all()
    assert (module.edges.diff(dim=1) >= 0).all()
    chance = np.log(8)
    assert trainer.callback_metrics["train/visible"] < 0.9 * chance
    assert "val/loss" in trainer.callback_metrics
    extractor = WaffleIronS(tmp_path / "waffleiron_s.safetensors", dim=16)
    points = cloud(9)
    prepared = extractor.prepare(points)
    batch = collate_scans([prepared])
    nothing = torch.zeros(len(batch.features), dtype=torch.bool)
    tokens = module.eval().tokens(batch, nothing).detach()
    expected = torch.nn.functional.normalize(tokens, dim=1)[prepared.upsample]
    features = extractor(points)
    assert torch.allclose(features @ features.T, expected @ expected.T, atol=1e-5)


def test_draws_are_a_function_of_seed_epoch_and_scan(data):
    data.setup("fit")
    first = data.train_set[(0, 1)]
    assert torch.equal(first.scan.features, data.train_set[(0, 1)].scan.features)
    assert torch.equal(first.scan.features, data.train_set[1].scan.features)  # as in validation
    assert not torch.equal(first.scan.features, data.train_set[(1, 1)].scan.features)
    other = DrawnPoints(data.train_set.scans, data.source.sensor, data.prepare, seed=1)
    assert not torch.equal(first.scan.features, other[(0, 1)].scan.features)
    assert len(data.train_set) == 3
    assert len(data.val_set) == 1


def test_points_and_networks_that_do_not_fit_are_refused(tmp_path, module, data):
    trainer = SimpleNamespace(datamodule=data)
    other = PointPretraining(WaffleIron(16, 3, (4, 4, 4)))
    other._trainer = trainer
    with pytest.raises(ValueError, match=r"network has cells \[4, 4, 4\].*\[32, 32, 12\]"):
        other.setup("fit")
    data.prepare = str
    module._trainer = trainer
    with pytest.raises(ValueError, match=r"with prepare r3dpa\.features\.Masking, got"):
        module.setup("fit")
    source = LidarDataModule(
        str(tmp_path / "scans"), extractor=torch.nn.Identity(), features_dir=str(tmp_path)
    )
    with pytest.raises(ValueError, match=r"source\.init_args\.extractor must be null"):
        PointDataModule(source, Masking(GRID))
