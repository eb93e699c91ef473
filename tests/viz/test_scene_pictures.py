"""Files of scenes to look at."""

from lidarsim import Semantic
from r3dpa.viz.scenes import COLOURS


def test_every_class_has_a_colour_of_its_own():
    assert {member.name for member in Semantic} <= set(COLOURS)
    colours = [COLOURS[member.name] for member in Semantic]
    assert len(set(colours)) == len(colours)
