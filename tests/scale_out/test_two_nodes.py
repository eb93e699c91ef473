"""The recipes of conf/launch, with two nodes on one machine, against one process."""

from __future__ import annotations

import csv
import os
import re
import signal
import socket
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cluster import PYTHON, Node, child_of, finish, two_nodes

from r3dpa.callbacks import scene_scoring
from r3dpa.cli import main
from r3dpa.metrics.results import Evaluation
from r3dpa.metrics.scene import DEFAULT

pytestmark = [pytest.mark.slow, pytest.mark.ddp]

CONF = Path(__file__).resolve().parents[2] / "conf"
LAUNCH = CONF / "launch"
STEPS = 8
NUM_SCANS = 12
RUN_S = 180
"""A job of this size ends in this time, whatever else the machine does."""
BOUND_S = 60
"""A job ends within this time after a process died, and after a node fell silent."""
LOGGER = {"class_path": "CSVLogger", "init_args": {"save_dir": "x", "name": ""}}
# As in test_two_processes_equal_one_with_the_global_batch: only the order of sums differs, and this
# optimiser does not blow rounding up; steps of 1e-2 agree to 1e-4.
# Slow enough that no logit comes near the kink of the hinge loss, where rounding alone could switch
# a sample's whole gradient on or off.
OPTIMIZER = ["--model.init_args.optimizer", "{lr: 1.0e-3, eps: 1.0e-3}"]
TOLERANCE = {"atol": 1e-5, "rtol": 1e-5}
SPREAD = ["--config", str(LAUNCH / "nodes.yaml"), "--trainer.devices", "1"]


@pytest.fixture
def nodes():
    try:
        with two_nodes() as found:
            yield found
    except PermissionError as error:
        pytest.skip(f"may not make network namespaces: {error}")


@pytest.fixture(scope="module")
def fit(smoke_args, vae_checkpoint):
    """``fit(run_dir, batch_size, *more)``: words of ``r3dpa`` that train a joint stage."""

    def words(run_dir, batch_size, *more):
        fixed = ["--model.init_args.init_from", vae_checkpoint, f"--trainer.logger={LOGGER}"]
        fixed += ["--trainer.max_steps", STEPS, "--checkpoint.every_n_train_steps", 2, *OPTIMIZER]
        fixed += ["--data.init_args.batch_size", batch_size, "--trainer.val_check_interval", 4]
        return smoke_args("joint", run_dir, *map(str, fixed), *more)

    return words


@pytest.fixture(scope="module")
def one(fit, tmp_path_factory):
    """Run of one process with the global batch."""
    run_dir = tmp_path_factory.mktemp("one")
    alone(fit(run_dir, 2), run_dir / "log")
    return run_dir


def alone(words, log):
    """A job of one process without a launcher, to its end."""
    log.parent.mkdir(parents=True, exist_ok=True)
    process = Node(0, "127.0.0.1", "lo").start([PYTHON, "-m", "r3dpa", *words], log)
    assert finish([process], RUN_S) == [0], log.read_text()


def started(nodes, words, folder):
    """Processes of a job of both nodes, and their logs."""
    folder.mkdir(parents=True, exist_ok=True)
    logs = [folder / f"node{node.rank}.log" for node in nodes]
    master = nodes[0].address
    jobs = [node.torchrun(words, log, master) for node, log in zip(nodes, logs, strict=True)]
    return jobs, logs


def together(nodes, words, folder):
    """A job of both nodes, to its end; what each said."""
    jobs, logs = started(nodes, words, folder)
    codes = finish(jobs, RUN_S)
    texts = [log.read_text() for log in logs]
    assert codes == [0, 0], "\n".join(texts)
    return texts


def last(run_dir):
    return torch.load(run_dir / "checkpoints" / "last.ckpt", weights_only=True)


def assert_same_training(run_dir, one):
    found, expected = last(run_dir), last(one)
    assert found["global_step"] == expected["global_step"] == STEPS
    for key, value in expected["state_dict"].items():
        torch.testing.assert_close(found["state_dict"][key], value, **TOLERANCE, msg=key)


