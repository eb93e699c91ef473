"""Weather and faults on scans from files."""

from r3dpa.simulation.recorded import Instrument, RecordedScan
from r3dpa.weather.rings import Rings, rings_of
from r3dpa.weather.weather import ADDED_CLASS, Weather, WeatheredScan, WeatherPrior

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
