"""Scenes arrive as files in order; what stops a run is told, and the next run goes on after it."""

import errno
import json
import threading

import numpy as np
import pytest
import torch

from lidarsim.scan_files import read_npz, read_points, read_scan, write_bin
from r3dpa.data import scene_writer
from r3dpa.data.scene_writer import SceneWriter
from r3dpa.geometry import LidarSensor, SphericalProjection, points_of

SENSOR = LidarSensor(beams=4, columns=8, range_min_m=1.0, range_max_m=50.0)
PROJECTION = SphericalProjection(SENSOR)
REQUEST = {"seed": 0, "interval": (0.0, 1.0)}


def scenes(num, seed=0):
    generator = torch.Generator().manual_seed(seed)
    range_m = 2 + 40 * torch.rand(num, 4, 8, generator=generator)
    return torch.where(torch.rand(num, 4, 8, generator=generator) < 0.8, range_m, -1.0)


def writer(out, num, formats=("bin",), request=REQUEST, overwrite=False):
    return SceneWriter(out, num, PROJECTION, formats, request, overwrite)


def write(out, range_m, batch=2, **options):
    with writer(out, len(range_m), **options) as open_writer:
        for first in range(open_writer.num_done, len(range_m), batch):
            open_writer.put(range_m[first : first + batch])
        open_writer.close()
        open_writer.finish({"num": len(range_m), "nfe": 8})


def files(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_every_format_holds_the_points_of_the_range_images(tmp_path):
    range_m = scenes(5)
    write(tmp_path, range_m, formats=("bin", "ply", "npz"))
    assert np.array_equal(np.load(tmp_path / "range_m.npy"), range_m.numpy())
    clouds = read_npz(tmp_path / "scenes.npz")
    assert list(clouds) == [f"{index:06d}" for index in range(5)]
    for index, (name, cloud) in enumerate(clouds.items()):
        points = points_of(range_m[index], PROJECTION).numpy()
        assert np.array_equal(cloud, points)
        assert np.array_equal(read_points(tmp_path / "ply" / f"{name}.ply"), points)
        assert np.array_equal(read_scan(tmp_path / "bin" / f"{name}.bin")[:, :3], points)
    assert len(files(tmp_path)) == 3 + 2 * 5  # nothing hidden is left


def test_an_interrupted_run_goes_on_where_it_stopped(tmp_path):
    """With the evaluations so far, and without the images of a batch that was not recorded."""
    range_m = scenes(7)
    with writer(tmp_path, 7) as first:
        first.put(range_m[:2], nfe=7)
        first.put(range_m[2:4], nfe=10)
    assert files(tmp_path) == [
        *(".unfinished.json", ".unfinished.npy"),
        *(f"bin/{index:06d}.bin" for index in range(4)),
    ]
    with (tmp_path / ".unfinished.npy").open("ab") as file:
        file.write(b"half of an image")
    kept = (tmp_path / "bin" / "000003.bin").stat().st_mtime_ns
    with writer(tmp_path, 7) as second:
        assert (second.num_done, second.evaluations) == (4, 2 * 7 + 2 * 10)
        second.put(range_m[4:], nfe=4)
        second.close()
        assert second.evaluations == 2 * 7 + 2 * 10 + 3 * 4
        second.finish({"num": 7, "nfe": 6})
    assert np.array_equal(np.load(tmp_path / "range_m.npy"), range_m.numpy())
    assert (tmp_path / "bin" / "000003.bin").stat().st_mtime_ns == kept
    assert not [name for name in files(tmp_path) if name.startswith(".")]
    with writer(tmp_path, 7, overwrite=True) as third:
        assert (third.num_done, third.evaluations) == (0, 0)


def test_an_error_before_the_first_scene_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError), writer(tmp_path, 2):
        raise RuntimeError
    assert files(tmp_path) == []
    broken = scenes(3)
    broken[1] = torch.nan  # after the points of the first scene are written
    for _ in range(2):  # and the folder can be written again
        with pytest.raises(ValueError, match=r"scene 000001 of .* holds NaN"):
            write(tmp_path, broken, batch=3)
        assert files(tmp_path) == []


def test_a_run_that_stops_before_its_last_file_only_needs_that(tmp_path):
    range_m = scenes(2)
    with writer(tmp_path, 2) as first:
        first.put(range_m)
        first.close()
    with writer(tmp_path, 2) as second:
        assert second.num_done == 2
        second.close()
        second.finish({"num": 7, "nfe": 6})
    assert np.array_equal(np.load(tmp_path / "range_m.npy"), range_m.numpy())


