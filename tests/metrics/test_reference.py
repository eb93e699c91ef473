import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from r3dpa.geometry import LidarSensor
from r3dpa.metrics.collection import metrics_by_name
from r3dpa.metrics.reference import ReferenceStatistics, cards_of, compute_reference, split_halves
from r3dpa.metrics.scene import DEFAULT, PROTOCOLS, EvaluationScene, through_sensor
from r3dpa.metrics.scene_features import SceneFeatures

SENSOR = LidarSensor(beams=16, columns=64)
PROTOCOL = replace(
    DEFAULT, sensor=SENSOR, voxel_m=1.0, num_samples=8, num_mmd_samples=6, num_mmd_references=4
)
CARD = {"backbone": "toy", "layer": "all", "weights": "abc", "preprocessing": "none"}


def toy(scenes):
    return torch.stack([torch.stack([s.range_m.mean(), s.range_m.std()]) for s in scenes])


TOY = SceneFeatures("toy", 2, CARD, toy)


def scenes(count=11):
    """Scans of three drives with 1 / 3 of the scans each."""
    generator = torch.Generator().manual_seed(0)
    for i in range(count):
        range_m = 5 + i + 9 * torch.rand(16, 64, generator=generator)
        yield EvaluationScene(f"drive{i % 3}/{i:03d}", None, range_m)


def empty(count=11, spaces=(TOY,), **changes):
    about = {"data": "somewhere", "split": "val", "commit": "c0ffee"}
    names = [scene.name for scene in scenes(count)]
    return ReferenceStatistics(replace(PROTOCOL, **changes), cards_of(spaces), names, about)


def filled(count=11):
    reference = empty(count)
    reference.update(scenes(count), [TOY])
    return reference


def whole(reference):
    metrics = reference.metrics()
    reference.fill(metrics)
    return metrics_by_name(metrics)


def test_moments_and_histograms_are_those_of_all_scans():
    reference = filled()
    metrics = whole(reference)
    features = toy([*scenes()]).double().numpy()
    moments = metrics["toy_frechet"].moments("real")
    assert moments.mean.numpy() == pytest.approx(features.mean(axis=0), rel=1e-9)
    assert moments.covariance().numpy() == pytest.approx(np.cov(features.T), rel=1e-9)
    assert (
        moments.count == metrics["cells"].count("real") == metrics["matching"].count("real") == 11
    )
    clouds = [through_sensor(scene, PROTOCOL).points for scene in scenes()]
    expected = PROTOCOL.grid.histogram(clouds)
    assert torch.equal(metrics["cells"].real_bins.view(100, 100).long(), expected)


def test_kept_scans_are_few_and_the_halves_have_different_drives():
    reference = filled()
    drives = [{n.split("/")[0] for n in reference.names_of_half(half)} for half in (0, 1)]
    assert drives[0].isdisjoint(drives[1])
    assert [len(reference.names_of_half(half)) for half in (0, 1)] == [7, 4]
    images, kept = {scene.name: scene.range_m for scene in scenes()}, []
    for index, half in enumerate(reference.halves):
        places, _ = metrics_by_name(half)["matching"].subset("real")
        kept += [reference.names_of_half(index)[place] for place in places]
    _, stored = whole(reference)["matching"].subset("real")
    for name, image in zip(kept, stored, strict=True):
        assert torch.equal(image, images[name])


@pytest.mark.parametrize(
    ("sizes", "first"),
    [
        ({"a": 3, "b": 1, "c": 2, "d": 1}, ["a/00", "a/01", "a/02", "d/00"]),  # a, then c, b, d
        ({"a": 3}, ["a/00", "a/01"]),
        ({"a": 4, "b": 1, "c": 1}, [f"a/{i:02d}" for i in range(4)]),  # twice as many is still left
        ({"long": 50, "some": 3, "one": 1}, [f"long/{i:02d}" for i in range(27)]),
    ],
)
def test_halves_are_whole_drives_unless_one_outweighs_the_others(sizes, first):
    names = [f"{drive}/{i:02d}" for drive, count in sizes.items() for i in range(count)]
    halves = split_halves(names[::-1])
    assert [name for name in names if halves[name] == 0] == first
    assert len(halves) == len(names)


@pytest.mark.parametrize(
    ("sizes", "limit", "kept"),
    [
        ((50, 3, 1), 20, (10, 10)),
        ((50, 3, 1), 100, (27, 27)),
        ((4, 2), 5, (3, 2)),  # halves of 4 and 2
        ((7, 4), 10, (6, 4)),  # the first makes up for what the second lacks
    ],
)
def test_as_many_scans_are_kept_as_the_protocol_asks_for(sizes, limit, kept):
    names = [f"{drive}/{i:02d}" for drive, count in enumerate(sizes) for i in range(count)]
    protocol = replace(PROTOCOL, num_samples=limit, num_mmd_references=limit)
    reference = ReferenceStatistics(protocol, cards_of([TOY]), names, {})
    reference.update((EvaluationScene(n, None, torch.full((16, 64), 9.0)) for n in names), [TOY])
    metrics = [*map(metrics_by_name, reference.halves), whole(reference)]
    wanted = (*kept, sum(kept))
    assert tuple(len(part["toy_frechet"].rows("real")) for part in metrics) == wanted
    assert tuple(len(part["matching"].subset("real")[0]) for part in metrics) == wanted


def test_a_reference_comes_back_from_its_file(tmp_path):
    reference = filled()
    reference.save(tmp_path / "a.safetensors")
    again = ReferenceStatistics.load(tmp_path / "a.safetensors")
    again.save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    assert again.complete
    assert again.protocol == reference.protocol
    assert again.describe() == reference.describe()
    assert again.describe().startswith("somewhere, val, 11 scans, names ")


