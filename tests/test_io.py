"""Atomic writes, journals, locks and names in files."""

import errno
import multiprocessing
import os
import signal
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from r3dpa.io import Journal, atomic_path, differences, only_writer, refuse_name, save_tensors

BAD_NAMES = [
    "../../x",
    "/etc/x",
    "a/../../x",
    "a/./x",
    "a//x",
    "..",
    ".",
    "",
    "C:x",
    "c:\\x",
    "a\\..\\x",
]


BAD_NAMES += ["a\0b", "a\nb", "x" * 2000]


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


@pytest.mark.parametrize("tail", ["", '{"a"', "\0\0", '{"a": 3}'])
def test_a_journal_goes_on_after_a_kill(tmp_path, tail):
    """An incomplete last line is ignored; one that lacks only its end counts."""
    journal = Journal(tmp_path / "jobs.jsonl")
    assert journal.read() == []
    journal.add({"a": 1})
    journal.add({"a": 2}, [])
    journal.close()
    journal.path.write_text(journal.path.read_text() + tail)
    after = Journal(journal.path)
    lines = after.read()
    assert lines == [{"a": 1}, {"a": 2}, []] + [{"a": 3}] * (tail == '{"a": 3}')
    after.start(*lines)
    after.add("end")
    assert Journal(journal.path).read() == [*lines, "end"]
    after.delete()
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_line_of_a_journal_is_no_incomplete_one(tmp_path):
    (tmp_path / "a").write_text('{"a": 1}\n{"a\n{"a": 2}\n')
    with pytest.raises(ValueError, match=r"control|delimiter|string"):
        Journal(tmp_path / "a").read()


def test_differences_of_requests_name_both_values():
    stored = {"seed": 1, "sensor": {"beams": 64}, "columns": list(range(10)), "same": 0}
    wanted = {"seed": 2, "sensor": {"beams": 32}, "columns": [], "same": 0, "new": "x"}
    assert list(differences(stored, wanted)) == [
        "seed 1 there, 2 now",
        "sensor.beams 64 there, 32 now",
        "columns 10 values there, [] now",
        "new None there, 'x' now",
    ]


@pytest.mark.faults
@pytest.mark.parametrize("writer", ["bytes", "torch", "safetensors"])
def test_an_error_of_a_full_disk_names_the_file(writer, small_disk):
    path = small_disk(1_000_000) / "file"

    def write():
        tensors = {"a": torch.zeros(1_000_000)}
        if writer == "torch":
            save_tensors(tensors, path)
            return
        with atomic_path(path) as temporary:
            if writer == "bytes":
                temporary.write_bytes(bytes(2_000_000))
            else:
                save_file(tensors, temporary)

    with pytest.raises(OSError, match=rf"No space left on device: '{path}'"):
        write()
    assert not list(path.parent.iterdir())


@pytest.mark.faults
def test_a_disk_without_locks_is_used_with_a_warning(tmp_path, monkeypatch, caplog):
    def no_locks(*_):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with only_writer(tmp_path / ".lock", "writes here"):
        assert "has no locks: make sure that no other process writes here" in caplog.text


@pytest.mark.fuzz
def test_names_that_would_leave_a_folder_are_refused():
    for name in (*BAD_NAMES, 3, None, ["a"]):
        assert refuse_name(name), name
    for name in ("a", "a/b", "2013_05_28_drive_0003_sync/0000000000", "..a", "ü 1"):
        assert refuse_name(name) is None
