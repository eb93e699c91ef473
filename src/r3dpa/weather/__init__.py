"""Weather and faults on scans from files."""

from r3dpa.weather.prior import WeatherPrior
from r3dpa.weather.recorded import RecordedScan
from r3dpa.weather.recorded_sweep import Instrument
from r3dpa.weather.rings import Rings, rings_of
from r3dpa.weather.weather import ADDED_CLASS, Weather, WeatheredScan

__all__ = [
    "ADDED_CLASS",
    "Instrument",
    "RecordedScan",
    "Rings",
    "Weather",
    "WeatherPrior",
    "WeatheredScan",
    "rings_of",
]
