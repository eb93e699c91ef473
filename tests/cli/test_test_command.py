"""``r3dpa test`` at smoke size: samples a checkpoint and compares the scenes with the scans."""

import csv
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stdout

import numpy as np
import pytest

from r3dpa.callbacks import SceneScorer, scene_scoring
from r3dpa.cli import main
from r3dpa.data import SimulatedDataModule
from r3dpa.generation import SceneGenerator
from r3dpa.geometry import LidarSensor
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.results import Evaluation

pytestmark = pytest.mark.usefixtures("coarse_protocols")

FILES = {"evaluation.json", "metrics.csv", "table.md", "table.tex"}
PICTURES = {"birds_eye.png", "matches.png", "ranges.png"}
QUIET = ["--trainer.logger=false", "--trainer.limit_val_batches=0", "--trainer.callbacks=[]"]
GEOMETRIC = ["--scorer.spaces=[fgeo]"]


@pytest.fixture(autouse=True)
def no_figures(monkeypatch):
    """Most of the time of a test; those of the fixture ``scored`` are drawn."""
    monkeypatch.setattr(scene_scoring, "save_figures", lambda *_, **__: None)


@pytest.fixture(scope="module")
def words(smoke_args, joint_checkpoint):
    """``words(run_dir, *more)``: arguments of ``r3dpa``."""

    def arguments(run_dir, *more):
        fixed = smoke_args("joint", run_dir, "--ckpt_path", str(joint_checkpoint))
        return ["test", *fixed[1:], *more]

    return arguments


@pytest.fixture(scope="module")
def scored(words, tmp_path_factory):
    """Run folder of a test that used the geometric features alone; what it printed is beside it."""
    run_dir = tmp_path_factory.mktemp("scored") / "run"
    logger = {"class_path": "CSVLogger", "init_args": {"save_dir": "x", "name": ""}}
    with (run_dir.parent / "printed.txt").open("w") as file, redirect_stdout(file):
        main(words(run_dir, *QUIET, *GEOMETRIC, f"--trainer.logger={logger}"))
    return run_dir


@pytest.fixture(scope="module")
def reference(scored):
    """The reference that the test has computed."""
    return scored / "evaluation" / "reference.safetensors"


def values(run_dir):
    rows = Evaluation.load(run_dir / "evaluation" / "evaluation.json").rows
    return {row.name: (row.value, row.interval, row.floor) for row in rows}


def test_the_table_is_printed_written_and_logged(scored):
    printed = (scored.parent / "printed.txt").read_text()
    for metric in ("JSD", "TV", "W1 range", "MMD", "CD 3D", "FGEO", "FGEO recall"):
        assert re.search(rf"^{re.escape(metric)}[ x]", printed, re.MULTILINE), metric
    assert "R3DPA (published)" not in printed  # the scans are simulated
    assert "test/range_error_m" in printed
    out = scored / "evaluation"
    assert {path.name for path in out.iterdir()} == {*FILES, *PICTURES, "reference.safetensors"}
    stored = Evaluation.load(out / "evaluation.json")
    about, extra = stored.about, stored.about["extra"]
    assert stored.label == "run"
    assert (stored.row("JSD").num_samples, stored.row("JSD").num_references) == (4, 12)
    assert (about["solver"], about["steps"], about["seed"]) == ("euler", 2, 0)
    assert about["feature_source"] == "geometric"
    assert (extra["stage"], extra["step"], extra["nfe"]) == ("joint", 3, 2)
    lines = (scored / "version_0" / "metrics.csv").open(newline="")
    logged = {key: value for row in csv.DictReader(lines) for key, value in row.items() if value}
    assert int(logged["step"]) == 3
    for metric in ("JSD", "W1 range", "FGEO"):
        key = f"test/{metric.replace(' ', '_')}"
        assert float(logged[key]) == pytest.approx(stored.row(metric).value)


def test_scenes_are_those_of_sample_and_evaluate(
    scored, reference, joint_checkpoint, tmp_path, monkeypatch
):
    monkeypatch.setattr("r3dpa.viz.evaluation.save_figures", lambda *_, **__: None)
    out = ["--out", str(tmp_path / "scenes"), "--device", "cpu"]
    how = ["--num", "4", "--solver", "euler", "--steps", "2", "--pictures", "0"]
    main(["sample", "--ckpt", str(joint_checkpoint), *out, *how])
    options = ["--reference", str(reference), "--allow_few", "--device", "cpu"]
    options += ["--out", str(tmp_path / "evaluation")]
    main(["evaluate", "--samples", str(tmp_path / "scenes" / "bin"), *options])
    mine, theirs = values(scored), values(tmp_path)
    assert set(mine) == set(theirs)
    for name in ("JSD", "TV", "W1 range", "MMD", "FGEO"):
        assert theirs[name][0] == pytest.approx(mine[name][0], rel=0.02), name


def test_the_reference_is_kept_while_it_fits(words, scored, tmp_path, monkeypatch):
    """What does not fit is renewed: metrics/test_reference.py."""
    monkeypatch.setattr(ReferenceStatistics, "update", lambda *_: pytest.fail("computed again"))
    shutil.copytree(scored, tmp_path / "run")
    main(words(tmp_path / "run", *QUIET, *GEOMETRIC))
    assert values(tmp_path / "run") == values(scored)


