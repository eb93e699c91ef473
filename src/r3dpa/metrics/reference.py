"""Statistics of real scans, computed once and stored in one file."""

from __future__ import annotations

import hashlib
import json
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from glob import escape
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor
from torchmetrics import MetricCollection
from tqdm import tqdm

from r3dpa.io import (
    UNPICKLING_ERRORS,
    atomic_path,
    differences,
    first_line,
    only_writer,
    refuse_name,
)
from r3dpa.metrics.collection import (
    batches_with_features,
    metrics_by_name,
    scene_metrics,
    update_with,
)
from r3dpa.metrics.distances import SceneMetric
from r3dpa.metrics.results import MetricResult
from r3dpa.metrics.scene import EvaluationScene, Protocol, usable_scenes
from r3dpa.metrics.scene_features import SceneFeatures

_ABOUT = "r3dpa_reference"  # key of the file's metadata
_VERSION = 3
_EVERY = 500  # scans between two saves of an unfinished reference

_log = logging.getLogger(__name__)


class ReferenceStatistics:
    """Statistics of real scans, in two halves whose distance is the floor of every metric.

    The halves are of different drives if there are several, see :func:`split_halves`.

    Args:
        protocol: Preparation of the scans.
        spaces: Cards of the feature spaces, see :func:`cards_of`.
        names: Names of the scans, ``drive/frame``.
        about: Origin of the scans: ``data``, ``split``, ``dataset`` (``KITTI-360`` if the published
            numbers are of these scans) and anything else for JSON.

    Attributes:
        halves: Metrics of :func:`scene_metrics` with the real scans of each half. Together they
            hold features of up to ``num_samples`` scans and images of up to ``num_mmd_references``.
        num_done: Scans added so far.
        floors: Cache of the floors by their settings, see
            :func:`r3dpa.metrics.floors.measure_floors`.

    Raises:
        ValueError: For fewer than two scans, or a name given twice.
    """

    def __init__(
        self,
        protocol: Protocol,
        spaces: dict[str, dict[str, Any]],
        names: Sequence[str],
        about: dict[str, Any],
    ) -> None:
        if len(names) < 2:
            raise ValueError(f"a reference needs at least 2 scans, got {len(names)}")
        repeated = [name for name, count in Counter(names).items() if count > 1]
        if repeated:
            raise ValueError(f"names of scans given twice: {', '.join(repeated[:5])}")
        self.protocol, self.spaces, self.about = protocol, spaces, about
        self.num_done = 0
        self.floors: dict[tuple[Any, ...], dict[str, MetricResult]] = {}
        self.names = tuple(names)
        self._half_of = split_halves(names)
        max_rows = limits_of_halves(protocol.num_samples, self.sizes_of_halves)
        max_images = limits_of_halves(protocol.num_mmd_references, self.sizes_of_halves)
        self.halves = tuple(
            self.metrics(max_rows=rows, max_images=(images, None))
            for rows, images in zip(max_rows, max_images, strict=True)
        )

    def metrics(self, spaces: Iterable[str] | None = None, **options: Any) -> MetricCollection:
        """Return empty metrics of the protocol and of some or all feature spaces."""
        chosen = self.spaces if spaces is None else spaces
        widths = {name: self.spaces[name]["dim"] for name in chosen}
        return scene_metrics(self.protocol, widths, **options)

    def fill(self, metrics: MetricCollection, spaces: Sequence[SceneFeatures] = ()) -> None:
        """Set the real side of metrics to the scans of both halves."""
        parts = [metrics_by_name(half) for half in self.halves]
        for name, metric in metrics_by_name(metrics).items():
            metric.adopt_real(*(part[name] for part in parts))

    def names_of_half(self, index: int) -> list[str]:
        """Return the names of the scans of a half, in their order."""
        return [name for name in self.names if self._half_of[name] == index]

    @property
    def sizes_of_halves(self) -> tuple[int, int]:
        """Number of scans of each half."""
        return len(self.names_of_half(0)), len(self.names_of_half(1))

    @property
    def complete(self) -> bool:
        """Whether every scan was counted in."""
        return self.num_done == len(self.names)

    def check(self, spaces: Sequence[SceneFeatures] = ()) -> None:
        """Check that the statistics are complete and have these spaces.

        Raises:
            ValueError: If not, or if a space has other weights or another protocol.
        """
        if not self.complete:
            raise ValueError(
                f"the reference holds {self.num_done} of {len(self.names)} scans; repeat its "
                "command to complete it"
            )
        for space in spaces:
            if space.name not in self.spaces:
                raise ValueError(
                    f"the reference has no features of {space.name}, only of "
                    f"{', '.join(self.spaces) or 'none'}: choose among these, or compute it again"
                )
            stored, given = self.spaces[space.name], cards_of([space])[space.name]
            different = [
                f"{key} {given.get(key)} not {stored.get(key)}"
                for key in stored | given
                if stored.get(key) != given.get(key)
            ]
            if different:
                raise ValueError(
                    f"{space.name} differs from the reference: {', '.join(different)}; give the "
                    "same weights and protocol, or compute the reference again"
                )

    def describe(self) -> str:
        """Return data, split, count and hash of the names, in one line."""
        digest = hashlib.sha256("\n".join(self.names).encode()).hexdigest()[:12]
        parts = [str(self.about[key]) for key in ("data", "split") if self.about.get(key)]
        return ", ".join([*parts, f"{len(self.names)} scans", f"names {digest}"])

    def update(
        self,
        scenes: Iterable[EvaluationScene],
        spaces: Sequence[SceneFeatures],
        partial: Path | None = None,
    ) -> None:
        """Add the scans that are missing; interruptions change no bit of the result.

        Args:
            scenes: The scans ``names[num_done:]``, in that order.
            spaces: All feature spaces of the statistics.
            partial: File to save to every 500 scans.

        Raises:
            ValueError: If a scan cannot be used or is not the next one.
        """
        saved = self.num_done
        for batch, features in batches_with_features(usable_scenes(scenes, self.protocol), spaces):
            expected = self.names[self.num_done : self.num_done + len(batch)]
            if tuple(scene.name for scene in batch) != expected:
                raise ValueError(f"{batch[0].name}: not the next scan; give all, in order")
            for index, part in enumerate(self.halves):
                chosen = [i for i, name in enumerate(expected) if self._half_of[name] == index]
                features_of_half = {name: values[chosen] for name, values in features.items()}
                update_with(part, [batch[i] for i in chosen], features_of_half, real=True)
            self.num_done += len(batch)
            if partial is not None and self.num_done - saved >= _EVERY:
                self.save(partial)
                saved = self.num_done

    def _states(self) -> Iterator[tuple[str, SceneMetric, str, Tensor]]:
        """Key in the file, metric, name and value of each state; a feature space has one set."""
        for half, collection in enumerate(self.halves):
            metrics = metrics_by_name(collection)
            for name in ("cells", "ranges", "matching", *(f"{s}_frechet" for s in self.spaces)):
                for state, value in metrics[name].real_states().items():
                    yield f"{half}.{name}.{state}", metrics[name], state, value

    def save(self, path: str | Path) -> None:
        """Write everything to one ``.safetensors`` file, its card in the metadata."""
        tensors: dict[str, Tensor] = {}
        for key, _, name, value in self._states():
            if name == "real_bins":  # nearly all are empty
                occupied = value.nonzero()[:, 0]
                value = torch.stack([occupied, value[occupied].long()])
            tensors[key] = value.contiguous()
        card = {
            "version": _VERSION,
            "protocol": asdict(self.protocol),
            "spaces": self.spaces,
            "names": self.names,
            "about": self.about,
            "num_done": self.num_done,
        }
        with atomic_path(path) as temporary:
            save_file(tensors, temporary, metadata={_ABOUT: json.dumps(card)})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what ``save`` wrote, complete or not.

        Raises:
            ValueError: Naming the file and the fault.
        """
        if Path(path).is_dir():
            raise ValueError(f"{path} is a folder; give the file that `r3dpa data reference` wrote")
        try:
            with safe_open(path, framework="pt") as file:
                about = (file.metadata() or {}).get(_ABOUT)
                if about is None:
                    raise ValueError("it has no metadata of one")
                card = json.loads(about)
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - no dict
            if card["version"] != _VERSION:
                raise ValueError(f"is of version {card['version']}, this is {_VERSION}")
            protocol = Protocol.from_dict(card["protocol"])
            if refused := [why for why in map(refuse_name, card["names"]) if why]:
                raise ValueError(f"name of a scan {refused[0]}")
            reference = cls(protocol, card["spaces"], card["names"], card["about"])
            reference.num_done = card["num_done"]
            for key, metric, name, value in reference._states():
                if key not in tensors:
                    raise ValueError(f"tensor {key} is missing")
                if name == "real_bins":
                    occupied, counts = tensors[key]
                    value[occupied] = counts.to(value)
                else:
                    metric.load_real_state(name, tensors[key])
        except (*UNPICKLING_ERRORS, SafetensorError) as error:
            raise ValueError(
                f"{path} holds no reference statistics ({first_line(error)}): give the "
                "file that `r3dpa data reference` wrote"
            ) from error
        return reference


def compute_reference(
    job: ReferenceStatistics,
    scans_from: Callable[[int], Iterable[EvaluationScene]],
    spaces: Sequence[SceneFeatures],
    out: Path,
    renew: bool = False,
) -> ReferenceStatistics:
    """Compute the statistics of scans into a file; read or resume an existing one.

    Args:
        job: Empty statistics.
        scans_from: Gives the scans of the job from a number on.
        spaces: All feature spaces of the job.
        out: File to write.
        renew: Replace a file of another job.

    Raises:
        ValueError: If another process writes ``out`` or, without ``renew``, if the file is damaged
            or of another job.
    """
    partial = out.with_name(f"{out.stem}.partial{out.suffix}")
    with only_writer(out.with_name(f".{out.name}.lock"), f"computes {out}"):
        for path in out.parent.glob(f".{escape(out.stem)}.*.partial.*"):
            path.unlink(missing_ok=True)  # of a killed call
        statistics = job
        for path in filter(Path.exists, (partial, out)):
            try:
                stored = ReferenceStatistics.load(path)
                for key in ("protocol", "spaces", "names", "about"):
                    its, wanted = getattr(stored, key), getattr(job, key)
                    if its != wanted:
                        differ = "; ".join(differences(its, wanted, key))
                        raise ValueError(
                            f"{path} is of another job ({differ}): repeat that command to "
                            "complete it, delete the file to start anew, or give another --out"
                        )
                statistics = stored
            except ValueError as error:
                if not renew:
                    raise
                _log.warning("computed anew: %s", error)
                path.unlink()
        if not (statistics.complete and out.exists()):
            start, total = statistics.num_done, len(statistics.names)
            scans = scans_from(start)
            scenes = tqdm(scans, "reference", total, initial=start, unit="scan", disable=None)
            statistics.update(scenes, spaces, partial)
            statistics.save(out)
            partial.unlink(missing_ok=True)
        return statistics


def cards_of(spaces: Iterable[SceneFeatures]) -> dict[str, dict[str, Any]]:
    """Return the cards of feature spaces by name, as a reference file stores them."""
    return {space.name: {**space.card, "dim": space.dim, "label": space.label} for space in spaces}


def split_halves(names: Sequence[str]) -> dict[str, int]:
    """Assign each scan to half 0 or 1, by whole drives: the part of its name before the last ``/``.

    Neighbouring scans of a drive are alike, so a drive in both halves would make the floors too
    low. Drives go to the smaller half, the largest first; a drive with over two thirds of all scans
    is divided so that both halves have equally many.
    """
    drives: dict[str, list[str]] = {}
    for name in sorted(names):
        drives.setdefault(name.rpartition("/")[0], []).append(name)
    halves: tuple[list[str], list[str]] = ([], [])
    for _, scans in sorted(drives.items(), key=lambda item: (-len(item[1]), item[0])):
        min(halves, key=len).extend(scans)
    larger, smaller = sorted(halves, key=len, reverse=True)
    if len(larger) > 2 * len(smaller):  # only if it is a single drive: the others are no larger
        cut = (len(names) + 1) // 2
        smaller.extend(larger[cut:])
        del larger[cut:]
    return {name: half for half, scans in enumerate(halves) for name in scans}


def limits_of_halves(limit: int, sizes: tuple[int, int]) -> tuple[int, int]:
    """Divide ``limit`` scans between halves: equally, unless the second half lacks some."""
    first = min(sizes[0], max((limit + 1) // 2, limit - sizes[1]))
    return first, min(sizes[1], limit - first)
