"""LiDAR scene generation with 3D representation alignment (R3DPA)."""

__version__ = "0.1.0"
