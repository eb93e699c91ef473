"""Two roads to one scan: weather on a recorded clear scan, and weather simulated in its scene.

    python tests/bench/weather_on_two_roads.py notebooks/results/weather_two_roads.json 200

Writes the study that notebook 07 shows.
"""

import copy
import json
import math
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from lidarsim import Semantic, Street, Sweep, load_sensor
from lidarsim.effects import ECHO_EFFECTS, RAY_EFFECTS
from lidarsim.recorded import RecordedScan
from lidarsim.scan import calibrated_intensity, run_effect
from lidarsim.scene import Conditions
from lidarsim.sweep import Origin
from lidarsim.weather import Weather

CLEAR = Conditions(clear_sky=False)
WEATHERS = {
    "fog 30 m": {"visibility_m": 30.0},
    "fog 60 m": {"visibility_m": 60.0},
    "fog 200 m": {"visibility_m": 200.0},
    "rain 30 mm/h": {"rain_mm_h": 30.0},
    "snow 3 mm/h": {"snow_mm_h": 3.0},
    "water 1 mm": {"water_film_mm": 1.0},
    "spray": {"water_film_mm": 1.0},
    "sun 4 deg": {"clear_sky": True, "sun_elevation_deg": 4.0, "sun_azimuth_deg": 30.0},
}
EDGES_M = np.array([0, 10, 20, 30, 50, 80, 120])
CLASSES = (Semantic.ROAD, Semantic.SIDEWALK, Semantic.BUILDING, Semantic.VEGETATION, Semantic.CAR)
AIR = [Origin.FOG, Origin.RAIN, Origin.SNOW, Origin.SPRAY, Origin.SUN]


def cast(scene, sensor, key):
    """The turn of a scan before its echoes, without puddles, which a scan does not show."""
    sweep = Sweep(replace(scene, puddles=()), sensor)
    for effect in RAY_EFFECTS:
        run_effect(effect, sweep, key, {})
    sweep.cast()
    return sweep


def turn(before, weather, key, off=("spray",)):
    """The turn in a weather. The instrument draws as it does in the clear."""
    fixed = {id(part): part for part in (before.scene, before.sensor, before.solids)}
    sweep = copy.deepcopy(before, fixed)
    sweep.scene = replace(before.scene, weather=weather)
    for effect in ECHO_EFFECTS:
        run_effect(effect, sweep, key, dict.fromkeys(off, "off"))
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


def fast_boxes(scene, sensor):
    """Vehicles with spray, ``(N, 8)`` as :meth:`Weather.apply` takes them."""
    parts, rows = {}, []
    for part in scene.primitives:
        if math.hypot(*part.velocity_m_s) > 10:
            parts.setdefault(part.instance, []).append(part)
    pose = scene.pose
    for solids in parts.values():
        heading = math.atan2(*solids[0].velocity_m_s[::-1])
        ahead = np.array([math.cos(heading), math.sin(heading)])
        axes = np.array([[*ahead, 0], [-ahead[1], ahead[0], 0], [0, 0, 1]])
        centres = np.array([axes @ part.centre for part in solids])
        sizes = []
        for part in solids:
            cosine, sine = (abs(f(part.yaw_rad - heading)) for f in (math.cos, math.sin))
            a, b, c = part.half_size
            sizes.append([a * cosine + b * sine, a * sine + b * cosine, c])
        low, high = (centres - sizes).min(axis=0), (centres + sizes).max(axis=0)
        x, y, z = axes.T @ ((low + high) / 2) - (pose.x_m, pose.y_m, pose.z_m)
        cosine, sine = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
        x, y = cosine * x + sine * y, cosine * y - sine * x
        turned, speed = heading - pose.heading_rad, math.hypot(*solids[0].velocity_m_s)
        # As the scan shows them: where they are when the head looks at them, seen from there.
        time_s = math.atan2(y, x) / (2 * math.pi) / sensor.spin_hz
        x += (speed * math.cos(turned) - scene.motion.speed_m_s) * time_s
        y += speed * math.sin(turned) * time_s
        rows.append([x, y, z, *(high - low), turned, speed])
    return np.array(rows) if rows else None


def scene_figures(number, sensor, weathers=WEATHERS):
    """Figures of one scene by weather: clear, on the first road, and twice on the second.

    Weather meets the clear scan with draws of its own, but in the scene with those of the
    instrument that the clear scan of the same seed has: a shot that is empty in the clear must not
    be another one in the weather.
    """
    street = Street(1000 + number, number % 11, CLEAR)
    scene = street.scene(37 * number % 400, sensor.mount_height_m)
    keys = [(number, seed) for seed in "ab"]
    before = [cast(scene, sensor, key) for key in keys]
    in_clear = [shown(turn(*each)) for each in zip(before, (CLEAR, CLEAR), keys, strict=True)]
    shots, points, intensity, labels, origins = in_clear[0]
    scan = RecordedScan(points, intensity, labels=labels)
    clear = figures(*in_clear[0], shots)
    turned_deg = math.degrees(scene.pose.heading_rad)
    result = {}
    for name, weather in weathers.items():
        boxes, off = (fast_boxes(scene, sensor), ()) if name == "spray" else (None, ("spray",))
        there = Weather(**asdict(CLEAR) | weather).apply(scan, number, boxes=boxes)
        labels_there = np.where(there.index < 0, 0, there.labels)
        made_by = np.where(there.index < 0, there.origins, origins[there.shot])
        columns = (shots[there.shot], there.points, there.intensity, labels_there, made_by)
        roads = [clear, figures(*columns, shots)]
        azimuth_deg = weather.get("sun_azimuth_deg", 0.0) + turned_deg
        here = Conditions(**asdict(CLEAR) | weather | {"sun_azimuth_deg": azimuth_deg})
        for sweep, key, (clear_shots, *_) in zip(before, keys, in_clear, strict=True):
            roads.append(figures(*shown(turn(sweep, here, key, off)), clear_shots))
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


def study(num):
    """Figures of all weathers for ``num`` scenes, and for a quarter with lasers of equal gain."""
    sensor = load_sensor("hdl64e", shots=1041)
    equal = replace(sensor, lasers=replace(sensor.lasers, intensity_gain=(1.0,) * 64))
    found = {
        "scenes": num,
        "sensor": "hdl64e, 1041 shots",
        "range_edges_m": EDGES_M.tolist(),
        "classes": [c.name.lower() for c in CLASSES],
        "settings": WEATHERS,
    }
    for key, lidar, scenes in (("weathers", sensor, num), ("equal_gains", equal, num // 4)):
        every = [scene_figures(number, lidar) for number in range(scenes)]
        found[key] = {
            name: {
                figure: {road: [float(f"{v:.5g}") for v in row] for road, row in values.items()}
                for figure, values in compared([scene[name] for scene in every]).items()
            }
            for name in WEATHERS
        }
    return found


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(study(int(sys.argv[2]))) + "\n")
