"""Simulation, feature extraction, sampling and reference statistics that are stopped or killed."""

from __future__ import annotations

import json
import os
import re
import signal
from dataclasses import dataclass
from functools import partial

import pytest
from fault_commands import At, Command, assert_whole, fill, kill_worker, limit_files, pause, rows_of
from tiny_networks import tiny_checkpoint

pytestmark = pytest.mark.faults
# When and where something was made, and what fills the disk.
_NOT_PROMISED = {"metadata.json", "filler"}
SENSOR = {"class_path": "r3dpa.geometry.LidarSensor", "init_args": {"beams": 16, "columns": 64}}


@dataclass(frozen=True)
class Job:
    """A command that writes."""

    words: list  # all but ``--out``
    inside: At  # function that is called for each piece of the work
    num_bytes: int = 5000  # it is killed when it writes more to a file
    is_file: bool = False  # it writes one file, not a folder

    def command(self, out, *more):
        return [*self.words, "--out", out, *more]


@pytest.fixture(scope="session")
def jobs(scans_folder, tmp_path_factory):
    folder = tmp_path_factory.mktemp("jobs")
    lasers = folder / "lasers.yaml"
    lasers.write_text("lasers: [{vert_correction: 0.02}, {vert_correction: -0.1}]")
    data = {"scans": str(scans_folder), "sensor": SENSOR, "grid_size": [2, 8], "batch_size": 1}
    data = {"class_path": "r3dpa.data.LidarDataModule", "init_args": data}
    (folder / "data.yaml").write_text(json.dumps({"data": data}))
    extractor = ["--extractor", "geometric", "--trainer.accelerator", "cpu"]
    sampler = ["--steps", 2, "--pictures", 0, "--device", "cpu", "--formats", "bin,ply,npz"]
    ckpt = tiny_checkpoint(folder / "tiny.safetensors")
    return {
        "simulate": Job(
            ["simulate", "--scans", 3, "--sensor", lasers],
            At("pathlib.Path.replace", None, call=2, match=".bin"),
            1000,
        ),
        "features": Job(
            ["features", "--data", folder / "data.yaml", *extractor],
            At("r3dpa.modules.feature_extraction.pooled_grids", None, call=4),
        ),
        "sample": Job(
            ["sample", "--ckpt", ckpt, "--num", 4, "--batch_size", 1, *sampler],
            At("r3dpa.generation.SceneGenerator.generate", None, call=4),
        ),
        "reference": Job(
            ["reference", "--data", folder / "data.yaml", "--spaces", "fgeo", "--device", "cpu"],
            At("r3dpa.data.scans.read_scan", None, call=4),
            is_file=True,
        ),
    }


def at(job, do):
    return At(job.inside.target, do, job.inside.call, job.inside.match)


def contents(out):
    """Bytes of all files of which they are promised; of a store those of each scan's row."""
    if out.is_file():
        return out.read_bytes()
    found = {}
    for path in out.rglob("*"):
        name = path.relative_to(out)
        if not path.is_file() or name.name in _NOT_PROMISED or name.name[0] == ".":
            continue
        if name.suffix == ".jsonl":
            found |= {f"{name.parent}/{scan}": row for scan, row in rows_of(path).items()}
        elif name.suffix != ".rows":
            found[str(name)] = path.read_bytes()
    return found


@pytest.fixture(scope="session")
def expected(jobs, tmp_path_factory):
    """``expected(name)``: what an undisturbed run of a job writes."""
    made = {}

    def make(name):
        if name not in made:
            folder = tmp_path_factory.mktemp(name)
            out = folder / ("out.safetensors" if jobs[name].is_file else "out")
            status, seen = Command(folder / ".log", jobs[name].command(out)).end()
            assert status == 0, seen
            made[name] = contents(out)
        return made[name]

    return make


