"""Point features without training: local shape, height and direction, lifted at random."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from r3dpa.geometry import LidarSensor, SphericalProjection, range_image

# Neighbourhood in pixels: wider than high, as a spinning sensor samples more densely in azimuth.
_ROW_OFFSETS = (-2, -1, 0, 1, 2)
_COLUMN_OFFSETS = (-6, -3, -1, 0, 1, 3, 6)
# One image for all sensors: 0.42 deg per row, between the beam spacings of the two blocks of an
# HDL-64E (0.34 and 0.51 deg).
_IMAGE = LidarSensor(
    beams=96,
    columns=1024,
    inclination_max_deg=15.0,
    inclination_min_deg=-25.0,
    range_min_m=0.0,
    range_max_m=1e6,
)
_PROJECTION = SphericalProjection(_IMAGE)
# A neighbour belongs to the surface of the centre if the ranges differ by less than this.
_GATE_M, _GATE_SHARE = 0.3, 0.05
# Spread below which a direction counts as not covered: the noise of a range measurement.
_NOISE_M = 0.01
_SENSOR_HEIGHT_M = 1.73
_BANDWIDTH = 2.0  # of the Gaussian kernel, in standard deviations
_KERNEL_WIDTH = 64  # K: the error of the kernel is about 1 / sqrt(K)
#: Mean and standard deviation of the nine `GeometricFeatures.descriptors` over points of real
#: HDL-64E scans.
CENTRES = (0.47, 0.67, 0.13, -0.28, 0.23, 0.52, 0.63, 2.3, 0.26)
SPREADS = (0.18, 0.24, 0.13, 0.34, 0.28, 0.63, 0.86, 0.65, 0.15)


class GeometricFeatures(nn.Module):
    """Frozen, label-free feature extractor: the local surroundings of a point.

    The nine values of :meth:`descriptors`, standardised with fixed constants, are lifted to
    features of unit norm whose inner product approximates a Gaussian kernel of the values::

        phi(x) = [cos(W x), sin(W x)] / sqrt(K / 2),    features = Q phi(x),    Q^T Q = I

    A scan, its mirror image and the rotated scan have the same features.

    Source: eigenvalue features as in Demantké et al., "Dimensionality based scale selection in 3D
    LiDAR point clouds" (2011); Rahimi and Recht, "Random Features for Large-Scale Kernel Machines"
    (NeurIPS 2007).

    Args:
        dim: Width D of the features, even.
    """

    name = "geometric"
    num_headings = _IMAGE.columns
    mirror_invariant = True
    centres: Tensor
    spreads: Tensor
    frequencies: Tensor
    basis: Tensor

    def __init__(self, dim: int = 768) -> None:
        super().__init__()
        if dim < 2 or dim % 2:
            raise ValueError(f"dim must be even and at least 2, got {dim}")
        self.dim = dim
        self.settings: dict[str, Any] = {"seed": 0, "version": 2}
        width = min(dim, _KERNEL_WIDTH)
        generator = torch.Generator().manual_seed(0)
        frequencies = torch.randn(len(CENTRES), width // 2, generator=generator) / _BANDWIDTH
        self.register_buffer("centres", torch.tensor(CENTRES), persistent=False)
        self.register_buffer("spreads", torch.tensor(SPREADS), persistent=False)
        self.register_buffer("frequencies", frequencies, persistent=False)
        self.register_buffer("basis", random_basis(dim, width, generator), persistent=False)

    @staticmethod
    def descriptors(points: Tensor) -> Tensor:
        """Nine values per point that describe its surroundings.

        With the standard deviations s1 >= s2 >= s3 of the neighbours along their principal axes
        and the normal n, the axis of s3, turned towards the sensor:

        0. linearity 1 - s2/s1 (1 where the neighbours lie on a line),
        1. planarity (s2 - s3)/(s2 + 1 cm) (near 1 where they lie on a plane, at any sampling),
        2. sphericity s3/s1,
        3. n along the horizontal viewing direction, 4. n across it without its sign, which a mirror
        would turn, 5. n upwards,
        6. height above the ground for a sensor 1.73 m up, metres,
        7. natural logarithm of the range in metres,
        8. intensity.

        Values 3 and 4 turn with the ray: rotating the scan about z rotates the features with it.

        Returns ``(P, 9)`` float32 of points ``(P, 4)`` x, y, z in metres, intensity. A point with
        fewer than two neighbours has shape and normal 0.
        """
        xyz = points[:, :3].float()
        radius = torch.linalg.vector_norm(xyz, dim=1)
        row, column = _PROJECTION.pixel_of(xyz)
        pixel = row * _IMAGE.columns + column
        shape, normal = _local_shape(xyz, pixel)
        azimuth = torch.atan2(xyz[:, 1], xyz[:, 0])
        cos, sin = azimuth.cos(), azimuth.sin()
        along = normal[:, 0] * cos + normal[:, 1] * sin
        across = (normal[:, 1] * cos - normal[:, 0] * sin).abs()
        height = xyz[:, 2] + _SENSOR_HEIGHT_M
        log_range = radius.clamp_min(0.1).log()
        rest = [along, across, normal[:, 2], height, log_range, points[:, 3].float()]
        return torch.cat([shape, torch.stack(rest, dim=1)], dim=1)

    prepare = descriptors

    def forward(self, points: Tensor) -> Tensor:
        """Features ``(P, dim)`` float32 of unit norm of points ``(P, 4)``."""
        return self.lift(self.point_features([self.prepare(points)])[0])

    def point_features(self, prepared: Sequence[Tensor]) -> list[Tensor]:
        """Kernel features ``phi`` ``(P_i, K)`` float32 of prepared scans, before the lift."""
        scans = (values.to(self.basis.device) for values in prepared)
        phases = ((values - self.centres) / self.spreads @ self.frequencies for values in scans)
        root = math.sqrt(self.frequencies.shape[1])
        return [torch.cat([phase.cos(), phase.sin()], dim=1) / root for phase in phases]

    def lift(self, values: Tensor) -> Tensor:
        """Linear, norm-preserving map of ``point_features``, or of means of them, to ``dim``."""
        return values @ self.basis.T


def random_basis(dim: int, width: int, generator: torch.Generator) -> Tensor:
    """Random ``(dim, width)`` float32 matrix with orthonormal columns, ``width <= dim``."""
    q, r = torch.linalg.qr(torch.randn(dim, width, generator=generator, dtype=torch.float64))
    return (q * r.diagonal().sign()).float()  # LAPACK libraries differ in the signs of Q


def _local_shape(xyz: Tensor, pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Linearity, planarity, sphericity ``(P, 3)`` and normal ``(P, 3)`` of each point's pixel.

    The neighbours of a pixel are the nearest returns of the pixels around it, columns wrapping,
    whose range is close to its own. The statistics are over the neighbours and the pixel
    itself; with fewer than three in all, every value is 0.
    """
    rows, columns = _IMAGE.beams, _IMAGE.columns
    range_m, nearest = range_image(xyz, _PROJECTION, xyz)
    assert nearest is not None
    image = torch.cat([nearest, torch.where(range_m > 0, range_m, torch.inf)[None]])
    occupied = torch.nonzero(range_m.flatten() > 0)[:, 0]
    # Wrap columns, add empty rows above and below, so that each offset is one slice of memory.
    pad_rows, pad_columns = max(_ROW_OFFSETS), max(_COLUMN_OFFSETS)
    image = torch.cat([image[..., -pad_columns:], image, image[..., :pad_columns]], dim=2)
    border = image.new_zeros(4, pad_rows, image.shape[2])
    border[3] = torch.inf
    image = torch.cat([border, image, border], dim=1)
    width = image.shape[2]
    image = image.reshape(4, -1)
    centre = (occupied // columns + pad_rows) * width + occupied % columns + pad_columns
    centres = image[:, centre]
    gate = _GATE_M + _GATE_SHARE * centres[3]
    count = torch.zeros_like(centres[3])
    first = torch.zeros_like(centres[:3])
    second = centres.new_zeros(6, len(centre))
    for row_offset in _ROW_OFFSETS:
        for column_offset in _COLUMN_OFFSETS:
            other = image[:, centre + (row_offset * width + column_offset)]
            near = ((other[3] - centres[3]).abs() < gate).float()
            x, y, z = (other[:3] - centres[:3]) * near
            count += near
            first += torch.stack([x, y, z])
            second += torch.stack([x * x, y * y, z * z, x * y, x * z, y * z])
    mx, my, mz = first / count
    second = second / count - torch.stack([mx * mx, my * my, mz * mz, mx * my, mx * mz, my * mz])
    values, normal = _symmetric_eigen(second.double())
    s1, s2, s3 = values.clamp_min(0).sqrt()
    shape = torch.stack(
        [
            1 - s2 / s1.clamp_min(1e-9),
            (s2 - s3) / (s2 + _NOISE_M),
            s3 / s1.clamp_min(1e-9),
        ]
    )
    normal = normal * torch.where((normal * centres[:3]).sum(dim=0) > 0, -1.0, 1.0)
    both = torch.cat([shape, normal]) * (count >= 3)
    table = xyz.new_zeros(rows * columns, 6)
    table[occupied] = both.T.float()
    per_point = table[pixel]
    return per_point[:, :3], per_point[:, 3:]


def _symmetric_eigen(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues ``(3, N)``, descending, and unit eigenvector ``(3, N)`` of the smallest one.

    Closed form (trigonometric solution of the characteristic cubic), ten times faster than LAPACK
    for so many small matrices.

    Args:
        matrix: ``(6, N)`` float64 entries xx, yy, zz, xy, xz, yz.
    """
    xx, yy, zz, xy, xz, yz = matrix
    mean = (xx + yy + zz) / 3
    off = xy * xy + xz * xz + yz * yz
    scale = (((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * off) / 6).sqrt()
    scale = scale.clamp_min(1e-12)
    a, b, c = (xx - mean) / scale, (yy - mean) / scale, (zz - mean) / scale
    d, e, f = xy / scale, xz / scale, yz / scale
    half_determinant = (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)) / 2
    angle = half_determinant.clamp(-1, 1).acos() / 3
    largest = mean + 2 * scale * angle.cos()
    smallest = mean + 2 * scale * (angle + 2 * math.pi / 3).cos()
    values = torch.stack([largest, 3 * mean - largest - smallest, smallest])
    # The rows of A - smallest * I span the plane across the eigenvector: take their largest
    # cross product.
    x, y, z = xx - smallest, yy - smallest, zz - smallest
    rows = torch.stack([x, xy, xz, xy, y, yz, xz, yz, z]).unflatten(0, (3, 3))
    products = torch.linalg.cross(rows[[0, 0, 1]], rows[[1, 2, 2]], dim=1)
    lengths = torch.linalg.vector_norm(products, dim=1)
    best = lengths.argmax(dim=0)
    columns = torch.arange(best.shape[0], device=best.device)
    vector = products[best, :, columns].T
    return values, vector / lengths[best, columns].clamp_min(torch.finfo(torch.float64).tiny)
