import io
import os
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidarsim.scan_files import write_bin
from r3dpa.cli import main
from r3dpa.metrics.evaluation import evaluate
from r3dpa.metrics.functional import frechet_distance_of
from r3dpa.metrics.functional_bev import histogram_distance, minimum_matching
from r3dpa.metrics.official_statistics import OfficialStatistics
from r3dpa.metrics.resampling import Resampling
from r3dpa.metrics.results import Evaluation
from r3dpa.metrics.scene import PUBLISHED, EvaluationScene, through_sensor
from r3dpa.metrics.scene_features import SceneFeatures

WITHOUT = Resampling(num_resamples=0)


def features(scenes):
    """Mean, deviation and horizon of the range images."""
    images = [scene.range_m for scene in scenes]
    return torch.stack([torch.stack([i.mean(), i.std(), i[20].mean()]) for i in images]) / 20


FRID = SceneFeatures("frid", 3, {"in_channels": 4}, features)


def scenes(seed, count):
    """Walls and ground, 64 x 1024 pixels, with returns in every fourth row; two drives."""
    generator = torch.Generator().manual_seed(seed)
    for index in range(count):
        wall = 5 + 30 * torch.rand(1, 64, generator=generator).repeat_interleave(16, dim=1)
        ground = 3 + 10 * torch.rand(64, 1, generator=generator)
        range_m = torch.full((64, 1024), -1.0)
        range_m[::4] = torch.minimum(wall, ground)[::4]
        yield EvaluationScene(f"{'ab'[index % 2]}/{index:03d}", None, range_m)


REAL = list(scenes(0, 4))


def content(seen=None):
    """The layout of the official file, from scenes as the sensor sees them."""
    seen = seen or [through_sensor(scene, PUBLISHED) for scene in REAL]
    rows = features(seen).double().numpy()
    grid, counts, points = PUBLISHED.grid, np.zeros((2000, 2000), np.float32), []
    for scene in seen:
        x, y = np.divmod(grid.cells(scene.points).numpy(), 2000)
        counts[x, y] += 1
        points.append((np.stack([x, y], axis=1) / 2000).astype(np.float32))
    moments = {"mu": rows.mean(axis=0), "sigma": np.cov(rows, rowvar=False)}
    split = {"rangevit_wo_i": moments, "dataset_bev_hist": counts}
    paths = [["2013_05_28", f"{index}.bin"] for index in range(len(points))]
    clouds = {"points": points, "file_paths": paths}
    return {"all": dict(split), "val": {**split, "valset_voxelized_bev": clouds}}


CONTENT = content()


def write(path, value=CONTENT):
    np.save(path, np.array(value, dtype=object), allow_pickle=True)
    return path


def changed(key, value, split="val"):
    """The content with one field replaced, or left out where the value is None."""
    part = {name: entry for name, entry in CONTENT[split].items() if name != key}
    return {split: part if value is None else {**part, key: value}}


@pytest.fixture
def file(tmp_path):
    return write(tmp_path / "data_statistics.npy")


class TestEvaluateOfficial:
    def test_rows_are_those_against_the_scans_themselves(self, file):
        """From the file alone, the numbers that the metrics give from all scans."""
        seen = [[through_sensor(s, PUBLISHED) for s in part] for part in (REAL, scenes(1, 4))]
        clouds, grid = [[scene.points for scene in part] for part in seen], PUBLISHED.grid
        distances = histogram_distance(*map(grid.histogram, clouds))
        cells = [[grid.cells(cloud) for cloud in part] for part in clouds]
        expected = {
            "JSD": distances.jsd_distance,
            "TV": distances.total_variation,
            "MMD": minimum_matching(*cells, grid).squared_normalised.mean().item(),
            "FRID": frechet_distance_of(*map(features, seen)),
        }
        found = evaluate(
            scenes(1, 4), OfficialStatistics.load(file), [FRID], label="made", resampling=WITHOUT
        )
        assert found.figures is None
        found = found.evaluation
        assert [row.name for row in found.rows] == ["JSD", "TV", "MMD", "FRID"]
        for row in found.rows:
            assert row.value == pytest.approx(expected[row.name], rel=1e-6), row.name
            assert row.num_samples == 4
            assert row.num_references == (4 if row.name == "MMD" else None)
            assert row.floor is None
        assert found.about["protocol"]["name"] == "published"
        assert found.about["reference"].startswith("official statistics data_statistics.npy, ")
        assert "precision" in found.about["extra"]["left_out"]

    def test_what_the_file_lacks_is_left_out_and_said(self, tmp_path):
        part = {"all": {"rangevit_wo_i": CONTENT["all"]["rangevit_wo_i"]}}
        statistics = OfficialStatistics.load(write(tmp_path / "s.npy", part))
        found = evaluate(
            scenes(1, 6), statistics, [FRID], label="made", resampling=Resampling(num_resamples=40)
        ).evaluation
        assert [row.name for row in found.rows] == ["FRID"]
        assert found.rows[0].interval[0] < found.rows[0].interval[1]
        for name in ("JSD", "TV", "MMD"):
            assert name in found.about["extra"]["left_out"]

    def test_few_scenes_and_other_spaces_are_refused(self, file):
        statistics = OfficialStatistics.load(file)
        assert (statistics.split, statistics.spaces) == ("val", ["frid"])
        with pytest.raises(ValueError, match="3 generated scenes for the 3 features of FRID"):
            evaluate(scenes(1, 3), statistics, [FRID], label="made")
        toy = replace(FRID, name="fgeo")
        with pytest.raises(ValueError, match=r"no moments of fgeo .*only of rangevit_wo_i"):
            evaluate(scenes(1, 3), statistics, [toy], label="made")
        intense = replace(FRID, card={"in_channels": 5})
        with pytest.raises(ValueError, match=r"no moments of frid \(rangevit_w_i\)"):
            evaluate(scenes(1, 3), statistics, [intense], label="made")
        with pytest.raises(ValueError, match=r"val.rangevit_wo_i: has 3 features, but frid has 4"):
            statistics.moments_of(replace(FRID, dim=4))


