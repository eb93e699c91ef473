import pytest
import torch

from r3dpa.features import SOURCES, GeometricFeatures, ScaLR, WaffleIron, feature_source
from r3dpa.features.scalr import official_name


@pytest.fixture
def scalr_file(tmp_path):
    """Checkpoint as the distillation writes it, of width 4."""
    weights = WaffleIron(width=4, depth=1, head_dim=5).state_dict()
    weights = {official_name(key): value for key, value in weights.items()}
    torch.save({"model_point": weights}, tmp_path / "ckpt_last.pth")
    return tmp_path / "ckpt_last.pth"


def test_each_name_gives_its_extractor(scalr_file):
    assert SOURCES == ("scalr", "waffleiron-s", "waffleiron-s-2", "geometric")
    for name, ckpt, kind in (("scalr", scalr_file, ScaLR), ("geometric", None, GeometricFeatures)):
        source = feature_source(name, ckpt, dim=4)
        assert type(source) is kind
        assert (source.name, source.dim) == (name, 4)
    assert feature_source("geometric").dim == 768
    assert feature_source("scalr", str(scalr_file), 4).settings["weights"]


def test_refused_names_and_checkpoints(scalr_file):
    with pytest.raises(ValueError, match="source 'dino'; choose from scalr, waffleiron-s"):
        feature_source("dino")
    with pytest.raises(ValueError, match=r"scalr needs ckpt.*choose from waffleiron-s, "):
        feature_source("scalr")
    with pytest.raises(ValueError, match=r"ckpt_last.pth has features of width 4, but dim is 768"):
        feature_source("scalr", scalr_file)
    with pytest.raises(ValueError, match=r"geometric has no weights: leave ckpt \(a.pth\) out"):
        feature_source("geometric", "a.pth")
