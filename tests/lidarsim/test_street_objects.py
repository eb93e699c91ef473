"""What stands in a street: its class, its size, and that it stands on the ground."""

import numpy as np
import pytest

from lidarsim import Material, Semantic, Shape
from lidarsim.street import furniture, people, vehicles, works
from lidarsim.street.builder import Builder, Strip
from lidarsim.street.buildings import Front
from lidarsim.street.course import BLOCK_M, Kerb, course_of

# A street without bends and slopes, whose sides are pavements: x is s, y the lateral distance.
COURSE = course_of(0, 1)._replace(
    bends=(), slopes=(), kerbs=(Kerb(3.0, 3.0, 40.0, False, 0.0),) * 2
)
GROUND_M = COURSE.surface_m(8.0)
S, LATERAL = BLOCK_M * 5.5, -8.0


def built(build, seed):
    """Solids of an object, near and far ones."""
    builder = Builder(COURSE, COURSE.section(S), 1)
    build(builder, np.random.default_rng(seed))
    return builder.primitives + builder.details


def stood(body):
    """A body that stands in the street and looks along it."""
    return lambda builder, draw: builder.body(body(draw), (S, LATERAL), 0.0, builder.new_instance())


def placed(thing, *more):
    return lambda builder, draw: thing(builder, draw, S, LATERAL, *more)


def box_around(solids):
    """Lowest and highest x, y and z of solids, the z above the ground."""
    lows, highs = [], []
    for p in solids:
        cosine, sine = abs(np.cos(p.yaw_rad)), abs(np.sin(p.yaw_rad))
        long, wide, tall = p.half_size
        reach = np.array([cosine * long + sine * wide, sine * long + cosine * wide, tall])
        centre = np.subtract(p.centre, (0, 0, GROUND_M))
        lows.append(centre - reach)
        highs.append(centre + reach)
    return np.min(lows, axis=0), np.max(highs, axis=0)


# Classes of each body; the least and the
# greatest size along, across and up in metres.
ONE = {
    "car": (vehicles.car, {Semantic.CAR}, (3.6, 1.6, 1.3), (5.5, 2.2, 2.0)),
    "van": (vehicles.van, {Semantic.CAR}, (4.8, 1.9, 2.0), (6.5, 2.5, 2.8)),
    "caravan": (vehicles.caravan, {Semantic.CARAVAN}, (5.0, 2.1, 2.5), (6.1, 2.4, 2.7)),
    "trailer": (vehicles.trailer, {Semantic.TRAILER}, (3.0, 1.4, 0.8), (3.8, 1.8, 1.8)),
    "motorcycle": (vehicles.motorcycle, {Semantic.MOTORCYCLE}, (1.5, 0.65, 1.0), (2.2, 0.8, 1.1)),
    "bicycle": (vehicles.bicycle, {Semantic.BICYCLE}, (1.7, 0.5, 1.0), (1.85, 0.6, 1.05)),
    "person": (people.person, {Semantic.PERSON}, (0.25, 0.4, 1.55), (1.0, 0.9, 1.9)),
    "cyclist": (
        people.cyclist, {Semantic.RIDER, Semantic.BICYCLE}, (1.7, 0.5, 1.6), (1.85, 0.7, 2.0),
    ),
}  # fmt: skip
PLACED = {
    "street_lamp": (placed(furniture.street_lamp, -1.0), {Semantic.POLE, Semantic.LAMP}),
    "sign": (placed(furniture.sign, -1.0), {Semantic.SMALL_POLE, Semantic.SIGN}),
    "traffic_light": (
        placed(furniture.traffic_light, -1.0), {Semantic.POLE, Semantic.TRAFFIC_LIGHT},
    ),
    "bus_stop": (placed(furniture.bus_stop, -1.0), {Semantic.STOP}),
    "bins": (placed(furniture.bins), {Semantic.TRASH_BIN}),
    "litter_bin": (placed(furniture.litter_bin), {Semantic.TRASH_BIN}),
    "bench": (placed(furniture.bench), {Semantic.UNKNOWN_OBJECT}),
    "cabinet": (placed(furniture.cabinet), {Semantic.BOX}),
    "hydrant": (placed(furniture.hydrant), {Semantic.UNKNOWN_OBJECT}),
    "planter": (placed(furniture.planter), {Semantic.UNKNOWN_OBJECT, Semantic.VEGETATION}),
    "poster": (placed(furniture.poster), {Semantic.UNKNOWN_OBJECT}),
    "power_pole": (placed(furniture.power_pole), {Semantic.POLE}),
    "group": (placed(people.group), {Semantic.PERSON}),
    "bollards": (
        lambda builder, draw: furniture.bollards(builder, draw, S, S + 9, LATERAL),
        {Semantic.SMALL_POLE},
    ),
    "scaffolding": (
        lambda builder, draw: works.scaffolding(builder, draw, Front(-1.0, S - 6, S + 6, 9.0), 8.0),
        {Semantic.UNKNOWN_CONSTRUCTION},
    ),
}  # fmt: skip
BUILDS = {name: stood(body) for name, (body, *_) in ONE.items()}
BUILDS |= {name: build for name, (build, _) in PLACED.items()}
BUILDS |= {
    "bicycles": placed(furniture.bicycles),
    "clutter": placed(furniture.clutter),
    "building_site": lambda builder, draw: works.building_site(
        builder, draw, Strip(-1.0, S - 10, S + 10, 6.0, 14.0)
    ),
    "parked_vehicle": stood(vehicles.parked_vehicle),
}


