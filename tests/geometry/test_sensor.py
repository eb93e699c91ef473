import math

import pytest

from r3dpa.geometry import LidarSensor


def test_limits_in_radians():
    sensor = LidarSensor(inclination_max_deg=45.0, inclination_min_deg=-90.0)
    assert sensor.inclination_max_rad == pytest.approx(math.pi / 4)
    assert sensor.inclination_min_rad == pytest.approx(-math.pi / 2)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"beams": 0}, "beams=0"),
        ({"columns": -3}, "columns=-3"),
        ({"inclination_max_deg": -25.0}, "inclination_max_deg=-25.0"),
        ({"inclination_max_deg": 90.5}, "90.5"),
        ({"inclination_min_deg": float("nan")}, "nan"),
        ({"range_min_m": -0.1}, "range_min_m=-0.1"),
        ({"range_min_m": 56.0}, "range_max_m=56.0"),
        ({"range_max_m": math.inf}, "inf"),
    ],
)
def test_impossible_sensors_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        LidarSensor(**wrong)
