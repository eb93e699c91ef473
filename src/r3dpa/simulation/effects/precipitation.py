"""Rain and snow: drops and flakes that may be detected singly."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from r3dpa.simulation.draws import Draws, RayIndex
from r3dpa.simulation.effects.instrument import MAX_SPREADS
from r3dpa.simulation.effects.medium import (
    attenuate,
    overlap_by_square,
    range_edges,
    steps_before_target,
)
from r3dpa.simulation.scene import Scene
from r3dpa.simulation.sensor import SpinningLidar
from r3dpa.simulation.solids import NO_SURFACE
from r3dpa.simulation.sweep import Effect, Origin, Sweep

_STEP_M = 0.2
_POWERS = 64


class DropTable(NamedTuple):
    """M(p, r) of :class:`Rain` and :class:`Snow` on a grid."""

    edges: NDArray[np.float64]  # (K,) ranges, metres
    powers: NDArray[np.float64]  # (P,) growing, even in their logarithms, m^-2
    expected: NDArray[np.float32]  # (P, K) mean number of stronger drops before each range


class _Hydrometeors(Effect):
    """Drops or flakes with an exponential size distribution, which may be detected singly.

    At the rate R in mm/h there are, per cubic metre and millimetre of diameter D::

        N(D) = N0 exp(-Lambda D)        N0 = n R^a        Lambda = l R^b
        extinction = integral of 2 (pi D^2 / 4) N(D) = 1e-6 pi N0 / Lambda^3   per metre

    The echo of one of them within the beam, a cone of the diameter d = divergence * r, is::

        power = reflectivity * min(D / d, 1)^2 * exp(-2 extinction r) * xi(r) / r^2

    so that those above a power p before the range r are a Poisson process with the mean::

        M(p, r) = integral of N0 / Lambda exp(-Lambda D_p(s)) pi (d / 2)^2 ds,   up to r

    with D_p the diameter that gives p, without the ranges where even D = d falls short. The
    strongest one before a target at R then has the power p at which M(p, R) equals a draw of the
    exponential distribution (none if M stays below it at the detection limit), and a range with
    the density dM/dp there. This is exact and needs two draws per ray for any number of drops.
    """

    reflectivity: float  # of one as wide as the beam, beside a diffuse surface
    intercept: tuple[float, float]  # n per m^3 and mm, and a
    slope: tuple[float, float]  # l per mm, and b
    origin: Origin
    field: str  # of Weather, its rate in mm/h

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        rate = getattr(scene.weather, self.field)
        return f"{rate:g} mm/h of {self.origin.name.lower()}" if rate > 0 else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        """Attenuate the echoes and add the strongest drop or flake of each ray."""
        rate = getattr(sweep.scene.weather, self.field)
        attenuate(sweep, self.extinction_per_m(rate))
        table = self.drop_table(rate, sweep.sensor)
        if table is None:
            return
        edges, powers, expected = table
        log_step = math.log(powers[1] / powers[0])
        weakest = sweep.weakest_recorded()
        row = np.log(np.maximum(weakest, powers[0]) / powers[0]) / np.float32(log_step)
        row = row.astype(np.intp).clip(max=_POWERS)
        before = steps_before_target(sweep, edges)

        # Rays with a drop that is stronger than their echo, and its power.
        drawn = draws.exponential(slice(None))
        chosen = np.flatnonzero(_between(expected, row, before) > drawn)
        drawn, row, before = drawn[chosen], row[chosen], before[chosen]
        end = np.full_like(row, _POWERS)
        row = _last_where(lambda middle: _between(expected, middle, before) > drawn, row, end)
        above, beyond = _between(expected, row, before), _between(expected, row + 1, before)
        power = powers[row] * np.exp(log_step * (above - drawn) / (above - beyond))
        stronger = power > weakest[chosen]
        chosen, row, before, power = (a[stronger] for a in (chosen, row, before, power))
        if not len(chosen):
            return

        # Its range: the drops of this row's powers, up to the target.
        in_row = np.ascontiguousarray(expected[:-1] - expected[1:])
        level = draws.uniform(chosen) * _between(in_row, row, before)
        end = before.astype(np.intp) + 1
        step = _last_where(lambda middle: in_row[row, middle] <= level, np.zeros_like(row), end)
        lower, upper = in_row[row, step], in_row[row, (step + 1).clip(max=len(edges) - 1)]
        part = np.divide(
            level - lower, upper - lower, out=np.zeros_like(level), where=upper > lower
        )
        at = np.minimum(step + part, before)
        range_m = edges[0] + (edges[1] - edges[0]) * at
        range_m, power = range_m.astype(np.float32), power.astype(np.float32)
        sweep.offer(chosen, range_m, power, NO_SURFACE, self.origin)

    def extinction_per_m(self, rate_mm_h: float) -> float:
        """Extinction at a rate, see the class."""
        exponent = self.intercept[1] - 3 * self.slope[1]
        return 1e-6 * math.pi * self.intercept[0] / self.slope[0] ** 3 * rate_mm_h**exponent

    def drop_table(self, rate_mm_h: float, sensor: SpinningLidar) -> DropTable | None:
        """M(p, r) of the class for an instrument; None where no single drop can be detected."""
        edges = range_edges(sensor, _STEP_M)
        middle = (edges[1:] + edges[:-1]) / 2
        through = np.exp(-2 * self.extinction_per_m(rate_mm_h) * middle)
        filling = self.reflectivity * through * overlap_by_square(middle, sensor)
        weakest = sensor.min_power * math.exp(-MAX_SPREADS * sensor.threshold_spread)
        if not (sensor.divergence_rad > 0 and filling.max() > weakest):
            return None
        powers = np.geomspace(weakest, filling.max(), _POWERS + 1)
        per_mm = self.slope[0] * rate_mm_h ** self.slope[1]
        per_m3 = self.intercept[0] * rate_mm_h ** self.intercept[1] / per_mm
        with np.errstate(divide="ignore", over="ignore"):
            squared = powers[:, None] / filling
        diameter_mm = 1000 * sensor.divergence_rad * middle * np.sqrt(squared)
        density = per_m3 * np.exp(-per_mm * diameter_mm) * (squared <= 1)
        density *= math.pi * (sensor.divergence_rad * middle / 2) ** 2
        expected = np.zeros((len(powers), len(edges)))
        # Nothing is stronger than the last power.
        np.cumsum(density[:-1] * (edges[1] - edges[0]), axis=1, out=expected[:-1, 1:])
        return DropTable(edges, powers, expected.astype(np.float32))


class Rain(_Hydrometeors):
    """Rain attenuates every echo, and a drop in the beam may outshine a weak target.

    Equations: :class:`_Hydrometeors`. A sphere of the refractive index n = 1.33 reflects from
    its front and, focused, from its rear ``F / 4 (1 + (1 - F)^2 (n / (2 - n))^2) = 0.024`` of the
    echo of a white disk, with F = 0.02. At 10 mm/h the extinction is 1.6e-3 per metre.

    Source: Marshall and Palmer 1948 for the sizes.
    """

    reflectivity = 0.02
    intercept = (8000.0, 0.0)
    slope = (4.1, -0.21)
    origin = Origin.RAIN
    field = "rain_mm_h"


class Snow(_Hydrometeors):
    """Snow attenuates every echo, and flakes may outshine weak targets.

    Equations: :class:`_Hydrometeors`. Diameters are those of the molten flakes. Ice
    crystals return 2 pi / S = 0.3 of the echo of a white disk, with S = 20 sr their ratio of
    extinction to backscatter. At 1 mm/h the extinction is 1.4e-3 per metre.

    Source: Gunn and Marshall 1958 for the sizes, with twice their number as in LISA (molten
    flakes hide less than real ones).
    """

    reflectivity = 0.3
    intercept = (7600.0, -0.87)
    slope = (2.55, -0.48)
    origin = Origin.SNOW
    field = "snow_mm_h"


def _between(table: NDArray, row: NDArray[np.intp], column: NDArray) -> NDArray:
    """Entries (M,) of rows of a table (P, K), between its columns."""
    left = np.minimum(column.astype(np.intp), table.shape[1] - 2)
    flat, at = table.reshape(-1), row * table.shape[1] + left
    lower = flat[at]
    return lower + (column - left) * (flat[at + 1] - lower)


def _last_where(
    holds: Callable[[NDArray[np.intp]], NDArray[np.bool_]],
    low: NDArray[np.intp],
    high: NDArray[np.intp],
) -> NDArray[np.intp]:
    """Last index (M,) in [low, high) where a condition holds, which is true first, then false."""
    while (high - low > 1).any():
        middle = (low + high) // 2
        held = holds(middle)
        low, high = np.where(held, middle, low), np.where(held, high, middle)
    return low