def logged(run_dir):
    """Last value of each logged number, over all versions."""
    values = {}
    for path in sorted(run_dir.glob("version_*/metrics.csv")):
        with path.open(newline="") as file:
            values |= {k: float(v) for row in csv.DictReader(file) for k, v in row.items() if v}
    return values


def wait_for_checkpoint(run_dir, jobs):
    end = time.monotonic() + RUN_S
    while not (run_dir / "checkpoints" / "last.ckpt").exists():
        assert all(job.poll() is None for job in jobs)
        assert time.monotonic() < end
        time.sleep(0.005)


def test_training_equals_that_of_one_process(nodes, fit, one, tmp_path):
    run_dir = tmp_path / "run"
    texts = together(nodes, fit(run_dir, 1, *SPREAD), tmp_path / "logs")
    assert "GLOBAL_RANK: 1, MEMBER: 2/2" in texts[1]
    assert_same_training(run_dir, one)
    validated = {key: value for key, value in logged(one).items() if key.startswith("val/")}
    assert len(validated) > 2
    found = {key: logged(run_dir)[key] for key in validated}
    assert found == pytest.approx(validated, rel=1e-3, abs=1e-4)
    written = [{path.name for path in folder.rglob("*")} - {"log"} for folder in (run_dir, one)]
    assert written[0] == written[1]  # one process of all writes, under no other names


def test_killed_process_ends_the_job_which_resumes(nodes, fit, one, tmp_path):
    run_dir = tmp_path / "run"
    words = fit(run_dir, 1, *SPREAD)
    jobs, logs = started(nodes, words, tmp_path / "killed")
    wait_for_checkpoint(run_dir, jobs)
    os.kill(child_of(jobs[1]), signal.SIGKILL)
    assert finish(jobs, BOUND_S) == [1, 1]
    peer = re.escape(nodes[1].address)
    survivor, bereft = (log.read_text() for log in logs)
    assert re.search(rf"{peer}.*Connection (closed|reset) by peer", survivor) or re.search(
        rf"Connection (closed|reset) by peer.*{peer}", survivor
    ), survivor
    assert "Signal 9 (SIGKILL) received" in bereft
    assert 0 < last(run_dir)["global_step"] < STEPS
    checkpoint = run_dir / "checkpoints" / "last.ckpt"
    texts = together(nodes, [*words, "--ckpt_path", checkpoint], tmp_path / "resumed")
    assert f"Restored all states from the checkpoint at {checkpoint}" in texts[0]
    assert_same_training(run_dir, one)


def test_silent_node_ends_the_job(nodes, fit, tmp_path):
    """Nothing closes the connections: only the time limit of conf/launch/nodes.yaml helps."""
    run_dir = tmp_path / "run"
    limit = ["--trainer.strategy.init_args.timeout", "0:00:20", "--trainer.max_steps", "1000"]
    jobs, logs = started(nodes, fit(run_dir, 1, *SPREAD, *limit), tmp_path / "silent")
    wait_for_checkpoint(run_dir, jobs)
    nodes[1].pull_the_cable()
    assert finish(jobs, BOUND_S) == [1, 1]
    for log in logs:
        text = log.read_text()
        assert re.search("Timed out waiting 20000ms|Application timeout", text), text
    assert 0 < last(run_dir)["global_step"] < 1000  # whole: it can be read


