import math
import re
from dataclasses import replace
from functools import cache

import pytest
import torch

from r3dpa.geometry import LidarSensor
from r3dpa.metrics.evaluation import TooFewScenesError, evaluate, scene_distance
from r3dpa.metrics.floors import verdict
from r3dpa.metrics.functional import frechet_distance_of
from r3dpa.metrics.functional_bev import histogram_distance
from r3dpa.metrics.reference import ReferenceStatistics, cards_of
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import EvaluationTable, MetricResult
from r3dpa.metrics.scene import DEFAULT, EvaluationScene, through_sensor
from r3dpa.metrics.scene_features import SceneFeatures

SENSOR = LidarSensor(beams=16, columns=32)
PROTOCOL = replace(DEFAULT, sensor=SENSOR, voxel_m=2.0, num_samples=60)
CARD = {"backbone": "toy", "layer": "all", "weights": "abc", "preprocessing": "none"}
QUICK = Resampling(num_resamples=40)
DISTANCES = {"JSD", "TV", "W1 range", "MMD", "CD 3D", "TOY", "TOY inf", "TOY KID"}
SHARES = {"TOY precision", "TOY recall", "TOY density", "TOY coverage"}


def toy(scenes):
    """Mean, deviation and horizon of the range images."""
    images = [scene.range_m for scene in scenes]
    return torch.stack([torch.stack([i.mean(), i.std(), i[5].mean()]) for i in images]) / 20


TOY = SceneFeatures("toy", 3, CARD, toy)


def scenes(seed=0, count=40, noise=0.0):
    """Scans in a street of random width, of two drives; with any noise the streets are the same."""
    generator, noise_generator = (torch.Generator().manual_seed(s) for s in (seed, 1000 + seed))
    for i in range(count):
        width, ground = 4 + 6 * torch.rand(2, generator=generator)
        columns = width / (0.2 + torch.linspace(-3, 3, 32).sin().abs())
        range_m = columns.clamp(max=50).expand(16, 32) + ground * torch.rand(
            16, 1, generator=generator
        )
        range_m = range_m + noise * torch.randn(16, 32, generator=noise_generator).abs()
        yield EvaluationScene(f"drive{i % 2}/{i:03d}", None, range_m)


def reference_of(real, protocol=PROTOCOL, spaces=(TOY,)):
    names = [scene.name for scene in real]
    reference = ReferenceStatistics(protocol, cards_of(spaces), names, {"split": "val"})
    reference.update(real, spaces)
    return reference


def evaluated(made, reference, **options):
    options = {"label": "made", "resampling": QUICK} | options
    return evaluate(made, reference, [TOY], **options).evaluation


def rows_of(made, reference, **options):
    return {row.name: row for row in evaluated(made, reference, **options).rows}


@cache
def whole_reference():
    return reference_of(list(scenes()))


@cache
def large_reference(num_scans):
    """Statistics of enough scans for a verdict."""
    return reference_of(list(scenes(count=num_scans)), replace(PROTOCOL, num_samples=80))


@cache
def found(seed, count=40):
    """Rows of these scenes against the reference of the module, computed once."""
    return rows_of(scenes(seed, count), whole_reference())


@cache
def fresh():
    """Evaluation of other scenes like those of the reference."""
    return evaluated(scenes(1), whole_reference())


@pytest.fixture(scope="module")
def reference():
    return whole_reference()


def test_the_same_scenes_have_no_distance(reference):
    rows = rows_of(scenes(), reference)
    assert set(rows) == DISTANCES | SHARES
    for name in DISTANCES - {"TOY inf", "TOY KID"}:
        assert rows[name].value == pytest.approx(0, abs=1e-9), name
    # Both are free of a bias that grows with few scenes, and may fall below 0.
    assert rows["TOY inf"].value == pytest.approx(0, abs=0.005)
    assert rows["TOY KID"].value < 0.01
    for name in ("precision", "recall", "coverage"):
        assert rows[f"TOY {name}"].value == 1.0


def test_distances_of_the_baselines_are_computed_on_request(reference):
    """They need nothing that references of R3DPA do not hold."""
    rows = rows_of(scenes(1), reference, baseline_metrics=True)
    others = {"JSD points", "MMD kernel", "MMD 0.5 m"}
    assert set(rows) == DISTANCES | SHARES | others
    for name in others:
        low, high = rows[name].interval
        assert low < rows[name].value < high, name
        assert rows[name].floor is not None, name
        assert scene_distance(name, scenes(0), scenes(1), PROTOCOL) == rows[name].value, name
    assert found(1)["JSD"] == rows["JSD"]


