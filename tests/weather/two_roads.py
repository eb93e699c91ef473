"""Two roads to one scan: weather on a recorded clear scan, and weather simulated in its scene."""

import math
from dataclasses import asdict, replace

import numpy as np

from r3dpa.simulation import Semantic, Street, Sweep
from r3dpa.simulation import Weather as SimulatedWeather
from r3dpa.simulation.effects import ECHO_EFFECTS, RAY_EFFECTS
from r3dpa.simulation.scan import calibrated_intensity, run_effect
from r3dpa.simulation.sweep import Origin
from r3dpa.weather import RecordedScan, Weather

CLEAR = SimulatedWeather(clear_sky=False)
WEATHERS = {
    "fog 30 m": {"visibility_m": 30.0},
    "fog 60 m": {"visibility_m": 60.0},
    "fog 200 m": {"visibility_m": 200.0},
    "rain 5 mm/h": {"rain_mm_h": 5.0},
    "rain 30 mm/h": {"rain_mm_h": 30.0},
    "snow 1 mm/h": {"snow_mm_h": 1.0},
    "snow 3 mm/h": {"snow_mm_h": 3.0},
    "water 0.3 mm": {"water_film_mm": 0.3},
    "water 1 mm": {"water_film_mm": 1.0},
    "sun 4 deg": {"clear_sky": True, "sun_elevation_deg": 4.0, "sun_azimuth_deg": 30.0},
}
EDGES_M = np.array([0, 10, 20, 30, 50, 80, 120])
CLASSES = (Semantic.ROAD, Semantic.SIDEWALK, Semantic.BUILDING, Semantic.VEGETATION, Semantic.CAR)
AIR = [Origin.FOG, Origin.RAIN, Origin.SNOW, Origin.SPRAY, Origin.SUN]


def turn(scene, sensor, key):
    """The turn of a simulated scan with all effects but those of wet roads that need the scene."""
    sweep = Sweep(replace(scene, puddles=()), sensor)
    for effect in RAY_EFFECTS:
        run_effect(effect, sweep, key, {})
    sweep.cast()
    for effect in ECHO_EFFECTS:
        run_effect(effect, sweep, key, {"spray": "off"})
    return sweep


def shown(sweep):
    """Shots of the returns, and points, intensity, labels and origins of these."""
    first = sweep.first
    shots = np.flatnonzero(np.isfinite(first.range_m))
    range_m, power, surface, origin = (column[shots] for column in first.columns())
    start, direction = (axis.reshape(3, -1)[:, shots] for axis in sweep.sensor.rays)
    points = (start + range_m * direction).T.astype(np.float32)
    intensity = calibrated_intensity(power, range_m, sweep.sensor.min_power)
    return shots, points, intensity, sweep.labels(surface, origin), origin


def figures(shots, points, intensity, labels, origins, clear_shots):
    """Returns and false returns by range, mean intensity by range, and returns by class.

    False returns of shots that show nothing in the clear are counted apart.
    """
    range_m = np.linalg.norm(points, axis=1)
    is_air = np.isin(origins, AIR)
    has_clear = np.isin(shots, clear_shots)
    bins = np.searchsorted(EDGES_M, range_m[~is_air]) - 1
    count = np.bincount(bins, minlength=len(EDGES_M))[: len(EDGES_M) - 1]
    total = np.bincount(bins, intensity[~is_air], len(EDGES_M))[: len(EDGES_M) - 1]
    return {
        "returns": count,
        "false": np.histogram(range_m[is_air & has_clear], EDGES_M)[0],
        "false_before_nothing": np.array([(is_air & ~has_clear).sum()]),
        "intensity": total / np.maximum(count, 1),
        "of_class": np.array([((labels & 0xFFFF) == c).sum() for c in CLASSES]),
    }


def scene_figures(number, sensor, weathers=WEATHERS):
    """Figures of one scene by weather: clear, on the first road, and twice on the second."""
    street = Street(1000 + number, number % 11, CLEAR)
    scene = street.scene(37 * number % 400, sensor.mount_height_m)
    shots, points, intensity, labels, origins = shown(turn(scene, sensor, (number, "clear")))
    scan = RecordedScan(points, intensity, labels=labels)
    clear = figures(shots, points, intensity, labels, origins, shots)
    turned_deg = math.degrees(scene.pose.heading_rad)
    result = {}
    for name, weather in weathers.items():
        there = Weather(**asdict(CLEAR) | weather).apply(scan, number)
        labels_there = np.where(there.index < 0, 0, there.labels)
        made_by = np.where(there.index < 0, there.origins, origins[there.shot])
        columns = (shots[there.shot], there.points, there.intensity, labels_there, made_by)
        roads = [clear, figures(*columns, shots)]
        azimuth_deg = weather.get("sun_azimuth_deg", 0.0) + turned_deg
        here = SimulatedWeather(**asdict(CLEAR) | weather | {"sun_azimuth_deg": azimuth_deg})
        for seed in "ab":
            seen = shown(turn(replace(scene, weather=here), sensor, (number, seed)))
            roads.append(figures(*seen, shots))
        result[name] = roads
    return result


def compared(every):
    """Means over scenes of both roads, and the spread of the second road's two seeds.

    ``every``: for each scene the figures of one weather. For each figure: ``clear``, ``recorded``
    and ``simulated`` are means per scan; ``spread`` the standard deviation over scenes of the
    difference of two seeds; ``within`` the share of scenes whose recorded figure differs from a
    simulated one by no more than 95 % of the scenes' two seeds do.
    """
    result = {}
    for name in every[0][0]:
        roads = np.array([[road[name] for road in scene] for scene in every], dtype=float)
        clear, recorded, one, other = roads.swapaxes(0, 1)
        limit = np.quantile(np.abs(one - other), 0.95, axis=0)
        result[name] = {
            "clear": clear.mean(axis=0),
            "recorded": recorded.mean(axis=0),
            "simulated": ((one + other) / 2).mean(axis=0),
            "spread": (one - other).std(axis=0),
            "within": (np.abs(recorded - one) <= limit).mean(axis=0),
        }
    return result