@pytest.mark.parametrize("name", BUILDS)
def test_objects_are_a_function_of_the_seed_and_stand_on_the_ground(name):
    for seed in range(12):
        solids = built(BUILDS[name], seed)
        assert solids == built(BUILDS[name], seed)
        assert solids != built(BUILDS[name], seed + 100)
        lowest, _ = box_around(solids)
        assert lowest[2] <= 0.01, (name, seed)


@pytest.mark.parametrize("name", ONE)
def test_vehicles_and_people_have_their_class_and_size(name):
    body, classes, least, most = ONE[name]
    for seed in range(40):
        solids = built(stood(body), seed)
        low, high = box_around(solids)
        assert {p.semantic for p in solids} == classes
        assert low[2] == pytest.approx(0.0, abs=0.01)
        assert (high - low >= least).all(), (seed, high - low)
        assert (high - low <= most).all(), (seed, high - low)
        assert len({p.instance for p in solids}) == 1


@pytest.mark.parametrize("name", PLACED)
def test_furniture_has_its_classes(name):
    build, classes = PLACED[name]
    for seed in range(20):
        assert {p.semantic for p in built(build, seed)} == classes


@pytest.mark.parametrize("name", ["bins", "bollards", "group", "bicycles", "bus_stop", "bench"])
def test_solids_of_one_place_do_not_stray(name):
    for seed in range(20):
        low, high = box_around(built(BUILDS[name], seed))
        assert (low[:2] > np.array([S - 5.0, LATERAL - 1.8])).all()
        assert (high[:2] < np.array([S + 9.5, LATERAL + 1.8])).all()


def test_cars_have_a_bonnet_below_their_doors_and_a_roof_above():
    for seed in range(40):
        body = vehicles.car(np.random.default_rng(seed))
        tops = {part.centre[2] + part.size[2] / 2: part for part in body if not part.detail}
        painted = {top: p for top, p in tops.items() if p.material is Material.PAINT}
        front = max(painted.values(), key=lambda part: part.centre[0])
        doors = max(painted.values(), key=lambda part: part.size[0])
        nose_m, doors_m = (part.centre[2] + part.size[2] / 2 for part in (front, doors))
        assert front.shape == Shape.CYLINDER
        assert 0.5 < nose_m < doors_m - 0.05
        assert doors_m < max(tops) - 0.3


