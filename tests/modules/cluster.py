"""Two nodes on one machine: network namespaces, each with an address of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

PYTHON = sys.executable


@dataclass(frozen=True)
class Node:
    """A place to start processes in: rank, IPv4 address, and the prefix of its commands."""

    rank: int
    address: str
    prefix: tuple[str, ...] = ()
    interface: str = "lo"

    def start(self, words: Sequence[object], log: Path, **environment: str) -> subprocess.Popen:
        """Starts a command here; its output goes to a file."""
        env = {"OMP_NUM_THREADS": "1", "GLOO_SOCKET_IFNAME": self.interface, **environment}
        with log.open("w") as file:
            return subprocess.Popen(
                [*self.prefix, *map(str, words)],
                stdout=file,
                stderr=subprocess.STDOUT,
                env=os.environ | env,
            )

    def torchrun(self, words: Sequence[object], log: Path, master: str) -> subprocess.Popen:
        """Starts ``r3dpa`` as conf/launch/nodes.yaml says, but one process on each node."""
        run = [PYTHON, "-m", "torch.distributed.run", "--nnodes", 2, "--nproc_per_node", 1]
        run += ["--node_rank", self.rank, "--master_addr", master, "--master_port", 29500]
        return self.start([*run, "-m", "r3dpa", *words], log)

    def pull_the_cable(self) -> None:
        """Packets from and to this node are lost from now on, and nobody is told."""
        _ip("-n", self.prefix[-1], "link", "set", self.interface, "down")


@contextmanager
def two_nodes() -> Iterator[list[Node]]:
    """Two nodes joined by a cable, and by nothing with this machine; the disk is shared.

    Whatever still runs on them at the end is killed.
    PermissionError: this process may not make them.
    """
    names = [f"r3dpa-{os.getpid()}-{rank}" for rank in (0, 1)]
    nodes = [
        Node(rank, f"10.77.0.{rank + 1}", ("ip", "netns", "exec", name), "veth0")
        for rank, name in enumerate(names)
    ]
    made: list[str] = []
    try:
        try:
            for name in names:
                _ip("netns", "add", name)
                made.append(name)
            ends = [["veth0", "netns", name] for name in names]
            _ip("link", "add", *ends[0], "type", "veth", "peer", "name", *ends[1])
            for node, name in zip(nodes, names, strict=True):
                _ip("-n", name, "link", "set", "lo", "up")
                _ip("-n", name, "address", "add", f"{node.address}/24", "dev", "veth0")
                _ip("-n", name, "link", "set", "veth0", "up")
        except FileNotFoundError as error:
            raise PermissionError("there is no `ip` (iproute2)") from error
        except subprocess.CalledProcessError as error:
            raise PermissionError(error.stderr.strip()) from error
        yield nodes
    finally:
        for name in made:
            for pid in _ip("netns", "pids", name).split():
                with suppress(ProcessLookupError):
                    os.kill(int(pid), signal.SIGKILL)
            _ip("netns", "delete", name)


def finish(processes: Sequence[subprocess.Popen], timeout_s: float) -> list[int]:
    """Exit statuses; raises ``TimeoutExpired`` where a process has not ended in time."""
    end = time.monotonic() + timeout_s
    return [process.wait(max(0.1, end - time.monotonic())) for process in processes]


def child_of(process: subprocess.Popen) -> int:
    """The one process that this one started and that runs ``r3dpa``."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    (child,) = (
        int(pid) for pid in children if b"r3dpa" in Path(f"/proc/{pid}/cmdline").read_bytes()
    )
    return child


def _ip(*words: str) -> str:
    return subprocess.run(["ip", *words], check=True, capture_output=True, text=True).stdout
