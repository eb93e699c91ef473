"""The air: dense clouds of droplets (fog, spray), and rain and snow, which may be detected singly.

Beam and field of view of the receiver overlap only partly at short range. With an overlap
``xi`` that grows as the square up to ``r0 = overlap_range_m``, the echo of a scatterer goes as::

    xi(r) / r^2 = min(1, (r / r0)^2) / r^2 = 1 / max(r, r0)^2

Without it the nearest metres of fog would outshine every target. Soft echoes depend only on the
combination of ``r0`` and backscatter, so that ``r0`` also absorbs the factor of pi between a
backscatter coefficient and a diffuse reflectivity.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarsim.draws import Draws, RayIndex
from lidarsim.effects.instrument import MAX_SPREADS
from lidarsim.raycast import surface_distance
from lidarsim.scene import Primitive, Scene, Semantic, Shape
from lidarsim.sensors.spinning import SpinningLidar
from lidarsim.solids import NO_SURFACE, Floats, solids_of
from lidarsim.sweep import Effect, Origin, Sweep

# Backscatter over extinction of clouds of water droplets, see Fog.
_BACKSCATTER = 0.046 / math.log(20)
_FOG_STEP_M = 0.05
_FAST_M_S = 10.0
_PLUME_S, _PLUME_MAX_M, _PLUME_HEIGHT_M = 0.6, 12.0, 1.8
# Grid of the table of drops and flakes.
_DROP_STEP_M, _DROP_POWERS = 0.2, 64


def attenuate(sweep: Sweep, extinction_per_m: float) -> None:
    """Attenuate every echo of the turn along its path, both ways."""
    sweep.extinction_per_m += extinction_per_m
    # Above 0 in float32: 0 times an infinite range would be NaN.
    twice = np.float32(max(2 * extinction_per_m, 1e-30))
    for echoes in sweep.echoes():
        echoes.power *= np.exp(-twice * echoes.range_m)


def overlap_by_square(range_m: NDArray[np.floating], sensor: SpinningLidar) -> NDArray:
    """``xi(r) / r^2`` of the module's docstring, m^-2."""
    return np.maximum(range_m, sensor.overlap_range_m) ** -2.0


def range_edges(sensor: SpinningLidar, step_m: float) -> NDArray[np.float64]:
    """Even steps of about ``step_m`` from the smallest to the largest reported range."""
    num = math.ceil((sensor.max_range_m - sensor.min_range_m) / step_m)
    return np.linspace(sensor.min_range_m, sensor.max_range_m, num + 1)


def steps_before_target(sweep: Sweep, edges: NDArray[np.float64]) -> Floats:
    """Number of steps of ``edges`` (K,) before each ray's strongest echo, ``(R,)``."""
    target = np.minimum(sweep.first.range_m, np.float32(edges[-1]))
    steps = (target - np.float32(edges[0])) * np.float32(1 / (edges[1] - edges[0]))
    return steps.clip(0, len(edges) - 1)


class Fog(Effect):
    """Fog attenuates every echo and adds a soft echo of its own.

    With the meteorological optical range MOR, the speed of light c and the pulse length tau::

        extinction = ln(20) / MOR        backscatter = 0.046 / MOR
        hard echo: power * exp(-2 extinction R)
        soft echo: W(r) = backscatter * integral of exp(-2 extinction s) xi(s) / s^2 over the
                   pulse, s = r - c tau / 4 .. r + c tau / 4

    A ray's soft echo has the largest W before its target, and is kept if stronger than the hard
    one. Its range is drawn with the density W before the target: fog is turbulent, and the
    waveform is nearly flat, so its peak may lie anywhere.

    Extinction at MOR 50 m leaves 2.75 % of the power of a target at 30 m. The effect runs at every
    finite MOR.

    Source: Rasshofer et al. 2011 and Hahner et al., ICCV 2021, for both coefficients.
    """

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        visibility_m = scene.weather.visibility_m
        return f"visibility of {visibility_m:g} m" if math.isfinite(visibility_m) else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        sensor, visibility_m = sweep.sensor, sweep.scene.weather.visibility_m
        extinction = math.log(20) / visibility_m
        attenuate(sweep, extinction)
        edges, waveform = soft_waveform(visibility_m, sensor)
        peak = np.maximum.accumulate(waveform).astype(np.float32)
        peak[0] = 0.0
        steps = np.append(0.0, ((waveform[1:] + waveform[:-1]) / 2).cumsum())
        before = steps_before_target(sweep, edges).astype(np.intp)
        power = peak[before]
        chosen = np.flatnonzero(power > sweep.weakest_recorded())
        if not len(chosen):
            return
        share = draws.uniform(chosen) * steps[before[chosen]]
        range_m = np.interp(share, steps, edges).astype(np.float32)
        sweep.offer(chosen, range_m, power[chosen], NO_SURFACE, Origin.FOG)