def test_resumed_is_the_same_as_undisturbed(tmp_path, monkeypatch):
    undisturbed, partial = tmp_path / "a.safetensors", tmp_path / "partial.safetensors"
    filled(27).save(undisturbed)

    def killed():
        for index, scene in enumerate(scenes(27)):
            if index == 23:  # in the third batch of 8
                raise KeyboardInterrupt
            yield scene

    monkeypatch.setattr("r3dpa.metrics.reference._EVERY", 9)  # saved in whole batches
    with pytest.raises(KeyboardInterrupt):
        empty(27).update(killed(), [TOY], partial)
    resumed = ReferenceStatistics.load(partial)
    assert resumed.num_done == 16
    resumed.update(list(scenes(27))[16:], [TOY], partial)
    resumed.save(partial)
    assert partial.read_bytes() == undisturbed.read_bytes()


def test_a_file_is_read_resumed_or_renewed(tmp_path):
    out, partial = tmp_path / "a.safetensors", tmp_path / "a.partial.safetensors"
    started = []

    def scans_from(start):
        started.append(start)
        return list(scenes(27))[start:]

    half_done = empty(27)
    half_done.update(list(scenes(27))[:16], [TOY])
    half_done.save(partial)
    compute_reference(empty(27), scans_from, [TOY], out)
    filled(27).save(tmp_path / "b.safetensors")
    assert out.read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    half_done.save(partial)  # as if killed before it was removed
    assert compute_reference(empty(27), scans_from, [TOY], out).complete
    assert started == [16]
    for other, key in (
        (empty(11), "names"),
        (empty(27, unprojection="corner"), "protocol"),
        (empty(27, spaces=(replace(TOY, card={**CARD, "weights": "x"}),)), "spaces"),
        (ReferenceStatistics(PROTOCOL, cards_of([TOY]), empty(27).names, {"data": "x"}), "about"),
    ):
        with pytest.raises(
            ValueError, match=rf"of another job \({key}.* there, .* now\): .*delete the file"
        ):
            compute_reference(other, scans_from, [TOY], out)
    compute_reference(empty(27, unprojection="corner"), scans_from, [TOY], out, renew=True)
    assert started == [16, 0]
    assert ReferenceStatistics.load(out).protocol.unprojection == "corner"


def test_scans_must_come_as_announced():
    with pytest.raises(ValueError, match=r"drive1/001: not the next scan"):
        empty().update(list(scenes())[1:], [TOY])
    with pytest.raises(ValueError, match="given twice: a/0"):
        ReferenceStatistics(PROTOCOL, {}, ["a/0", "a/0", "a/1"], {})
    with pytest.raises(ValueError, match="at least 2 scans"):
        ReferenceStatistics(PROTOCOL, {}, ["a/0"], {})


def test_features_unlike_those_of_the_reference_are_refused():
    with pytest.raises(ValueError, match="holds 0 of 11 scans"):
        empty().check([TOY])
    stored = filled()
    stored.check([TOY])
    with pytest.raises(ValueError, match="no features of fgeo, only of toy"):
        stored.check([replace(TOY, name="fgeo")])
    with pytest.raises(ValueError, match="toy differs from the reference: weights x not abc"):
        stored.check([replace(TOY, card={**CARD, "weights": "x"})])


def test_files_of_something_else_are_named(tmp_path):
    path = tmp_path / "a.safetensors"
    filled().save(path)
    for content in (None, b"no tensors at all", path.read_bytes()[:-100]):
        path.unlink(missing_ok=True)
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.safetensors holds no reference statistics"):
            ReferenceStatistics.load(path)
    with pytest.raises(ValueError, match="is a folder; give the file that `r3dpa data reference`"):
        ReferenceStatistics.load(tmp_path)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("0.toy_frechet.real_moments", lambda x: x[:-1], r"real_moments of shape \(6,\)"),
        ("1.toy_frechet.real_values", lambda x: x[:, :1], r"real_values of shape \(4, 1\)"),
        ("1.matching.real_values", lambda x: x[..., :32], r"real_values of shape \(2, 16, 32\)"),
        ("1.ranges.real_bins", None, r"tensor 1.ranges.real_bins is missing"),
    ],
)
def test_tensors_of_other_shapes_are_named(tmp_path, key, change, message):
    path = tmp_path / "a.safetensors"
    filled().save(path)
    with safe_open(path, framework="pt") as file:
        tensors, card = {k: file.get_tensor(k) for k in file.keys()}, file.metadata()  # noqa: SIM118
    found = tensors.pop(key)
    if change is not None:
        tensors[key] = change(found).contiguous()
    save_file(tensors, path, metadata=card)
    with pytest.raises(ValueError, match=rf"a\.safetensors holds .*{message}"):
        ReferenceStatistics.load(path)


@pytest.mark.fuzz
def test_scan_names_that_leave_the_folder_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    protocol = replace(PROTOCOLS["default"], sensor=LidarSensor(4, 16))
    ReferenceStatistics(protocol, {}, ["a/0", "b/0"], {}).save(path)
    with safe_open(path, framework="pt") as file:
        tensors, about = {key: file.get_tensor(key) for key in file.keys()}, file.metadata()  # noqa: SIM118
    card = json.loads(about["r3dpa_reference"])
    card["names"][0] = "../../x"
    save_file(tensors, path, {"r3dpa_reference": json.dumps(card)})
    with pytest.raises(ValueError, match=r"a\.safetensors holds no .*name of a scan"):
        ReferenceStatistics.load(path)
