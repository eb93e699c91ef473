"""``r3dpa data features`` from the outside: forms of the command, refusals, several processes.

Interrupts and kills are in test_faults_of_writers.py.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from r3dpa.cli import main
from r3dpa.data import FeatureGrids, LidarDataModule, find_scans
from r3dpa.data.feature_grids import any_settings, default_features_dir
from r3dpa.features import WaffleIron
from r3dpa.features.scalr import official_name
from r3dpa.geometry import LidarSensor, SphericalProjection

CONF = Path(__file__).resolve().parents[2] / "conf"
NUM = 20
PROJECTION = SphericalProjection(LidarSensor(beams=16, columns=64))
GEOMETRIC = {"class_path": "r3dpa.features.GeometricFeatures", "init_args": {"dim": 16}}
QUIET = ["--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false"]
ROW = 2 * 8 * 16 * 2  # bytes of a 2 x 8 grid, 16 float16 a cell


def make_scans(folder, count):
    folder.mkdir(parents=True)
    generator = np.random.default_rng(0)
    for frame in range(count):
        points = generator.uniform((-20, -20, -2, 0), (20, 20, 1, 1), (200, 4))
        (folder / f"{frame:010d}.bin").write_bytes(points.astype(np.float32).tobytes())
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Data YAML of ``NUM`` scans."""
    folder = tmp_path_factory.mktemp("features")
    arguments = {
        "scans": str(make_scans(folder / "scans", NUM)),
        "sensor": {"beams": 16, "columns": 64},
        "grid_size": [2, 8],
        "extractor": GEOMETRIC,
        "batch_size": 2,
    }
    config = {"data": {"class_path": "r3dpa.data.LidarDataModule", "init_args": arguments}}
    path = folder / "data.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def features(*words):
    main(["features", *map(str, words), *QUIET])


def rows(out):
    """Bytes of each grid by scan."""
    scans = find_scans(out.parent / "scans")
    grids = FeatureGrids(out, scans, PROJECTION, (2, 8))
    return {s.name: grids.read(s).numpy().tobytes() for s in scans}


@pytest.fixture(scope="module")
def expected(data):
    """Grids made by one process, undisturbed."""
    features("--data", data, "--out", data.parent / "expected")
    grids = rows(data.parent / "expected")
    assert len(set(grids.values())) == NUM
    return grids


def num_written(out):
    return sum(len(path.read_text().splitlines()) for path in out.rglob("shard_*.jsonl"))


