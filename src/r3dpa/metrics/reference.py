"""What samples are compared with: statistics of real scans, computed once and kept in one file."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Self

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from r3dpa.io import UNPICKLING_ERRORS, atomic_path, first_line, refuse_name
from r3dpa.metrics.functional import Moments
from r3dpa.metrics.protocol import Protocol
from r3dpa.metrics.scene import EvaluationScene
from r3dpa.metrics.scene_features import SceneFeatures
from r3dpa.metrics.scene_set import SceneSet, add_scenes, usable_scenes

_ABOUT = "r3dpa_reference"  # key of the file's metadata
_VERSION = 2


class ReferenceStatistics:
    """Statistics of real scans, in two halves whose distance is the floor of every metric.

    The halves are of different drives where there are several (see :func:`split_halves`), since
    neighbouring scans of a drive are alike.

    Args:
        protocol: How scans are prepared.
        spaces: Cards of the feature spaces by name; each also holds ``dim`` and ``label``.
        names: Names of all scans, in their order.
        about: What a reader must know, such as ``data``, ``split`` and ``commit``.

    Attributes:
        halves: The two sets; features of up to ``num_samples`` scans and images of up to
            ``num_mmd_references`` are kept, half of them in each, or more in one where the other
            has fewer scans.
        num_done: Scans counted in so far; all of them once complete.

    Raises:
        ValueError: If there are fewer than two scans, or a name occurs twice.
    """

    def __init__(
        self,
        protocol: Protocol,
        spaces: dict[str, dict[str, Any]],
        names: Sequence[str],
        about: dict[str, Any],
    ) -> None:
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice or len(names) < 2:
            raise ValueError(
                f"a reference needs at least 2 scans with names of their own, got {len(names)}"
                + (f"; given twice: {', '.join(twice[:5])}" if twice else "")
            )
        self.protocol, self.spaces, self.about = protocol, spaces, about
        self.names, self._half_of = tuple(names), split_halves(names)
        self.num_done = 0
        widths = {name: card["dim"] for name, card in spaces.items()}
        in_first = sum(half == 0 for half in self._half_of.values())
        sizes = (in_first, len(names) - in_first)
        limits = [
            _kept_of_halves(limit, sizes)
            for limit in (protocol.num_samples, protocol.num_mmd_references)
        ]
        self.halves = tuple(
            SceneSet(protocol, widths, *of_half) for of_half in zip(*limits, strict=True)
        )

    @classmethod
    def prepare(
        cls,
        spaces: Sequence[SceneFeatures],
        protocol: Protocol,
        names: Sequence[str],
        about: dict[str, Any],
    ) -> Self:
        """Empty statistics of these scans; the arguments are those of the class."""
        return cls(protocol, {space.name: space_card(space) for space in spaces}, names, about)

    @property
    def complete(self) -> bool:
        """Whether every scan was counted in."""
        return self.num_done == len(self.names)

    def check_complete(self) -> None:
        """Refuses statistics that lack scans.

        Raises:
            ValueError: Telling how many are there.
        """
        if not self.complete:
            raise ValueError(
                f"the reference holds {self.num_done} of {len(self.names)} scans; repeat its "
                "command to complete it"
            )

    @property
    def whole(self) -> SceneSet:
        """Both halves together."""
        return self.halves[0].merge(self.halves[1])

    def describe(self) -> str:
        """Split, count and hash of the names, in one line."""
        digest = hashlib.sha256("\n".join(self.names).encode()).hexdigest()[:12]
        parts = [str(self.about[key]) for key in ("data", "split") if self.about.get(key)]
        return ", ".join([*parts, f"{len(self.names)} scans", f"names {digest}"])

    def update(
        self,
        scenes: Iterable[EvaluationScene],
        spaces: Sequence[SceneFeatures],
        partial: Path | None = None,
        every: int = 2000,
        batch_size: int = 8,
    ) -> None:
        """Count in all scans that are missing.

        Args:
            scenes: The scans ``names[num_done:]``, in that order.
            spaces: Those that the statistics were prepared for.
            partial: File to save to after every ``every`` scans, so that the work can be resumed.
            every: Rounded up to whole batches. Interrupted and resumed at such a point, the
                statistics are the same to the last bit.
            batch_size: Scans per pass of a network.

        Raises:
            ValueError: If a scan is not the next one, there are too few, or one cannot be used;
                the message names it.
        """
        check_spaces(self.spaces, spaces)
        every = -(-every // batch_size) * batch_size
        seen = usable_scenes(scenes, self.protocol)
        for batch, features in add_scenes(seen, spaces, batch_size):
            expected = self.names[self.num_done : self.num_done + len(batch)]
            if tuple(scene.name for scene in batch) != expected:
                raise ValueError(
                    f"the scans from number {self.num_done} on are {[s.name for s in batch]}, but "
                    f"{list(expected)} were announced: give them in the order of their names"
                )
            for index, part in enumerate(self.halves):
                own = [i for i, name in enumerate(expected) if self._half_of[name] == index]
                part.add(
                    [batch[i] for i in own],
                    {name: values[own] for name, values in features.items()},
                )
            self.num_done += len(batch)
            if partial is not None and self.num_done % every == 0 and not self.complete:
                self.save(partial)
        if not self.complete:
            raise ValueError(f"got {self.num_done} of {len(self.names)} scans; give all of them")

    def save(self, path: str | Path) -> None:
        """Writes everything to one ``.safetensors`` file, its card in the metadata."""
        tensors: dict[str, Tensor] = {}
        chosen = []
        for index, part in enumerate(self.halves):
            rows, images = part.rows.items(), part.images.items()
            chosen.append({"rows": [r[:2] for r in rows], "images": [i[:2] for i in images]})
            tensors |= {f"{index}.moments.{s}": m.pack() for s, m in part.moments.items()}
            tensors |= {f"{index}.features.{s}": part.features(s) for s in part.widths}
            sensor = self.protocol.sensor
            stack = torch.zeros(len(images), sensor.beams, sensor.columns)
            for place, (_, _, image) in enumerate(images):
                stack[place] = image
            tensors[f"{index}.images"] = stack
            occupied = part.cells[0].nonzero()[:, 0]
            tensors[f"{index}.cells"] = occupied.int()
            tensors[f"{index}.cell_counts"] = part.cells[0, occupied]
            tensors[f"{index}.ranges"] = part.ranges
        card = {
            "version": _VERSION,
            "protocol": self.protocol.to_dict(),
            "spaces": self.spaces,
            "names": self.names,
            "about": self.about,
            "num_done": self.num_done,
            "counts": [part.count for part in self.halves],
            "chosen": chosen,
        }
        with atomic_path(path) as temporary:
            save_file(
                {name: tensor.contiguous() for name, tensor in tensors.items()},
                temporary,
                metadata={_ABOUT: json.dumps(card)},
            )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Reads what ``save`` wrote, complete or not.

        Raises:
            ValueError: If the file is missing, damaged or of something else; it is named.
        """
        try:
            with safe_open(path, framework="pt") as file:
                card = json.loads(file.metadata()[_ABOUT])
                tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - no dict
            if card["version"] != _VERSION:
                raise ValueError(f"is of version {card['version']}, this is {_VERSION}")
            protocol = Protocol.from_dict(card["protocol"])
            if refused := [why for why in map(refuse_name, card["names"]) if why]:
                raise ValueError(f"name of a scan {refused[0]}")
            reference = cls(protocol, card["spaces"], card["names"], card["about"])
            reference.num_done = card["num_done"]
            for index, part in enumerate(reference.halves):
                _fill(part, tensors, index, card)
        except (*UNPICKLING_ERRORS, SafetensorError) as error:
            raise ValueError(
                f"{path} holds no reference statistics ({first_line(error)}): give the "
                "file that `r3dpa reference` wrote"
            ) from error
        return reference


