"""What generated scenes are compared with."""

from types import SimpleNamespace

import numpy as np

from r3dpa.callbacks import SceneScorer
from r3dpa.data import LidarDataModule, write_bin


def test_further_scans_are_no_reference(tmp_path):
    """Such as simulated ones beside those of a sensor."""
    points = np.random.default_rng(0).uniform(2, 20, (100, 4)).astype(np.float32)
    points[:, 3] = 0.5
    for place in ("real/0", "real/1", "simulated/0", "simulated/1", "simulated/2"):
        write_bin(tmp_path / f"{place}.bin", points)
    further = str(tmp_path / "simulated")
    data = LidarDataModule(str(tmp_path / "real"), further_scans=further, val_every=2)
    data.setup("test")
    scorer = SceneScorer(spaces=["fgeo"], allow_few=True)
    module = SimpleNamespace(scene_generator=None, ema=object(), device="cpu")
    scorer.on_test_start(SimpleNamespace(datamodule=data), module)
    _, _, scans = scorer._job
    assert [scan.path.parent.name for scan in scans] == ["real", "real"]
