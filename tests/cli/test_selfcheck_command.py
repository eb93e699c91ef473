import contextlib
import io
import json
import re
from dataclasses import replace
from functools import partial

import pytest
import torch

import r3dpa.cli.selfcheck as command
from r3dpa.cli import main
from r3dpa.cli.selfcheck import CorruptionTable, Row
from r3dpa.data.scans import write_bin
from r3dpa.geometry import LidarSensor, SphericalProjection, points_of
from r3dpa.metrics.distances import Resampling
from r3dpa.metrics.protocol import DEFAULT
from r3dpa.metrics.results import MetricResult

SENSOR = LidarSensor(beams=16, columns=64)
# Cells of half a metre are a hundredth of the work.
SMALL = {"default": replace(DEFAULT, voxel_m=0.5, sensor=SENSOR)}
ROWS = ["real", "noise 2 cm", "noise 5 cm", "noise 10 cm", "noise 20 cm", "drop 10 %", "drop 30 %"]
ROWS += ["rotation 90 deg"]
DISTANCES = ("JSD", "TV", "W1 range", "MMD", "CD 3D", "FGEO", "FGEO KID")
SHARES = ("FGEO precision", "FGEO recall", "FGEO density", "FGEO coverage")


@pytest.fixture(scope="module", autouse=True)
def little_work():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "PROTOCOLS", SMALL)
        patch.setattr(command, "Resampling", partial(Resampling, num_resamples=40))
        yield


def write_scans(folder, seed, count, far_m=0.0):
    """Boxes around the sensor in two drives, longer ahead than to the sides."""
    generator = torch.Generator().manual_seed(seed)
    azimuth = torch.arange(64) * 2 * torch.pi / 64
    for index in range(count):
        ahead, side = 25 + 10 * torch.rand(1, generator=generator), 5 + far_m
        wall = torch.minimum(ahead / azimuth.cos().abs(), side / azimuth.sin().abs())
        image = wall.expand(16, 64) + 0.02 * torch.rand(16, 64, generator=generator)
        points = points_of(image, SphericalProjection(SENSOR))
        write_bin(folder / "ab"[index % 2] / f"{index:03d}.bin", points)
    return folder


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    return write_scans(tmp_path_factory.mktemp("selfcheck") / "real", 0, 16)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    return write_scans(tmp_path_factory.mktemp("selfcheck") / "simulated", 1, 20, far_m=4.0)


@pytest.fixture(scope="module")
def found(real, simulated, tmp_path_factory):
    """What the command prints, and the JSON that it writes."""
    out = tmp_path_factory.mktemp("selfcheck") / "selfcheck.json"
    words = ["--data", real, "--against", simulated, "--spaces", "fgeo", "--out", out]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        main(["selfcheck", *map(str, words), "--device", "cpu"])
    assert str(real) not in out.read_text()
    return printed.getvalue(), json.loads(out.read_text())


def test_prints_a_row_for_every_corruption_and_says_how_few_scans_there_are(found):
    printed, _ = found
    # Two blocks of columns in each of two tables; simulated scans are in the first alone.
    for row, blocks in {**dict.fromkeys(ROWS, 4), "simulated": 2}.items():
        assert len(re.findall(rf"^{re.escape(row)} .*\d", printed, re.MULTILINE)) == blocks, row
    assert "\nreal: 8 scans of 1 drive, compared with 8 scans of 1 drive;" in printed
    assert "\nsimulated: 8 scans of 2 drives of simulated." in printed
    assert printed.count("FGEO inf: needs 260 scenes") == 2


def test_metrics_answer_as_they_must(found):
    _, content = found
    other, same = (table["verdicts"] for table in content["tables"])
    assert set(other) == set(same) == {*DISTANCES, *SHARES}
    for verdicts in (other, same):
        # What is turned looks the same to ranges and to features without directions, but not
        # from above.
        for blind in ("W1 range", "FGEO", "FGEO KID"):
            assert verdicts[blind]["rotation"] == "none", blind
        for metric in ("JSD", "MMD", "CD 3D"):
            assert verdicts[metric]["rotation"] == "seen", metric
    # The simulated street is wider by metres.
    for metric in ("JSD", "W1 range", "MMD", "CD 3D", "FGEO"):
        assert other[metric]["simulated"] == "yes 1/1", metric
    # Walls are smooth to 2 cm, so features of shape notice noise at once.
    for metric in ("FGEO", "W1 range", "CD 3D"):
        assert same[metric]["noise"].startswith("yes"), metric
    assert other["FGEO"]["noise"].startswith("yes")


