"""Networks apart from the code that trains them: class, arguments, weights; strict loading."""

from __future__ import annotations

import hashlib
import importlib
import inspect
import itertools
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

__all__ = [
    "NETWORK_NAMES",
    "Checkpoint",
    "NetworkState",
    "format_table",
    "load_into",
    "weights_sha256",
]

NETWORK_NAMES = ("vae", "discriminator", "sit", "latent_norm", "ema", "ema_latent_norm")
"""Names a network may have in a checkpoint; ``ema`` is the averaged copy of ``sit``."""

_ALLOWED_PACKAGE = "r3dpa.nn"
_NUM_LISTED = 10
# Of constructors that are given numbers or types that make no sense.
_BUILD_ERRORS = (
    *(ArithmeticError, AssertionError, AttributeError, LookupError, MemoryError),
    *(NotImplementedError, RuntimeError, TypeError, ValueError),
)
# Arguments that change what the weights compute but not the shape of any weight, and the attribute
# in which a network, or one of its layers, keeps each.
_SHAPELESS_ARGS = {
    "input_size": "input_size",
    "num_heads": "num_heads",
    "alignment_depth": "alignment_depth",
    "legacy_upsample": "legacy",
    "eps": "eps",
    "norm_groups": "num_groups",
}


def _network_class(class_path: str) -> type[nn.Module]:
    """The class of a network, looked up inside ``r3dpa.nn`` only."""
    refusal = (
        f"class {class_path!r} is not allowed: a checkpoint may only name networks defined in "
        f"{_ALLOWED_PACKAGE}. Edit the class_path if the class was moved; otherwise do not trust "
        f"the file"
    )
    module_path, _, name = str(class_path).rpartition(".")
    if module_path != _ALLOWED_PACKAGE and not module_path.startswith(f"{_ALLOWED_PACKAGE}."):
        raise ValueError(refusal)
    try:
        found = getattr(importlib.import_module(module_path), name)
    except (ImportError, AttributeError, TypeError) as error:
        raise ValueError(f"class {class_path!r} does not exist in this version ({error})") from None
    is_network = isinstance(found, type) and issubclass(found, nn.Module)
    if not is_network or not found.__module__.startswith(f"{_ALLOWED_PACKAGE}."):
        raise ValueError(refusal)
    return found


def _tuples(value: Any) -> Any:
    """YAML and JSON know lists only; the networks' sequence arguments are tuples."""
    return tuple(_tuples(item) for item in value) if isinstance(value, list | tuple) else value


@dataclass(frozen=True)
class NetworkState:
    """One network as data: class inside ``r3dpa.nn``, plain constructor arguments, weights."""

    class_path: str
    init_args: Mapping[str, Any]
    state_dict: Mapping[str, Tensor]

    @classmethod
    def of(cls, network: nn.Module, init_args: Mapping[str, Any]) -> NetworkState:
        """State of a network built by hand with the given arguments.

        Raises:
            ValueError: If the class is not allowed, or the arguments do not rebuild this network.
        """
        kind = type(network)
        state = cls(f"{kind.__module__}.{kind.__qualname__}", init_args, network.state_dict())
        state.check()
        return state

    @property
    def kind(self) -> type[nn.Module]:
        """The class; raises a ``ValueError`` if it is not one of ``r3dpa.nn``."""
        return _network_class(self.class_path)

    @property
    def arguments(self) -> dict[str, Any]:
        """The constructor arguments, defaults included."""
        parameters = inspect.signature(self.kind).parameters.values()
        defaults = {p.name: p.default for p in parameters if p.default is not p.empty}
        return defaults | {key: _tuples(value) for key, value in self.init_args.items()}

    def new(self) -> nn.Module:
        """The network freshly initialised, without the weights.

        Raises:
            ValueError: If the class is not allowed or does not accept the arguments.
        """
        kind = self.kind
        if not isinstance(self.init_args, Mapping):
            given = type(self.init_args).__name__
            raise ValueError(f"{self.class_path} needs arguments by name, got a {given}")
        try:
            return kind(**{str(key): _tuples(value) for key, value in self.init_args.items()})
        except _BUILD_ERRORS as error:
            raise ValueError(
                f"{self.class_path} does not accept the arguments "
                f"{reprlib.repr(dict(self.init_args))}: {error}"
            ) from error

    def build(self) -> nn.Module:
        """The network with these weights, on the CPU, in training mode as constructed.

        Raises:
            ValueError: As :meth:`new`, or if any key or shape does not fit, listing all of them.
        """
        network = self.new()
        _raise_if_any(self.problems(network), f"the weights do not fit {self.class_path}")
        network.load_state_dict(self.state_dict, strict=True)
        return network

    def check(self) -> None:
        """Checks that class and arguments fit the weights, without allocating memory.

        Raises:
            ValueError: As :meth:`build`.
        """
        with torch.device("meta"), _at_most(4 * len(self.state_dict) + 4):
            network = self.new()
        _raise_if_any(self.problems(network), f"the weights do not fit {self.class_path}")

    def problems(self, network: nn.Module) -> list[str]:
        """All keys and shapes that differ between ``network`` and these weights."""
        own = network.state_dict()
        missing = [f"missing in the checkpoint: {key}" for key in own if key not in self.state_dict]
        unexpected = [
            f"unknown to the network: {key} {tuple(value.shape)}"
            for key, value in self.state_dict.items()
            if key not in own
        ]
        shapes = [
            f"shape of {key}: checkpoint {tuple(self.state_dict[key].shape)}, "
            f"network {tuple(value.shape)}"
            for key, value in own.items()
            if key in self.state_dict and self.state_dict[key].shape != value.shape
        ]
        return shapes + missing + unexpected


