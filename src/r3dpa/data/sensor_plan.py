"""Plan of fine-tuning ``r3dpa-s`` on the scans of a sensor: data, sizes, steps and simulated scans.

``r3dpa data plan`` writes it as YAML files for the commands of ``make my-sensor``.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml

from lidarsim import Simulator
from lidarsim.sensors import SpinningLidar, load_sensor
from r3dpa.data.datamodules import LidarDataModule
from r3dpa.data.scans import evenly
from r3dpa.geometry import BeamProjection, describe_share_kept, share_kept
from r3dpa.io import write_text

MOST_SIMULATED, FEWEST_SIMULATED = 2000, 32
# Measured on two idle cores, for ten minutes in all.
_SIMULATION_SHARE = 0.2  # of the time
_VAE_STEPS, _FLOW_STEPS = 160, 200
_VAE_SHARE, _FLOW_SHARE = 0.35, 0.4  # of the time, after which a slow machine ends a stage
_LATENTS = (8, 64)  # rows and columns of r3dpa-s, which the stem makes of any image
_STRIDE = 2  # of its VAE beyond the stem, in both directions
_GRID = (8, 32)
_FEWEST_HELD_OUT = 2  # fewer cannot be compared
_HOLD_OUT_EVERY = 5
_USER_SHARE = 1 / 3  # of the training scans of an epoch
_EVERY = 20  # simulated scans of a drive are 2 s apart
_TIMED_SCANS = 3
_SCANS_TO_CHECK = 8  # of whose points the share in the image is printed
# Share of the points that come back from an image with a column per shot: 0.9 and more in scans of
# the sensor, see notebooks/results/sensors/points_kept.md, mostly half and less of another one.
_LEAST_KEPT = 0.6


class Split(NamedTuple):
    """Number of scans to train on and held out, and the stride of the latter.

    With none held out, simulated scans are, at the same stride.
    """

    num_train: int
    num_held_out: int
    val_every: int

    def __str__(self) -> str:
        held_out = f"{self.num_held_out} held out"
        if not self.num_held_out:
            held_out = "too few to hold out: simulated scans take their place"
        return f"scans: {self.num_train} to train on, {held_out}"


@dataclass(frozen=True)
class SensorPlan:
    """Plan of one run of ``make my-sensor``.

    Args:
        sensor: Preset or YAML file of the sensor.
        scans: Folder of its scans.
        projection: Range images.
        split: Scans to train on and to compare with.
        kept: Line that says which share of the points the images give back.
        seconds_per_scan: Time to simulate a scan on one core.
        num_simulated: Scans to simulate.
        minutes: Time for everything.
        workers: Processes.
    """

    sensor: str
    scans: str
    projection: BeamProjection
    split: Split
    kept: str
    seconds_per_scan: float
    num_simulated: int
    minutes: float
    workers: int

    @classmethod
    def of(
        cls, sensor: str, scans: str, minutes: float, columns: int = 1024, workers: int = 2
    ) -> SensorPlan:
        """Plan for the scans of a folder; simulates a few scans to measure the machine.

        Raises:
            ValueError: If images cannot have so many columns, or if the scans are of another
                sensor.
        """
        divisor = _LATENTS[1] * _STRIDE
        if columns % divisor:
            raise ValueError(f"columns must be a multiple of {divisor}, got {columns}")
        lidar = load_sensor(sensor)
        projection = BeamProjection.for_networks(lidar, columns)
        module = LidarDataModule(scans, sensor=sensor, image_columns=columns, val_every=None)
        all_scans = module.split()[0]
        checked = evenly(all_scans, _SCANS_TO_CHECK)
        points = [torch.from_numpy(scan.read(projection.sensor)[:, :3]) for scan in checked]
        _check_sensor(sensor, lidar, scans, points)
        split = split_of(len(all_scans))
        seconds = _seconds_per_scan(lidar)
        fitting = int(60 * _SIMULATION_SHARE * minutes * workers / seconds)
        num_simulated = min(MOST_SIMULATED, max(FEWEST_SIMULATED, fitting))
        kept = describe_share_kept(points, projection)
        return cls(sensor, scans, projection, split, kept, seconds, num_simulated, minutes, workers)

    @property
    def stem(self) -> tuple[int, int]:
        """Rows and columns of a block of pixels, such that latents have the size of r3dpa-s."""
        size = (self.projection.sensor.beams, self.projection.sensor.columns)
        return size[0] // (_LATENTS[0] * _STRIDE), size[1] // (_LATENTS[1] * _STRIDE)

    @property
    def repeats(self) -> int:
        """How often a scan of the user occurs per epoch: a third of it, all together.

        Where scans are too few to hold any out, each occurs once.
        """
        wanted = self.num_simulated * _USER_SHARE / (1 - _USER_SHARE)
        return max(1, round(wanted / self.split.num_train))

    def steps(self, in_ten_minutes: int) -> int:
        """Steps of a stage, in proportion to the time."""
        return max(8, round(in_ten_minutes * self.minutes / 10))

    def files(self, out: Path) -> dict[str, dict[str, Any]]:
        """YAML files by name: data, both stages, and the simulation below the folder ``out``."""
        simulated = str(out / "simulated")
        if self.split.num_held_out:
            scans = {"scans": self.scans, "further_scans": simulated, "repeats": self.repeats}
        else:
            scans = {"scans": simulated, "further_scans": self.scans}
        data = scans | {
            "sensor": self.sensor,
            "image_columns": self.projection.sensor.columns,
            "codec": {"encoding": "log2", "return_channel": True},
            "grid_size": list(_GRID),
            "extractor": None,
            "val_every": self.split.val_every,
            "num_workers": self.workers,
        }
        return {
            "data": {"data": {"class_path": "r3dpa.data.LidarDataModule", "init_args": data}},
            "vae": self._stage(_VAE_STEPS, _VAE_SHARE, {"init_other_sensor": True}),
            "flow": self._stage(_FLOW_STEPS, _FLOW_SHARE, {})
            | {"data": {"init_args": {"augmentation": {"rotate": True}}}},
            "simulate": {
                "scans": self.num_simulated,
                "sensor": self.sensor,
                "every": _EVERY,
                "workers": self.workers,
            },
        }

    def write(self, out: Path) -> None:
        """Write :meth:`files` and :attr:`more`."""
        for name, content in self.files(out).items():
            text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
            write_text(out / f"{name}.yaml", text)
        write_text(out / "more.txt", self.more + "\n")

    def _stage(
        self, in_ten_minutes: int, share: float, init_args: dict[str, Any]
    ) -> dict[str, Any]:
        steps = self.steps(in_ten_minutes)
        every = max(1, min(steps // 2, 50))
        model = {
            "vae": {"init_args": {"stem": list(self.stem)}},
            "optimizer": {"warmup_steps": 5, "decay_steps": steps // 2},
        }
        return {
            "model": {"init_args": model | init_args},
            "trainer": {
                "max_steps": steps,
                "max_time": {"seconds": math.ceil(60 * share * self.minutes)},
                "val_check_interval": steps,
                "limit_val_batches": 2,
            },
            "checkpoint": {"every_n_train_steps": every},
        }

    def __str__(self) -> str:
        sensor = self.projection.sensor
        simulated = f"{self.num_simulated} scans to simulate, {self.seconds_per_scan:.2f} s each"
        if self.num_simulated < MOST_SIMULATED:
            simulated += f" on a core: {MOST_SIMULATED} would take longer than the time allows"
        reach = f"{sensor.range_min_m:g} to {sensor.range_max_m:g} m"
        return "\n".join(
            [
                f"image: {sensor.beams} x {sensor.columns}, {reach}, one row per beam",
                self.kept,
                str(self.split),
                simulated,
                f"{self._steps_text}, fewer where the time ends before",
            ]
        )

    @property
    def _steps_text(self) -> str:
        return f"{self.steps(_VAE_STEPS)} steps of the VAE, {self.steps(_FLOW_STEPS)} of the SiT"

    @property
    def more(self) -> str:
        """Text that says what an hour or a GPU improves."""
        compared = f"{self.split.num_held_out} held-out" if self.split.num_held_out else "simulated"
        return (
            f"Planned for {self.minutes:g} minutes on two idle cores: {self.num_simulated} scans, "
            f"{self._steps_text}; a slower machine stops a stage before its last step.\n"
            "make my-sensor MINUTES=60 takes six times as many steps as ten minutes, and up to "
            f"{MOST_SIMULATED} scans.\n"
            "A GPU takes the steps that r3dpa-s was trained with in about an hour: 5252 of 64 "
            "scans and 6790 of 256.\n"
            "More scans of your own, from other drives, make the scores after it more reliable: "
            f"they compare with {compared} scans."
        )


def split_of(num_scans: int) -> Split:
    """Hold out every fifth scan, but at least two, and none of one or two scans."""
    if num_scans <= _FEWEST_HELD_OUT:
        return Split(num_scans, 0, _HOLD_OUT_EVERY)
    num_held_out = max(_FEWEST_HELD_OUT, num_scans // _HOLD_OUT_EVERY)
    val_every = math.ceil(num_scans / num_held_out)
    num_held_out = len(range(0, num_scans, val_every))
    return Split(num_scans - num_held_out, num_held_out, val_every)


def _check_sensor(name: str, lidar: SpinningLidar, scans: str, points: list[torch.Tensor]) -> None:
    """Refuse scans ``(P, 3)`` of which too few points have a pixel of their own.

    Of each shot of a dual return, one return has.
    """
    projection = BeamProjection.of(lidar)
    share = sum(share_kept(scan, projection) for scan in points) / len(points)
    least = _LEAST_KEPT / 2 if lidar.return_mode == "dual" else _LEAST_KEPT
    if share < least:
        raise ValueError(
            f"only {share:.0%} of the points of {scans} come back from range images of the sensor "
            f"{name} ({lidar.num_beams} beams, {lidar.shots} columns), at least {least:.0%} would "
            f"of its own scans: give the sensor of these, which `r3dpa data sensor {scans} "
            "--out mine.yaml` estimates"
        )


def _seconds_per_scan(lidar: SpinningLidar) -> float:
    """Time to simulate a scan, without the first one, which also builds the street."""
    simulator = Simulator(sensor=lidar)
    simulator.scan(0)
    started = time.perf_counter()
    for number in range(1, 1 + _TIMED_SCANS):
        simulator.scan(number * _EVERY)
    return (time.perf_counter() - started) / _TIMED_SCANS
