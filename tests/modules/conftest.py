"""Fixtures of the training stages."""

from __future__ import annotations

import pytest


@pytest.fixture
def from_previous(request, vae_checkpoint):
    """``from_previous(stage)``: words that name the checkpoint of the stage before, if any."""

    def words(stage):
        if stage == "vae_alignment":
            return []
        few = stage == "few_step"
        before = request.getfixturevalue("flow_checkpoint") if few else vae_checkpoint
        return ["--model.init_args.init_from", str(before)]

    return words
