"""Cost of the metrics: both ways agree, the parts are the whole, and the command."""

from __future__ import annotations

import json
import math

import pytest
import torch

from r3dpa.bench import metrics as bench
from r3dpa.bench.metric_networks import NETWORKS, OperationClock, Part, _measure, _whole
from r3dpa.bench.timing import Comparison, Ratio, Times
from r3dpa.cli import main
from r3dpa.data.scans import write_bin
from r3dpa.metrics.functional_bev import BEVGrid, MatchingTiming
from r3dpa.metrics.protocol import PUBLISHED

GRID = BEVGrid(cell_m=1.0)


def cylinder(count=3000, seed=0):
    """Points on a wall around the sensor, 8 to 12 m away."""
    generator = torch.Generator().manual_seed(seed)
    azimuth, radius, z, intensity = torch.rand(4, count, generator=generator)
    azimuth, radius = 2 * math.pi * azimuth, 8 + 4 * radius
    x, y = radius * azimuth.cos(), radius * azimuth.sin()
    return torch.stack([x, y, 2 * z - 1.8, intensity], dim=1)


class TestBothWays:
    def test_turned_scenes_are_as_far_away_and_elsewhere(self):
        one, two = bench.turned(cylinder(), 2)
        assert one[:, :2].norm(dim=1).mean().item() == pytest.approx(
            two[:, :2].norm(dim=1).mean().item(), 1e-3
        )
        half = cylinder()
        half = half[half[:, 0] > 0]
        front, back = bench.turned(half, 2)
        assert front[:, 0].min() > -0.1
        assert back[:, 0].max() < 0.1

    def test_histograms_and_matchings_agree(self):
        clouds = bench.turned(cylinder(), 4)
        jsd = bench.histograms(clouds, GRID, 2)
        assert jsd.largest_difference < 1e-9
        assert list(jsd.comparison.ms) == ["ours", "dense images"]
        cells = [GRID.cells(cloud) for cloud in clouds]
        mmd, timing, searched = bench.matching(cells[:2], cells[2:], GRID, (2, 1), 2)
        assert mmd.largest_difference < 1e-9
        assert timing.largest_difference < 1e-9
        assert 0 < searched["second_direction_share"] <= 1

    def test_convolutions_agree(self):
        """At a box that holds all: each voxel, and its neighbours, counted by hand."""
        points = 0.05 * torch.tensor([[30.0, 0, 0], [31, 0, 0], [31, 1, 0], [60, 0, 0]])
        found = bench.convolution(points, (8, 8, 4), 3, 2)
        # Three voxels that all touch each other: nine pairs; the fourth is outside the box.
        assert (found.about["voxels"], found.about["neighbours"]) == (3, 3.0)
        assert found.about["occupied"] == pytest.approx(3 / 256, abs=1e-6)
        assert found.largest_difference < 1e-5

    def test_a_difference_is_told(self, monkeypatch):
        monkeypatch.setattr(bench, "chamfer_cells", lambda a, b, grid: 1.0)
        cells = [GRID.cells(cloud) for cloud in bench.turned(cylinder(), 4)]
        mmd, *_ = bench.matching(cells[:2], cells[2:], GRID, (2, 2), 1)
        assert mmd.largest_difference > 0.5


def test_what_is_paid_once_is_not_multiplied():
    times = {"ours": Times(3, 1010.0, 0, 0), "dense images": Times(3, 4020.0, 0, 0)}
    comparison = Comparison(times, {}, Ratio(1, 1, 1))
    about = {"scenes": 10, "ms once, ours": 10.0, "ms once, dense images": 20.0}
    jsd = bench.Agreement(comparison, 0.0, about)
    times = {"all cells with all": Times(3, 12_000.0, 0, 0)}
    six = {"references": 2, "samples": 3}
    mmd = bench.Agreement(Comparison(times, {}, Ratio(1, 1, 1)), 0.0, six)
    # The brute force that was measured once, 99 s, does not count.
    full = bench._extrapolated(jsd, mmd, MatchingTiming(1.0, 0.001, 99.0, 0.0))
    assert full["JSD, 10000 scenes"] == pytest.approx((0.01 + 1000, 0.02 + 4000))
    # 3000 tables, two look-ups for each of 2 000 000 pairs.
    assert full["MMD, 2000 x 1000"] == pytest.approx((3000 + 4000, 4e6))


class TestNetworks:
    def test_operations_go_to_their_parts(self):
        clock, rows = OperationClock(), torch.randn(4, 3)
        index = torch.tensor([1, 2])
        with torch.inference_mode(), clock:
            gathered = rows.index_select(0, index)
            rows.index_add_(0, index, gathered)
            _ = gathered @ rows.T
            _ = torch.unique(index)
            _ = gathered + 1
        assert {name: part.calls for name, part in clock.parts.items()} == {
            **{"gather": 1, "index_add": 1, "matmul": 1, "map": 1},
            "rest": clock.parts["rest"].calls,
        }

    def test_parts_are_the_whole(self):
        parts = {"map": Part(1.0, 0.5, 2), "rest": Part(0.5, 0.5, 1)}
        whole = _whole(parts, 4.0, 3.0)
        assert whole == {"rest": Part(3.0, 2.5, 1), "map": Part(1.0, 0.5, 2)}
        assert list(whole) == ["rest", "map"]

    @pytest.mark.parametrize("name", NETWORKS)
    def test_one_scan(self, name):
        threads = torch.get_num_threads()
        cost = _measure(name, cylinder(500).numpy(), 1, small=True, threads=threads)
        own = {"map", "gather", "matmul", "index_add", "norm"}
        if name == "SPVCNN":
            own |= {"interpolation"}
        if name in ("MinkowskiNet", "SPVCNN"):
            assert own <= set(cost.parts)
            assert cost.dim == 64  # 16 rings of 4 channels
        assert "matmul" in cost.parts
        assert cost.peak_host_bytes >= cost.before_host_bytes > 0
        assert 0 < cost.seconds[1] <= cost.seconds[0] <= cost.seconds[2]


def test_prints_what_the_file_says(tmp_path, capsys):
    write_bin(tmp_path / "recording" / "cylinder.bin", cylinder())
    scan, out = tmp_path / "recording" / "cylinder.bin", tmp_path / "cost.json"
    main(["bench", "metrics", "--quick", "--scan", str(scan), "--out", str(out)])
    text, printed = out.read_text(), capsys.readouterr().out
    content = json.loads(text)
    assert content["scan"] == {"file": "cylinder.bin", "points": 3000}
    assert "recording" not in text + printed.replace(str(out), "")
    assert list(content["networks"]) == ["SPVCNN"]
    assert f"{content['networks']['SPVCNN']['core_seconds']:.3g}" in printed
    for name in ("jsd", "mmd", "sparse_convolution"):
        assert content[name]["largest_difference"] < 1e-5
        times = content[name]["comparison"]["ms"]
        for case in times.values():
            assert f"{case['median']:.2f}" in printed
    full = content["extrapolated_seconds"][f"JSD, {PUBLISHED.num_samples} scenes"]
    assert f"{full[0]:.4g}" in printed