def _fill(part: SceneSet, tensors: dict[str, Tensor], index: int, card: dict[str, Any]) -> None:
    """Statistics of one half from a file."""

    def tensor(key: str, *shape: int) -> Tensor:
        found = tensors.get(f"{index}.{key}")
        if found is None or found.shape != shape:
            given = "is missing" if found is None else f"has shape {tuple(found.shape)}"
            raise ValueError(f"tensor {index}.{key} {given}, expected {shape}")
        return found

    chosen, sensor = card["chosen"][index], part.protocol.sensor
    rows, images = chosen["rows"], chosen["images"]
    part.count = card["counts"][index]
    part.moments = {
        space: Moments.unpack(tensor(f"moments.{space}", 1 + width + width**2))
        for space, width in part.widths.items()
    }
    features = {s: tensor(f"features.{s}", len(rows), width) for s, width in part.widths.items()}
    for row, (name, place) in enumerate(rows):
        part.rows.offer(name, place, {space: values[row] for space, values in features.items()})
    stack = tensor("images", len(images), sensor.beams, sensor.columns)
    for row, (name, place) in enumerate(images):
        part.images.offer(name, place, stack[row])
    occupied = len(tensors.get(f"{index}.cells", ()))
    part.cells[0, tensor("cells", occupied).long()] = tensor("cell_counts", occupied)
    part.ranges = tensor("ranges", *part.ranges.shape)