@dataclass(frozen=True)
class Checkpoint:
    """Everything a checkpoint file says about its networks, whatever its format.

    Args:
        path: File it was read from.
        stage: Training stage that wrote it (``vae_alignment``, ``joint``, ``official``, ...).
        networks: Networks by name, see :data:`NETWORK_NAMES`.
        step: Optimiser steps taken, None if the file does not tell.
        geometry: Plain values of the ``ScanGeometry`` it was trained for, None if unknown.
        augmentation: Plain values of the ``Augmentation`` of its training, None if unknown.
        feature_source: Name of the feature source of its last training stage; None if unknown or
            none.
        interpolant: Path between latents and noise that its SiT was trained on.
        version: Version of r3dpa that wrote it, None for official files.
        commit: Commit of r3dpa that wrote it, if known.
        official_args: Options of the official training script, kept for the way back.
        left_out: Entries of the file that are not read, with the reason.
    """

    path: Path
    stage: str
    networks: Mapping[str, NetworkState]
    step: int | None = None
    geometry: Mapping[str, Any] | None = None
    augmentation: Mapping[str, Any] | None = None
    feature_source: str | None = None
    interpolant: Literal["linear", "cosine"] = "linear"
    version: str | None = None
    commit: str | None = None
    official_args: Mapping[str, Any] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)

    def network(self, name: str) -> NetworkState:
        """The network called ``name``; raises a ``ValueError`` if the checkpoint has none."""
        if name not in self.networks:
            reason = f" ({self.left_out[name]})" if name in self.left_out else ""
            raise ValueError(
                f"checkpoint {self.path} is of stage {self.stage!r} and has no {name}{reason}, "
                f"only: {', '.join(self.networks)}"
            )
        return self.networks[name]


def load_into(networks: Mapping[str, nn.Module], checkpoint: Checkpoint, stage: str) -> None:
    """Copies the weights of a checkpoint into networks, all of them or none.

    A key names the network in the checkpoint: ``{"sit": average}`` starts an average from ``sit``.
    ``stage`` appears in errors.

    Raises:
        ValueError: If a network is absent or does not fit; lists everything that does not fit, and
            no network is changed.
    """
    problems: list[str] = []
    for name, network in networks.items():
        try:
            state = checkpoint.network(name)
        except ValueError as error:
            problems.append(f"{error}; {stage} needs: {', '.join(networks)}")
            continue
        differences = _different_settings(state, network) + state.problems(network)
        problems += [f"{name}: {line}" for line in _shortened(differences)]
    if problems:
        raise ValueError(
            f"{stage} cannot start from {checkpoint.path}:\n  "
            + "\n  ".join(problems)
            + "\nGive the networks of this run the arguments of the checkpoint, or another file"
        )
    for name, network in networks.items():
        network.load_state_dict(checkpoint.network(name).state_dict, strict=True)


def weights_sha256(state: Mapping[str, Tensor]) -> str:
    """SHA-256 of the names and bytes of weights, whatever device, memory format or file."""
    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(name.encode())
        # As bytes: numpy knows no bfloat16.
        values = state[name].detach().cpu().contiguous().flatten().view(torch.uint8)
        digest.update(values.numpy().data)
    return digest.hexdigest()


def format_table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Plain-text table with aligned columns."""
    lines = [tuple(header), *(tuple(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    lines.insert(1, tuple("-" * width for width in widths))
    return "\n".join(
        "  ".join(f"{cell:<{width}}" for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )


def _different_settings(state: NetworkState, network: nn.Module) -> list[str]:
    """Arguments that differ although all weights fit."""
    differences = []
    for key, attribute in _SHAPELESS_ARGS.items():
        keeper = next((m for m in network.modules() if attribute in vars(m)), None)
        if keeper is not None and key in state.arguments:
            wanted, own = state.arguments[key], vars(keeper)[attribute]
            if own != wanted:
                differences.append(f"{key}: checkpoint {wanted}, network {own}")
    return differences


@contextmanager
def _at_most(count: int) -> Iterator[None]:
    """Limits the number of parameters: a damaged file may ask for a billion layers."""
    left = itertools.count(count, -1)

    def counted(*_: Any) -> None:
        if next(left) <= 0:
            raise ValueError(
                f"it asks for more than {count} parameters, far more than its weights are"
            )

    handle = register_module_parameter_registration_hook(counted)
    try:
        yield
    finally:
        handle.remove()


def _shortened(lines: list[str]) -> list[str]:
    """The first lines and a count of the others."""
    rest = len(lines) - _NUM_LISTED
    return lines if rest <= 0 else [*lines[:_NUM_LISTED], f"... and {rest} more"]


def _raise_if_any(problems: list[str], what: str) -> None:
    if problems:
        raise ValueError(f"{what}:\n  " + "\n  ".join(_shortened(problems)))