class TestForms:
    def test_yaml_after_data_or_config_and_later_words_win(self, data, expected, capsys):
        out = data.parent / "overridden"
        words = ["--data", data, "--out", out, "--data.init_args.limit", 2]
        features(*words)
        first, last = capsys.readouterr().out.splitlines()
        store = out / "2x8"
        # A tenth of the scans is held out: two of each split.
        assert first.startswith("feature grids of geometric: 4 scans to do, 0 done; ")
        assert f"; {4 * ROW / 1e9:.3g} GB needed, " in first
        assert first.endswith(f" GB needed, in {store}")
        assert last.startswith("feature grids: 4 made, 0 kept, ")
        assert last.endswith(f" scans per second, in {store}")
        features("--config", data, "--data.init_args.features_dir", out)
        first, last = capsys.readouterr().out.splitlines()
        assert first.startswith(f"feature grids of geometric: {NUM - 4} scans to do, 4 done; ")
        assert last.startswith(f"feature grids: {NUM - 4} made, 4 kept, ")
        assert rows(out) == expected
        before = {path: path.stat().st_mtime_ns for path in store.iterdir()}
        features(f"--data={data}", "--out", out)
        assert f" 0 scans to do, {NUM} done; " in capsys.readouterr().out
        assert before == {path: path.stat().st_mtime_ns for path in store.iterdir()}

    def test_folders_and_a_shipped_yaml(self, tmp_path, capsys, monkeypatch):
        """Any folder of scans, and the KITTI-360 layout, of which both splits are made."""
        monkeypatch.chdir(tmp_path)
        for drive in ("0000", "0003"):
            name = f"2013_05_28_drive_{drive}_sync"
            make_scans(tmp_path / "layout" / "data_3d_raw" / name / "velodyne_points/data", 1)
        make_scans(tmp_path / "scans", 2)
        make_scans(tmp_path / "shipped", 2)
        config = CONF / "data" / "folder.yaml"
        forms = {
            "layout": [tmp_path / "layout"],
            "scans": [tmp_path / "scans"],
            "shipped": [config, "--data.init_args.scans", tmp_path / "shipped"],
        }
        for folder, words in forms.items():
            words += ["--extractor", "geometric", "--data.init_args.num_workers", 0]
            features("--data", *words)
            grids = default_features_dir(str(tmp_path / folder), "geometric")
            assert any_settings(grids).extractor["name"] == "geometric"
            assert num_written(grids / "8x64") == 2
            assert capsys.readouterr().out.endswith(f" per second, in {grids / '8x64'}\n")

    def test_scalr_by_its_checkpoint_in_the_configuration_at_several_sizes(self, data, tmp_path):
        network = WaffleIron(width=4, depth=1, head_dim=5)
        weights = {f"module.{official_name(k)}": v for k, v in network.state_dict().items()}
        torch.save({"model_points": weights}, tmp_path / "ckpt_last.pth")
        words = ["--data.init_args.extractor", "r3dpa.features.ScaLR.from_checkpoint"]
        words += ["--data.init_args.extractor.init_args.path", tmp_path / "ckpt_last.pth"]
        words += ["--data.init_args.limit", 1, "--out", tmp_path / "grids"]
        words += ["--grid_sizes", "[[2, 8], [4, 16]]"]
        features("--data", data, *words)
        assert any_settings(tmp_path / "grids").extractor["name"] == "scalr"
        assert [num_written(tmp_path / "grids" / size) for size in ("2x8", "4x16")] == [2, 2]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--data", "no/folder"], "--data no/folder: no such folder of scans or data YAML"),
        (["--data", "{scans}"], "no feature extractor: give --extractor, one of scalr, "),
        (["--data", "{scans}", "--ckpt", "no.pth"], "no.pth: no such file; give ckpt_last.pth"),
        (
            ["--data", "{yaml}", "--trainer.precision", "16-true"],
            "precision 16-true is not",
        ),
    ],
)
def test_errors_name_what_is_wrong(words, message, data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [word.format(scans=data.parent / "scans", yaml=data) for word in words]
    with pytest.raises(ValueError, match=message):
        features(*words, "--out", tmp_path / "grids")
    assert not (tmp_path / "grids" / "2x8").exists()


@pytest.mark.ddp
@pytest.mark.slow  # two more starts of the command
def test_two_processes_write_what_one_does(data, expected):
    """Also what a process finds that begins late: the list of the first one counts."""
    out = data.parent / "two"
    command = [Path(sys.executable).with_name("r3dpa"), "features", "--data", data, "--out", out]
    command += ["--trainer.accelerator=cpu", "--trainer.devices=2", "--trainer.strategy=ddp"]
    command += ["--data.init_args.num_workers=1", "--data.init_args.batch_size=1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    journals = [path.read_text().splitlines() for path in sorted(out.rglob("*.jsonl"))]
    assert [len(lines) for lines in journals] == [NUM // 2, NUM // 2]
    assert rows(out) == expected
    assert done.stdout.count("scans to do") == 1
    assert f"{NUM // 2}/{NUM // 2}" in done.stdout  # the bar counts the batches of its own process
    assert f"feature grids: {NUM} made, 0 kept, " in done.stdout.splitlines()[-1]
    assert "Warning" not in done.stderr


def cached_images(root, codec):
    """Data YAML of two simulated scans that are kept as images."""
    arguments = {"root": str(root), "num_scans": 2, "sensor": {"beams": 16, "columns": 64}}
    arguments |= {"codec": codec, "grid_size": [2, 8], "extractor": GEOMETRIC}
    path = root.parent / f"{root.name}.yaml"
    name = "r3dpa.data.SimulatedImageDataModule"
    path.write_text(yaml.safe_dump({"data": {"class_path": name, "init_args": arguments}}))
    return path


def test_labelled_images_give_the_grids_that_a_training_would_make(tmp_path, capsys):
    codec = {"encoding": "log2", "return_channel": True, "intensity_channel": True}
    grids = []
    for name in ("prepared", "extracted"):
        config = cached_images(tmp_path / name, codec)
        if name == "extracted":
            features("--data", config, "--data.init_args.batch_size", 3)
            assert "2 made, 0 kept" in capsys.readouterr().out
        main(["prepare", "--config", str(config)])
        (file,) = (tmp_path / name / "feature_grids").rglob("*.rows")
        grids.append(file.read_bytes())
    assert len(grids[0]) == 2 * ROW
    assert grids[0] == grids[1]


def test_images_of_ranges_alone_are_refused(tmp_path):
    config = cached_images(tmp_path / "ranges", {"encoding": "log2", "return_channel": True})
    with pytest.raises(ValueError, match="ranges alone are cached: give the codec a channel"):
        features("--data", config)


class TestNamedColumns:
    """Scans of six columns: ``--columns`` names them in every command that reads a data set."""

    NAMES = "x,y,z,intensity,time,angle"

    @pytest.fixture
    def scans(self, tmp_path, monkeypatch):
        """Files of a folder, and the four columns that are read of the first one."""
        monkeypatch.chdir(tmp_path)
        rng = np.random.default_rng(1)
        (tmp_path / "scans").mkdir()
        for number in range(4):
            points = rng.uniform((-20, -20, -2, 0), (20, 20, 1, 1), (300, 4))
            others = rng.uniform(-3, 3, (300, 2))
            rows = np.concatenate([points, others], axis=1).astype(np.float32)
            (tmp_path / "scans" / f"{number}.bin").write_bytes(rows.tobytes())
        return tmp_path / "scans"

    def test_data_module(self, scans):
        with pytest.raises(ValueError, match="name the columns with --columns"):
            LidarDataModule(str(scans), sensor=PROJECTION.sensor).points(find_scans(scans)[0])
        for columns in (self.NAMES, self.NAMES.split(",")):
            data = LidarDataModule(str(scans), sensor=PROJECTION.sensor, columns=columns)
            first = np.fromfile(scans / "0.bin", "<f4").reshape(-1, 6)
            (scan,) = (scan for scan in data.split()[1] if scan.frame == "0")
            assert data.points(scan).numpy().tolist() == first[:, :4].tolist()

    def test_rows_of_other_columns_are_not_taken_from_a_cache(self, scans):
        keys = {find_scans(scans, names)[0].cache_key for names in ((), ("x", "y"), ("y", "x"))}
        assert len(keys) == 3

    def test_features_and_reference(self, scans, tmp_path, capsys):
        named = ["--columns", self.NAMES]
        sensor = "--data.init_args.sensor={beams: 16, columns: 64}"
        size = "--data.init_args.grid_size=[2, 8]"
        grids, out = str(tmp_path / "grids"), tmp_path / "reference.safetensors"
        words = [str(scans), *named, sensor, size, *QUIET, "--extractor", "geometric"]
        main(["data", "features", "--data", *words, "--out", grids])
        assert "4 made" in capsys.readouterr().out
        words = [str(scans), *named, "--spaces", "fgeo", "--out", str(out)]
        main(["data", "reference", "--data", *words])
        assert out.is_file()

    def test_fit(self, scans, capsys):
        words = ["fit", "vae_alignment", "--preset", "folder", "--data.init_args.scans", str(scans)]
        with pytest.raises(SystemExit) as ended:
            main([*words, f"--columns={self.NAMES}", "--print_config"])
        assert ended.value.code == 0
        data = yaml.safe_load(capsys.readouterr().out)["data"]["init_args"]
        assert data["columns"] == self.NAMES

    def test_the_layout_of_kitti360_has_its_own(self, capsys):
        with pytest.raises(SystemExit):
            main(["fit", "vae_alignment", "--columns", self.NAMES])
        assert "unknown option --data.init_args.columns" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["prepare", "features"])
def test_configurations_of_the_package_are_found_anywhere(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["data", command, "--config", "conf/data/demo.yaml", "--print_config"])
    assert ended.value.code == 0
    assert "SimulatedDataModule" in capsys.readouterr().out


def test_what_lightning_says_of_its_options_is_one_line(tmp_path):
    words = ["--data", str(tmp_path), "--extractor", "geometric"]
    with pytest.raises(ValueError, match="limit_predict_batches"):
        main(["data", "features", *words, "--trainer.limit_predict_batches", "1.5"])
