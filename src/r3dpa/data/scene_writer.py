"""Writer of generated scenes, which runs beside the generator."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from io import BytesIO, FileIO
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from lidarsim.clouds import READERS, suffix_of
from lidarsim.scan_files import write_bin, write_npz, write_ply
from r3dpa.data.labels import write_labels
from r3dpa.geometry import points_of, values_at_returns
from r3dpa.geometry.projection import Projection
from r3dpa.io import (
    Journal,
    append,
    delete_unfinished,
    differences,
    json_values,
    no_follow,
    only_writer,
    write_text,
)

_CLOUD_WRITERS: dict[str, Callable[[Path, Tensor], None]] = {"bin": write_bin, "ply": write_ply}
_FORMATS = (*_CLOUD_WRITERS, "npz")
#: Files that ``r3dpa sample`` and the edits write beside their metadata.
_WRITTEN = (
    *_CLOUD_WRITERS,
    "labels",
    "range_m.npy",
    "scenes.npz",
    "range",
    "birds_eye",
    "scene_3d",
    "scenes.png",
    "scenes.html",
    "classes.png",
    "before.npy",
    "mask.png",
    "edit.png",
    "edit.html",
    "scans",
)


class SceneWriter:
    """Writer of scenes in order, in a thread; completes interrupted runs, adds to finished ones.

    ======================= ===================================================================
    ``range_m.npy``         ``(num, H, W)`` float32 metres, -1 without a return
    ``bin/000000.bin``      points of each scene, with format ``bin``; ``ply/000000.ply`` likewise
    ``labels/000000.label`` uint32 KITTI-360 class of each of these points, if scenes have them
    ``scenes.npz``          all scenes in one file, without intensity, with format ``npz``
    ``metadata.json``       written last: a folder without it is unfinished
    ======================= ===================================================================

    Until the end there are two hidden files, ``.unfinished.npy`` and the journal
    ``.unfinished.json`` with the request and the number of scenes written. At most two batches are
    in memory. An error of the thread is raised by the next :meth:`put`, by :meth:`close`, or at the
    end of the block.

    Args:
        out: Folder; one process at a time writes to it.
        num: Number of scenes.
        projection: Projection of the range images.
        formats: Files of points: ``bin``, ``ply``, ``npz``.
        request: All settings that determine the scenes, as JSON values.
        overwrite: Start anew in a folder that holds scenes, finished or not.

    Raises:
        ValueError: If a format is unknown, another process writes to ``out``, or ``out`` holds
            scenes of another request, or as many as ``num``.

    Attributes:
        num_done: Scenes written so far, also by interrupted runs of the same request.
        evaluations: Network evaluations of all these scenes together.
    """

    def __init__(
        self,
        out: Path,
        num: int,
        projection: Projection,
        formats: Sequence[str],
        request: dict[str, Any],
        overwrite: bool = False,
    ) -> None:
        for name in formats:
            if name not in _FORMATS:
                raise ValueError(f"unknown format {name!r}; choose from {', '.join(_FORMATS)}")
        self.out, self.num, self.num_done, self.evaluations = out, num, 0, 0
        self._projection = projection
        self._formats = tuple(formats)
        self._request = json_values(request)
        self._journal = Journal(out / ".unfinished.json")
        self._unfinished = out / ".unfinished.npy"
        with ExitStack() as alone:
            alone.enter_context(only_writer(out / ".lock", f"writes scenes to {out}"))
            if (out / "metadata.json").exists() and not overwrite:
                self._reopen()
            delete_unfinished(out)
            if self._journal.path.exists() and not overwrite:
                self.num_done, self.evaluations = self._written_before()
            if not self.num_done:
                self._clear()
            self._file = self._open()
            self._alone = alone.pop_all()
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="scene-writer")
        self._batch: Future[None] | None = None  # that is being written

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        with self._alone:
            self._thread.shutdown()
            self._file.close()
            self._journal.close()
            if error is not None and not self.num_done:
                self._delete_scenes()
                self._journal.delete()
        if error is None:
            self._wait()

    @property
    def range_path(self) -> Path:
        """Range images of all scenes, complete after :meth:`close`."""
        return self.out / "range_m.npy"

    def put(
        self,
        range_m: Tensor,
        nfe: int = 0,
        intensity: Tensor | None = None,
        labels: Tensor | None = None,
    ) -> None:
        """Write the next scenes beside the caller; waits for those before them.

        Args:
            range_m: ``(B, H, W)`` metres on any device; must not be changed afterwards.
            nfe: Network evaluations of each of them.
            intensity: ``(B, H, W)`` of the points; 0 in ``.bin`` files without.
            labels: ``(B, H, W)`` KITTI-360 class of the points.
        """
        self._wait()
        if intensity is not None:
            intensity = intensity.cpu()
        if labels is not None:
            labels = labels.cpu()
        self._batch = self._thread.submit(self._write, range_m.cpu(), nfe, intensity, labels)

    def close(self) -> None:
        """Wait until all scenes are written, and give ``range_m.npy`` its name."""
        self._wait()
        os.fsync(self._file)
        self._file.close()
        assert self.num_done == self.num, "closed before all scenes were put"
        if "npz" in self._formats:
            images = enumerate(np.load(self._unfinished, mmap_mode="r"))
            clouds = (
                (f"{index:06d}", points_of(torch.from_numpy(np.array(range_m)), self._projection))
                for index, range_m in images
            )
            write_npz(self.out / "scenes.npz", clouds)
        self._unfinished.replace(self.range_path)

    def finish(self, metadata: dict[str, Any]) -> None:
        """Write ``metadata.json``, which marks the folder as complete."""
        write_text(self.out / "metadata.json", json.dumps(metadata, indent=2) + "\n")
        self._journal.delete()

    def _reopen(self) -> None:
        """Make a finished folder an unfinished one of more scenes."""
        metadata_path = self.out / "metadata.json"
        try:
            metadata = json.loads(metadata_path.read_text(encoding="utf-8"))
            num_done, nfe = int(metadata["num"]), float(metadata["nfe"])
        except (ValueError, KeyError, TypeError):
            num_done, nfe = self.num, 0.0
        if num_done >= self.num:
            raise ValueError(
                f"{self.out} holds scenes already; give another --out or --overwrite true"
            )
        stored = {key: metadata.get(key) for key in self._request}
        if different := self._differences(stored, num_done):
            raise ValueError(
                f"{self.out} holds {num_done} scenes of another request ({different}); give "
                "another --out or --overwrite true"
            )
        self._start_journal(num_done, round(nfe * num_done))
        metadata_path.unlink()

    def _differences(self, stored: dict[str, Any], num_done: int) -> str:
        """How the request that made ``num_done`` scenes differs in what scenes depend on.

        They do not depend on how many are made at once, and more can be added.
        """
        free = {"batch_size"} if num_done > self.num else {"batch_size", "num"}
        request = {name: value for name, value in self._request.items() if name not in free}
        before = {name: value for name, value in stored.items() if name not in free}
        return "; ".join(differences(before, request))

    def _written_before(self) -> tuple[int, int]:
        try:
            first, *later = self._journal.read()
            stored = first["request"]
            last = later[-1] if later else first
            num_done, evaluations = int(last["num_done"]), int(last["evaluations"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{self._journal.path}: is damaged ({error!r}); give --overwrite true to start anew"
            ) from error
        if num_done and (different := self._differences(stored, num_done)):
            raise ValueError(
                f"{self.out} holds {num_done} scenes of an unfinished run of another request "
                f"({different}); the same request completes it, --overwrite true starts anew"
            )
        self._start_journal(num_done, evaluations)
        if num_done and not self._unfinished.exists() and self.range_path.exists():
            self.range_path.replace(self._unfinished)  # stopped between the two last files
        return num_done, evaluations

    def _clear(self) -> None:
        """Remove the output of earlier runs, and nothing else."""
        for file in self.out.glob("[!.]*"):
            if file.name not in _WRITTEN and suffix_of(file) in READERS:
                raise ValueError(
                    f"{file} is a scan that is none of these scenes: give another --out"
                )
        for name in _WRITTEN:
            if (self.out / name).is_symlink():
                raise ValueError(f"{self.out / name} is a link: remove it, or give another --out")
        written = [path for name in _WRITTEN if (path := self.out / name).exists()]
        if written and not self._holds_scenes() and not self._journal.path.exists():
            raise ValueError(
                f"{written[0]} is in the way and no scenes of this command lie in {self.out}; "
                "give another --out"
            )
        # Marks the folder as ours, should this be interrupted.
        self.out.mkdir(parents=True, exist_ok=True)
        self._start_journal(0, 0)
        (self.out / "metadata.json").unlink(missing_ok=True)
        self._delete_scenes()

    def _holds_scenes(self) -> bool:
        """Whether the metadata in the folder is of scenes, not of another program."""
        try:
            metadata = json.loads((self.out / "metadata.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        return isinstance(metadata, dict) and {"num", "nfe"} <= metadata.keys()

    def _delete_scenes(self) -> None:
        for path in (self._unfinished, *(self.out / name for name in _WRITTEN)):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def _open(self) -> FileIO:
        """File of the range images, positioned after those that are written."""
        sensor = self._projection.sensor
        shape = (self.num, sensor.beams, sensor.columns)
        header = BytesIO()
        layout = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(header, layout)
        end = header.tell() + 4 * self.num_done * sensor.beams * sensor.columns
        size = self._unfinished.stat().st_size if self._unfinished.exists() else 0
        if self.num_done and size < end:  # to extend it would make scenes of zeros
            raise ValueError(
                f"{self._unfinished} is gone or cut short, but {self._journal.path} counts "
                f"{self.num_done} scenes: give --overwrite true to start anew"
            )
        file = FileIO(self._unfinished, "r+b" if self.num_done else "wb", opener=no_follow)
        file.write(header.getvalue())
        file.truncate(end)
        file.seek(end)
        return file

    def _write(
        self, range_m: Tensor, nfe: int, intensity: Tensor | None, labels: Tensor | None
    ) -> None:
        for place, scene in enumerate(range_m):
            index = self.num_done + place
            if scene.isnan().any():
                raise ValueError(
                    f"scene {index:06d} of {self.out} holds NaN: the networks diverged; check the "
                    "checkpoint, or sample in fp32"
                )
            value = None if intensity is None else intensity[place]
            points = points_of(scene, self._projection, intensity=value)
            for name in self._formats:
                if name in _CLOUD_WRITERS:
                    _CLOUD_WRITERS[name](self.out / name / f"{index:06d}.{name}", points)
            if labels is not None:
                classes = values_at_returns(labels[place], scene, self._projection)
                write_labels(self.out / "labels" / f"{index:06d}.label", classes)
        append(self._file, range_m.numpy().astype("<f4", copy=False).tobytes())
        num_done = self.num_done + len(range_m)
        evaluations = self.evaluations + nfe * len(range_m)
        self._journal.add({"num_done": num_done, "evaluations": evaluations})
        self.num_done, self.evaluations = num_done, evaluations

    def _wait(self) -> None:
        """Wait for the batch that is being written; raises its error, once."""
        batch, self._batch = self._batch, None
        if batch is not None:
            batch.result()

    def _start_journal(self, num_done: int, evaluations: int) -> None:
        about = {"request": self._request, "num_done": num_done, "evaluations": evaluations}
        self._journal.start(about)
