"""A device without memory in place of a GPU: finds host synchronisation and mixed devices on a CPU.

Tensors on ``meta`` have shapes and a device but no values. Reading a value (``.item()``,
``bool(tensor)``, ``.tolist()``, ``.cpu()``, a mask as an index) raises an error there, where a GPU
would wait. :class:`OneDevice` adds the error for CPU tensors among others. In contrast to
``FakeTensorMode`` with ``cuda`` tensors, slices and gradients work without a CUDA build, and host
arithmetic on CPU tensors alone is allowed.
"""

from __future__ import annotations

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

COPIES = {torch.ops.aten._to_copy.default}


class OneDevice(TorchDispatchMode):
    """Refuses operations on tensors of several devices; numbers and copies are allowed."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        values = [value for value in tree_leaves((args, kwargs)) if isinstance(value, torch.Tensor)]
        devices = {value.device.type for value in values if value.dim()}
        if len(devices) > 1 and func not in COPIES:
            raise AssertionError(f"{func} got tensors of {' and '.join(sorted(devices))}")
        return func(*args, **kwargs or {})