def test_a_reference_knows_its_scans_from_others_of_their_names(reference, smoke_root, tmp_path):
    def stamp(root):
        data = SimulatedDataModule(str(root), num_scans=12, sensor=LidarSensor(16, 64))
        data.setup("predict")
        return scene_scoring._stamp(data.all_set.scans)

    unstable = shutil.ignore_patterns("feature_grids", ".*")  # other processes write these
    shutil.copytree(smoke_root, tmp_path / "data", ignore=unstable)
    stored = ReferenceStatistics.load(reference).about["scans_sha256"]
    assert stored == stamp(smoke_root) == stamp(tmp_path / "data")
    scan = next((tmp_path / "data").rglob("velodyne_points/data/*.bin"))
    scan.write_bytes(scan.read_bytes()[:-160])
    assert stored != stamp(tmp_path / "data")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--scorer.allow_few=false"],
            "4 generated scenes for the 64 features of FGEO; 12.*--scorer.allow_few true",
        ),
        (["--scorer.protocol=published"], "the reference is of the protocol default, not publi"),
    ],
)
def test_a_reference_that_does_not_fit_is_said_before_scenes_are_sampled(
    options, message, reference, words, tmp_path, monkeypatch
):
    monkeypatch.setattr(SceneScorer, "_sample", lambda *_: pytest.fail("has sampled"))
    given = [*QUIET, f"--scorer.reference={reference}", *options]
    with pytest.raises(ValueError, match=message):
        main(words(tmp_path, *given))


@pytest.fixture
def emptied(monkeypatch):
    """``emptied(*indices)``: the generator makes these scenes without any return."""

    def patch(*indices):
        generate = SceneGenerator.generate

        def broken(self, wanted, seed=0):
            found = generate(self, wanted, seed)
            for place, index in enumerate(wanted):
                if index in indices:
                    found.range_m[place] = -1.0
            return found

        monkeypatch.setattr(SceneGenerator, "generate", broken)

    return patch


def test_an_empty_scene_is_counted_and_listed(reference, words, tmp_path, emptied, capsys):
    emptied(2)
    given = [*QUIET, f"--scorer.reference={reference}"]
    main(words(tmp_path / "run", *given))
    stored = Evaluation.load(tmp_path / "run" / "evaluation" / "evaluation.json")
    assert stored.row("JSD").num_samples == 3
    assert [reason.split(":")[0] for reason in stored.bad_samples] == ["000002"]
    assert stored.bad_samples[0] in capsys.readouterr().out
    stop = (
        "000002: no pixel of the range image.*--skip_bad leaves such scenes out.*--scorer.skip_bad"
    )
    with pytest.raises(ValueError, match=stop):
        main(words(tmp_path, *given, "--scorer.skip_bad=false"))


def test_without_a_usable_scene_the_losses_are_reported(words, tmp_path, emptied, capsys):
    emptied(0, 1, 2)
    main(words(tmp_path, *QUIET, *GEOMETRIC))
    printed = capsys.readouterr().out
    assert "nothing is compared with real scans: 1 generated scene," in printed
    assert "3 cannot be used, the first is 000000: no pixel" in printed
    assert "test/range_error_m" in printed
    assert not (tmp_path / "evaluation" / "evaluation.json").exists()


def test_the_official_file_is_a_reference(words, tmp_path, capsys):
    """Its protocol is that of the published numbers, without being asked for."""
    counts = np.zeros((2000, 2000), np.float32)
    counts[900:1100, 900:1100] = 1
    official, parts = tmp_path / "data_statistics.npy", {"val": {"dataset_bev_hist": counts}}
    np.save(official, np.array(parts, dtype=object), allow_pickle=True)
    main(words(tmp_path / "run", *QUIET, f"--scorer.reference={official}"))
    assert "official statistics data_statistics.npy, split val" in capsys.readouterr().out
    stored = Evaluation.load(tmp_path / "run" / "evaluation" / "evaluation.json")
    assert [row.name for row in stored.rows] == ["JSD", "TV"]
    assert stored.about["protocol"]["name"] == "published"
    names = {path.name for path in (tmp_path / "run" / "evaluation").iterdir()}
    assert names == FILES


def test_without_scenes_the_losses_alone_are_reported(words, tmp_path, capsys):
    main(words(tmp_path, *QUIET, "--scorer.num_scenes=0"))
    assert "test/range_error_m" in capsys.readouterr().out
    assert not (tmp_path / "evaluation").exists()


@pytest.mark.ddp
@pytest.mark.slow  # two more starts of the command
def test_two_processes_give_the_numbers_of_one(reference, words, tmp_path):
    """Batches are the same, whoever samples them; threads, of which two processes have fewer each,
    may round sums otherwise."""
    more = [*QUIET, f"--scorer.reference={reference}", "--scorer.num_scenes=5"]
    main(words(tmp_path / "one", *more))
    two = ["--trainer.devices=2", "--trainer.strategy=ddp"]
    command = [sys.executable, "-m", "r3dpa", *words(tmp_path / "two", *more, *two)]
    subprocess.run(command, check=True, timeout=300, capture_output=True)
    two, one = (
        {name: row[0] for name, row in values(tmp_path / run).items() if row[0] is not None}
        for run in ("two", "one")
    )
    assert two == pytest.approx(one, rel=1e-5, abs=1e-6, nan_ok=True)
    assert not (tmp_path / "two" / "evaluation" / "sampled").exists()
