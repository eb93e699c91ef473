"""``r3dpa test`` at smoke size: samples a checkpoint and compares the scenes with the scans."""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from r3dpa.callbacks import SceneScorer, scene_scoring
from r3dpa.cli import main
from r3dpa.generation import SceneGenerator
from r3dpa.metrics.reference import ReferenceStatistics
from r3dpa.metrics.results import Evaluation
from r3dpa.metrics.scene import DEFAULT, PUBLISHED

pytestmark = pytest.mark.filterwarnings("ignore:LightningCLI's args parameter")

FILES = {"evaluation.json", "metrics.csv", "table.md", "table.tex"}
PICTURES = {"birds_eye.png", "matches.png", "ranges.png"}
QUIET = ["--trainer.logger=false", "--trainer.limit_val_batches=0", "--trainer.callbacks=[]"]
GEOMETRIC = ["--scorer.spaces=[fgeo]"]
WEIGHTS = ("vae_alignment", "sit_alignment")
NO_FEATURES = [f"--model.init_args.weights.{name}=0" for name in WEIGHTS]
NO_FEATURES += ["--data.init_args.extractor=null"]


@pytest.fixture(autouse=True)
def coarse_protocols(monkeypatch):
    """Cells of half a metre: a hundredth of the work."""
    coarse = {p.name: replace(p, voxel_m=0.5) for p in (DEFAULT, PUBLISHED)}
    monkeypatch.setattr(scene_scoring, "PROTOCOLS", coarse)


