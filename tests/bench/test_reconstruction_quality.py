import json

import pytest
import torch
import yaml
from reconstruction_quality import main, quality

from lidarsim import simulate
from r3dpa.checkpoints import Checkpoint, NetworkState, save_checkpoint
from r3dpa.geometry import (
    NUM_CLASSES,
    LidarSensor,
    Pixels,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
)
from r3dpa.nn import VAE

SENSOR = LidarSensor(beams=16, columns=64)
CODEC = RangeCodec("log2", return_channel=True, intensity_channel=True, num_classes=NUM_CLASSES)
ARGS = {"in_channels": 2, "channels": 32, "channel_multipliers": [1, 1], "strides": [[2, 2]]}
ARGS |= {"num_res_blocks": 0, "modes": 2, "intensity": True, "num_classes": NUM_CLASSES}
GEOMETRY = ScanGeometry(SphericalProjection(SENSOR), CODEC, (4, 8))


def test_the_spread_is_the_error_of_the_median(monkeypatch):
    """Intensities 0, 0.4 and 0.5: the median misses by 0.4, 0 and 0.1; the VAE says 0.5."""
    scan = Pixels(
        torch.full((1, 3), 10.0), torch.tensor([[0.0, 0.4, 0.5]]), torch.tensor([[0, 0, 11]])
    )
    decoded = Pixels(scan.range_m[None], torch.full((1, 1, 3), 0.5), scan.classes[None])
    given = Pixels(*(values[None] for values in scan))
    monkeypatch.setattr("reconstruction_quality.reconstruct", lambda *_: (given, decoded))
    figures = quality(None, [scan])
    assert figures["scans"] == 1
    assert figures["intensity_spread"] == pytest.approx(0.5 / 3)
    assert figures["intensity_error"] == pytest.approx(0.6 / 3)
    assert figures["miou"] == 1
    assert figures["range_error_m"] == 0


def test_held_out_and_real_scans_are_measured(tmp_path):
    weights = tmp_path / "vae.safetensors"
    networks = {"vae": NetworkState.of(VAE(**ARGS), ARGS)}
    save_checkpoint(
        Checkpoint(weights, "vae_alignment", networks, geometry=GEOMETRY.to_dict()), weights
    )
    data = {"class_path": "r3dpa.data.SimulatedImageDataModule"}
    data["init_args"] = {"root": str(tmp_path / "images"), "num_scans": 2, "grid_size": [4, 8]}
    data["init_args"] |= {"sensor": {"beams": 16, "columns": 64}, "simulation_sensor": "vlp16"}
    data["init_args"] |= {"codec": {"return_channel": True, "intensity_channel": True}}
    (tmp_path / "data.yaml").write_text(yaml.safe_dump({"data": data}))
    simulate(tmp_path / "real", 1, sensor="vlp16")
    out = tmp_path / "quality.json"
    words = ["--ckpt", weights, "--data", tmp_path / "data.yaml", "--real", tmp_path / "real"]
    main([str(word) for word in (*words, "--out", out)])
    results = json.loads(out.read_text())["reconstruction"]
    assert results["held-out scans"]["scans"] == results["real scans"]["scans"] == 1
    for figures in results.values():
        assert {"miou", "intensity_error", "intensity_spread", "edge_error_m"} <= figures.keys()