def test_floors_are_between_the_drives():
    rows = found(1)
    drives = [
        [through_sensor(scene, PROTOCOL) for scene in scenes() if scene.name.startswith(drive)]
        for drive in ("drive0", "drive1")
    ]
    clouds = [[scene.points for scene in drive] for drive in drives]
    jsd = histogram_distance(*map(PROTOCOL.grid.histogram, clouds)).jsd_distance
    assert rows["JSD"].floor == pytest.approx(jsd, rel=1e-9)
    frechet = frechet_distance_of(*map(toy, drives))
    assert rows["TOY"].floor == pytest.approx(frechet, rel=1e-6)
    assert "floor of 20 and 20 scans" in rows["TOY"].note
    assert (rows["JSD"].num_samples, rows["JSD"].num_references) == (40, 40)
    assert (rows["JSD"].unit, rows["W1 range"].unit) == ("", "m")
    assert rows["TOY precision"].floor is None  # no distance, so nothing ties with it
    assert "real scans reach" in rows["TOY precision"].note


def test_intervals_are_as_wide_as_fresh_sets_differ():
    """Half a 95 % interval is two standard deviations; both are estimates from few."""
    # Matching is slow and not compared here.
    reference = reference_of(list(scenes()), replace(PROTOCOL, num_mmd_samples=4))
    sets = [
        rows_of(scenes(seed, noise=1.0), reference, resampling=Resampling(num_resamples=num))
        for seed, num in zip(range(1, 8), (40, *[0] * 6), strict=True)
    ]
    for name in ("W1 range", "TOY", "JSD"):
        spread = torch.tensor([rows[name].value for rows in sets]).std().item()
        ratio = sets[0][name].half_width / (2 * spread)
        assert 0.4 < ratio < 2.5, (name, ratio)


def test_results_repeat_and_record_their_provenance(reference):
    told = {"solver": "heun", "steps": 5, "seed": 3, "weights": "ema"}
    run = evaluated(scenes(1), reference, made_with=told)
    assert run.rows == fresh().rows
    about = run.about
    assert (about["solver"], about["steps"], about["seed"]) == ("heun", 5, 3)
    assert about["extra"]["weights"] == "ema"
    assert about["extra"]["scenes"] == "40, where the protocol asks for 60"
    assert about["backbones"]["TOY"] == CARD
    assert about["protocol"]["unprojection"] == "centre"
    assert about["reference"].startswith("val, 40 scans")


def test_few_scenes_are_refused_or_marked(reference):
    with pytest.raises(ValueError, match=r"3 generated scenes for the 3 features.*allow_few"):
        rows_of(scenes(1, 3), reference)
    rows = rows_of(scenes(1, 3), reference, allow_few=True)
    assert rows["TOY"].note.startswith("3 scenes for 3 features")
    assert (rows["TOY inf"].value, rows["TOY inf"].note) == (None, "needs 16 scenes of both kinds")
    assert rows["TOY KID"].value is None
    assert rows["TOY recall"].note == "needs 6 scenes of both kinds"
    with pytest.raises(ValueError, match="1 generated scene, a comparison needs at least 2"):
        rows_of(scenes(1, 1), reference, allow_few=True)
    small = reference_of(list(scenes(count=2)))
    with pytest.raises(ValueError, match="2 real scans for the 3 features of TOY"):
        rows_of(scenes(1), small)


BAD = [
    (EvaluationScene("bad/1", torch.zeros(0, 3)), "bad/1: no pixel of the range image"),
    (EvaluationScene("bad/2", torch.full((1, 3), math.nan)), "bad/2: cloud holds 3 NaN"),
    (EvaluationScene("bad/3", None, torch.ones(8, 8)), r"bad/3: range image of shape \(8, 8\)"),
    (EvaluationScene("bad/4", torch.tensor([[0.0, 52.0, 0.0]])), "bad/4: none of 1 points has"),
    (EvaluationScene("bad/5", None, torch.full((16, 32), -1.0)), "bad/5: no pixel of the range"),
    (EvaluationScene("bad/6", None, torch.full((16, 32), math.nan)), "bad/6: range image holds"),
    (EvaluationScene("bad/7", None), "bad/7: has neither points nor"),
    (EvaluationScene("bad/8", torch.ones(2, 5)), r"bad/8: points of shape \(2, 5\)"),
]


def test_bad_scenes_are_left_out_and_listed(reference):
    """They change no number, do not count as scenes, and everything printed tells of them."""
    good = list(scenes(1, 10))
    mixed = [BAD[0][0], *good[:3], *(bad for bad, _ in BAD[1:]), *good[3:]]
    clean = evaluated(good, reference)
    found = evaluated(mixed, reference, skip_bad=True)
    assert found.rows == clean.rows
    for reason, (_, message) in zip(found.bad_samples, BAD, strict=True):
        assert re.match(message, reason)
        assert reason in str(found)
    assert "samples that cannot be used and are left out: 8" in str(found)
    assert (
        "made: samples that cannot be used and are left out: 8" in EvaluationTable((found,)).notes
    )
    assert clean.bad_samples == []
    assert "cannot be used" not in str(clean) + str(EvaluationTable((clean,)))