@pytest.fixture(scope="module")
def checkpoint(smoke_args, vae_checkpoint, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("joint")
    start = ["--model.init_args.init_from", str(vae_checkpoint)]
    main(smoke_args("joint", run_dir, *start, *QUIET))
    return run_dir / "checkpoints" / "last.ckpt"


@pytest.fixture
def words(smoke_args, checkpoint):
    """``words(run_dir, *more)``: arguments of ``r3dpa``."""

    def arguments(run_dir, *more):
        fixed = smoke_args("joint", run_dir, "--ckpt_path", str(checkpoint))
        return ["test", *fixed[1:], *more]

    return arguments


@pytest.fixture
def scored(words, tmp_path):
    """Run folder of a test that used the geometric features alone."""
    main(words(tmp_path / "run", *QUIET, *GEOMETRIC))
    return tmp_path / "run"


def values(run_dir):
    rows = Evaluation.load(run_dir / "evaluation" / "evaluation.json").rows
    return {row.name: (row.value, row.interval, row.floor) for row in rows}


def test_the_table_is_printed_written_and_logged(words, tmp_path, capsys):
    logger = {"class_path": "CSVLogger", "init_args": {"save_dir": "x", "name": ""}}
    main(words(tmp_path / "run", f"--trainer.logger={logger}"))
    printed = capsys.readouterr().out
    for metric in ("JSD", "TV", "W1 range", "MMD", "CD 3D", "FWID", "FGEO", "FGEO recall"):
        assert re.search(rf"^{re.escape(metric)}[ x]", printed, re.MULTILINE), metric
    assert "R3DPA (published)" in printed
    assert "test/range_error_m" in printed
    out = tmp_path / "run" / "evaluation"
    assert {path.name for path in out.iterdir()} == {*FILES, *PICTURES, "reference.safetensors"}
    stored = Evaluation.load(out / "evaluation.json")
    about = stored.about
    assert stored.label == "run"
    assert (stored.row("JSD").num_samples, stored.row("JSD").num_references) == (4, 12)
    assert (about["solver"], about["steps"], about["seed"]) == ("euler", 2, 0)
    assert about["feature_source"] == "geometric"
    assert (about["extra"]["stage"], about["extra"]["step"], about["extra"]["nfe"]) == (
        *("joint", 3),
        2,
    )
    lines = (tmp_path / "run" / "version_0" / "metrics.csv").open(newline="")
    logged = {key: value for row in csv.DictReader(lines) for key, value in row.items() if value}
    assert int(logged["step"]) == 3
    for metric in ("JSD", "W1 range", "FWID"):
        key = f"test/{metric.replace(' ', '_')}"
        assert float(logged[key]) == pytest.approx(stored.row(metric).value)


def test_scenes_are_those_of_sample_and_evaluate(scored, checkpoint, tmp_path):
    reference = scored / "evaluation" / "reference.safetensors"
    out = ["--out", str(tmp_path / "scenes"), "--device", "cpu"]
    how = ["--num", "4", "--solver", "euler", "--steps", "2", "--pictures", "0"]
    main(["sample", "--ckpt", str(checkpoint), *out, *how])
    options = ["--reference", str(reference), "--allow_few", "--device", "cpu"]
    options += ["--out", str(tmp_path / "evaluation")]
    main(["evaluate", "--samples", str(tmp_path / "scenes" / "bin"), *options])
    mine, theirs = values(scored), values(tmp_path)
    assert set(mine) == set(theirs)
    for name in ("JSD", "TV", "W1 range", "MMD", "FGEO"):
        assert theirs[name][0] == pytest.approx(mine[name][0], rel=0.02), name


def test_the_reference_is_kept_while_it_fits(words, smoke_root, tmp_path, monkeypatch):
    """And computed again under another protocol, or where a scan has changed."""
    done = []
    compute = ReferenceStatistics.update
    monkeypatch.setattr(
        ReferenceStatistics, "update", lambda *args: (done.append(1), compute(*args))
    )
    data, run_dir = tmp_path / "data", tmp_path / "run"
    shutil.copytree(smoke_root, data)
    fixed = [*QUIET, *GEOMETRIC, *NO_FEATURES, "--data.init_args.root", str(data)]
    main(words(run_dir, *fixed))
    first = values(run_dir)
    main(words(run_dir, *fixed))
    assert len(done) == 1
    assert values(run_dir) == first
    main(words(run_dir, *fixed, "--scorer.protocol=published"))
    assert len(done) == 2
    assert values(run_dir) != first
    scan = next(data.rglob("velodyne_points/data/*.bin"))
    scan.write_bytes(scan.read_bytes()[:-160])
    main(words(run_dir, *fixed, "--scorer.protocol=published"))
    assert len(done) == 3


def test_what_does_not_fit_is_said_before_scenes_are_sampled(scored, words, tmp_path, monkeypatch):
    monkeypatch.setattr(SceneScorer, "_sample", lambda *_: pytest.fail("has sampled"))
    reference = scored / "evaluation" / "reference.safetensors"
    given = [*QUIET, f"--scorer.reference={reference}"]
    few = "4 generated scenes for the 64 features of FGEO; 12.*with --scorer.allow_few true"
    with pytest.raises(ValueError, match=few):
        main(words(tmp_path, *QUIET, *GEOMETRIC, "--scorer.allow_few=false"))
    with pytest.raises(ValueError, match="the reference is of the protocol default, not published"):
        main(words(tmp_path, *given, "--scorer.protocol=published"))
    with pytest.raises(ValueError, match="the reference has no features of fwid"):
        main(words(tmp_path, *given, "--scorer.spaces=[fwid]"))
    with pytest.raises(ValueError, match=r"scorer\.reference: .*the split val does not apply"):
        main(words(tmp_path, *given, "--scorer.split=val"))
    begun, whole = tmp_path / "begun.safetensors", ReferenceStatistics.load(reference)
    parts = (whole.protocol, whole.spaces, whole.names, whole.about)
    ReferenceStatistics(*parts).save(begun)
    with pytest.raises(ValueError, match="holds 0 of 12 scans; repeat its command"):
        main(words(tmp_path, *QUIET, f"--scorer.reference={begun}"))
    with pytest.raises(ValueError, match=r"frid needs its official weights.*--scorer\.ckpt\.frid"):
        main(words(tmp_path, *QUIET, "--scorer.spaces=[frid]"))
    with pytest.raises(ValueError, match=r"nothing\.safetensors holds no reference statistics"):
        main(words(tmp_path, *QUIET, "--scorer.reference=nothing.safetensors"))
    with pytest.raises(ValueError, match=r"scorer\.batch_size must be at least 1, got 0"):
        SceneScorer(batch_size=0)


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


def test_an_empty_scene_is_counted_and_listed(scored, words, tmp_path, emptied, capsys):
    emptied(2)
    reference = scored / "evaluation" / "reference.safetensors"
    given = [*QUIET, f"--scorer.reference={reference}"]
    main(words(tmp_path / "run", *given))
    printed, out = capsys.readouterr().out, tmp_path / "run" / "evaluation"
    stored = Evaluation.load(out / "evaluation.json")
    assert stored.row("JSD").num_samples == 3
    assert [reason.split(":")[0] for reason in stored.bad_samples] == ["000002"]
    note = "run: samples that cannot be used and are left out: 1"
    assert note in printed
    assert stored.bad_samples[0] in printed
    assert note in (out / "table.md").read_text()
    stop = "000002: no pixel of the range image.*--scorer.skip_bad true leaves such scenes out"
    with pytest.raises(ValueError, match=stop):
        main(words(tmp_path, *given, "--scorer.skip_bad=false"))


def test_scenes_that_fall_out_do_not_leave_too_few(scored, words, tmp_path, emptied):
    """66 scenes are enough for 64 features; the 64 that are left are told to be few."""
    emptied(0, 1)
    reference = scored / "evaluation" / "reference.safetensors"
    counts = ["--scorer.num_scenes=66", "--scorer.batch_size=33"]
    main(words(tmp_path, *QUIET, *counts, f"--scorer.reference={reference}"))
    row = Evaluation.load(tmp_path / "evaluation" / "evaluation.json").row("FGEO")
    assert row.num_samples == 64


def test_without_a_usable_scene_the_losses_are_reported(words, tmp_path, emptied, capsys):
    emptied(0, 1, 2)
    main(words(tmp_path, *QUIET, *GEOMETRIC))
    printed = capsys.readouterr().out
    assert "nothing is compared with real scans: 1 generated scenes" in printed
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
    with pytest.raises(ValueError, match="of the protocol published, not default"):
        main(words(tmp_path, *QUIET, f"--scorer.reference={official}", "--scorer.protocol=default"))
    with pytest.raises(ValueError, match="holds no split all"):
        main(words(tmp_path, *QUIET, f"--scorer.reference={official}", "--scorer.split=all"))


def test_without_scenes_the_losses_alone_are_reported(words, tmp_path, capsys):
    main(words(tmp_path, *QUIET, "--scorer.num_scenes=0"))
    assert "test/range_error_m" in capsys.readouterr().out
    assert not (tmp_path / "evaluation").exists()


def test_a_stage_without_velocity_says_so(smoke_args, vae_checkpoint, tmp_path, caplog):
    fixed = smoke_args("vae_alignment", tmp_path, "--ckpt_path", str(vae_checkpoint), *QUIET)
    with caplog.at_level("INFO"):
        main(["test", *fixed[1:]])
    assert "stage vae_alignment has nothing to sample" in caplog.text
    assert not (tmp_path / "evaluation").exists()


def flat(rows):
    """Every number of every row by name; an interval has two."""
    return {
        f"{name} {place}": number
        for name, row in rows.items()
        for place, number in enumerate(
            part for value in row for part in (value if isinstance(value, tuple) else [value])
        )
        if number is not None
    }


@pytest.mark.ddp
def test_two_processes_give_the_numbers_of_one(scored, words, tmp_path):
    """Batches are the same, whoever samples them; threads, of which two processes have fewer each,
    may round sums otherwise."""
    reference = scored / "evaluation" / "reference.safetensors"
    more = [*QUIET, f"--scorer.reference={reference}", "--scorer.num_scenes=5"]
    main(words(tmp_path / "one", *more))
    two = ["--trainer.devices=2", "--trainer.strategy=ddp"]
    command = [sys.executable, "-m", "r3dpa", *words(tmp_path / "two", *more, *two)]
    subprocess.run(command, check=True, timeout=300, capture_output=True)
    two, one = (flat(values(tmp_path / name)) for name in ("two", "one"))
    assert two == pytest.approx(one, rel=1e-5, abs=1e-6, nan_ok=True)
    assert not (tmp_path / "two" / "evaluation" / "sampled").exists()
