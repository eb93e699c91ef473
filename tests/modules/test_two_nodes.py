"""The recipes of conf/launch, with two nodes on one machine, against one process."""

from __future__ import annotations

import csv
import os
import re
import signal
import time
from pathlib import Path

import pytest
import torch
from cluster import PYTHON, Node, child_of, finish, two_nodes

from r3dpa.cli import main

pytestmark = [pytest.mark.slow, pytest.mark.ddp, pytest.mark.nodes]

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
    main(fit(run_dir, 2))
    return run_dir


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
    torch.testing.assert_close(found["state_dict"], expected["state_dict"], **TOLERANCE)


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
    written = [{path.name for path in folder.rglob("*")} for folder in (run_dir, one)]
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
    environment = {"PATH": f"{tools}:{os.environ['PATH']}", "SLURM_JOB_ID": "4711"}
    environment |= {"SLURM_JOB_NAME": "r3dpa", "SLURM_JOB_NODELIST": "nodes[0-1]"}
    environment |= {"SLURM_NNODES": "2", "SLURM_NTASKS": "2", "SLURM_NTASKS_PER_NODE": "1"}
    run_dir = tmp_path / "run"
    launch = ["--config", str(LAUNCH / "nodes.yaml")]
    here = Node(0, "127.0.0.1")
    for steps, said in ((STEPS // 2, "MEMBER: 2/2"), (STEPS, "Restored all states from")):
        log = tmp_path / f"slurm{steps}.log"
        words = fit(run_dir, 1, *launch, "--trainer.max_steps", str(steps))
        job = here.start(["bash", LAUNCH / "slurm.sbatch", *words], log, **environment)
        assert finish([job], RUN_S) == [0], log.read_text()
        assert said in log.read_text()
        assert last(run_dir)["global_step"] == steps
    assert_same_training(run_dir, one)
