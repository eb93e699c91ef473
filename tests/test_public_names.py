"""Names, texts and files that a user of the installed package sees."""

import re
from pathlib import Path

import pytest

import lidarsim
import r3dpa

PACKAGE = Path(r3dpa.__file__).parent


@pytest.mark.parametrize("package", [r3dpa, lidarsim])
def test_public_names_are_listed_and_exist(package):
    assert dir(package) == sorted(package.__all__)
    assert all(hasattr(package, name) for name in package.__all__)


def test_a_simulator_is_described_in_one_line():
    assert repr(lidarsim.Simulator(3)) == "Simulator(seed=3, drive=0, weather=drawn, 64 beams)"
    weather = lidarsim.Simulator(3).street.scene(0).weather
    given = lidarsim.Simulator(3, weather=weather, sensor="hdl32e")
    assert f"weather={weather}, 32 beams)" in repr(given)


@pytest.mark.parametrize("card", sorted(PACKAGE.rglob("*.md")), ids=lambda path: path.name)
def test_links_of_a_card_lead_to_files_of_the_package(card):
    links = re.findall(r"\]\(([^)#]+)\)", card.read_text())
    files = [link for link in links if not link.startswith("https://")]
    assert all((card.parent / file).resolve().is_relative_to(PACKAGE) for file in files)
    assert all((card.parent / file).is_file() for file in files)
