"""Extraction by ``trainer.predict``: the grids on disk, whatever the number of processes."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from lightning import Trainer
from tiny_stages import SILENT

from r3dpa.data import FeatureGrids, StoreError, find_scans, write_feature_grids
from r3dpa.features import GeometricFeatures
from r3dpa.geometry import LidarSensor, SphericalProjection
from r3dpa.modules import FeatureExtraction

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.filterwarnings("ignore:predict returned None"),
    pytest.mark.filterwarnings("ignore:You have overridden `transfer_batch_to_device`"),
    pytest.mark.filterwarnings("ignore:Total length of"),
]
PROJECTION = SphericalProjection(LidarSensor(beams=16, columns=64))
SIZES = [(2, 8), (4, 16)]


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans")
    generator = np.random.default_rng(0)
    for frame in range(5):
        azimuth = generator.uniform(-np.pi, np.pi, 400)
        points = np.stack(
            [8 * np.cos(azimuth), 8 * np.sin(azimuth), -1.7 + 0 * azimuth, np.abs(azimuth) / 8]
        )
        points = points.T * generator.uniform(0.5, 2, (400, 1))
        (folder / f"{frame:010d}.bin").write_bytes(points.astype(np.float32).tobytes())
    return find_scans(folder)


def extract(scans, out, extractor=None, sizes=SIZES, batch_size=2, **options):
    extractor = extractor or GeometricFeatures(dim=16)
    trainer = Trainer(**SILENT | {"devices": 1} | options)
    extraction = FeatureExtraction(extractor, PROJECTION, sizes, out, scans, batch_size)
    assert not trainer.predict(extraction, return_predictions=False)


def read(out, scans, size):
    grids = FeatureGrids(out, scans, PROJECTION, size)
    return torch.stack([grids.read(scan) for scan in scans])


@pytest.fixture(scope="module")
def expected(scans, tmp_path_factory):
    """The same grids by the data module's own way."""
    out = tmp_path_factory.mktemp("expected")
    write_feature_grids(scans, GeometricFeatures(dim=16), PROJECTION, SIZES, out)
    return out


class Threefold:
    """Three times the points, without a lift; not finite where a scan has 399 points."""

    name, dim, settings = "threefold", 4, {}

    @staticmethod
    def prepare(points):
        return 3 * points if len(points) != 399 else points / 0

    def point_features(self, prepared):
        return list(prepared)


def test_grids_are_those_of_the_data_module(scans, expected, tmp_path):
    extract(scans, tmp_path)
    for size in SIZES:
        assert read(tmp_path, scans, size).abs().sum() > 0
        assert torch.equal(read(tmp_path, scans, size), read(expected, scans, size))


def test_bf16_differs_little(scans, expected, tmp_path):
    """Phases up to about 6 rounded to 8 bits, over the norm sqrt(8) of the kernel features."""
    extract(scans, tmp_path, precision="bf16-mixed")
    grids = read(tmp_path, scans, (2, 8))
    difference = (grids - read(expected, scans, (2, 8))).abs().max()
    assert 1e-5 < difference < 0.02
    settings = json.loads((tmp_path / "2x8" / "settings.json").read_text())
    assert settings["precision"] == "bf16-mixed"


@pytest.mark.ddp
@pytest.mark.parametrize(("num_scans", "shards"), [(5, [3, 2]), (1, [1]), (0, [])])
def test_processes_share_the_scans(num_scans, shards, scans, expected, tmp_path):
    """Each scan once; a process without one leaves nothing behind and holds nobody up."""
    scans = scans[:num_scans]
    extract(scans, tmp_path, devices=2, strategy="ddp_fork", batch_size=1)
    journals = sorted((tmp_path / "2x8").glob("shard_*.jsonl"))
    assert [len(path.read_text().splitlines()) for path in journals] == shards
    if scans:
        assert torch.equal(read(tmp_path, scans, (2, 8)), read(expected, scans, (2, 8)))


def test_bad_features_name_the_scan_and_what_was_made_before_stays(scans, tmp_path):
    bad = tmp_path / "bad.bin"
    bad.write_bytes(scans[0].path.read_bytes()[:-16])
    with pytest.raises(StoreError, match=r"bad\.bin: extractor threefold gave NaN"):
        extract([*scans[:2], *find_scans(bad)], tmp_path, Threefold(), batch_size=1)
    assert len((tmp_path / "2x8" / "shard_00000.jsonl").read_text().splitlines()) == 2