def soft_waveform(
    visibility_m: float, sensor: SpinningLidar
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reported ranges ``(K,)`` and power ``(K,)`` of the backscatter from there, m^-2."""
    extinction = math.log(20) / visibility_m
    half_pulse_m = sensor.pulse_depth_m / 2
    edges = range_edges(sensor, _FOG_STEP_M)
    everywhere = np.arange(0.0, sensor.max_range_m + half_pulse_m + _FOG_STEP_M, _FOG_STEP_M)
    density = np.exp(-2 * extinction * everywhere) * overlap_by_square(everywhere, sensor)
    energy = np.append(0.0, ((density[1:] + density[:-1]) / 2).cumsum() * _FOG_STEP_M)
    received = np.interp(edges + half_pulse_m, everywhere, energy)
    received -= np.interp(edges - half_pulse_m, everywhere, energy)
    return edges, _BACKSCATTER * extinction * received


@dataclass(frozen=True)
class Spray(Effect):
    """Plumes of droplets behind fast vehicles on a wet road.

    The plume is a box from the rear of the vehicle, as wide as the vehicle, 1.8 m high from
    its lowest part, and as long as the path of the last 0.6 s, at most 12 m. With the speed v and
    the depth w of the water, its extinction is::

        extinction = max_extinction * clip((v - 10 m/s) / 10 m/s, 0, 1) * clip(w / 1.2 mm, 0, 1)

    Over the path L within the box, echoes from behind are attenuated by exp(-2 extinction L), and
    a soft echo as of fog (backscatter / extinction = 0.046 / ln 20) is added near its near side:
    at the depth s with the density exp(-2 extinction s), of the power::

        backscatter * min(c tau / 2, L) * xi(r) / r^2 * exp(-2 extinction of the air r)

    Source: 0.05 to 0.2 per metre in the plumes of cars at 60 to 90 km/h; the depth at which a road
    counts as flooded comes from wet-ground models.

    Args:
        max_extinction_per_m: Extinction behind a vehicle at 20 m/s or more on a flooded road.
    """

    max_extinction_per_m: float = 0.2

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        film_mm = scene.weather.water_film_mm
        return f"fast vehicles on {film_mm:.2g} mm of water" if _plumes(scene) else None

    def rays(self, sweep: Sweep) -> RayIndex:
        """Rays whose window meets a plume."""
        scene = sweep.scene
        boxes = solids_of(_plumes(scene), scene.pose, scene.ground_m)
        return np.unique(np.concatenate(sweep.rays_near(boxes)))

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        sensor = sweep.sensor
        scene = sweep.scene
        boxes = _plumes(sweep.scene)
        solids = solids_of(boxes, scene.pose, scene.ground_m)
        flooded = scene.weather.water_film_mm / 1.2
        drawn = draws.uniform(slice(None))
        for index, window in enumerate(sweep.rays_near(solids)):
            start = sweep.start[:, window]
            start[:2] -= solids.velocity[index][:, None] * sweep.time_s[window]
            enter, leave = surface_distance(
                solids, np.full(len(window), index), start, sweep.direction[:, window]
            )
            enter = np.maximum(enter, np.float32(sensor.min_range_m))
            crossed = leave > enter
            chosen, enter, leave = window[crossed], enter[crossed], leave[crossed]
            faster = (math.hypot(*boxes[index].velocity_m_s) - _FAST_M_S) / 10.0
            extinction = self.max_extinction_per_m * min(faster, 1.0) * min(flooded, 1.0)
            twice = np.float32(2 * extinction)
            for echoes in sweep.echoes():
                path = np.minimum(leave, echoes.range_m[chosen]) - enter
                echoes.power[chosen] *= np.exp(-twice * path.clip(0))
            path = (np.minimum(leave, sweep.first.range_m[chosen]) - enter).clip(0)
            within_pulse = path.clip(max=sensor.pulse_depth_m)
            power = np.float32(_BACKSCATTER) * twice / 2 * within_pulse
            power *= overlap_by_square(enter, sensor)
            power *= np.exp(-2 * sweep.extinction_per_m * enter)
            if twice:
                depth = -np.log1p(drawn[chosen] * np.expm1(-twice * path)) / twice
                sweep.offer(chosen, enter + depth, power, NO_SURFACE, Origin.SPRAY)


def _plumes(scene: Scene) -> tuple[Primitive, ...]:
    """One box behind each fast vehicle, in the world frame; none on a dry road.

    Wheels and mirrors count even if they are too far away to be cast.
    """
    vehicles = defaultdict(list)
    if scene.weather.water_film_mm > 0:
        for index, primitive in enumerate((*scene.primitives, *scene.unseen)):
            if math.hypot(*primitive.velocity_m_s) > _FAST_M_S:
                # Solids that belong to no object are vehicles of their own.
                vehicles[primitive.instance or -1 - index].append(primitive)
    return tuple(_plume(parts) for parts in vehicles.values())


def _plume(parts: list[Primitive]) -> Primitive:
    speed = math.hypot(*parts[0].velocity_m_s)
    ahead_x, ahead_y = (component / speed for component in parts[0].velocity_m_s)
    heading = math.atan2(ahead_y, ahead_x)
    rear, right, left = math.inf, math.inf, -math.inf
    for part in parts:
        x, y, _ = part.centre
        cosine, sine = math.cos(part.yaw_rad - heading), math.sin(part.yaw_rad - heading)
        half_long, half_wide, _ = part.half_size
        reach_ahead = abs(half_long * cosine) + abs(half_wide * sine)
        reach_aside = abs(half_long * sine) + abs(half_wide * cosine)
        aside = y * ahead_x - x * ahead_y
        rear = min(rear, x * ahead_x + y * ahead_y - reach_ahead)
        right, left = min(right, aside - reach_aside), max(left, aside + reach_aside)
    length = min(_PLUME_S * speed, _PLUME_MAX_M)
    along, aside = rear - length / 2, (left + right) / 2
    road_m = min(part.centre[2] - part.half_size[2] for part in parts)
    x, y = along * ahead_x - aside * ahead_y, along * ahead_y + aside * ahead_x
    centre = (x, y, road_m + _PLUME_HEIGHT_M / 2)
    half_size = (length / 2, (left - right) / 2, _PLUME_HEIGHT_M / 2)
    velocity = parts[0].velocity_m_s
    return Primitive(
        Shape.BOX, centre, half_size, Semantic.UNLABELED, 1.0, heading, velocity_m_s=velocity
    )


class _Hydrometeors(Effect):
    """Drops or flakes with an exponential size distribution, which may be detected singly.

    At the rate R in mm/h there are, per cubic metre and millimetre of diameter D::

        N(D) = N0 exp(-Lambda D)        N0 = n R^a        Lambda = l R^b
        extinction = integral of 2 (pi D^2 / 4) N(D) = 1e-6 pi N0 / Lambda^3   per metre

    The echo of one of them within the beam, a cone of the diameter d = divergence * r, is::

        power = reflectivity * min(D / d, 1)^2 * exp(-2 extinction r) * xi(r) / r^2

    with the extinction of all the air. So those above a power p before the range r are a Poisson
    process with the mean::

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
    field: str  # of Conditions, its rate in mm/h

    def called_by(self, scene: Scene, sensor: SpinningLidar) -> str | None:
        rate = getattr(scene.weather, self.field)
        return f"{rate:g} mm/h of {self.origin.name.lower()}" if rate > 0 else None

    def apply(self, sweep: Sweep, rays: RayIndex, draws: Draws) -> None:
        rate = getattr(sweep.scene.weather, self.field)
        attenuate(sweep, self.extinction_per_m(rate))
        table = self.drop_table(rate, sweep.sensor, sweep.extinction_per_m)
        if table is None:
            return
        edges, powers, expected = table
        log_step = math.log(powers[1] / powers[0])
        weakest = sweep.weakest_recorded()
        row = np.log(np.maximum(weakest, powers[0]) / powers[0]) / np.float32(log_step)
        row = row.astype(np.intp).clip(max=_DROP_POWERS)
        before = steps_before_target(sweep, edges)

        # Rays with a drop that is stronger than their echo, and its power.
        drawn = draws.exponential(slice(None))
        chosen = np.flatnonzero(_between(expected, row, before) > drawn)
        drawn, row, before = drawn[chosen], row[chosen], before[chosen]
        end = np.full_like(row, _DROP_POWERS)
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

    def drop_table(
        self, rate_mm_h: float, sensor: SpinningLidar, extinction_per_m: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]] | None:
        """Ranges ``(K,)``, powers ``(P,)`` and M ``(P, K)`` at them; None if no drop is detected.

        The powers grow, even in their logarithms. The extinction is of fog, rain and snow together.
        """
        edges = range_edges(sensor, _DROP_STEP_M)
        middle = (edges[1:] + edges[:-1]) / 2
        through = np.exp(-2 * extinction_per_m * middle)
        filling = self.reflectivity * through * overlap_by_square(middle, sensor)
        weakest = sensor.min_power * math.exp(-MAX_SPREADS * sensor.threshold_spread)
        if not (sensor.divergence_rad > 0 and filling.max() > weakest):
            return None
        powers = np.geomspace(weakest, filling.max(), _DROP_POWERS + 1)
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
        return edges, powers, expected.astype(np.float32)


class Rain(_Hydrometeors):
    """Rain attenuates every echo, and a drop in the beam may outshine a weak target.

    Equations: :class:`_Hydrometeors`. A sphere of the refractive index n = 1.33 reflects from
    its front and, focused, from its rear ``F / 4 (1 + (1 - F)^2 (n / (2 - n))^2) = 0.024``, here
    0.02, of the echo of a white disk, with F = 0.02. At 10 mm/h the extinction is 1.6e-3 per metre.

    Source: Marshall and Palmer 1948 for the sizes.
    """

    reflectivity = 0.02
    intercept = (8000.0, 0.0)
    slope = (4.1, -0.21)
    origin = Origin.RAIN
    field = "rain_mm_h"


class Snow(_Hydrometeors):
    """Snow attenuates every echo, and flakes may outshine weak targets.

    Equations: :class:`_Hydrometeors`. Diameters are of the molten flakes. Ice
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
    flat = table.reshape(-1)
    at = row * table.shape[1] + left
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