def test_only_as_many_good_scenes_as_the_protocol_counts():
    reference = reference_of(list(scenes()), replace(PROTOCOL, num_samples=20))
    mixed = [*(bad for bad, _ in BAD), *scenes(1, 21)]
    found = evaluated(mixed, reference, skip_bad=True)
    assert found.row("JSD").num_samples == 20

    def read():
        yield from scenes(1, 20)
        raise ValueError("a file beyond them is damaged")

    assert evaluated(read(), reference).row("JSD").num_samples == 20
    assert found.about["extra"]["scenes"].startswith("only the first 20 were used")


def test_bad_scenes_are_errors_alone_or_without_the_option(reference):
    message = r"bad/4: none of 1 points has.*\. --skip_bad leaves such scenes out"
    with pytest.raises(ValueError, match=message):
        rows_of([*scenes(1, 5), BAD[3][0]], reference)
    with pytest.raises(TooFewScenesError, match=r"no generated .* 8 cannot .* bad/1: no pixel"):
        rows_of([bad for bad, _ in BAD], reference, skip_bad=True)


def test_floors_are_of_as_many_scenes_as_the_values():
    """The nearest of 8 scans is no nearer than that of all 20, of which they are a part."""
    few, many, more = (found(1, count) for count in (8, 20, 40))
    for name in ("MMD", "CD 3D", "TOY", "JSD", "W1 range"):
        assert few[name].note.endswith("floor of 8 and 20 scans"), name
        assert many[name].note.endswith("floor of 20 and 20 scans"), name
        assert more[name].note.endswith(
            "floor of 20 and 20 scans, rather high: the value is of 40 scenes"
        ), name
    assert few["MMD"].floor > many["MMD"].floor == more["MMD"].floor
    assert few["JSD"].note == "floor of 8 and 20 scans"
    assert few["JSD"].floor > many["JSD"].floor == more["JSD"].floor
    assert more["TOY KID"].note.endswith("floor of 20 and 20 scans")


def test_floors_of_few_scenes_are_not_kept_for_more():
    reference = reference_of(list(scenes()), replace(PROTOCOL, num_mmd_samples=8))
    notes = [rows_of(scenes(1, count), reference)["JSD"].note for count in (8, 20)]
    assert notes == ["floor of 8 and 20 scans", "floor of 20 and 20 scans"]


def test_verdict_is_one_line_above_the_table():
    large = large_reference(64)
    near = evaluated(scenes(1, 32), large).about["extra"]["verdict"]  # the least that tell
    assert near.startswith("near the floor in JSD")
    noisy = evaluated(scenes(1, noise=12.0), large)
    line = noisy.about["extra"]["verdict"]
    assert re.match(r"not realistic: TOY precision 0\.\d+ \(real scans 1\), ", line)
    assert str(noisy).splitlines()[1] == f"verdict: {line}"
    assert "{" not in str(noisy)  # JSON is in the file alone


@pytest.mark.parametrize(
    ("num_scenes", "num_scans", "start"),
    [
        (4, 64, "too few to tell: 4 scenes, floors between 4 scans; give at least 32 scenes"),
        (32, 62, "too few to tell: 32 scenes, floors between 31 scans"),
    ],
)
def test_verdict_needs_enough_scenes_and_scans(num_scenes, num_scans, start):
    """Four scenes are near every floor, whatever they look like."""
    run = evaluated(scenes(1, num_scenes), large_reference(num_scans), allow_few=True)
    assert run.about["extra"]["verdict"].startswith(start)


def floor_of(value, name="X"):
    return {name: MetricResult(name, value, num_samples=40, num_references=40)}


@pytest.mark.parametrize(
    ("value", "half_width", "expected"),
    [
        (1.49, 0.0, "near the floor in X"),
        (1.51, 0.0, "above it in 1 distance, most in X (1.51 x)"),
        (2.4, 1.0, "near the floor in X"),
        (2.6, 1.0, "above it in 1 distance, most in X (2.6 x)"),
    ],
)
def test_near_is_one_and_a_half_floors_plus_half_the_interval(value, half_width, expected):
    row = MetricResult("X", value, interval=(value - half_width, value + half_width))
    assert verdict([row], floor_of(1.0), 40) == expected


