from lidarsim import Semantic
from r3dpa.cli.scene_files import _COLOURS


def test_every_class_has_a_colour_of_its_own():
    assert {member.name for member in Semantic} <= set(_COLOURS)
    colours = [_COLOURS[member.name] for member in Semantic]
    assert len(set(colours)) == len(colours)
