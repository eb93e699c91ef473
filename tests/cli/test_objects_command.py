from __future__ import annotations

import pytest

from r3dpa.cli.data import objects
from r3dpa.data.objects import ObjectLibrary
from r3dpa.nn.backbones import GeometricFeatures
from r3dpa.simulation import simulate


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    root = tmp_path_factory.mktemp("simulated")
    simulate(root, 2)
    return root


def test_command_writes_a_library_and_tells_what_it_holds(simulated, tmp_path):
    out = tmp_path / "objects.safetensors"
    text = objects(data=str(simulated), out=out, dim=32, device="cpu")
    library = ObjectLibrary.load(out)
    assert {"road", "car"} <= set(library.names)
    assert library.source == GeometricFeatures.name
    library.check_source("geometric", 32)
    for name in library.names:
        assert name in text
    assert "2 scans" in text
    # What is found does not depend on what else is looked for.
    objects(data=str(simulated), out=out, classes=["car"], dim=32, device="cpu")
    assert ObjectLibrary.load(out).feature("car").equal(library.feature("car"))


def test_what_cannot_be_made_leaves_no_file(simulated, tmp_path):
    for arguments, message in (
        ({"out": tmp_path / "objects.npz"}, r"\.safetensors file, got .*objects\.npz"),
        ({"source": "none"}, "no feature source 'none'"),
        ({"classes": ["tram"]}, "no class tram"),
        ({"limit": 0}, "limit must be at least 1, got 0"),
        ({"grid_size": (7, 64)}, "does not divide"),
    ):
        given = {"out": tmp_path / "a.safetensors", "dim": 32, "device": "cpu"} | arguments
        with pytest.raises(ValueError, match=message):
            objects(data=str(simulated), **given)
    assert not list(tmp_path.iterdir())
