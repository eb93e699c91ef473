"""Masks of pixels and tokens for editing: True is generated anew.

Angles are in degrees: azimuth 0 looks forward and grows to the left (counter-clockwise seen from
above), so that 180 and -180 look backwards, where the range image has its seam; inclination grows
upwards from the horizon. A pixel stands for the ray through its centre. A mask that selects no
pixel, or all of them, raises a ValueError with the reason.
Letters: H beams, W columns, h x w cells, N = h * w tokens, S sources.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from einops import rearrange, repeat
from torch import Tensor

from r3dpa.geometry.projection import BeamProjection, Projection, ray_directions
from r3dpa.geometry.sensor import column_azimuths

_TURN_DEG = 360.0
_LEAST_BLEND_DEG = 1e-6  # a narrower seam is hard: its shares would be rounding alone
_DECIMALS = 9  # of degrees, so that rounding moves no ray across a border it lies on


def angle_box(
    projection: Projection,
    azimuth_from_deg: float,
    azimuth_to_deg: float,
    inclination_min_deg: float,
    inclination_max_deg: float,
) -> Tensor:
    """Pixels ``(H, W)`` bool between two azimuths in -360..360 and two inclinations.

    Azimuths run leftwards from the first to the second: ``170, -170`` are the 20 degrees across
    the seam behind the sensor, ``-10, 10`` the 20 degrees ahead. The box includes the first border
    of each pair and excludes the second.
    """
    what = (
        f"box of azimuth {azimuth_from_deg:g}..{azimuth_to_deg:g} and inclination "
        f"{inclination_min_deg:g}..{inclination_max_deg:g} degrees"
    )
    if not inclination_min_deg < inclination_max_deg:
        raise ValueError(f"{what} is empty: give the lower inclination first")
    columns = _between(projection, azimuth_from_deg, azimuth_to_deg, what)
    inclination, _ = _rays_deg(projection)
    rows = (inclination >= inclination_min_deg) & (inclination < inclination_max_deg)
    if not rows.any():
        raise _no_ray_error(projection, what)
    return check_mask(rows[:, None] & columns, what)


def sector(projection: Projection, azimuth_from_deg: float, azimuth_to_deg: float) -> Tensor:
    """All pixels ``(H, W)`` bool between two azimuths, as in :func:`angle_box`."""
    what = f"sector of azimuth {azimuth_from_deg:g}..{azimuth_to_deg:g} degrees"
    columns = _between(projection, azimuth_from_deg, azimuth_to_deg, what)
    return check_mask(columns.repeat(projection.sensor.beams, 1), what)


def in_box3d(
    points: Tensor,
    centre_m: Sequence[float],
    size_m: Sequence[float],
    yaw_deg: float = 0.0,
    margin_m: float = 0.2,
    ground_m: float = 0.25,
) -> Tensor:
    """Whether points ``(P, 3)`` belong to what stands in a box, bool.

    The box is ``margin_m`` wider on all sides, but what is less than ``ground_m`` above its bottom
    is ground. See :func:`box3d` for the other arguments.
    """
    from_centre = points.double() - torch.tensor(centre_m, dtype=torch.float64)
    half = torch.tensor(size_m, dtype=torch.float64) / 2
    inside = ((from_centre @ _box_axes(yaw_deg).T).abs() <= half + margin_m).all(dim=-1)
    return inside & (from_centre[..., 2] > ground_m - half[2])


def _box_axes(yaw_deg: float) -> Tensor:
    """Axes of a turned box, ``(3, 3)`` float64, one per row."""
    yaw = math.radians(yaw_deg)
    return torch.tensor(
        [[math.cos(yaw), math.sin(yaw), 0], [-math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]],
        dtype=torch.float64,
    )


def box3d(
    projection: Projection, centre_m: Sequence[float], size_m: Sequence[float], yaw_deg: float = 0.0
) -> Tensor:
    """Pixels whose ray meets a box within the range limits, whatever occludes the box.

    Args:
        projection: Rays of the range image.
        centre_m: x forward, y left, z up of the middle of the box, in the sensor frame.
        size_m: Length (along x before the turn), width and height.
        yaw_deg: Turn about the vertical axis, counter-clockwise seen from above.

    Returns:
        ``(H, W)`` bool.
    """
    entry_m, exit_m, what = _ray_spans(projection, centre_m, size_m, yaw_deg)
    sensor = projection.sensor
    met = (entry_m <= exit_m) & (entry_m < sensor.range_max_m) & (exit_m > sensor.range_min_m)
    if not met.any():
        raise _no_ray_error(projection, what)
    return check_mask(met, what)


def box3d_front_m(
    projection: Projection, centre_m: Sequence[float], size_m: Sequence[float], yaw_deg: float = 0.0
) -> Tensor:
    """Range ``(H, W)`` float32 at which each ray enters a box; 0 where it misses the box.

    See :func:`box3d` for the arguments.
    """
    entry_m, exit_m, _ = _ray_spans(projection, centre_m, size_m, yaw_deg)
    return torch.where(entry_m <= exit_m, entry_m, 0.0).float()


def _ray_spans(
    projection: Projection, centre_m: Sequence[float], size_m: Sequence[float], yaw_deg: float
) -> tuple[Tensor, Tensor, str]:
    """Ranges ``(H, W)`` float64 at which rays enter and leave a box, and words for the box.

    Slab test per ray ``o + t * d`` from its optical centre, with the box's centre c and half size s
    in the axes of the box: the ray is inside for ``max_i min(t_i) <= t <= min_i max(t_i)``, where
    ``t_i = (c_i - o_i -+ s_i) / d_i``. A ray that misses the box leaves before it enters.
    """
    what = (
        f"box at ({', '.join(f'{v:g}' for v in centre_m)}) m of size "
        f"{' x '.join(f'{v:g}' for v in size_m)} m, yaw {yaw_deg:g} degrees"
    )
    if len(centre_m) != 3 or len(size_m) != 3:
        raise ValueError(f"{what}: needs x, y, z of the centre and length, width, height")
    if not all(map(math.isfinite, (*centre_m, *size_m, yaw_deg))) or min(size_m) <= 0:
        raise ValueError(f"{what}: needs finite numbers, and a size above 0 on every axis")
    axes = _box_axes(yaw_deg)
    centre = axes @ torch.tensor(centre_m, dtype=torch.float64)
    half = torch.tensor(size_m, dtype=torch.float64) / 2
    if (centre.abs() <= half).all():
        raise ValueError(f"{what} contains the sensor, so every ray hits it; move the box away")
    directions = ray_directions(projection, dtype=torch.float64) @ axes.T
    # A ray in the plane of a face gives 0 / 0: it touches the slab everywhere.
    origins = torch.zeros_like(directions)
    if isinstance(projection, BeamProjection):
        origins = projection.origins() @ axes.T
    low = ((centre - origins - half) / directions).nan_to_num(-math.inf, math.inf, -math.inf)
    high = ((centre - origins + half) / directions).nan_to_num(math.inf, math.inf, -math.inf)
    entry = torch.minimum(low, high).amax(dim=-1)
    leave = torch.maximum(low, high).amin(dim=-1)
    met = (entry <= leave) & (leave > 0)

    def range_m(along: Tensor, missed: float) -> Tensor:
        """Distance from the sensor of a place along the rays; ``missed`` where they miss."""
        along = torch.where(met, along, 0.0).clamp(min=0)
        distance = (origins + along[..., None] * directions).norm(dim=-1)
        return torch.where(met, distance, missed)

    return range_m(entry, math.inf), range_m(leave, -math.inf), what


def dropped_beams(projection: Projection, kept: Sequence[int]) -> Tensor:
    """Pixels ``(H, W)`` bool of all rows that ``kept`` does not list."""
    beams = projection.sensor.beams
    if outside := [row for row in kept if not 0 <= row < beams]:
        raise ValueError(f"row {outside[0]} is kept, but the images have rows 0 to {beams - 1}")
    missing = torch.ones(beams, projection.sensor.columns, dtype=torch.bool)
    missing[list(kept)] = False
    return check_mask(missing, f"{len(set(kept))} of {beams} beams kept: the mask of the others")


def sensor_pair(projection: Projection, other: Projection) -> Tensor:
    """Pixels ``(H, W)`` bool that another sensor at the same place does not fill.

    Each ray of the other sensor in the field of view of ``projection`` fills the pixel whose ray
    is nearest, the upper and left one at a tie.
    """
    sensor = projection.sensor
    inclination, azimuth = _rays_deg(projection)
    beams, columns = _rays_deg(other)
    in_view = (beams < sensor.inclination_max_deg) & (beams >= sensor.inclination_min_deg)
    seen_rows = torch.zeros(sensor.beams, dtype=torch.bool)
    if in_view.any():
        seen_rows[_nearest(beams[in_view, None] - inclination)] = True
    apart = columns[:, None] - azimuth
    seen_columns = torch.zeros(sensor.columns, dtype=torch.bool)
    seen_columns[_nearest((apart + _TURN_DEG / 2) % _TURN_DEG - _TURN_DEG / 2)] = True
    return check_mask(
        ~(seen_rows[:, None] & seen_columns),
        f"what a sensor of {other.sensor.beams} beams and {other.sensor.columns} columns does not "
        f"see in one of {sensor.beams} beams and {sensor.columns} columns",
    )


def check_mask(mask: Tensor, what: str) -> Tensor:
    """Return the mask.

    Raises:
        ValueError: If it is not of bool, or selects nothing or all; names ``what``.
    """
    if mask.dtype != torch.bool:
        raise ValueError(f"{what}: must be of bool, got {mask.dtype}; give for example mask > 0")
    if not mask.any():
        raise ValueError(f"{what}: selects nothing, so that nothing would change; make it larger")
    if mask.all():
        raise ValueError(
            f"{what}: selects all of {' x '.join(map(str, mask.shape))}, so that nothing of the "
            "scan would stay; make it smaller, or generate a new scene"
        )
    return mask


def token_mask(pixel_mask: Tensor, grid_size: tuple[int, int], dilation: int = 0) -> Tensor:
    """Tokens with a selected pixel.

    Args:
        pixel_mask: ``(H, W)`` bool.
        grid_size: Rows and columns (h, w) of the tokens, dividing H and W.
        dilation: Steps of :func:`dilated` on the tokens afterwards.

    Returns:
        ``(N,)`` bool, row after row, as feature grids are.
    """
    cells = rearrange(pixel_mask, "(h p) (w q) -> h w (p q)", h=grid_size[0], w=grid_size[1])
    what = f"tokens with any of their {cells.shape[-1]} pixels selected"
    return check_mask(dilated(cells.any(dim=-1), dilation).flatten(), what)


def mask_of_tokens(tokens: Tensor, grid_size: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Repeat token values ``(..., N)`` of a grid ``(h, w)`` over the patches of an image.

    Args:
        tokens: ``(..., N)``, bool or weights.
        grid_size: Rows and columns (h, w) of the tokens.
        size: Rows and columns of the result; multiples of h and w.
    """
    (rows, columns), (height, width) = grid_size, size
    p, q = height // rows, width // columns
    return repeat(tokens, "... (h w) -> ... (h p) (w q)", h=rows, w=columns, p=p, q=q)


