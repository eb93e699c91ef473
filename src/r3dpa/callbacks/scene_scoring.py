"""Scenes sampled after a test run and compared with real scans."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import lightning as L
from jsonargparse.typing import NonNegativeInt, PositiveInt
from lightning.pytorch.utilities import rank_zero_info
from safetensors.torch import load_file, save_file
from tqdm import tqdm

from r3dpa.data import Scan
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.feature_names import DEFAULT_SPACES
from r3dpa.generation import SamplerConfig
from r3dpa.geometry import points_of
from r3dpa.io import atomic_path, source_commit
from r3dpa.metrics.evaluation import (
    AnyReference,
    TooFewScenesError,
    check_counts,
    evaluate,
    feature_spaces,
    load_reference,
    reference_spaces,
)
from r3dpa.metrics.reference import ReferenceStatistics, cards_of, compute_reference
from r3dpa.metrics.results import report, save_reports
from r3dpa.metrics.scene import PROTOCOLS, EvaluationScene
from r3dpa.metrics.scene_features import SceneFeatures
from r3dpa.viz.evaluation import save_figures

if TYPE_CHECKING:
    from r3dpa.baselines import Baseline
    from r3dpa.modules import GenerativeModule

_SAMPLER = SamplerConfig()


class SceneScorer(L.Callback):
    """Samples scenes after a test run and compares them with real scans.

    All processes sample, in batches that do not depend on their number; the first one compares. It
    prints the table of ``r3dpa evaluate``, logs its numbers as ``test/<metric>`` and writes them
    with tables and figures to ``<run_dir>/evaluation``, which must be visible to all processes.
    Nothing is sampled in a stage that trains no velocity.

    Args:
        num_scenes: Number of scenes, larger than the number of features; 0 samples none.
        batch_size: Scenes sampled together.
        sampler: Solver and steps.
        precision: Precision of the networks that sample.
        seed: Seed of the scenes, see :class:`SceneGenerator`.
        reference: File of ``r3dpa data reference``, or R3DPA's own ``data_statistics.npy``. Without
            it, all ``scans`` of the data module are the reference, training and held-out, but not
            ``further_scans``; their statistics are computed once and kept in
            ``<run_dir>/evaluation/reference.safetensors``.
        split: Split of ``data_statistics.npy``; default: ``val``, if it holds both.
        spaces: Feature spaces; default: all of the reference file that need no weights or have
            them in ``ckpt``; without a reference file ``fwid``, ``fgeo`` and those in ``ckpt``.
        ckpt: Official weights by space.
        protocol: ``default`` or ``published``; default: as recorded in the reference file, else
            ``default``.
        allow_few: Accept fewer scenes than features; for trying out only.
        skip_bad: Leave out and report unusable scenes, such as scenes without a return; otherwise
            the first one ends the test.
    """

    def __init__(
        self,
        num_scenes: NonNegativeInt = 256,
        batch_size: PositiveInt = 8,
        sampler: SamplerConfig = _SAMPLER,
        precision: Literal["fp32", "bf16"] = "fp32",
        seed: NonNegativeInt = 0,
        reference: str | None = None,
        split: Literal["val", "all"] | None = None,
        spaces: list[str] | None = None,
        ckpt: dict[str, str] | None = None,
        protocol: Literal["default", "published"] | None = None,
        allow_few: bool = False,
        skip_bad: bool = True,
    ) -> None:
        if split is not None and reference is None:
            raise ValueError(
                f"scorer.split {split} selects a part of scorer.reference, which is not given: "
                "leave it out"
            )
        self.num_scenes, self.batch_size, self.seed = num_scenes, batch_size, seed
        self.sampler, self.precision = sampler, precision
        self.reference, self.split, self.protocol = reference, split, protocol
        self.spaces, self.ckpt = spaces, ckpt or {}
        self.allow_few, self.skip_bad = allow_few, skip_bad
        self._job: tuple[AnyReference, list[SceneFeatures], list[Scan]] | None = None

    def on_test_start(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Check all that can be checked before scenes are sampled."""
        self._job = None
        if not hasattr(pl_module, "scene_generator") or not self.num_scenes:
            return
        if pl_module.ema is None:
            rank_zero_info(f"stage {pl_module.stage} has nothing to sample: no scenes are scored")
            return
        device = str(pl_module.device)
        statistics: AnyReference
        scans: list[Scan] = []
        if self.reference is not None:
            statistics = load_reference(Path(self.reference), self.split)
            spaces = reference_spaces(statistics, self.spaces, self.ckpt, device, self.protocol)
        else:
            datamodule = getattr(trainer, "datamodule", None)
            if not isinstance(datamodule, LidarDataModule) or not hasattr(datamodule, "all_set"):
                raise ValueError(
                    f"scorer.reference: {type(datamodule).__name__} does not list its scans: give "
                    "a file of `r3dpa data reference`, or --scorer.num_scenes 0 to score no scenes"
                )
            scans = datamodule.without_further(datamodule.all_set.scans)
            setting = replace(PROTOCOLS[self.protocol or "default"], sensor=datamodule.sensor)
            names = tuple(dict.fromkeys((*DEFAULT_SPACES, *self.ckpt)))
            spaces = feature_spaces(self.spaces or names, self.ckpt, setting, device)
            about = {
                "data": str(datamodule.scans),
                "split": "all",
                "dataset": datamodule.dataset,
                "scans_sha256": _stamp(scans),  # names may stay
                "commit": source_commit(),
            }
            scan_names = [scan.name for scan in scans]
            statistics = ReferenceStatistics(setting, cards_of(spaces), scan_names, about)
        check_counts(self.num_scenes, statistics, spaces, self.allow_few)
        self._job = (statistics, spaces, scans)

    def on_test_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        """Sample scenes and compare them with real scans."""
        if self._job is None:
            return
        statistics, spaces, scans = self._job
        self._job = None
        folder = Path(trainer.default_root_dir) / "evaluation"
        nfe = self._sample(trainer, pl_module, folder)
        trainer.strategy.barrier("SceneScorer")
        if not trainer.is_global_zero:
            return
        if isinstance(statistics, ReferenceStatistics) and not statistics.complete:
            path = folder / "reference.safetensors"
            datamodule = cast(Any, trainer).datamodule

            def scans_from(start: int) -> Iterator[EvaluationScene]:
                for scan in scans[start:]:
                    yield EvaluationScene(scan.name, datamodule.points(scan))

            statistics = compute_reference(statistics, scans_from, spaces, path, renew=True)
        try:
            comparison = evaluate(
                self._read_scenes(pl_module, folder, statistics),
                statistics,
                spaces,
                label=folder.absolute().parent.name,
                source=str(trainer.ckpt_path),
                made_with=self._made_with(trainer, pl_module, nfe),
                allow_few=True,  # checked before; scenes left out later are listed
                skip_bad=self.skip_bad,
            )
        except TooFewScenesError as error:  # the losses of the test are still to be printed
            trainer.print(f"nothing is compared with real scans: {error}; see {folder / 'sampled'}")
            return
        shutil.rmtree(folder / "sampled")
        evaluation = comparison.evaluation
        save_reports(evaluation, statistics.about, folder)
        if comparison.figures:
            save_figures(folder, **comparison.figures)
        trainer.print(report(evaluation, statistics.about))
        values = {
            f"test/{row.name.replace(' ', '_')}": row.value
            for row in evaluation.rows
            if row.value is not None
        }
        for logger in trainer.loggers:
            logger.log_metrics(values, trainer.global_step or pl_module.loaded_step)
            logger.save()

    def _sample(self, trainer: L.Trainer, module: GenerativeModule | Baseline, folder: Path) -> int:
        """Write the batches of this process; network evaluations per scene, 0 without any."""
        assert module.ema is not None
        generator = module.scene_generator(self.sampler, self.precision)
        batches = range(0, self.num_scenes, self.batch_size)
        batches = batches[trainer.global_rank :: trainer.world_size]
        quiet = None if trainer.is_global_zero else True
        nfe = 0
        for first in tqdm(batches, "sampling", unit="batch", disable=quiet):
            indices = range(first, min(first + self.batch_size, self.num_scenes))
            scenes = generator.generate(indices, self.seed)
            nfe = scenes.nfe
            images = {"range_m": scenes.range_m, "intensity": scenes.intensity}
            tensors = {name: x.cpu().contiguous() for name, x in images.items() if x is not None}
            with atomic_path(_part(folder, first)) as temporary:
                save_file(tensors, temporary)
        return nfe

    def _made_with(
        self, trainer: L.Trainer, module: GenerativeModule | Baseline, nfe: int
    ) -> dict[str, Any]:
        return {
            "solver": self.sampler.solver,
            "steps": self.sampler.steps,
            "seed": self.seed,
            "precision": self.precision,
            "feature_source": module.feature_source,
            "checkpoint": str(trainer.ckpt_path),
            "stage": module.stage,
            "step": trainer.global_step or module.loaded_step,
            "weights": "ema",
            "nfe": nfe,
            "sampler": asdict(self.sampler),
        }

    def _read_scenes(
        self, module: GenerativeModule | Baseline, folder: Path, statistics: AnyReference
    ) -> Iterator[EvaluationScene]:
        """Scenes of all processes, in order; as points where the reference has other pixels."""
        projection = module.scan_geometry.projection
        for first in range(0, self.num_scenes, self.batch_size):
            tensors = load_file(_part(folder, first))
            intensities = tensors.get("intensity", [None] * len(tensors["range_m"]))
            images = zip(tensors["range_m"], intensities, strict=True)
            for index, (range_m, intensity) in enumerate(images, first):
                name = f"{index:06d}"
                if projection == statistics.protocol.projection:
                    yield EvaluationScene(name, None, range_m, intensity)
                else:
                    points = points_of(range_m, projection, intensity=intensity)
                    yield EvaluationScene(name, points)


def _stamp(scans: Sequence[Scan]) -> str:
    """Hash of names, sizes and modification times, which changes when a scan is replaced."""
    stats = [(scan.name, scan.path.stat()) for scan in scans]
    keys = [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats]
    return hashlib.sha256(repr(keys).encode()).hexdigest()


def _part(folder: Path, first: int) -> Path:
    return folder / "sampled" / f"{first:06d}.safetensors"
