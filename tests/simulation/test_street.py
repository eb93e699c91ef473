import numpy as np
import pytest

from r3dpa.simulation import Semantic, Shape, Street
from r3dpa.simulation.roadside import BLOCK_M
from r3dpa.simulation.street import _block, _plan

MOVING = 56000  # instance numbers above are cars in motion


def standing(scene):
    return {p for p in scene.primitives if p.instance <= MOVING}


def test_scans_of_a_drive_share_geometry():
    street = Street(0, 3)
    here, next_one, far = (street.scene(scan) for scan in (100, 101, 400))
    shared = standing(here) & standing(next_one)
    # One scan on, at most one of the nine blocks has been exchanged.
    assert len(shared) > 0.8 * len(standing(here))
    assert not {p for p in standing(here) & standing(far) if p.instance}


@pytest.mark.parametrize("drive", [0, 3, 10])
def test_the_car_advances_by_1_to_1_4_metres(drive):
    street = Street(1, drive)
    poses = [street.scene(scan).pose for scan in range(0, 60)]
    steps = np.hypot(np.diff([p.x_m for p in poses]), np.diff([p.y_m for p in poses]))
    # The bend moves the lane's centre by less than 2 cm a scan, and by up to 20 cm at a corner.
    along = np.diff([_plan(street).position(scan) for scan in range(60)])
    assert (along >= 1.0).all()
    assert (along <= 1.4).all()
    assert np.median(steps) == pytest.approx(np.median(along), abs=0.05)
    assert len({p.pitch_rad for p in poses}) == 60  # the body rocks from scan to scan
    heading = np.diff([p.heading_rad for p in poses])
    assert np.abs(heading).max() < 0.02


def test_scenes_do_not_depend_on_the_order_or_on_what_was_made_before():
    first = Street(2, 5).scene(77)
    _block.cache_clear()
    _plan.cache_clear()
    Street(2, 5).scene(3)
    Street(2, 6).scene(77)
    assert Street(2, 5).scene(77) == first


def test_other_seed_drive_or_scan_is_another_scene():
    scenes = [Street(*key).scene(10) for key in ((0, 3), (1, 3), (0, 4))]
    scenes.append(Street(0, 3).scene(11))
    for index, scene in enumerate(scenes):
        for other in scenes[index + 1 :]:
            assert scene.pose != other.pose
            assert scene.primitives != other.primitives


def test_blocks_join_without_a_gap():
    """The axis of a block, halfway between its pavements, ends where the next one begins."""
    street = Street(0, 7)

    def axis_ends(block):
        left, right = (
            p
            for p in _block(street, block)
            if p.semantic == Semantic.SIDEWALK and p.half_size[0] > BLOCK_M / 2
        )
        middle = (np.array(left.centre[:2]) + right.centre[:2]) / 2
        reach = np.array([np.cos(left.yaw_rad), np.sin(left.yaw_rad)]) * BLOCK_M / 2
        return middle - reach, middle + reach

    every = _plan(street).crossing_every
    blocks = [b for b in range(-10, 60) if (b + 1000) % every and (b + 1001) % every]
    assert len(blocks) > 20
    for block in blocks:
        np.testing.assert_allclose(axis_ends(block)[1], axis_ends(block + 1)[0], atol=1e-9)


def test_content_of_the_scenes():
    scenes = [Street(0, drive).scene(50) for drive in (0, 2, 3, 4, 5, 6, 7, 9, 10)]
    counts = [len(scene.primitives) for scene in scenes]
    assert min(counts) > 150
    assert max(counts) < 450
    classes = {p.semantic for scene in scenes for p in scene.primitives}
    assert classes == set(Semantic) - {Semantic.ROAD}
    for scene in scenes:
        assert {p.shape for p in scene.primitives} == set(Shape)
        assert scene.pose.z_m == 1.73


def test_an_object_has_one_instance_number():
    """Instance numbers of a scene are unique: the solids of one lie close together."""
    for drive in (0, 3):
        by_instance = {}
        for p in Street(4, drive).scene(20).primitives:
            if p.instance:
                by_instance.setdefault(p.instance, []).append(p)
        assert len(by_instance) > 50
        for parts in by_instance.values():
            centres = np.array([p.centre[:2] for p in parts])
            assert np.ptp(centres, axis=0).max() < 15
            assert len({p.semantic for p in parts}) == 1


def test_cars_keep_clear_of_the_recording_car():
    for drive in (0, 3, 9):
        for scan in range(0, 300, 20):
            scene = Street(0, drive).scene(scan)
            for p in scene.primitives:
                if p.semantic in (Semantic.CAR, Semantic.PERSON, Semantic.POLE):
                    offset = np.subtract(p.centre[:2], (scene.pose.x_m, scene.pose.y_m))
                    assert np.linalg.norm(offset) > 1.5


def test_negative_numbers_are_refused():
    with pytest.raises(ValueError, match="seed and drive"):
        Street(-1, 0)
    with pytest.raises(ValueError, match="scan must be 0 or greater, got -1"):
        Street(0, 0).scene(-1)