@pytest.fixture
def goes_on(jobs, ended, expected):
    """``goes_on(name, out)``: the same command ends with the bytes of an undisturbed run."""

    def run(name, out):
        status, seen = ended(jobs[name].command(out))
        assert status == 0, seen
        assert contents(out) == expected(name)
        assert not list(out.parent.rglob(".*.partial.*"))
        if not jobs[name].is_file:
            assert_whole(out)

    return run


@pytest.fixture
def out_of(jobs, tmp_path):
    return lambda name, root=tmp_path: root / ("out.safetensors" if jobs[name].is_file else "out")


each_job = pytest.mark.parametrize("name", ["simulate", "features", "sample", "reference"])


@each_job
def test_a_command_stopped_by_sigterm_goes_on(name, jobs, ended, out_of, goes_on):
    out = out_of(name)
    stop = at(jobs[name], partial(signal.raise_signal, signal.SIGTERM))
    status, seen = ended(jobs[name].command(out), stop)
    assert status == 130, seen
    assert seen.endswith(f"r3dpa {name}: stopped; the same command continues\n")
    assert "Traceback" not in seen
    assert_whole(out.parent)
    goes_on(name, out)


@pytest.mark.slow
@each_job
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGXFSZ])
def test_a_command_killed_between_two_writes_or_in_one_goes_on(
    number, name, jobs, ended, out_of, goes_on
):
    out, job = out_of(name), jobs[name]
    fault = partial(limit_files, job.num_bytes)
    if number == signal.SIGKILL:
        fault = at(job, partial(signal.raise_signal, number))
    status, seen = ended(job.command(out), fault)
    assert status == -number, seen
    assert not out.is_file()
    assert_whole(out.parent)
    goes_on(name, out)


@pytest.mark.slow
@each_job
def test_a_command_on_a_full_disk_goes_on_when_there_is_space(
    name, jobs, ended, out_of, small_disk, goes_on
):
    disk = small_disk(32_000_000)
    out, job = out_of(name, disk), jobs[name]
    status, seen = ended(job.command(out), at(job, partial(fill, disk, 0)))
    assert status == 1
    assert "No space left on device" in seen
    assert str(out.with_suffix("")) in seen.splitlines()[-1]
    assert "Traceback" not in seen
    assert_whole(disk)
    (disk / "filler").unlink()
    goes_on(name, out)


@pytest.mark.slow
@each_job
def test_a_read_only_disk_is_named_in_one_line(
    name, jobs, ended, out_of, small_disk, make_read_only
):
    disk = small_disk(1_000_000)
    make_read_only(disk)
    out = out_of(name, disk)
    status, seen = ended(jobs[name].command(out))
    assert status == 1
    line = seen.splitlines()[-1]
    assert line.startswith(f"r3dpa {name}: ")
    assert "Read-only file system" in line
    assert out.name in line
    assert "Traceback" not in seen


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sample", "reference"])  # the others wait
def test_a_second_command_is_refused(name, jobs, start, ended, out_of, tmp_path, expected):
    out, job = out_of(name, tmp_path / "two"), jobs[name]
    first = start(job.command(out), at(job, partial(pause, tmp_path)))
    first.wait_for((tmp_path / "reached").exists)
    status, seen = ended(job.command(out))
    assert status == 1
    assert f"another process ({first.pid} on {os.uname().nodename})" in seen.splitlines()[-1]
    (tmp_path / "go").touch()
    assert first.end()[0] == 0
    assert contents(out) == expected(name)


@pytest.mark.slow  # torch notices after five seconds
def test_an_extraction_whose_loader_process_was_killed_goes_on(jobs, ended, out_of, goes_on):
    out, job = out_of("features"), jobs["features"]
    words = job.command(out, "--data.init_args.num_workers", 1)
    status, seen = ended(words, at(job, kill_worker))
    assert status == 1
    # The second where the worker dies while a batch is handed over.
    assert re.search("DataLoader worker|Connection reset", seen.splitlines()[-1])
    assert_whole(out)
    goes_on("features", out)
