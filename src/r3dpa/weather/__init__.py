"""Weather and faults on scans from files."""

from r3dpa.weather.recorded import RecordedScan

__all__ = ["RecordedScan"]
