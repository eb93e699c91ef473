"""Random clouds for training on points, and the grid they lie in."""

import torch

from r3dpa.features import ScanGrid

GRID = ScanGrid((-8.0, -8.0, -2.0), (8.0, 8.0, 4.0), cell_m=0.5, voxel_m=0.3, num_neighbors=4)


def cloud(seed=0, num_points=800):
    generator = torch.Generator().manual_seed(seed)
    xyz = torch.randn(num_points, 3, generator=generator) * torch.tensor([4.0, 4.0, 1.0])
    return torch.cat([xyz, torch.rand(num_points, 1, generator=generator)], dim=1)