class TestLoad:
    def test_file_of_an_older_numpy(self, tmp_path):
        """NumPy 1 called its modules otherwise, and wrote pickles of protocol 3."""
        stream = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            stream, {"descr": "|O", "fortran_order": False, "shape": ()}
        )
        pickled = pickle.dumps(np.array(CONTENT, dtype=object), protocol=3)
        older = pickled.replace(b"numpy._core.multiarray\n", b"numpy.core.multiarray\n")
        assert b"numpy.core.multiarray\n" in older
        stream.write(older)
        path = tmp_path / "old.npy"
        path.write_bytes(stream.getvalue())
        assert torch.equal(
            OfficialStatistics.load(path).cells,
            OfficialStatistics.load(write(tmp_path / "new.npy")).cells,
        )

    def test_a_pickle_runs_no_code(self, tmp_path):
        class Harm:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / "harm"),)

        path = write(tmp_path / "bad.npy", {"val": Harm()})
        with pytest.raises(ValueError, match=r"bad.npy: .*posix.mkdir is no array"):
            OfficialStatistics.load(path)
        assert not (tmp_path / "harm").exists()

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            ({"test": {}}, r"with the split val or all \(KeyError\('all'\)"),
            ({"val": {}}, "field val: holds no statistics"),
            (changed("rangevit_wo_i", {"mu": np.zeros(3)}), r"KeyError\('sigma'\)"),
            (
                changed("rangevit_wo_i", {"mu": np.zeros(3), "sigma": np.eye(4)}),
                r"shape '\[3, 3\]' is invalid for input of size 16",
            ),
            (
                changed("rangevit_wo_i", {"mu": np.full(2, np.nan), "sigma": np.eye(2)}),
                r"an array of shape \(2,\) instead of 1 axes of numbers",
            ),
            (changed("dataset_bev_hist", "x"), "no attribute 'ndim'"),
            (
                changed("valset_voxelized_bev", {"points": [np.full((1, 2), 0.00025)]}),
                "occupied cells that are not multiples of 1 / 2000",
            ),
        ],
    )
    def test_damaged_statistics_are_named_with_their_file(self, tmp_path, value, message):
        with pytest.raises(ValueError, match=message) as caught:
            OfficialStatistics.load(write(tmp_path / "named.npy", value))
        assert "named.npy" in str(caught.value)

    def test_files_that_are_no_official_statistics_are_refused(self, tmp_path, file):
        np.save(tmp_path / "plain.npy", np.zeros(3))
        for name in ("plain.npy", "missing.npy"):
            with pytest.raises(ValueError, match=f"{name}: is no official statistics file"):
                OfficialStatistics.load(tmp_path / name)
        file.write_bytes(file.read_bytes()[:-1000])
        with pytest.raises(ValueError, match="no official statistics file"):
            OfficialStatistics.load(file)


class TestCommand:
    def test_prints_and_writes_the_distances(self, tmp_path, capsys):
        points = through_sensor(REAL[0], PUBLISHED).points
        for index in range(2):
            write_bin(tmp_path / "made" / f"{index}.bin", points)
        reference, out = write(tmp_path / "stats.npy"), tmp_path / "out"
        words = ["evaluate", "--samples", tmp_path / "made", "--reference", reference, "--out", out]
        main([*map(str, words), "--split", "all", "--device", "cpu"])
        printed = capsys.readouterr().out
        rows = {row.name: row for row in Evaluation.load(out / "evaluation.json").rows}
        assert list(rows) == ["JSD", "TV"]
        assert "official statistics stats.npy, split all" in printed
        assert "left_out" in printed
        assert (out / "table.tex").exists()
        assert not (out / "birds_eye.png").exists()


@pytest.mark.fuzz
@pytest.mark.parametrize(
    ("pickled", "reason"),
    [
        (b"\x80\x04}r\xff\xff\xff\x7f.", "no attribute 'item'"),
        (b"\x80\x05\x8e" + (2**40).to_bytes(8, "little") + b"abc.", "EOFError"),
        (b"cnumpy\nndarray\n(I1099511627776\ntR.", "not callable"),
        (
            pickle.dumps(np.array([None] * 77), 3).replace(b"KM\x85", b"J\xff\xff\xff\x7f\x85"),
            r"array of shape \(2147483647,\) is cut short",
        ),
    ],
)
def test_pickles_that_claim_much_memory_are_refused(pickled, reason, tmp_path):
    path = tmp_path / "statistics.npy"
    np.save(path, np.array(None), allow_pickle=True)
    path.write_bytes(path.read_bytes()[:128] + pickled)
    with pytest.raises(ValueError, match=rf"statistics\.npy: is no official .*{reason}"):
        OfficialStatistics.load(path)
