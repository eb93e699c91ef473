from dataclasses import replace

import pytest
from tiny_stages import QUIET, TinyData, stage_module

from r3dpa.geometry import RangeCodec

pytestmark = QUIET


@pytest.mark.parametrize("stage", ["flow_matching", "joint"])
def test_a_checkpoint_of_other_range_images_is_refused(stage):
    module, other = stage_module(stage), replace(TinyData.geometry, codec=RangeCodec("log2"))
    content = {"r3dpa": {"stage": stage, "geometry": TinyData.geometry.to_dict()}}
    module.geometry = None
    module.on_load_checkpoint(content)
    assert module.geometry == TinyData.geometry
    module.geometry = other
    with pytest.raises(ValueError, match="the checkpoint was trained on other range images"):
        module.on_load_checkpoint(content)
