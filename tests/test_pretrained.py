from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file
from tiny_networks import tiny_checkpoint

from r3dpa import SceneGenerator, SceneVAE, pretrained
from r3dpa.checkpoints import convert, read_checkpoint
from r3dpa.geometry import LidarSensor, RangeCodec, ScanGeometry, SphericalProjection

GEOMETRY = ScanGeometry(SphericalProjection(LidarSensor(16, 64)), RangeCodec(), (2, 8))


@pytest.fixture
def shipped(tmp_path, monkeypatch):
    """Folder of shipped weights with one name, ``tiny``."""
    folder = tmp_path / "weights"
    folder.mkdir()
    tiny_checkpoint(folder / "tiny.safetensors", GEOMETRY)
    (folder / "tiny.md").write_text("# tiny: the card\n")
    monkeypatch.setattr(pretrained, "_FOLDER", folder)
    return folder


def test_a_name_a_file_and_a_repository_are_taken_alike(shipped, monkeypatch):
    asked = []

    def snapshot_download(name, allow_patterns):
        asked.append((name, allow_patterns))
        return str(shipped)

    hub = SimpleNamespace(snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    sources = ("tiny", shipped / "tiny.safetensors", "hf://owner/name")
    first, *others = (SceneGenerator.from_pretrained(source, device="cpu") for source in sources)
    expected = first.generate(2).range_m
    for other in others:
        assert torch.equal(other.generate(2).range_m, expected)
    assert asked == [("owner/name", ["*.safetensors", "*.yaml"])]
    assert SceneVAE.from_pretrained("tiny", "cpu").vae.latent_channels == first.sit.in_channels
    assert read_checkpoint("hf://owner/name/tiny.safetensors").path == sources[1]


def test_unknown_names_are_answered_with_the_known_ones(shipped):
    with pytest.raises(FileNotFoundError, match=r"no checkpoint file large; .*\(tiny\)"):
        read_checkpoint("large")
    with pytest.raises(ValueError, match="no weights 'large'; there are tiny"):
        pretrained.models("large")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (None, "pip install"),
        (OSError("no route to host"), "cannot be read: no route to host"),
        (ValueError("404 not found"), "cannot be read: 404"),
    ],
)
def test_a_repository_that_cannot_be_read_is_one_line(monkeypatch, fault, message):
    def snapshot_download(*_, **__):
        raise fault

    hub = fault and SimpleNamespace(snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    with pytest.raises(ValueError, match=f"hf://owner/name.*{message}") as error:
        read_checkpoint("hf://owner/name")
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="give hf://owner/name"):
        read_checkpoint("hf://owner")


def test_models_lists_and_shows_cards(shipped):
    assert "tiny" in pretrained.models()
    assert pretrained.models("tiny") == "# tiny: the card\n"


def test_half_precision_rounds_all_but_statistics(shipped, tmp_path):
    out = tmp_path / "half.safetensors"
    names = ["vae", "ema", "ema_latent_norm"]
    convert(shipped / "tiny.safetensors", out, networks=names, half=True)
    weights, before = load_file(out), load_file(shipped / "tiny.safetensors")
    assert {name.split(".")[0] for name in weights} == set(names)
    for name, value in weights.items():
        if "latent_norm" in name:
            assert torch.equal(value, before[name])
        elif value.is_floating_point():
            assert value.dtype == torch.float16
            torch.testing.assert_close(value.float(), before[name], rtol=1e-3, atol=1e-6)
    generator = SceneGenerator.from_pretrained(out, device="cpu")
    assert generator.generate(1).range_m.isfinite().all()
    assert {p.dtype for p in generator.sit.parameters()} == {torch.float32}
