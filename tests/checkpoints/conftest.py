"""A checkpoint with every network, as ours and in the official layout."""

import argparse
import copy
from pathlib import Path

import pytest
import torch
from whole_checkpoint import (
    GEOMETRY,
    NETWORKS,
    randomised,
)

from r3dpa.checkpoints import (
    Checkpoint,
    NetworkState,
    to_official,
)


@pytest.fixture(scope="session")
def first_checkpoint():
    """Made once: building the networks takes longer than most of the tests."""
    torch.manual_seed(0)
    networks = {
        name: NetworkState.of(randomised(kind(**args)), args)
        for name, (kind, args) in NETWORKS.items()
    }
    about = {"step": 30, "geometry": GEOMETRY.to_dict(), "feature_source": "geometric"}
    return Checkpoint(Path("run.ckpt"), "joint", networks, **about)


@pytest.fixture
def checkpoint(first_checkpoint):
    torch.manual_seed(0)
    return copy.deepcopy(first_checkpoint)


@pytest.fixture
def official(checkpoint):
    content = to_official(checkpoint)
    content["args"] = argparse.Namespace(vae="h2p2d4", encoder_depth=2, num_classes=1)
    return content
