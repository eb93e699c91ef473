from __future__ import annotations

import json
import re
import shutil

import pytest

from r3dpa.cli import main
from r3dpa.cli.probe import CLASSES, _extractors, probe
from r3dpa.data.scans import ScanError
from r3dpa.simulation import simulate


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    root = tmp_path_factory.mktemp("probe")
    simulate(root, 4, drives=["0003", "0000"])
    return root


def test_sources_are_compared_in_a_table_and_a_file(simulated, tmp_path, capsys):
    out = tmp_path / "probe.json"
    words = ["probe", "--data", simulated, "--sources", "geometric,oracle", "--train_scans", 2]
    main([*map(str, words), "--val_scans", "1", "--device", "cpu", "--out", str(out)])
    printed = capsys.readouterr().out
    report = json.loads(out.read_text())
    assert list(report["sources"]) == printed.splitlines()[0].split() == ["geometric", "oracle"]
    geometric, oracle = report["sources"].values()
    assert oracle["accuracy"] > 0.95 > geometric["accuracy"] > 0.3
    assert oracle["empty_share"] == geometric["empty_share"]  # of the scan, not of the source
    assert set(oracle["iou"]) == set(CLASSES.values()) == set(report["classes"])
    assert oracle["train_points"] == 4000
    row = re.search(r"^accuracy \(%\) +([\d.]+) +([\d.]+)$", printed, re.MULTILINE)
    shown = [100 * source["accuracy"] for source in (geometric, oracle)]
    assert [float(value) for value in row.groups()] == pytest.approx(shown, abs=0.051)
    assert report["data"].endswith("2 scans to fit, 1 to test")
    assert {"command", "machine", "versions"} < set(report)
    # The rows of the confusion matrix are the test points; each class of the mean has some.
    counts = dict(zip(report["classes"], map(sum, oracle["confusion"]), strict=True))
    known = [value for value in oracle["iou"].values() if value is not None]
    assert [name for name, value in oracle["iou"].items() if value is None] == [
        name for name, count in counts.items() if count == 0
    ]
    assert oracle["mean_iou"] == pytest.approx(sum(known) / len(known))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sources": ["geometry"]}, "no feature source 'geometry'.*oracle"),
        ({"sources": ["oracle", "oracle"]}, "must be different names.*oracle,oracle"),
        ({"sources": ["oracle"], "ckpt": "x.pth"}, "no source of oracle reads a ckpt.*x.pth"),
        ({"sources": ["oracle"], "val_scans": 0}, "val_scans must be 1 or greater, got 0"),
    ],
)
def test_wrong_options_are_named(simulated, options, message):
    with pytest.raises(ValueError, match=message):
        probe(simulated, **options)


def test_random_is_the_network_of_waffleiron_s_with_other_weights():
    trained, random = _extractors(["waffleiron-s", "random"], None).values()
    assert (trained.name, random.name) == ("waffleiron-s", "random")
    assert trained.settings["weights"] != random.settings["weights"]
    assert trained.network.state_dict().keys() == random.network.state_dict().keys()


def test_data_without_a_split_or_without_labels_is_named(simulated, tmp_path):
    root = tmp_path / "data"
    shutil.copytree(simulated, root)
    shutil.rmtree(next(root.glob("data_3d_raw/*0003*/velodyne_points/labels")))
    with pytest.raises(ScanError, match=r"\.bin has no labels"):
        probe(root, ["geometric"], device="cpu")
    shutil.rmtree(next(root.glob("data_3d_raw/*0000*")))
    with pytest.raises(ValueError, match="no scan for val_scans"):
        probe(root, ["geometric"], device="cpu")
