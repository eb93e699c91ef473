import json
import re

import pytest
import torch
import yaml
from torch import nn

import r3dpa.cli.evaluate as command
from lidarsim.scan_files import write_bin
from r3dpa.cli import main
from r3dpa.features import ScanGrid, WaffleIron
from r3dpa.features.scalr import save_weights
from r3dpa.geometry import LidarSensor, SphericalProjection, points_of
from r3dpa.metrics.networks.minkowski import MinkowskiNet, official_name
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.results import Evaluation
from r3dpa.viz import evaluation as figures

pytestmark = pytest.mark.usefixtures("coarse_protocols")

SENSOR = LidarSensor(beams=16, columns=64)
FILES = {"evaluation.json", "metrics.csv", "table.md", "table.tex"}


def range_images(seed, count):
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        wall = 4 + 20 * torch.rand(1, 64, generator=generator)
        yield wall.expand(16, 64) + torch.rand(16, 64, generator=generator)


def clouds(seed, count):
    return [points_of(image, SphericalProjection(SENSOR)) for image in range_images(seed, count)]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Data YAML of 12 scans of two drives, for a sensor of 16 x 64."""
    folder = tmp_path_factory.mktemp("real")
    for index, points in enumerate(clouds(0, 12)):
        write_bin(folder / "scans" / "ab"[index % 2] / f"{index:03d}.bin", points)
    sensor = {"class_path": "r3dpa.geometry.LidarSensor", "init_args": {"beams": 16, "columns": 64}}
    settings = {"scans": str(folder / "scans"), "sensor": sensor, "val_drives": ["b"]}
    path = folder / "data.yaml"
    content = {"data": {"class_path": "r3dpa.data.LidarDataModule", "init_args": settings}}
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture(scope="module")
def reference_file(coarse_protocols, data, tmp_path_factory):
    out = tmp_path_factory.mktemp("reference") / "reference.safetensors"
    command.reference(data=data, out=out, spaces=("fgeo",))
    return out


@pytest.fixture
def samples(tmp_path):
    folder = tmp_path / "made" / "samples"
    for index, points in enumerate(clouds(1, 10)):
        write_bin(folder / f"{index:03d}.bin", points)
    return folder


@pytest.fixture
def no_figures(monkeypatch):
    """Folders to which figures would go; test_test_command.py draws them, for half of the time."""
    folders = []
    monkeypatch.setattr(figures, "save_figures", lambda folder, **_: folders.append(folder))
    return folders


def evaluate(*words):
    main(["evaluate", *map(str, words), "--device", "cpu"])


def test_a_second_judge_has_rows_of_its_own(data, samples, tmp_path, no_figures):
    """Whoever gives other weights than those of the reference is told."""
    torch.manual_seed(0)
    grid = ScanGrid((-8.0, -8.0, -4.0), (8.0, 8.0, 4.0), (1.0, 1.0, 1.0), 0.5, 4)
    files = [tmp_path / name for name in ("judge.safetensors", "another.safetensors")]
    for file in files:
        save_weights(file, WaffleIron(8, 3, grid.cells), nn.BatchNorm1d(8), grid)
    reference, out = tmp_path / "ref.safetensors", tmp_path / "out"
    judge = {"fwid_judge": files[0]}
    command.reference(data=data, out=reference, spaces=("fgeo", "fwid_judge"), ckpt=judge)
    samples = samples.rename(tmp_path / "v1.2")
    words = ["--samples", samples, "--reference", reference, "--allow_few", "--out", out]
    evaluate(*words, "--ckpt.fwid_judge", files[0])
    found = Evaluation.load(out / "evaluation.json")
    assert found.label == "v1.2"
    names = {row.name for row in found.rows}
    assert {"FGEO", "FWID_JUDGE", "FWID_JUDGE recall"} <= names
    assert "FWID" not in names
    assert found.about["backbones"]["FWID_JUDGE"]["weights"]
    with pytest.raises(ValueError, match="fwid_judge"):
        evaluate(*words, "--ckpt.fwid_judge", files[1])


def test_a_reference_of_another_format_is_refused_before_scans_are_read(data, tmp_path):
    with pytest.raises(ValueError, match=r"ref\.npy: must be a \.safetensors file"):
        command.reference(data=data, out=tmp_path / "ref.npy", spaces=("fgeo",))


def test_samples_are_compared_with_a_reference(data, samples, no_figures, tmp_path, capsys):
    """In the default spaces, on few scans and samples: FWID is a large network."""
    reference, out = tmp_path / "ref.safetensors", tmp_path / "results"
    words = ["--data", data, "--out", reference, "--limit", 4, "--device", "cpu"]
    main(["reference", *map(str, words)])
    described = capsys.readouterr().out.strip().splitlines()[-1]
    assert re.search(r"4 scans, names [0-9a-f]{12}; fwid, fgeo; protocol default", described)
    for path in sorted(samples.iterdir())[3:]:
        path.unlink()
    metadata = {
        "r3dpa": "1.0",
        "feature_source": "geometric",
        "sampler": {"solver": "heun", "steps": 7},
        "seed": 3,
        "weights": "ema",
    }
    (samples.parent / "metadata.json").write_text(json.dumps(metadata))
    words = ["--samples", samples, "--reference", reference, "--allow_few", "--out", out]
    evaluate(*words, "--label", "ours")
    printed = capsys.readouterr().out
    for metric in ("JSD", "TV", "W1 range", "MMD", "CD 3D", "FWID", "FGEO", "FGEO recall"):
        assert re.search(rf"^{re.escape(metric)}[ x]", printed, re.MULTILINE), metric
    assert "published" not in printed  # the scans are not KITTI-360
    assert re.search(r"^\| ours +\| +[-\d]", printed, re.MULTILINE)
    assert {path.name for path in out.iterdir()} == FILES
    assert no_figures == [out]
    stored = Evaluation.load(out / "evaluation.json")
    assert stored.label == "ours"
    assert (stored.row("JSD").num_samples, stored.row("JSD").num_references) == (3, 4)
    assert stored.row("JSD").floor > 0
    about = stored.about
    assert (about["source"], about["solver"]) == (str(samples), "heun")
    assert (about["steps"], about["seed"], about["feature_source"]) == (7, 3, "geometric")
    assert about["extra"]["weights"] == "ema"
    assert (out / "metrics.csv").read_text().count("\nours,False,") == len(stored.rows)


def test_the_split_and_the_limit_choose_scans(data, tmp_path):
    names = {}
    for split in ("train", "val", "all"):
        out = tmp_path / f"{split}.safetensors"
        command.reference(data=data, out=out, spaces=("fgeo",), split=split, limit=4)
        names[split] = ReferenceStatistics.load(out).names
    assert names["train"] == ("a/000", "a/002", "a/006", "a/008")
    assert names["val"] == ("b/001", "b/003", "b/007", "b/009")
    assert [name[0] for name in names["all"]] == ["a", "a", "b", "b"]


def test_scans_to_train_on_beside_the_own_ones_are_no_reference(data, tmp_path):
    for index, points in enumerate(clouds(20, 4)):
        write_bin(tmp_path / "simulated" / f"{index:03d}.bin", points)
    content = yaml.safe_load(data.read_text())
    content["data"]["init_args"] |= {"further_scans": str(tmp_path / "simulated"), "repeats": 2}
    path, out = tmp_path / "data.yaml", tmp_path / "reference.safetensors"
    path.write_text(yaml.safe_dump(content))
    command.reference(data=path, out=out, spaces=("fgeo",))
    names = ReferenceStatistics.load(out).names
    assert len(names) == 12
    assert {name[0] for name in names} == {"a", "b"}


def test_bad_samples_stop_or_are_listed(reference_file, no_figures, samples, tmp_path, capsys):
    """The reader refuses the first, the scorer the second: all its points are beside the grid."""
    (samples / "004.bin").write_bytes(b"no points")
    write_bin(samples / "007.bin", torch.tensor([[0.0, 52.0, 0.0, 0.0]]))
    words = ["--samples", samples, "--reference", reference_file, "--allow_few"]
    with pytest.raises(ValueError, match=r"004\.bin: has 9 bytes.*skip_bad leaves such"):
        evaluate(*words)
    with pytest.warns(UserWarning, match="1 bad samples left out"):
        evaluate(*words, "--skip_bad", "--out", tmp_path / "out")
    stored = Evaluation.load(tmp_path / "out" / "evaluation.json")
    assert stored.row("JSD").num_samples == 8
    (first, second), printed = stored.bad_samples, capsys.readouterr().out
    assert re.search(r"004\.bin: has 9 bytes", first)
    assert second.startswith("samples/007: none of 1 points has x and y within")
    assert first in printed
    assert second in printed
    note = "samples: samples that cannot be used and are left out: 2"
    assert note in printed
    assert note in (tmp_path / "out" / "table.md").read_text()
    (samples.parent / "metadata.json").write_text("{")
    with pytest.raises(ValueError, match=r"metadata\.json: is damaged"):
        evaluate(*words)


def test_official_weights_are_given_by_space(data, no_figures, samples, tmp_path):
    torch.manual_seed(0)
    network, weights = MinkowskiNet((2,) * 9), tmp_path / "fsvd.ckpt"
    torch.save({official_name(k): v for k, v in network.state_dict().items()}, weights)
    reference = tmp_path / "ref.safetensors"
    words = ["--data", data, "--out", reference, "--spaces", "fgeo,fsvd", "--ckpt.fsvd", weights]
    words += ["--limit", 4]
    for path in sorted(samples.iterdir())[3:]:
        path.unlink()
    main(["reference", *map(str, words), "--device", "cpu"])
    words = ["--samples", samples, "--reference", reference, "--allow_few"]
    evaluate(*words, "--out", tmp_path / "free")  # without the file, without its space
    evaluate(*words, "--ckpt.fsvd", weights, "--out", tmp_path / "both")
    free, both = (Evaluation.load(tmp_path / name / "evaluation.json") for name in ("free", "both"))
    assert free.row("FSVD") is None
    assert free.row("FGEO") is not None
    assert both.row("FSVD") is not None
    assert both.about["backbones"]["FSVD"]["backbone"] == "MinkowskiNet"
    torch.nn.init.ones_(network.head.bias)
    torch.save({official_name(k): v for k, v in network.state_dict().items()}, weights)
    with pytest.raises(ValueError, match="fsvd differs from the reference: weights"):
        evaluate(*words, "--ckpt.fsvd", weights)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--spaces", "fgeo"], "10 generated scenes for the 64 features of FGEO.*allow_few"),
        (["--spaces", "fwid"], "the reference has no features of fwid, only of fgeo"),
        (["--ckpt.frid", "x.ckpt"], r"--ckpt\.frid: frid is not among the spaces \(fgeo\)"),
        (["--split", "val"], r"reference\.safetensors: .*the split val does not apply"),
    ],
)
def test_wrong_options_of_evaluate_are_named(reference_file, samples, words, message):
    options = ["--samples", samples, "--reference", reference_file]
    with pytest.raises(ValueError, match=message):
        evaluate(*options, *words)


def test_wrong_options_of_a_reference_are_named(data, reference_file, tmp_path):
    out = tmp_path / "new.safetensors"
    with pytest.raises(ValueError, match=r"reference\.safetensors exists: delete it"):
        command.reference(data=data, out=reference_file, spaces=("fgeo",))
    with pytest.raises(ValueError, match="1 scan in split all; at least 2 are needed"):
        command.reference(data=data, out=out, spaces=("fgeo",), limit=1)
    assert not out.exists()