def dilated(mask: Tensor, steps: int) -> Tensor:
    """Dilate a mask ``(..., rows, columns)`` by its 8 neighbours ``steps`` times; columns wrap."""
    if steps < 0:
        raise ValueError(f"dilation must be 0 or greater, got {steps}")
    for _ in range(steps):
        wide = mask | mask.roll(1, dims=-1) | mask.roll(-1, dims=-1)
        mask = wide.clone()
        mask[..., 1:, :] |= wide[..., :-1, :]
        mask[..., :-1, :] |= wide[..., 1:, :]
    return mask


def sector_weights(
    layout: Sequence[tuple[float, int]], grid_size: tuple[int, int], blend_deg: float = 0.0
) -> Tensor:
    """Weight of each source in each token when scenes are mixed by azimuth.

    A sector reaches from its azimuth leftwards to the next one. Its weight at an azimuth is the
    part of the surrounding ``blend_deg`` that lies in it: linear ramps centred on the seams::

        weight_i(a) = |[a - blend / 2, a + blend / 2] in sector i| / blend

    Args:
        layout: Azimuth in degrees and number of the source of each sector, in any order; a source
            may have several. The left half of 0 and the right half of 1: ``[(0, 0), (180, 1)]``.
        grid_size: Rows and columns (h, w) of the tokens; a token counts at its cell's centre.
        blend_deg: Width of the seams, in [0, 360].

    Returns:
        ``(S, N)`` float32, row after row; the sum over S is 1.
    """
    if not 0 <= blend_deg <= _TURN_DEG:
        raise ValueError(f"blend must be 0 to 360 degrees, got {blend_deg:g}")
    sources = sorted({source for _, source in layout})
    if len(sources) < 2 or sources != list(range(len(sources))):
        raise ValueError(
            f"a layout of sectors needs two or more sources, numbered from 0; got {sources}"
        )
    if not all(math.isfinite(start) for start, _ in layout):
        raise ValueError(f"azimuths of a layout must be finite, got {list(layout)}")
    ordered = sorted((start % _TURN_DEG, source) for start, source in layout)
    starts = [start for start, _ in ordered]
    if len(set(starts)) < len(starts):
        raise ValueError(f"two sectors start at one azimuth: {list(layout)}; leave one out")
    azimuth = _degrees(column_azimuths(grid_size[1], corner=False))
    weights = torch.zeros(len(sources), grid_size[1], dtype=torch.float64)
    for (start, source), end in zip(ordered, [*starts[1:], starts[0] + _TURN_DEG], strict=True):
        place, width = azimuth - start, end - start
        if blend_deg > _LEAST_BLEND_DEG:
            inside = _covered(place + blend_deg / 2, width) - _covered(place - blend_deg / 2, width)
            weights[source] += inside / blend_deg
        else:
            weights[source] += place % _TURN_DEG < width
    return repeat(weights.float(), "s w -> s (h w)", h=grid_size[0])