def resume_or_start(reference: ReferenceStatistics, partial: Path) -> ReferenceStatistics:
    """What an interrupted job has saved, or the empty statistics where there is nothing.

    Args:
        reference: Empty statistics of the job.
        partial: Its file for partial results.

    Raises:
        ValueError: If the file is of another job.
    """
    if not partial.exists():
        return reference
    stored = ReferenceStatistics.load(partial)
    for key in ("protocol", "spaces", "names", "about"):
        if getattr(stored, key) != getattr(reference, key):
            raise ValueError(
                f"{partial} is of another job: its {key} differ. Repeat that command to complete "
                "it, delete the file to start anew, or give another --out"
            )
    return stored


def space_card(space: SceneFeatures) -> dict[str, Any]:
    """Card of a space with its width and label."""
    return {**space.card, "dim": space.dim, "label": space.label}


def check_spaces(stored: dict[str, dict[str, Any]], spaces: Sequence[SceneFeatures]) -> None:
    """Refuses spaces that a reference lacks or that were made with something else.

    Raises:
        ValueError: Naming the space and the fields that differ.
    """
    for space in spaces:
        if space.name not in stored:
            raise ValueError(
                f"the reference has no features of {space.name}, only of "
                f"{', '.join(stored) or 'none'}: choose among these, or compute it again"
            )
        theirs, own = stored[space.name], space_card(space)
        differing = [key for key in {**theirs, **own} if theirs.get(key) != own.get(key)]
        if differing:
            given = ", ".join(f"{key} {own.get(key)} not {theirs.get(key)}" for key in differing)
            raise ValueError(
                f"{space.name} is not that of the reference: {given}. Give the same weights and "
                "protocol, or compute the reference again"
            )


def split_halves(names: Sequence[str]) -> dict[str, int]:
    """Half, 0 or 1, of each scan: whole drives, as long as no half has over two thirds of them all.

    The drive of a scan is what its name has before the last ``/``. Drives go to the smaller half,
    the largest first. A single drive, or one with over two thirds of all scans, is divided: its
    start makes one half, and its end goes to the other, so that both have equally many.

    Args:
        names: ``drive/frame`` of each scan.
    """
    drives: dict[str, list[str]] = {}
    for name in sorted(names):
        drives.setdefault(name.rpartition("/")[0], []).append(name)
    halves: tuple[list[str], list[str]] = ([], [])
    for _, scans in sorted(drives.items(), key=lambda item: (-len(item[1]), item[0])):
        min(halves, key=len).extend(scans)
    larger, smaller = sorted(halves, key=len, reverse=True)
    if len(larger) > 2 * len(smaller):  # only if it is a single drive: the others are no larger
        cut = -(-len(names) // 2)
        smaller.extend(larger[cut:])
        del larger[cut:]
    return {name: half for half, scans in enumerate(halves) for name in scans}


def _kept_of_halves(limit: int, sizes: tuple[int, int]) -> tuple[int, int]:
    """Scans that each half of so many keeps: half the limit, and what the other half lacks."""
    first = min(sizes[0], max(-(-limit // 2), limit - sizes[1]))
    return first, min(sizes[1], limit - first)
