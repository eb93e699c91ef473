"""Atomic writes and locks."""

import multiprocessing
import os
import signal
from pathlib import Path

import pytest

from r3dpa.io import atomic_path, only_writer


def test_the_file_is_on_the_disk_before_its_name_and_the_folder_after(tmp_path, monkeypatch):
    calls, path = [], tmp_path / "a" / "b.txt"
    fsync, rename = os.fsync, os.rename

    def flush(descriptor):
        calls.append(str(Path(f"/proc/self/fd/{descriptor}").readlink()))
        fsync(descriptor)

    def replace(self, target):
        calls.append("rename")
        rename(self, target)

    monkeypatch.setattr(os, "fsync", flush)
    monkeypatch.setattr(type(path), "replace", replace)
    with atomic_path(path) as temporary:
        temporary.write_text("x")
    assert calls == [str(temporary), "rename", str(path.parent)]
    assert path.read_text() == "x"


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(FileNotFoundError, match="gone"), atomic_path(path) as temporary:
        temporary.write_text((tmp_path / "gone").read_text())
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_second_writer_is_refused_until_the_first_ends_or_is_killed(tmp_path):
    lock, ready = tmp_path / "a" / ".lock", multiprocessing.get_context("fork").Event()

    def hold():
        with only_writer(lock, "writes"):
            ready.set()
            signal.pause()

    child = multiprocessing.get_context("fork").Process(target=hold)
    child.start()
    ready.wait()
    message = rf"another process \({child.pid} on .*\) writes: wait for it"
    with pytest.raises(ValueError, match=message), only_writer(lock, "writes"):
        pass
    child.kill()
    child.join()
    for _ in range(2):
        with only_writer(lock, "writes"):
            assert lock.exists()
        assert not list(lock.parent.iterdir())


def test_a_lock_ends_with_its_block_whatever_was_forked_within(tmp_path):
    """Loader processes may outlive it, with copies of the open files."""
    with only_writer(tmp_path / ".lock", "writes"):
        child = multiprocessing.get_context("fork").Process(target=signal.pause)
        child.start()
    with only_writer(tmp_path / ".lock", "writes"):
        pass
    child.kill()
    child.join()


def test_a_lock_that_is_a_link_leaves_the_file_it_leads_to(tmp_path):
    target, lock = tmp_path / "mine.txt", tmp_path / "run" / ".fit.lock"
    target.write_text("mine")
    lock.parent.mkdir()
    lock.symlink_to(target)
    with pytest.raises(OSError, match=r"symbolic links.*\.fit\.lock"), only_writer(lock, "trains"):
        pass
    assert target.read_text() == "mine"
