"""How well the beams of an estimated sensor explain its scans."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from lidarsim.sensors.estimation import SensorEstimate
from r3dpa.viz.curves import COLOURS


def beam_residuals(estimate: SensorEstimate) -> Figure:
    """Draw the residuals of each beam, its optical centre and its azimuth offset."""
    lasers = estimate.sensor.lasers
    inclination_deg = np.degrees(lasers.inclination_rad)
    low, lower, middle, upper, high = estimate.residual_deg.T
    figure = Figure(figsize=(10, 6), layout="constrained")
    residuals, heights, offsets = figure.subplots(1, 3, sharey=True, width_ratios=(2, 1, 1))
    residuals.hlines(inclination_deg, low, high, color=COLOURS[4], linewidth=1, label="5 to 95 %")
    residuals.hlines(
        inclination_deg, lower, upper, color=COLOURS[0], linewidth=3, label="25 to 75 %"
    )
    residuals.plot(middle, inclination_deg, "|", color=COLOURS[11], label="median")
    residuals.set(xlabel="residual, degrees", ylabel="inclination of the beam, degrees")
    residuals.legend(loc="best", fontsize="small")
    heights.plot(lasers.height_m, inclination_deg, ".", color=COLOURS[5])
    heights.set(xlabel="optical centre, m")
    offsets.plot(np.degrees(lasers.azimuth_offset_rad), inclination_deg, ".", color=COLOURS[2])
    offsets.set(xlabel="azimuth offset, degrees")
    figure.suptitle(
        f"{len(inclination_deg)} beams by {estimate.beams_by}, {estimate.sensor.shots} columns, "
        f"{estimate.num_scans} scans"
    )
    return figure
