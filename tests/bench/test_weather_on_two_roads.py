"""Weather on a recorded scan and weather in its scene give one scan."""

import numpy as np
import pytest
from weather_on_two_roads import WEATHERS, compared, scene_figures

from lidarsim import load_sensor


@pytest.fixture(scope="module")
def scenes():
    chosen = {name: WEATHERS[name] for name in ("fog 60 m", "rain 30 mm/h", "snow 3 mm/h")}
    sensor = load_sensor("hdl64e", shots=520)
    return [scene_figures(number, sensor, chosen) for number in range(2)]


@pytest.mark.parametrize("name", ["fog 60 m", "rain 30 mm/h", "snow 3 mm/h"])
def test_two_roads_lead_to_one_scan(scenes, name):
    """Weather on the clear scan, and the same weather in its scene; the notebook has 200 scenes."""
    result = compared([scene[name] for scene in scenes])
    for figure, most in {"returns": 0.02, "false": 0.1, "of_class": 0.02}.items():
        values = {key: value.sum() for key, value in result[figure].items()}
        slack = 3 * values["spread"] + most * values["simulated"]
        assert abs(values["recorded"] - values["simulated"]) <= slack, (figure, values)
    near = [result["intensity"][road][:2] for road in ("recorded", "simulated")]
    assert np.allclose(*near, atol=0.01)