def test_scans_are_no_distance_from_themselves(found):
    _, content = found
    clean = {row["name"]: row["value"] for row in content["tables"][1]["rows"][0]["metrics"]}
    assert clean["JSD"] == clean["TV"] == clean["W1 range"] == clean["MMD"] == clean["CD 3D"] == 0
    # Rounding of the matrix root.
    assert clean["FGEO"] == pytest.approx(0, abs=1e-6)
    assert clean["FGEO precision"] == clean["FGEO recall"] == clean["FGEO coverage"] == 1


def test_is_repeatable_and_needs_no_simulated_scans(real, found):
    _, content = found
    again = command.selfcheck(real, spaces=["fgeo"], device="cpu").to_dict()["tables"]
    rows = json.loads(json.dumps([table["rows"] for table in again]))
    assert rows == [content["tables"][0]["rows"][:-1], content["tables"][1]["rows"]]


class TestVerdict:
    """Verdicts on made-up values."""

    @staticmethod
    def table(metric, values):
        rows = (
            Row(*case, (MetricResult(metric, value, (value - 0.5, value + 0.5), scale=-2),))
            for case, value in values.items()
        )
        return CorruptionTable("made up", tuple(rows), ("FGEO",))

    def test_names_the_levels_that_do_not_worsen(self):
        table = self.table(
            "JSD",
            {
                ("real", ""): 1.0,
                ("noise", "2 cm"): 3.0,
                ("noise", "5 cm"): 2.0,
                ("noise", "10 cm"): 2.0,
                ("drop", "10 %"): 1.2,
                ("drop", "30 %"): 4.0,
                ("simulated", ""): 0.9,
            },
        )
        assert table.verdict("noise", "JSD") == "no: 5 cm, 10 cm"
        assert table.verdict("drop", "JSD") == "yes 1/2"
        assert table.verdict("simulated", "JSD") == "no"
        lines = [re.sub(r"\s+", " ", line.rstrip()) for line in str(table).splitlines()]
        assert "noise 2 cm 300.00" in lines
        assert "noise 5 cm 200.00<" in lines
        assert "drop 10 % 120.00~" in lines
        assert "worsens with noise no" in lines

    @pytest.mark.parametrize(
        ("metric", "turned", "verdict"),
        [
            ("JSD", 1.005, "none"),
            ("JSD", 1.3, "small"),
            ("JSD", 0.1, "seen"),
            ("W1 range", 1.005, "none"),
            ("W1 range", 1.3, "small !"),
            ("FGEO KID", 3.0, "seen !"),
        ],
    )
    def test_of_rotation(self, metric, turned, verdict):
        values = {("real", ""): 1.0, ("noise", "2 cm"): 2.0, ("rotation", "90 deg"): turned}
        assert self.table(metric, values).verdict("rotation", metric) == verdict


class TestErrors:
    def test_too_few_scans_are_counted(self, tmp_path):
        folder = write_scans(tmp_path / "few", 0, 3)
        with pytest.raises(ValueError, match=r"3 scans give halves of 2 and 1"):
            main(["selfcheck", "--data", str(folder)])

    def test_weights_of_no_space(self, real):
        words = ["--data", str(real), "--spaces", "fgeo", "--ckpt.frid", "model.ckpt"]
        with pytest.raises(ValueError, match=r"--ckpt\.frid: .*is not among the spaces \(fgeo\)"):
            main(["selfcheck", *words])

    def test_folder_without_scans(self, tmp_path):
        with pytest.raises(ValueError, match="No scan found"):
            main(["selfcheck", "--data", str(tmp_path)])