def _covered(place: Tensor, width: float) -> Tensor:
    """Degrees between 0 and a place that lie in a sector ``[0, width]`` of every turn."""
    return (place / _TURN_DEG).floor() * width + (place % _TURN_DEG).clamp(max=width)


def _between(projection: Projection, from_deg: float, to_deg: float, what: str) -> Tensor:
    """Columns ``(W,)`` bool whose rays lie between two azimuths."""
    are_turns = abs(from_deg) <= _TURN_DEG and abs(to_deg) <= _TURN_DEG  # NaN is not
    if not are_turns or to_deg - from_deg > _TURN_DEG:
        raise ValueError(f"{what}: azimuths must lie in -360..360 degrees, at most 360 apart")
    width = _TURN_DEG if to_deg - from_deg == _TURN_DEG else (to_deg - from_deg) % _TURN_DEG
    if width == 0:
        raise ValueError(f"{what} is empty: for a full turn give -180 and 180")
    columns = (_rays_deg(projection)[1] - from_deg) % _TURN_DEG < width
    if not columns.any():
        pitch = _TURN_DEG / projection.sensor.columns
        raise ValueError(f"{what} lies between two columns, which are {pitch:.3g} degrees apart")
    return columns


def _no_ray_error(projection: Projection, what: str) -> ValueError:
    """Error of a region that no ray meets, with the reach of the rays."""
    bottom, top = _rays_deg(projection)[0].aminmax()
    sensor = projection.sensor
    return ValueError(
        f"{what}: no ray meets it. The rays of the sensor reach from {bottom:.1f} to {top:.1f} "
        f"degrees above the horizon and {sensor.range_min_m:g} to {sensor.range_max_m:g} m; move "
        "the region there or make it larger"
    )


def _rays_deg(projection: Projection) -> tuple[Tensor, Tensor]:
    inclination, azimuth = projection.ray_angles()
    return _degrees(inclination), _degrees(azimuth)


def _nearest(apart_deg: Tensor) -> Tensor:
    """Index of the smallest angle in each row, the first of several equal up to rounding."""
    return apart_deg.abs().round(decimals=_DECIMALS).argmin(dim=1)


def _degrees(angle: Tensor) -> Tensor:
    return angle.rad2deg().round(decimals=_DECIMALS)