@pytest.mark.parametrize("damage", ["cut short", "gone"])
def test_lost_range_images_are_not_made_up(tmp_path, damage):
    """Two scenes are told of; zeros in their place would be scenes."""
    with writer(tmp_path, 4) as first:
        first.put(scenes(2))
    images = tmp_path / ".unfinished.npy"
    if damage == "gone":
        images.unlink()
    else:
        with images.open("r+b") as file:
            file.truncate(images.stat().st_size - 4)
    before = files(tmp_path)
    with pytest.raises(
        ValueError, match=r"\.npy is gone or cut short, but .* counts 2 scenes.*--overwrite true"
    ):
        writer(tmp_path, 4)
    assert files(tmp_path) == before
    write(tmp_path, scenes(4), overwrite=True)


def test_an_error_of_the_thread_ends_the_block(tmp_path):
    """Nobody asks for the result of a batch that cannot be written."""
    message = r"scene 000000 .* holds NaN: the networks diverged"
    with pytest.raises(ValueError, match=message), writer(tmp_path, 3) as open_writer:
        open_writer.put(torch.full((1, 4, 8), torch.nan))
    assert not (tmp_path / "metadata.json").exists()


def test_another_request_is_refused_until_it_may_start_anew(tmp_path):
    with writer(tmp_path, 4) as first:
        first.put(scenes(2))
    other = {**REQUEST, "seed": 1}
    with pytest.raises(ValueError, match=r"2 scenes of an unfinished .*seed 0 there, 1 now.*over"):
        writer(tmp_path, 4, request=other)
    write(tmp_path, scenes(1, seed=5), request=other, overwrite=True)
    assert files(tmp_path) == ["bin/000000.bin", "metadata.json", "range_m.npy"]
    with pytest.raises(ValueError, match=r"holds scenes already.*--overwrite"):
        writer(tmp_path, 1, request=other)


def test_a_folder_with_other_scans_is_refused(tmp_path):
    """Labels of the scenes would be read as labels of these scans."""
    write_bin(tmp_path / "000000.bin", np.ones((3, 4)))
    for overwrite in (False, True):
        with pytest.raises(ValueError, match=r"000000\.bin is a scan that is none of these scenes"):
            writer(tmp_path, 4, overwrite=overwrite)
    assert files(tmp_path) == ["000000.bin"]


def test_scenes_can_be_made_by_other_numbers_at_once(tmp_path):
    range_m = scenes(5)
    finish(tmp_path, range_m, 2, batch_size=2)
    assert finish(tmp_path, range_m, 3, batch_size=1) == 2
    with writer(tmp_path, 5, request={"seed": 0, "num": 5, "batch_size": 8}) as stopped:
        stopped.put(range_m[3:4], nfe=8)
    assert finish(tmp_path, range_m, 5, batch_size=1) == 4


def finish(out, range_m, num, **changes):
    """Write the scenes that are missing of `num`, as `r3dpa sample` does it."""
    request = {"seed": 0, "num": num} | changes
    with writer(out, num, request=request) as open_writer:
        first = open_writer.num_done
        open_writer.put(range_m[first:num], nfe=8)
        open_writer.close()
        open_writer.finish(request | {"nfe": open_writer.evaluations / num})
    return first


@pytest.mark.parametrize("finished", [True, False])
def test_more_scenes_are_added_to_those_that_are_there(tmp_path, finished):
    range_m = scenes(7)
    if finished:
        assert finish(tmp_path, range_m, 4) == 0
    else:
        with writer(tmp_path, 5, request={"seed": 0, "num": 5}) as stopped:
            stopped.put(range_m[:4], nfe=8)
    assert finish(tmp_path, range_m, 7) == 4
    assert np.array_equal(np.load(tmp_path / "range_m.npy"), range_m.numpy())
    assert json.loads((tmp_path / "metadata.json").read_text()) == {"seed": 0, "num": 7, "nfe": 8}
    before = files(tmp_path)
    with pytest.raises(ValueError, match=r"holds scenes already"):
        finish(tmp_path, range_m, 7)
    with pytest.raises(ValueError, match=r"7 scenes of another request \(seed 0 there, 1 now\)"):
        finish(tmp_path, range_m, 8, seed=1)
    assert files(tmp_path) == before


