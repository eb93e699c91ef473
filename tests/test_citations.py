from __future__ import annotations

import re

import pytest

from r3dpa import citations


def entries_of(text):
    return re.findall(r"^@\w+\{(\w+),$", text, re.MULTILINE)


def test_cite_names_what_the_shipped_weights_use():
    text = citations.cite("r3dpa-s")
    keys = ["r3dpa", "mean_flows", "lidm", "sit", "waffleiron", "perturbed_attention"]
    assert entries_of(text) == keys
    assert text.count("{") == text.count("}")


@pytest.mark.parametrize(
    ("stage", "features", "expected"),
    [
        ("joint", "waffleiron-s", {"r3dpa", "repa_e", "waffleiron"}),
        ("joint", "scalr", {"r3dpa", "repa_e", "scalr", "waffleiron"}),
        ("flow_matching", "geometric", {"r3dpa"}),
        ("r2flow", None, {"r2flow"}),
    ],
)
def test_stage_and_features_decide(stage, features, expected):
    assert set(citations.keys_of(stage, [], features, {})) == expected


def test_every_key_has_an_entry():
    entries = citations.files("r3dpa").joinpath("citations.bib").read_text()
    used = {key for keys in citations._OF_STAGE.values() for key in keys}
    used |= set(citations._OF_NETWORK.values()) | {"perturbed_attention"}
    used |= {key for keys in citations._OF_FEATURES.values() for key in keys}
    assert used == set(entries_of(entries))