def test_scores_are_those_of_one_process(nodes, fit, one, tmp_path, monkeypatch):
    """Scenes and comparison are the same to the last bit; metres of error are means over a
    batch, of which two processes have others (5e-4 seen)."""
    coarse = {"default": replace(DEFAULT, voxel_m=0.5)}  # a hundredth of the work
    monkeypatch.setattr(scene_scoring, "PROTOCOLS", coarse)
    more = ["--ckpt_path", str(one / "checkpoints" / "last.ckpt"), "--scorer.spaces", "[fgeo]"]
    main(["test", *fit(tmp_path / "coarse", 2, *more)[1:]])
    reference = tmp_path / "coarse" / "evaluation" / "reference.safetensors"
    more += ["--scorer.reference", str(reference)]
    runs = [tmp_path / name for name in ("one", "two")]
    alone(["test", *fit(runs[0], 2, *more)[1:]], tmp_path / "log")
    together(nodes, ["test", *fit(runs[1], 1, *more, *SPREAD)[1:]], tmp_path / "logs")
    expected, found = (Evaluation.load(run / "evaluation" / "evaluation.json") for run in runs)
    assert expected.row("JSD").value > 0
    assert repr(found.rows) == repr(expected.rows)  # not a number equals itself here
    tables = [(run / "evaluation" / "table.md").read_text() for run in runs]
    assert tables[1].replace("two", "one") == tables[0].replace("two", "one")
    assert logged(runs[1]) == pytest.approx(logged(runs[0]), rel=1e-3, abs=1e-6)
    assert not (runs[1] / "evaluation" / "sampled").exists()


def test_slurm_script_trains_and_goes_on(nodes, fit, one, tmp_path):
    """The script itself, with an ``srun`` that starts its command on both nodes."""
    tools = tmp_path / "bin"
    tools.mkdir()
    hosts = "".join(f"echo {node.address}\n" for node in nodes)
    starts = "".join(
        f"SLURM_PROCID={node.rank} SLURM_NODEID={node.rank} SLURM_LOCALID=0 "
        f'GLOO_SOCKET_IFNAME={node.interface} {" ".join(node.prefix)} "$@" & pids+=($!)\n'
        for node in nodes
    )
    fakes = {
        "scontrol": f'[ "$*" = "show hostnames nodes[0-1]" ] || exit 9\n{hosts}',
        "srun": f'[ "$1" = --kill-on-bad-exit=1 ] || exit 9\nshift 2\npids=()\n{starts}'
        'for pid in "${pids[@]}"; do wait "$pid" || exit 1; done\n',
        "r3dpa": f'exec {PYTHON} -m r3dpa "$@"\n',
    }
    for name, lines in fakes.items():
        (tools / name).write_text(f"#!/bin/bash\n{lines}")
        (tools / name).chmod(0o755)
    environment = {
        "PATH": f"{tools}:{os.environ['PATH']}",
        "SLURM_JOB_ID": "4711",
        "SLURM_JOB_NAME": "r3dpa",
        "SLURM_JOB_NODELIST": "nodes[0-1]",
        "SLURM_NNODES": "2",
        "SLURM_NTASKS": "2",
        "SLURM_NTASKS_PER_NODE": "1",
    }
    run_dir = tmp_path / "run"
    launch = ["--config", str(LAUNCH / "nodes.yaml")]
    here = Node(0, "127.0.0.1", "lo")
    for steps, said in ((STEPS // 2, "MEMBER: 2/2"), (STEPS, "Restored all states from")):
        log = tmp_path / f"slurm{steps}.log"
        words = fit(run_dir, 1, *launch, "--trainer.max_steps", str(steps))
        job = here.start(["bash", LAUNCH / "slurm.sbatch", *words], log, **environment)
        assert finish([job], RUN_S) == [0], log.read_text()
        assert said in log.read_text()
        assert last(run_dir)["global_step"] == steps
    assert_same_training(run_dir, one)


def test_plain_environment_variables(fit, one, tmp_path):
    """Two addresses of this machine and no launcher: for where no namespaces can be made."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    run_dir = tmp_path / "run"
    command = [PYTHON, "-m", "r3dpa", *fit(run_dir, 1, *SPREAD)]
    logs = [tmp_path / f"node{rank}.log" for rank in (0, 1)]
    jobs = [
        Node(rank, f"127.0.0.{rank + 1}", "lo").start(
            command, log, MASTER_ADDR="127.0.0.1", MASTER_PORT=port, NODE_RANK=str(rank)
        )
        for rank, log in enumerate(logs)
    ]
    try:
        assert finish(jobs, RUN_S) == [0, 0], [log.read_text() for log in logs]
    finally:
        for job in jobs:
            job.kill()
    assert_same_training(run_dir, one)