def test_an_unfinished_folder_of_an_earlier_version_is_completed(tmp_path):
    """Its state was one line without an end, written anew after each batch."""
    range_m = scenes(4)
    with writer(tmp_path, 4) as first:
        first.put(range_m[:2], nfe=3)
    state = {"request": REQUEST, "num_done": 2, "evaluations": 6}
    (tmp_path / ".unfinished.json").write_text(json.dumps(state))
    with writer(tmp_path, 4) as second:
        assert (second.num_done, second.evaluations) == (2, 6)
        second.put(range_m[2:])
        second.close()
        second.finish({"num": 7, "nfe": 6})
    assert np.array_equal(np.load(tmp_path / "range_m.npy"), range_m.numpy())


def test_a_damaged_state_is_named(tmp_path):
    (tmp_path / ".unfinished.json").write_text("{")
    with pytest.raises(ValueError, match=r"unfinished.json: is damaged.*--overwrite true"):
        writer(tmp_path, 1)


@pytest.mark.parametrize("where", ["put", "close"])
def test_an_error_while_writing_stops_the_run_with_its_message(tmp_path, monkeypatch, where):
    real = scene_writer.write_bin

    def full_disk(path, points):
        if path.name == "000003.bin":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        real(path, points)

    monkeypatch.setitem(scene_writer._CLOUD_WRITERS, "bin", full_disk)
    range_m = scenes(40 if where == "put" else 4)
    with pytest.raises(OSError, match=r"No space left.*000003\.bin"):
        write(tmp_path, range_m)
    *_, state = (tmp_path / ".unfinished.json").read_text().splitlines()
    assert json.loads(state)["num_done"] == 2  # and nothing behind the gap
    assert not list(tmp_path.rglob(".*.partial*"))
    monkeypatch.setitem(scene_writer._CLOUD_WRITERS, "bin", real)
    write(tmp_path, range_m)
    assert np.array_equal(np.load(tmp_path / "range_m.npy"), range_m.numpy())


def test_writing_goes_on_beside_drawing(tmp_path, monkeypatch):
    """One batch may wait; the second `put` comes back only when it has been written."""
    gate = threading.Event()
    real = scene_writer.write_bin
    monkeypatch.setitem(
        scene_writer._CLOUD_WRITERS, "bin", lambda *args: gate.wait(10) and real(*args)
    )
    range_m = scenes(2)
    with writer(tmp_path, 2) as open_writer:
        open_writer.put(range_m[:1])
        assert open_writer.num_done == 0
        second = threading.Thread(target=open_writer.put, args=(range_m[1:],))
        second.start()
        second.join(0.1)
        assert second.is_alive()
        gate.set()
        second.join(10)
        open_writer.close()
        assert open_writer.num_done == 2


def test_pictures_of_replaced_scenes_go_with_them(tmp_path):
    write(tmp_path, scenes(3))
    for name in ("scenes.png", "scenes.html", "classes.png"):
        (tmp_path / name).touch()
    write(tmp_path, scenes(1), overwrite=True)
    assert files(tmp_path) == ["bin/000000.bin", "metadata.json", "range_m.npy"]


def test_files_of_somebody_else_are_never_removed(tmp_path):
    theirs = tmp_path / "bin" / "000000.bin"
    theirs.parent.mkdir()
    theirs.write_bytes(b"a scan")
    for overwrite in (False, True):
        with pytest.raises(ValueError, match="is in the way and no scenes of this command"):
            writer(tmp_path, 2, overwrite=overwrite)
    for metadata in ('{"name": "their data set"}', '["num", "nfe"]', "their notes"):
        (tmp_path / "metadata.json").write_text(metadata)
        with pytest.raises(ValueError, match="is in the way and no scenes of this command"):
            writer(tmp_path, 2, overwrite=True)
        assert (tmp_path / "metadata.json").read_text() == metadata
    assert theirs.read_bytes() == b"a scan"


def test_a_linked_folder_is_refused_before_anything_is_removed(tmp_path):
    write(tmp_path / "out", scenes(2))
    (tmp_path / "out/bin").rename(tmp_path / "disk")
    (tmp_path / "out/bin").symlink_to(tmp_path / "disk")
    before = files(tmp_path)
    with pytest.raises(ValueError, match=r"out/bin is a link: remove it, or give another --out"):
        writer(tmp_path / "out", 2, overwrite=True)
    assert files(tmp_path) == before
