"""Cost of feature grids: what is made of the times, the work of a network, and the command."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from torch import nn

from r3dpa.bench import features as bench
from r3dpa.bench.point_network import _needed, _PartClock
from r3dpa.bench.timing import Ratio, Times, compare, seconds
from r3dpa.cli import main
from r3dpa.nn.backbones import WaffleIron


@pytest.fixture
def scan(tmp_path):
    """600 points on a cylinder around the sensor."""
    rng = np.random.default_rng(0)
    azimuth, height = rng.uniform(-np.pi, np.pi, 600), rng.uniform(-2, 0.4, 600)
    columns = [10 * np.cos(azimuth), 10 * np.sin(azimuth), height, rng.uniform(0, 1, 600)]
    path = tmp_path / "recording" / "cylinder.bin"
    path.parent.mkdir()
    np.column_stack(columns).astype("<f4").tofile(path)
    return path


class TestCompare:
    def test_runs_there_and_back_and_leaves_the_first_round_out(self):
        calls = []

        def case(name, milliseconds):
            values = iter(milliseconds)

            def run():
                calls.append(name)
                return next(values) / 1000

            return run

        # "a" is also the repeated case: two of its times belong to each round.
        cases = {"a": case("a", [99, 99, 2, 4, 6, 8]), "b": case("b", [99, 6, 12])}
        found = compare(cases, rounds=2)
        assert calls == ["a", "b", "a", *["a", "b", "a"], *["a", "b", "a"]]
        # Backwards in the second round: the repeat comes first there.
        assert found.ms["a"] == Times(2, 5.0, 4.0, 6.0)
        assert found.ms["b"] == Times(2, 9.0, 6.0, 12.0)
        assert found.over_first.keys() == {"b"}
        assert found.over_first["b"].value == pytest.approx(9 / 5)
        assert found.repeat.value == pytest.approx(5 / 5)

    def test_interval_of_a_ratio(self):
        rng = np.random.default_rng(0)
        noise = rng.uniform(0.9, 1.1, (2, 50))
        ratio = Ratio.of((3 * noise[0]).tolist(), noise[1].tolist())
        assert ratio.value == pytest.approx(np.median(3 * noise[0]) / np.median(noise[1]))
        assert 2.7 < ratio.low < ratio.value < ratio.high < 3.3
        # Rounds are drawn together: what slows both down does not widen the interval.
        shared = Ratio.of((3 * noise[0]).tolist(), noise[0].tolist())
        assert (shared.low, shared.high) == pytest.approx((3, 3))

    def test_a_difference_between_equal_cases_is_told(self):
        rising = iter(range(1, 100))
        found = compare({"only": lambda: float(next(rising))}, rounds=3)
        assert found.sound
        alternating = iter([1.0, 1.0, 2.0, 1.0, 1.0, 2.0, 2.0, 1.0])
        found = compare({"only": lambda: next(alternating)}, rounds=3)
        assert not found.sound
        assert found.repeat.value == 2
        assert "claim nothing" in bench.comparison_table("table", found)

    def test_seconds_takes_the_time_of_the_function(self):
        import time

        assert 0.01 < seconds(lambda: time.sleep(0.01))() < 1


class TestNetwork:
    def test_work_equals_what_the_layers_count(self):
        """Multiply-adds by layer, from the shapes that the layers see."""
        network, num_points, num_neighbors = WaffleIron(6, 4, (5, 4, 3)).eval(), 7, 3
        flop = {"embedding": 0, "spatial mixing": 0, "channel mixing": 0}

        def count(part):
            def hook(layer, inputs, output):
                weights = layer.weight[0].numel()  # of one output
                flop[part] += 2 * weights * output.numel()

            return hook

        for name, layer in network.named_modules():
            if isinstance(layer, nn.Linear | nn.Conv2d):
                part = {"s": "spatial mixing", "c": "channel mixing", "e": "embedding"}[name[0]]
                layer.register_forward_hook(count(part))
        from r3dpa.nn.backbones import PointCloudBatch

        sizes = [rows * columns for rows, columns in network.plane_sizes]
        batch = PointCloudBatch(
            torch.randn(num_points, 5),
            torch.randint(num_points, (num_points, num_neighbors)),
            torch.stack([torch.randint(size, (num_points,)) for size in sizes]),
            torch.tensor([num_points]),
        )
        with torch.inference_mode():
            network(batch)
        needed = _needed(network, num_points, num_neighbors)
        assert {part: work[0] for part, work in needed.items()} == flop

    def test_parts_of_the_clock_are_the_whole(self, monkeypatch):
        from r3dpa.bench import point_network

        times = iter([(0.0, 0.0), (1.0, 2.0), (3.0, 2.5), (7.0, 4.5)])
        monkeypatch.setattr(point_network, "now", lambda: next(times))
        clock = _PartClock()
        clock.mark("a")
        clock.mark("b")
        clock.mark("a")
        assert clock.seconds == {"a": (1.0 + 4.0, 2.0 + 2.0), "b": (2.0, 0.5)}


def test_command_prints_what_the_file_says(scan, monkeypatch, capsys, tmp_path):
    out = tmp_path / "cost.json"
    words = ["bench", "features", "--quick", "--scan", str(scan), "--out", str(out)]
    monkeypatch.setattr("sys.argv", ["/somewhere/r3dpa", *words])
    main(words)
    content, printed = json.loads(out.read_text()), capsys.readouterr().out
    assert content["scan"] == {"file": "cylinder.bin", "points": 600}
    assert content["command"].startswith("r3dpa bench features --quick --scan cylinder.bin --out")
    comparisons = list(content["grid_building"].values())
    reading = content["grid_reading"]
    comparisons += [case for name, case in reading.items() if "process" in name]
    assert len(reading) in (2 + 2, 2 + 4)  # cold where the system allows
    for case in comparisons:
        first, *others = case["ms"]
        assert case["over_first"].keys() == set(others)
        for name in others:
            ratio = case["over_first"][name]
            medians = case["ms"][name]["median"], case["ms"][first]["median"]
            assert ratio["value"] == pytest.approx(medians[0] / medians[1])
            assert 0 < ratio["low"] <= ratio["high"]
    sizes = reading["bytes_per_scan"]
    values = 512 * bench._QUICK.dim
    assert 2 * values < sizes["float16"] < sizes["npz float16"] < sizes["npz float64"]
    assert values + 4 * 512 < sizes["int8"] < sizes["float16"]
    assert 8 * values < sizes["npz float64"] < 8 * values + 1000
    (network,) = content["networks"].values()
    parts = network["parts"]
    for key in ("seconds", "core_seconds"):
        total = sum(part[key] for part in parts.values())
        assert total == pytest.approx(network[key], rel=0.02, abs=2e-3)
    assert list(parts) == [
        *["preparation", "collation", "embedding", "planes"],
        *["spatial mixing", "channel mixing", "upsampling"],
    ]
    for part in parts.values():
        by_flop = part["flop"] / 1e9 / network["gflop_s"]
        by_bytes = part["num_bytes"] / 1e9 / network["read_gb_s"]
        assert part["floor_core_seconds"] == pytest.approx(max(by_flop, by_bytes))
    assert network["peak_host_bytes"] > 2**26
    rows = {line.split("  ")[0]: line.split() for line in printed.splitlines() if line}
    assert rows["embedding"][1] == f"{parts['embedding']['seconds']:.3g}"
    assert content["versions"]["torch"] in printed


def test_bad_paths_are_refused_before_any_work(scan, tmp_path):
    with pytest.raises(ValueError, match="is a folder"):
        main(["bench", "features", "--out", str(tmp_path)])
    with pytest.raises(ValueError, match=r"none\.bin"):
        main(["bench", "features", "--scan", str(tmp_path / "none.bin")])
