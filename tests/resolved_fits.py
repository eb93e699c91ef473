"""Configurations of `r3dpa fit` commands for all tests of a process: half a second each."""

from functools import cache

from r3dpa.cli import bench

resolved = cache(bench.resolve_config)
