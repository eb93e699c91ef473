"""Lightning data modules: scans in, :class:`LidarBatch` out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import torch
from lightning.pytorch.utilities.rank_zero import rank_zero_info
from torch import Tensor, nn
from torch.utils.data import DataLoader

from lidarsim import TRAIN_DRIVES, VAL_DRIVES, simulate, split_scans
from lidarsim.drive_files import drive_name
from lidarsim.scene import Conditions
from lidarsim.weather import WeatherPrior
from r3dpa.data.augmentation import Augmentation, AugmentedDataset
from r3dpa.data.datasets import CachedImages, LidarDataset
from r3dpa.data.feature_grids import (
    Extractor,
    FeatureGrids,
    any_settings,
    default_features_dir,
    write_feature_grids,
)
from r3dpa.data.loader_module import LoaderModule
from r3dpa.data.loaders import at_least
from r3dpa.data.scans import Scan, evenly, find_scans, kitti360_scans
from r3dpa.data.store import CachedTensors
from r3dpa.geometry import (
    BeamProjection,
    LidarSensor,
    Projection,
    RangeCodec,
    RingProjection,
    ScanGeometry,
    SphericalProjection,
    describe_share_kept,
)

_SENSOR = LidarSensor()
_CODEC = RangeCodec()
_AUGMENTATION = Augmentation()
_SCALR_DIM = 768  # width of the published feature grids
_COLUMNS = 1024  # of the images of named sensors
_SCANS_TO_FIT = 8  # scans that the ring inclinations are measured in
_SCANS_TO_CHECK = 3  # of whose points the share in the image is printed
_EMPTY_SPLIT = (
    "all scans are of the other split. Look at val_every and val_drives, or, in the KITTI-360 "
    "layout, for missing drives with `r3dpa data check`"
)


class LidarDataModule(LoaderModule):
    """Scans of a folder, file, glob, or list of these, as :class:`LidarBatch`.

    Validation and test use the held-out scans, prediction all scans in order. Only training scans
    are augmented, and not under ``overfit_batches``. Their order and augmentation depend on
    ``seed`` and the epoch alone; a resumed run goes on with the very next batch.

    Args:
        scans: Folder (searched with its sub-folders), ``.bin`` file, glob, or list of these.
        sensor: Image size, field of view and range limits; or a preset of ``r3dpa data sensors``
            or a YAML of ``r3dpa data sensor``, which gives all of them but the columns.
        image_columns: Columns of the images of a ``sensor`` given by its name or file, 1024 by
            default.
        projection: ``"spherical"``: rows of equal pitch; ``"rings"``: one row per laser, for scans
            stored ring after ring, at inclinations measured in the first training scans;
            ``"beams"``: one row per beam of a named sensor, for which it is the default, and empty
            rows up to a multiple of 16, for scans in any order.
        codec: Metres to [-1, 1], by default up to the largest range of the sensor. With
            ``num_classes`` every scan needs labels, see :func:`r3dpa.data.labels.read_labels`.
        grid_size: Rows and columns (h, w) of the feature grid.
        extractor: Frozen network, see :class:`r3dpa.data.Extractor`; makes the grids that are
            missing before training. Without it, ``features_dir`` must hold all of them.
        features_dir: Folder of the feature grids of one extractor, of any grid sizes; by default
            from :func:`default_features_dir`. No grids without folder and extractor.
        batch_size: Scans per batch **per process**; an optimiser step sees ``batch_size`` x
            processes x ``accumulate_grad_batches`` scans.
        num_workers: Loader processes per training process.
        seed: Seed of the order of training scans and of their augmentation.
        val_every: Hold out every n-th scan; None for no validation split. Neighbours in a recording
            look alike: hold out whole recordings by ``val_drives`` for an honest score.
        val_drives: Folders, relative to the root, that are held out whole; replaces ``val_every``.
        further_scans: Scans to train on beside ``scans``, such as simulated ones; none of
            them is held out. Folder, file or glob; their columns are detected.
        repeats: How often a training scan of ``scans`` occurs per epoch beside ``further_scans``.
        limit: Maximum scans per split, evenly spaced.
        columns: Columns of files without names, such as ``x,y,z,intensity,time``; default: inferred
            from the values.
        prepare_data_per_node: Whether one process of each node prepares the data, as node-local
            disks need; by default one process of all does, for a disk that the nodes share.
        augmentation: Rotation and mirroring of training scans; none by default.
        weather: Weather of training scans, drawn anew in each epoch; none by default. Feature grids
            stay as for the clear scans, which ``augmentation.approximate_grids`` must allow.
    """

    #: Whether the folder of scans is the data module's own, which may hold the feature grids too.
    makes_scans = False
    # Also of subclasses that make their batches without __init__.
    augmentation = _AUGMENTATION
    weather_prior: WeatherPrior | None = None

    def __init__(
        self,
        scans: str | list[str],
        sensor: LidarSensor | str = _SENSOR,
        projection: Literal["spherical", "rings", "beams"] | None = None,
        codec: RangeCodec = _CODEC,
        grid_size: tuple[int, int] = (8, 64),
        extractor: nn.Module | None = None,
        features_dir: str | None = None,
        batch_size: int = 8,
        num_workers: int = 0,
        seed: int = 0,
        val_every: int | None = 10,
        val_drives: list[str] | None = None,
        limit: int | None = None,
        columns: str | list[str] | None = None,
        prepare_data_per_node: bool = False,
        augmentation: Augmentation = _AUGMENTATION,
        weather: WeatherPrior | None = None,
        image_columns: int | None = None,
        further_scans: str | None = None,
        repeats: int = 1,
    ) -> None:
        super().__init__(batch_size, num_workers, seed)
        self.prepare_data_per_node = prepare_data_per_node
        at_least(2, val_every=val_every)
        at_least(1, limit=limit, image_columns=image_columns, repeats=repeats)
        if repeats > 1 and further_scans is None:
            raise ValueError(
                f"repeats {repeats} counts beside further_scans, of which there are none: leave it "
                "out, or name them"
            )
        self.scans, self.further_scans, self.repeats = scans, further_scans, repeats
        self.beams: BeamProjection | None = None
        if isinstance(sensor, str):
            self.beams = BeamProjection.for_networks(sensor, image_columns or _COLUMNS)
            sensor = self.beams.sensor
        elif image_columns is not None or projection == "beams":
            raise ValueError(
                "image_columns and projection: beams need a sensor given as a preset of `r3dpa "
                "data sensors` or a YAML of `r3dpa data sensor`"
            )
        if not isinstance(sensor, LidarSensor):
            raise ValueError(
                "sensor must be a LidarSensor (image size, field of view and range limits), a "
                f"preset or a YAML file, got {sensor!r}"
            )
        self.sensor = sensor
        self.columns = tuple(columns.split(",") if isinstance(columns, str) else columns or ())
        self.codec = codec.reaching(self.sensor.range_max_m)
        self.projection_kind = projection or ("spherical" if self.beams is None else "beams")
        self.grid_size = (grid_size[0], grid_size[1])
        self.extractor = extractor
        self.features_dir = self._find_features_dir(features_dir)
        self.val_every, self.val_drives, self.limit = val_every, val_drives, limit
        self.augmentation = augmentation
        if self.features_dir is not None:
            augmentation.check_extractor(extractor, self.grid_size[1])
        self.weather_prior = weather
        if weather is not None and self.projection_kind == "rings":
            raise ValueError(
                "weather adds points at the end of a scan, which then has no order of rings: use "
                "projection: spherical"
            )
        if weather is not None and codec.num_classes:
            raise ValueError(
                "weather: the labels of codec.num_classes belong to the clear scans. Switch one "
                "of them off"
            )
        with_grids = self.features_dir is not None and not augmentation.approximate_grids
        if weather is not None and with_grids:
            raise ValueError(
                "weather: the feature grids belong to the clear scans. Train without them, or "
                "on these with augmentation.approximate_grids: true"
            )

    @property
    def feature_dim(self) -> int:
        """Width D of the feature grids; 768, as in ScaLR, where none are used."""
        if self.extractor is not None:
            return cast(Extractor, self.extractor).dim
        return _SCALR_DIM if self.features_dir is None else any_settings(self.features_dir).dim

    @property
    def feature_source(self) -> str | None:
        """Name of the extractor of the feature grids; None where none are used."""
        if self.extractor is not None or self.features_dir is None:
            return getattr(self.extractor, "name", None)
        return str(any_settings(self.features_dir).extractor["name"])

    @property
    def images(self) -> CachedImages | None:
        """Cached images of the scans; None where these are read from their files."""
        return None

    @property
    def dataset(self) -> str | None:
        """Name of the published data set that the scans come from; None for others."""
        return None

    @property
    def geometry(self) -> ScanGeometry:
        """Projection, codec and grid size, known after ``setup``."""
        return ScanGeometry(self.projection, self.codec, self.grid_size)

    def split(self) -> tuple[list[Scan], list[Scan]]:
        """Training and held-out scans, each sorted, before ``limit``.

        Raises:
            ValueError: If there is no scan, or ``val_drives`` names a folder without one.
        """
        scans = find_scans(self.scans, self.columns)
        if self.val_drives:
            drives = {scan.drive for scan in scans}
            if unknown := set(self.val_drives) - drives:
                raise ValueError(
                    f"val_drives names {sorted(unknown)}, but the scans are of {sorted(drives)}"
                )
            held_out = {scan for scan in scans if scan.drive in self.val_drives}
        else:
            held_out = set(scans[:: self.val_every] if self.val_every else [])
        train = [scan for scan in scans if scan not in held_out]
        if self.further_scans is not None:
            further = find_scans(self.further_scans)
            if both := sorted({scan.path for scan in scans} & {scan.path for scan in further}):
                raise ValueError(
                    f"further_scans names {both[0]}, which is one of scans too: a held-out scan "
                    "would be trained on. Name other scans"
                )
            train = self.repeats * train + further
        return train, sorted(held_out)

    def limited_split(self) -> tuple[list[Scan], list[Scan]]:
        """Training and held-out scans within ``limit``."""
        train, val = self.split()
        return evenly(train, self.limit), evenly(val, self.limit)

    def without_further(self, scans: list[Scan]) -> list[Scan]:
        """Scans that a reference may hold: all but ``further_scans``."""
        further = set() if self.further_scans is None else set(find_scans(self.further_scans))
        return [scan for scan in scans if scan not in further]

    def points(self, scan: Scan) -> Tensor:
        """Points ``(P, 3)`` or ``(P, 4)`` of one of the scans, metres and intensity."""
        return torch.from_numpy(scan.read(self.sensor))

    def prepare_data(self) -> None:
        """Make the missing feature grids, except to predict."""
        predicting = self.trainer is not None and self.trainer.predicting
        if predicting or self.features_dir is None or self.extractor is None:
            return
        train, val, projection = self._scans_and_projection()
        extractor = cast(Extractor, self.extractor.eval())
        num_made = write_feature_grids(
            train + val,
            extractor,
            projection,
            [self.grid_size],
            self.features_dir,
            workers=self.num_workers,
            images=self.images,
        )
        rank_zero_info(f"feature grids: {num_made} made, in {self.features_dir}")

    def setup(self, stage: str) -> None:
        """Index the scans; open the store of feature grids, except to predict.

        Before training, the share of the points that the images hold is printed.
        """
        train, val, self.projection = self._scans_and_projection()
        scans = sorted({*train, *val})  # a scan may be repeated in training
        grids: FeatureGrids | None = None
        if stage == "fit" and scans and not self.makes_scans:
            # Held-out scans are none of further_scans.
            checked = evenly(val or train, _SCANS_TO_CHECK)
            points = [self.points(scan)[:, :3] for scan in checked]
            rank_zero_info(describe_share_kept(points, self.projection))
        if self.features_dir is not None and stage != "predict":
            extractor = cast(Extractor | None, self.extractor)
            grids = FeatureGrids(
                self.features_dir, scans, self.projection, self.grid_size, extractor
            )
        self.train_set, self.val_set, self.all_set = (
            LidarDataset(split, self.projection, self.codec, grids, images=self.images)
            for split in (train, val, scans)
        )

    def check_posteriors(self) -> None:
        """Refuse weather, which cached posteriors of a VAE cannot follow."""
        if self.weather_prior is not None:
            raise ValueError(
                "weather: cached posteriors belong to the clear scans. Switch it off, or encode "
                "in each step: --model.init_args.cache_latents false"
            )

    def use_posteriors(self, posteriors: CachedTensors) -> None:
        """Train on cached posteriors ``(2C, h, w)`` of a frozen VAE."""
        self.check_posteriors()
        self.train_set = replace(self.train_set, posteriors=posteriors)

    def train_dataloader(self) -> DataLoader[Any]:
        """Shuffled, resumable loader of full batches; in order under ``overfit_batches``."""
        dataset = self.train_set
        if not len(dataset):
            raise ValueError(f"no scan to train on in {self.scans}: {_EMPTY_SPLIT}")
        if self.overfits or (not self.augmentation.active and self.weather_prior is None):
            return self.loader(dataset, train=True)
        drawn = AugmentedDataset(
            dataset, self.augmentation, self.seed, self.grid_size[1], self.weather_prior
        )
        return self.loader(drawn, train=True, with_epoch=True)

    def val_dataloader(self) -> DataLoader[Any] | list[DataLoader[Any]]:
        """Held-out scans in order, none twice; no loader in a fit where nothing is held out."""
        if len(self.val_set):
            return self.loader(self.val_set, train=False)
        if self.trainer is not None and self.trainer.state.fn in ("validate", "test"):
            raise ValueError(f"no held-out scan in {self.scans}: {_EMPTY_SPLIT}")
        return []

    test_dataloader = val_dataloader

    def predict_dataloader(self) -> DataLoader[Any]:
        """All scans in order, none twice."""
        return self.loader(self.all_set, train=False)

    @property
    def known_projection(self) -> Projection:
        """Projection of the sensor, unless scans are needed for it."""
        if self.projection_kind == "beams" and self.beams is not None:
            return self.beams
        return SphericalProjection(self.sensor)

    def _find_features_dir(self, features_dir: str | None) -> Path | None:
        if features_dir is not None:
            return Path(features_dir)
        if self.extractor is None:
            return None
        name = cast(Extractor, self.extractor).name
        if self.makes_scans:
            return Path(cast(str, self.scans)) / "feature_grids" / name
        return default_features_dir(self.scans, name)

    def _scans_and_projection(self) -> tuple[list[Scan], list[Scan], Projection]:
        """:meth:`limited_split`, and the projection; rings are fitted to the first scans of all."""
        train, val = self.split()
        projection = self.known_projection
        if self.projection_kind == "rings":
            first = (train or val)[:_SCANS_TO_FIT]
            points = (torch.from_numpy(scan.read(self.sensor)[:, :3]) for scan in first)
            projection = RingProjection.fit(points, self.sensor)
        return evenly(train, self.limit), evenly(val, self.limit), projection


class KITTI360DataModule(LidarDataModule):
    """KITTI-360 with the split of R2DM and RangeLDM: drives 0 and 2 are held out.

    Only ``data_3d_raw`` is needed.

    Args:
        root: Folder that holds ``data_3d_raw``.
        kwargs: Arguments of :class:`LidarDataModule`.
    """

    def __init__(self, root: str, **kwargs: Any) -> None:
        # Given here, they are no options of the YAML: split and columns are fixed.
        super().__init__(
            scans=root,
            val_every=None,
            val_drives=None,
            columns=None,
            further_scans=None,
            repeats=1,
            **kwargs,
        )
        self.root = root

    @property
    def dataset(self) -> str | None:
        """``KITTI-360``; None for simulated scans, which have the same layout."""
        return None if (Path(self.root) / "simulation.json").is_file() else "KITTI-360"

    def split(self) -> tuple[list[Scan], list[Scan]]:
        """Scans of the official training and validation drives that are present."""
        return kitti360_scans(self.root, "train"), kitti360_scans(self.root, "val")


class SimulatedDataModule(LidarDataModule):
    """Simulated streets in the KITTI-360 layout, made before the first use.

    A folder that holds more scans of the same request serves a smaller one.

    Args:
        root: Folder of the data set; filled where it is not complete.
        num_scans: Scans to simulate, over all drives; 2 or more, a fifth of them held out.
        simulation_seed: Seed of streets and instrument.
        simulation_sensor: Instrument: preset of ``r3dpa data sensors`` or a YAML file;
            ``sensor`` is about the range images.
        effects: ``auto``, ``on`` or ``off`` by effect; those not named are ``auto``.
        weather: Weather of all scans; drawn where None.
        kwargs: Arguments of :class:`LidarDataModule`.
    """

    makes_scans = True

    def __init__(
        self,
        root: str,
        num_scans: int = 1000,
        simulation_seed: int = 0,
        simulation_sensor: str = "hdl64e",
        effects: dict[str, str | bool] | None = None,
        weather: Conditions | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            scans=root,
            val_every=None,
            val_drives=None,
            columns=None,
            further_scans=None,
            repeats=1,
            **kwargs,
        )
        at_least(2, num_scans=num_scans)  # one of them is held out
        self.root, self.num_scans, self.simulation_seed = root, num_scans, simulation_seed
        self.simulation_sensor, self.effects, self.weather = simulation_sensor, effects, weather

    def split(self) -> tuple[list[Scan], list[Scan]]:
        """Scans of the official training and validation drives."""
        counts = split_scans(self.num_scans, (*TRAIN_DRIVES, *VAL_DRIVES))
        wanted = {
            f"{drive_name(drive)}/{number:010d}"
            for drive, count in counts.items()
            for number in range(count)
        }
        train, val = kitti360_scans(self.root, "train"), kitti360_scans(self.root, "val")
        return (
            [scan for scan in train if scan.name in wanted],
            [scan for scan in val if scan.name in wanted],
        )

    def prepare_data(self) -> None:
        """Simulate the scans and make the feature grids that are missing."""
        self.simulate()
        super().prepare_data()

    def simulate(self) -> None:
        """Simulate the scans that are missing."""
        simulate(
            Path(self.root),
            scans=self.num_scans,
            seed=self.simulation_seed,
            workers=max(1, self.num_workers),
            sensor=self.simulation_sensor,
            effects=self.effects,
            weather=self.weather,
        )
