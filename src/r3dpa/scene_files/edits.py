"""Work shared by the edits: read checkpoint and scans, run the edit, write the results."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from lidarsim.changed_scans import inputs_of
from lidarsim.clouds import PointCloud
from lidarsim.scan_files import out_of_range, read_scan
from lidarsim.scan_folders import find_files
from r3dpa import viz
from r3dpa.checkpoints import read_checkpoint
from r3dpa.data import PointSample, Scan, ScanError, pooled_grids
from r3dpa.data.images import read_mask
from r3dpa.data.labels import find_labels, labels_of_cloud
from r3dpa.data.scene_writer import SceneWriter
from r3dpa.editing import EditResult, EditSettings, SceneEditor
from r3dpa.editing.gaps import check_view
from r3dpa.editing.regions import check_mask
from r3dpa.features import feature_source
from r3dpa.flow.sampler import SamplerConfig
from r3dpa.geometry import Pixels, in_range, in_view, project_pixels
from r3dpa.io import atomic_path, json_values, number_of, usable_device, write_text
from r3dpa.nn import VelocityNetwork
from r3dpa.scene_files.generated import feature_source_of, provenance
from r3dpa.scene_files.options import EditOptions
from r3dpa.scenes import SceneBatch
from r3dpa.stages import BASELINE_STAGES, scene_generator
from r3dpa.viz.scenes import draw_scene

_SHOWN = 8  # results on the sheet and the page
_BASELINE_STEPS = 32
_COUNTS = {
    "points_inside": "points in the box",
    "points_of_class": "of them taken for the object",
}


class ScanView(NamedTuple):
    """A scan: its file, points ``(P, 4)``, and pixels ``(H, W)``, the input of the model."""

    path: Path
    points: Tensor
    pixels: Pixels


def refuse_inside(out: Path, scans: Iterable[Path]) -> None:
    """Refuse to write into a folder that scans are read from, which ``--overwrite`` would empty."""
    for path in scans:
        if path.resolve().is_relative_to(out.resolve()):
            raise ValueError(f"{path} lies in --out {out}: give another folder as --out")


def _about_files(source: Path) -> dict[str, list[int]]:
    """Size and time of change of a file or of the scans of a folder, and of labels beside them."""
    root, paths = find_files(source)
    about: dict[str, list[int]] = {}
    for path in paths:
        about |= inputs_of(path, root)
    return about


class EditSession:
    """Checkpoint opened for one edit with ``num`` results.

    ``strength`` and ``window`` are of the guidance; None for their defaults. Baselines can only
    complete scans: for them, ``editor`` raises a ValueError.
    """

    def __init__(
        self,
        options: EditOptions,
        num: int,
        strength: float | None = None,
        window: tuple[float, float] | None = None,
    ) -> None:
        self.options, self.num = options, num
        strength = 0.5 if strength is None else strength
        window = window or (0.0, 1.0)
        steps = EditSettings.steps if options.steps is None else options.steps
        self.settings = EditSettings(options.solver, steps, options.shift, strength, window)
        self.device = usable_device(options.device)
        self.checkpoint = read_checkpoint(options.ckpt)
        shared: Any = {"weights": options.weights, "device": self.device}
        generator: Any
        self.baseline: Any = None
        if self.checkpoint.stage in BASELINE_STAGES:
            steps = _BASELINE_STEPS if options.steps is None else options.steps
            sampler = SamplerConfig("ddpm", steps)
            self.baseline = generator = scene_generator(self.checkpoint, sampler, **shared)
            self._called = generator.network
        else:
            self._editor = SceneEditor.from_checkpoint(
                self.checkpoint, self.settings, batch_size=options.batch_size, **shared
            )
            generator = self._editor.generator
            self._called = next(generator.sit.children())  # once in each evaluation
        self.geometry, self.projection = generator.geometry, generator.geometry.projection
        self.sensor = self.projection.sensor

    @property
    def editor(self) -> SceneEditor:
        """Editor of a model of R3DPA."""
        if self.baseline is not None:
            raise ValueError(
                f"{self.options.ckpt} is of stage {self.checkpoint.stage}, which can only complete "
                "scans: `r3dpa edit complete`"
            )
        return self._editor

    @property
    def sit(self) -> VelocityNetwork:
        """Velocity network of the editor."""
        return self.editor.generator.sit

    def read(self, path: Path) -> ScanView:
        """Read a scan, which must fill the field of view, and the labels beside it if any."""
        points = torch.from_numpy(read_scan(path, self.sensor, self.options.columns))
        known = find_labels(path, len(points))
        labels = None if known is None else torch.from_numpy(known)
        scan = ScanView(path, points, project_pixels(points, self.projection, labels))
        self.check(scan)
        return scan

    def view(self, path: Path, cloud: PointCloud) -> ScanView:
        """View of a scan that was read; unchecked.

        Points above and below the field of view, which would land in the first and last row, are in
        no pixel.
        """
        points, known = torch.from_numpy(cloud.rows()), labels_of_cloud(cloud)
        if not in_range(points[:, :3], self.sensor).any():
            raise out_of_range(path, self.sensor)
        labels = None if known is None else torch.from_numpy(known)
        outside = ~in_view(points[:, :3], self.projection)
        seen = points.masked_fill(outside[:, None], torch.nan)
        return ScanView(path, points, project_pixels(seen, self.projection, labels))

    def check(self, scan: ScanView, missing: Tensor | None = None) -> None:
        """Refuse a scan that does not fill the field of view outside ``missing`` ``(H, W)``."""
        try:
            check_view(scan.points[:, :3], scan.pixels.range_m, self.projection, missing)
        except ValueError as error:
            raise ScanError(f"{scan.path}: {error}") from error

    def complete(self, scan: ScanView, missing: Tensor, resamplings: int) -> EditResult:
        """Completions of a scan by a baseline; pixels that are not missing stay."""
        range_m, scan_intensity, _ = scan.pixels
        assert scan_intensity is not None
        image = self.geometry.codec.to_image(range_m, scan_intensity)
        batch_size, seed = self.options.batch_size, self.options.seed
        batches: list[SceneBatch] = []
        for first in range(0, self.num, batch_size):
            indices = range(first, min(first + batch_size, self.num))
            scenes = self.baseline.complete(image, ~missing, indices, seed, resamplings=resamplings)
            batches.append(scenes)

        def joined(name: str) -> Tensor:
            return torch.cat([getattr(batch, name) for batch in batches]).cpu()

        ranges = torch.where(missing, joined("range_m"), range_m)
        return EditResult(ranges, joined("latents"), batches[0].nfe, self.projection)

    def read_mask(self, path: Path) -> Tensor:
        """Mask ``(H, W)`` of a picture; refused if it selects nothing or all."""
        return check_mask(read_mask(path, self.sensor), str(path))

    def extractor(self, ckpt: Path | None) -> Any:
        """The feature source of the checkpoint, on the device of the networks."""
        source = feature_source_of(self.checkpoint)
        return feature_source(source, ckpt, self.sit.feature_dim).to(self.device)

    def feature_grids(self, scans: Iterable[ScanView], ckpt: Path | None) -> list[Tensor]:
        """Feature grid ``(N, F)`` of each scan, as ``r3dpa data features`` writes them."""
        extractor = self.extractor(ckpt)
        grids = []
        for path, points, _ in scans:
            file = Scan(path.parent.name, path.stem, path)
            sample = PointSample(file, file.cache_key, points, extractor.prepare(points))
            by_size = pooled_grids(extractor, [sample], self.projection, [self.sit.grid_size])
            grids.append(by_size[self.sit.grid_size][0].clone())
        return grids

    def write(
        self,
        command: str,
        arguments: Mapping[str, Any],
        scans: Mapping[str, ScanView],
        run: Callable[[], EditResult],
        parts: Tensor | None = None,
        part_names: Sequence[str] = (),
        guided: bool = False,
    ) -> str:
        """Run an edit and write scenes, pictures, page and metadata; return a summary.

        ``arguments`` are the options of the command, for the metadata; ``parts`` ``(H, W)`` says
        to which of the named parts each pixel belongs.
        """
        options = self.options
        paths = {name: scan.path for name, scan in scans.items()}
        refuse_inside(options.out, paths.values())
        request = self.request(command, arguments, {"scans": paths}, guided)
        with SceneWriter(
            options.out, self.num, self.projection, options.formats, request, options.overwrite
        ) as writer:
            start = time.perf_counter()
            with self._progress(command):
                result = run()
            seconds = time.perf_counter() - start
            todo = result[writer.num_done :]
            writer.put(todo.range_m.contiguous(), todo.nfe, todo.intensity, todo.labels)
            writer.close()
            self.show(command, scans, result.range_m, parts, part_names)
            measured = ("nfe", "vae_error_m", "round_trip_m")
            request |= {name: getattr(result, name) for name in measured} | {"seconds": seconds}
            for name in ("cosine", "draws", "likeness", "points_inside", "points_of_class"):
                values = getattr(result, name)
                request[name] = None if values is None else values.tolist()
            writer.finish(request)
        counts = ""
        for name, about in _COUNTS.items():
            if request[name] is not None:
                counts += f"{about}: {', '.join(map(str, request[name]))}\n"
        return (
            f"{command}: {number_of(self.num, 'scene')} in {options.out}, {result.nfe} "
            f"network evaluations each, {seconds:.3g} s; errors are in metadata.json\n{counts}"
            f"open {options.out / 'edit.png'} and {options.out / 'edit.html'}"
        )

    def request(
        self,
        command: str,
        arguments: Mapping[str, Any],
        sources: Mapping[str, Any],
        guided: bool = False,
    ) -> dict[str, Any]:
        """All that determines the results of a command, as JSON values.

        Of each file or folder among ``arguments``, the size and time of change of its files: scenes
        are added to earlier ones only where these are the same.
        """
        inputs = {
            name: _about_files(path) for name, path in arguments.items() if isinstance(path, Path)
        }
        options, settings = self.options, asdict(self.settings)
        if not guided:
            del settings["strength"], settings["window"]
        if self.baseline is not None:
            settings = {"steps": self.baseline.sampler.steps}
        request = dict(arguments)
        if options.columns:
            request["columns"] = options.columns
        request |= provenance(self.checkpoint, options, self.num, self.device, self.geometry)
        request |= {"command": command, "guided": guided, "settings": settings, "inputs": inputs}
        request |= sources
        return dict(json_values(request, default=str))  # paths as text

    @contextmanager
    def _progress(self, command: str) -> Iterator[None]:
        """Counter of network evaluations of whole batches."""
        with tqdm(unit="evaluation", desc=command, disable=None) as bar:

            def count(*_: Any) -> None:  # what a hook returns would become the output
                bar.update()

            with self._called.register_forward_hook(count):
                yield

    def show(
        self,
        command: str,
        scans: Mapping[str, ScanView],
        results: Tensor,
        parts: Tensor | None,
        part_names: Sequence[str],
    ) -> None:
        """Write ``before.npy``, pictures and the page of scans and results ``(B, H, W)``."""
        out = self.options.out
        before = {name: scan.pixels.range_m for name, scan in scans.items()}
        images = torch.stack(list(before.values()))
        with atomic_path(out / "before.npy") as temporary, temporary.open("wb") as file:
            np.save(file, images.numpy())
        for index, range_m in enumerate(results[: self.options.pictures]):
            draw_scene(out, index, range_m, self.geometry)
        after = {f"{command} {index}": image for index, image in enumerate(results[:_SHOWN])}
        rows = [viz.EditRow(name, image) for name, image in before.items()]
        numbers = None
        if parts is not None:
            numbers, shown = parts.numpy().astype(np.uint8), images[0]
            if command == "mix":  # each part as in the scan that it follows
                shown = images.gather(0, parts.long()[None])[0]
            rows.append(viz.EditRow("mask", shown, numbers))
            viz.save(numbers * np.uint8(255 // (len(part_names) - 1)), out / "mask.png")
        rows += [viz.EditRow(name, image, outline=numbers) for name, image in after.items()]
        viz.save(viz.edit_sheet(rows, part_names, self.projection), out / "edit.png")
        title = f"r3dpa {command}"
        page = viz.edit_page(before, after, numbers, part_names, self.projection, title)
        write_text(out / "edit.html", page)