def test_distances_above_a_floor_of_no_distance_are_named():
    """An unbiased floor of equal scans is below 0 half of the time."""
    row = MetricResult("X KID", 0.5, interval=(0.45, 0.55))
    expected = "above it in 1 distance, most in X KID (floor 0)"
    assert verdict([row], floor_of(-1e-4, "X KID"), 40) == expected


@pytest.mark.parametrize(("value", "is_poor"), [(0.41, False), (0.39, True)])
def test_poor_is_half_the_precision_of_real_scans(value, is_poor):
    row = MetricResult("X recall", value, direction="higher")
    line = verdict([row], floor_of(0.8, "X recall"), 40)
    assert line.startswith("not realistic: X recall 0.39 (real scans 0.8)") == is_poor


def test_scenes_of_another_sensor_are_warned_of(reference):
    """Every second pixel of both axes is a quarter of the returns."""
    coarse = list(scenes(1))
    for scene in coarse:
        scene.range_m[1::2] = -1
        scene.range_m[:, 1::2] = -1
    told = evaluated(coarse, reference)
    assert told.about["extra"]["warning"].startswith("128 returns in a scene (median), but 512")
    assert "warning: 128 returns" in str(told)
    assert "warning" not in str(fresh())


def corrupted(scene, ladder, amount):
    """The scan with noise on its ranges, or without a share of them; smaller amounts nest."""
    generator = torch.Generator().manual_seed(int(scene.name.rpartition("/")[2]))
    if ladder == "noise":
        noise = amount * torch.randn(16, 32, generator=generator).abs()
        return scene._replace(range_m=scene.range_m + noise)
    dropped = torch.rand(16, 32, generator=generator) < amount
    return scene._replace(range_m=torch.where(dropped, -1.0, scene.range_m))


@pytest.mark.parametrize(
    ("ladder", "amounts", "blind"),
    [("noise", (1.5, 4.0, 12.0), ()), ("drop", (0.3, 0.6, 0.9), ("W1 range",))],
)
def test_every_distance_worsens_with_each_corruption(reference, ladder, amounts, blind):
    """What is dropped at random leaves the distribution of ranges as it is."""
    steps = [found(1, 20)] + [
        rows_of([corrupted(s, ladder, amount) for s in scenes(1, 20)], reference)
        for amount in amounts
    ]
    for name in DISTANCES - set(blind):
        values = [rows[name].value for rows in steps]
        assert values == sorted(values), (name, values)
        assert values[0] < values[-1], name
    for name in SHARES if ladder == "noise" else ():  # balls around few scans are wide
        assert steps[0][name].value > steps[-1][name].value, name
    for name in ("TOY", "CD 3D"):
        assert steps[0][name].interval[1] < steps[-1][name].interval[0], name


def test_one_metric_of_two_sets_is_that_of_an_evaluation():
    rows = found(1)
    for name in ("JSD", "W1 range", "MMD"):
        assert scene_distance(name, scenes(0), scenes(1), PROTOCOL) == rows[name].value
    made = [through_sensor(scene, PROTOCOL)[:2] for scene in scenes(1, 8)]  # names and points
    arrays = [(name, points.numpy()) for name, points in made]
    assert scene_distance("FGEO coverage", made, arrays, PROTOCOL) == 1
    with pytest.raises(
        ValueError,
        match="unknown metric 'FGEO best'; choose from FGEO, FGEO inf, FGEO KID, FGEO precision",
    ):
        scene_distance("FGEO best", made, made, PROTOCOL)
    with pytest.raises(ValueError, match="FGEO KID: needs 4 scenes"):
        scene_distance("FGEO KID", made[:2], made, PROTOCOL)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fgeo", "unknown metric 'fgeo'; choose from FGEO, FGEO inf, FGEO KID, FGEO precision,"),
        ("jsd", "unknown metric 'jsd'; choose from JSD, TV, .*, or a feature space: .*, FWID,"),
        ("", "unknown metric ''; choose from JSD, TV"),
    ],
)
def test_unknown_metrics_are_refused_before_scenes_are_read(name, message):
    with pytest.raises(ValueError, match=message):
        scene_distance(name, ["not read"], ["not read"])


@pytest.mark.parametrize("wrong", ["scans", [torch.ones(9, 3)], [("a name",)]])
def test_scenes_of_another_form_are_refused(wrong):
    message = r"scenes must be tuples \(name, points\), .* got (str|Tensor|tuple)"
    with pytest.raises(ValueError, match=message):
        scene_distance("JSD", wrong, wrong)


def test_sets_without_a_scene_are_named():
    scene = ("a", torch.full((9, 3), 5.0))
    with pytest.raises(ValueError, match="there are no real scenes to compare"):
        scene_distance("JSD", [], [scene])
    with pytest.raises(ValueError, match="there are no generated scenes to compare"):
        scene_distance("JSD", [scene], [])