def test_now_and_then_a_parked_car_has_an_open_boot_and_a_caravan_stands_there():
    bodies = [vehicles.parked_vehicle(np.random.default_rng(seed)) for seed in range(300)]
    classes = [{part.semantic for part in body} for body in bodies]
    assert {Semantic.CARAVAN} in classes
    assert {Semantic.TRAILER} in classes
    assert sum(c == {Semantic.CAR} for c in classes) > 270
    behind = [min(part.centre[0] - part.size[0] / 2 for part in body[-1:]) for body in bodies]
    rear = [min(part.centre[0] - part.size[0] / 2 for part in body[:4]) for body in bodies]
    open_boots = np.array(behind) < np.array(rear) - 0.3
    assert 1 <= open_boots.sum() < 20


def test_people_walk_in_stride_and_stand_in_groups():
    def feet_apart_m(solids):
        """Distance along the heading between the two lowest cylinders of a person."""
        lowest = sorted(solids, key=lambda p: p.centre[2] - p.half_size[2])[:2]
        return abs(lowest[0].centre[0] - lowest[1].centre[0])

    strides = [feet_apart_m(built(stood(people.person), seed)) for seed in range(40)]
    assert min(strides) > 0.1
    assert max(strides) < 0.8
    sizes = set()
    for seed in range(40):
        solids = built(placed(people.group), seed)
        heads = [p.centre[:2] for p in solids if p.shape == Shape.ELLIPSOID]
        apart = np.linalg.norm(np.subtract.outer(heads, heads)[:, [0, 1], :, [0, 1]], axis=0)
        sizes.add(len(heads))
        assert (apart + 9 * np.eye(len(heads))).min() > 0.35
    assert sizes == {2, 3, 4, 5}


def test_all_parts_of_a_moving_cyclist_share_its_velocity():
    builder = Builder(COURSE, COURSE.section(S), 1)
    body = people.cyclist(np.random.default_rng(0))
    builder.body(body, (S, LATERAL), np.pi, builder.new_instance(), 5.0)
    velocities = np.array([p.velocity_m_s for p in builder.primitives + builder.details])
    np.testing.assert_allclose(velocities, [[-5.0, 0.0]] * len(body), atol=1e-12)


def test_a_scaffold_is_open_between_its_standards():
    solids = built(PLACED["scaffolding"][0], 0)
    rows = [p for p in solids if p.slats[0] > 1]
    assert len(rows) == 2
    for row in rows:
        pitch_m, share = row.slats
        assert share * pitch_m < 0.1
        # Standards at both ends: the row is a whole number of bays long, and one tube.
        assert (2 * row.half_size[0] - share * pitch_m) % pitch_m == pytest.approx(0, abs=1e-6)


def test_building_sites_keep_to_their_plot():
    for seed in range(30):
        low, high = box_around(built(BUILDS["building_site"], seed))
        assert (low[:2] > (S - 11.0, -14.8)).all()
        assert (high[:2] < (S + 11.0, -6.0 + 0.9)).all()


def test_sites_have_fences_heaps_and_machines():
    solids = [p for seed in range(30) for p in built(BUILDS["building_site"], seed)]
    assert {p.semantic for p in solids} == {
        Semantic.FENCE, Semantic.TERRAIN, Semantic.TRUCK, Semantic.UNKNOWN_CONSTRUCTION,
        Semantic.UNKNOWN_OBJECT,
    }  # fmt: skip


def test_clutter_is_of_many_kinds():
    classes = {p.semantic for seed in range(80) for p in built(placed(furniture.clutter), seed)}
    expected = {Semantic.TRASH_BIN, Semantic.BOX, Semantic.BICYCLE, Semantic.UNKNOWN_OBJECT}
    assert expected <= classes
