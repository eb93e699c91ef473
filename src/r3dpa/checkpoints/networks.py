"""Networks as data: class, arguments and weights; strict loading into networks."""

from __future__ import annotations

import importlib
import inspect
import reprlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from r3dpa.class_paths import current_path
from r3dpa.io import UNPICKLING_ERRORS

#: Fields of a :class:`Checkpoint` that files of ours, Lightning's and official ones share.
FACTS = (
    "stage",
    "geometry",
    "augmentation",
    "feature_source",
    "interpolant",
    "settings",
    "sampling",
    "version",
    "commit",
)

_OWN_PACKAGES = ("r3dpa.nn", "r3dpa.features", "r3dpa.baselines")
_further_packages: list[str] = []
_NUM_LISTED = 10
_LARGEST_SIDE = 2048  # of images, which no weights may have
#: Averaged copy of a network, which it may start from.
AVERAGES = {"sit": "ema", "latent_norm": "ema_latent_norm"}
# Arguments that change what the weights compute but not the shape of any weight, and the attribute
# in which a network, or one of its layers, keeps each.
_SHAPELESS_ARGS = {
    "input_size": "input_size",
    "num_heads": "num_heads",
    "head_channels": "head_channels",
    "alignment_depth": "alignment_depth",
    "eps": "eps",
    "legacy_upsample": "legacy",
    "norm_groups": "num_groups",
    "stem": "stem",
    "least_scale": "least_scale",
}


def allow_networks_of(packages: Iterable[str]) -> None:
    """Let checkpoints name networks of these packages too, until the process ends.

    Reading such a checkpoint imports the package. Only who started the process may allow it, as by
    ``--allow_import``, and nothing that a file says.

    Args:
        packages: Import paths of packages, modules or classes.
    """
    _further_packages.extend(packages)


def _is_allowed(import_path: str) -> bool:
    """Whether a checkpoint may name what has this import path."""
    allowed = (*_OWN_PACKAGES, *_further_packages)
    return any(f"{import_path}.".startswith(f"{package}.") for package in allowed)


def path_of(kind: type) -> str:
    """Import path of a class."""
    return f"{kind.__module__}.{kind.__qualname__}"


def shapes_of(weights: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Shape of each tensor by key."""
    return {key: tuple(value.shape) for key, value in weights.items()}


def _tuples(value: Any) -> Any:
    """YAML and JSON know lists only; the networks' sequence arguments are tuples."""
    return tuple(_tuples(item) for item in value) if isinstance(value, list | tuple) else value


def _numbers(value: Any) -> Iterator[int]:
    """Whole numbers of an argument, at any depth."""
    if isinstance(value, list | tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, int):
        yield value


@dataclass(frozen=True)
class NetworkState:
    """One network as data: class of an allowed package, plain constructor arguments, weights."""

    class_path: str
    init_args: Mapping[str, Any]
    state_dict: Mapping[str, Tensor]

    def __post_init__(self) -> None:
        object.__setattr__(self, "class_path", current_path(str(self.class_path)))

    @classmethod
    def of(cls, network: nn.Module, init_args: Mapping[str, Any]) -> NetworkState:
        """State of a network built by hand.

        Raises:
            ValueError: If the arguments do not rebuild it.
        """
        return cls(path_of(type(network)), init_args, network.state_dict()).checked()

    @property
    def config(self) -> dict[str, Any]:
        """Class and arguments in the form that YAML files have."""
        return {"class_path": self.class_path, "init_args": dict(self.init_args)}

    @property
    def kind(self) -> type[nn.Module]:
        """The class.

        Raises:
            ValueError: If it is no network of this package or an allowed one, or cannot be
                imported.
        """
        module_path, _, name = self.class_path.rpartition(".")
        if _is_allowed(self.class_path):
            try:
                kind = getattr(importlib.import_module(module_path), name)
            except ImportError as error:
                raise ValueError(
                    f"class {self.class_path!r} cannot be imported ({error}): install its package, "
                    "or name the folder of the package in PYTHONPATH"
                ) from None
            except AttributeError as error:
                raise ValueError(f"class {self.class_path!r} does not exist ({error})") from None
            is_network = isinstance(kind, type) and issubclass(kind, nn.Module)
            if is_network and _is_allowed(path_of(kind)):
                return kind
        raise ValueError(
            f"class {self.class_path!r} is not allowed: a checkpoint may only name networks "
            "defined in r3dpa.nn, r3dpa.features or r3dpa.baselines, and in a package of yours "
            "after --allow_import PACKAGE. Edit the class_path if the class was moved; otherwise "
            "do not trust the file"
        )

    @property
    def arguments(self) -> dict[str, Any]:
        """The constructor arguments, defaults included."""
        defaults: dict[str, Any] = {}
        for kind in self.kind.__mro__:  # up to the first class that takes no further keywords
            parameters = inspect.signature(kind).parameters.values()
            given = {p.name: p.default for p in parameters if p.default is not p.empty}
            defaults = given | defaults
            if not any(p.kind is p.VAR_KEYWORD for p in parameters):
                break
        return defaults | {key: _tuples(value) for key, value in self.init_args.items()}

    def new(self) -> nn.Module:
        """Build the network without the weights.

        Raises:
            ValueError: If the class refuses the arguments.
        """
        kind = self.kind
        arguments = {key: _tuples(value) for key, value in self.init_args.items()}
        try:
            return kind(**arguments)
        except UNPICKLING_ERRORS as error:
            raise ValueError(
                f"{self.class_path} does not accept the arguments "
                f"{reprlib.repr(self.init_args)}: {error}"
            ) from error

    def build(self) -> nn.Module:
        """Build the network with these weights, on the CPU, in training mode as constructed."""
        network = self.new()
        self._refuse_problems(network)
        network.load_state_dict(self.state_dict, strict=True)
        return network

    def checked(self, name: str = "") -> NetworkState:
        """Return this state if it can be built, which is tried without memory for weights.

        Raises:
            ValueError: As :meth:`build` does.
        """
        try:
            self._refuse_huge_arguments()
            with torch.device("meta"):
                network = self.new()
            self._refuse_problems(network)
        except ValueError as error:
            raise ValueError(f"{name}: {error}" if name else str(error)) from error
        return self

    def _refuse_huge_arguments(self) -> None:
        """Refuse a billion layers of a damaged file before they are built."""
        sides = (side for value in self.state_dict.values() for side in value.shape)
        largest = max(_LARGEST_SIDE, *sides)
        for key, value in self.init_args.items():
            if any(number > largest for number in _numbers(value)):
                raise ValueError(
                    f"{key} of {self.class_path} is {value}, far more than its weights"
                )

    def problems(self, network: nn.Module) -> list[str]:
        """List the keys and shapes that differ between ``network`` and these weights."""
        wanted, given = shapes_of(network.state_dict()), shapes_of(self.state_dict)
        differ = [key for key in wanted if key in given and wanted[key] != given[key]]
        return [
            *(f"shape of {key}: checkpoint {given[key]}, network {wanted[key]}" for key in differ),
            *(f"missing in the checkpoint: {key}" for key in wanted if key not in given),
            *(f"unknown to the network: {key} {given[key]}" for key in given if key not in wanted),
        ]

    def _refuse_problems(self, network: nn.Module) -> None:
        problems = _shorten(self.problems(network))
        if problems:
            raise ValueError("\n  ".join([f"the weights do not fit {self.class_path}:", *problems]))


@dataclass(frozen=True)
class Checkpoint:
    """Everything a checkpoint file says about its networks, whatever its format.

    Networks are called ``vae``, ``discriminator``, ``sit``, ``latent_norm``, ``thin_decoder``, and
    the averaged copies ``ema`` and ``ema_latent_norm``; networks of a baseline ``network``,
    ``ema_network`` and ``first_stage``. A field is None if the file does not state it.
    """

    path: Path  #: file it was read from
    stage: str  #: training stage that wrote it: ``vae_alignment``, ``joint``, ``official``, ...
    networks: Mapping[str, NetworkState]
    step: int | None = None  #: optimiser steps taken
    geometry: Mapping[str, Any] | None = None  #: plain values of its ``ScanGeometry``
    augmentation: Mapping[str, Any] | None = None  #: plain values of its ``Augmentation``
    feature_source: str | None = None  #: feature source of its last training stage
    interpolant: Literal["linear", "cosine"] = "linear"  #: path from latents to noise of its SiT
    settings: Mapping[str, Any] = field(default_factory=dict)  #: arguments of a baseline
    sampling: Mapping[str, Any] = field(default_factory=dict)  #: guidance of generated scenes
    version: str | None = None  #: version of r3dpa that wrote it
    commit: str | None = None  #: commit of r3dpa that wrote it
    official_args: Mapping[str, Any] = field(default_factory=dict)  #: official training options
    left_out: Mapping[str, str] = field(default_factory=dict)  #: unread entries, and the reason

    @property
    def facts(self) -> dict[str, Any]:
        """Plain values of all but the weights, the step and what was left out."""
        about: dict[str, Any] = {key: getattr(self, key) for key in FACTS}
        about["official_args"] = dict(self.official_args)
        about["networks"] = {name: state.config for name, state in self.networks.items()}
        return about

    def network(self, name: str) -> NetworkState:
        """Return the network called ``name``.

        Raises:
            ValueError: If the checkpoint has none.
        """
        if name not in self.networks:
            reason = f" ({self.left_out[name]})" if name in self.left_out else ""
            raise ValueError(
                f"checkpoint {self.path} is of stage {self.stage!r} and has no {name}{reason}, "
                f"only: {', '.join(self.networks)}"
            )
        return self.networks[name]


def load_into(networks: Mapping[str, nn.Module], checkpoint: Checkpoint, stage: str) -> None:
    """Copy the weights of a checkpoint into the networks of those names, all of them or none.

    Exported files hold averages alone, which ``sit`` and ``latent_norm`` then start from.

    Raises:
        ValueError: Listing for ``stage`` what is absent or does not fit; nothing is changed then.
    """
    problems: list[str] = []
    sources = {n: n if n in checkpoint.networks else AVERAGES.get(n, n) for n in networks}
    for name, network in networks.items():
        try:
            state = checkpoint.network(sources[name])
        except ValueError as error:
            problems.append(f"{error}; {stage} needs: {', '.join(networks)}")
            continue
        differences = _different_settings(state, network) + state.problems(network)
        problems += [f"{name}: {line}" for line in _shorten(differences)]
    if problems:
        raise ValueError(
            f"{stage} cannot start from {checkpoint.path}:\n  "
            + "\n  ".join(problems)
            + "\nGive the networks of this run the arguments of the checkpoint, or another file"
        )
    for name, network in networks.items():
        network.load_state_dict(checkpoint.network(sources[name]).state_dict, strict=True)


def _different_settings(state: NetworkState, network: nn.Module) -> list[str]:
    """Arguments that differ although all weights fit."""
    differences = []
    for key, attribute in _SHAPELESS_ARGS.items():
        keeper = next((m for m in network.modules() if attribute in vars(m)), None)
        if keeper is not None and key in state.arguments:
            there, here = state.arguments[key], vars(keeper)[attribute]
            if here != there:
                differences.append(f"{key}: checkpoint {there}, network {here}")
    return differences


def check_same_arguments(name: str, checkpoint: Checkpoint, other: Checkpoint) -> None:
    """Refuse a network of ``other`` that computes something else with weights of these shapes."""
    here, there = checkpoint.network(name).arguments, other.network(name).arguments
    for key in _SHAPELESS_ARGS:
        if key in here and here[key] != there.get(key):
            raise ValueError(
                f"the flow of {other.path} does not fit {checkpoint.path}: {name} has {key} "
                f"{there.get(key)} there and {here[key]} here"
            )


def _shorten(lines: list[str]) -> list[str]:
    rest = len(lines) - _NUM_LISTED
    return lines if rest <= 0 else [*lines[:_NUM_LISTED], f"... and {rest} more"]


def recorded_facts(about: Mapping[str, Any], configs: Mapping[str, Any]) -> dict[str, Any]:
    """Facts of a checkpoint that its file records; earlier files have fewer.

    Earlier versions recorded the sampling settings among the arguments of the SiT, which
    ``configs`` hold by the name of the network.
    """
    facts = {key: about[key] for key in FACTS if key in about}
    if facts.get("sampling") is None:
        facts["sampling"] = {}
        for name in ("sit", "ema"):
            config = configs.get(name)
            init_args = config.get("init_args") if isinstance(config, Mapping) else None
            if init_args and init_args.get("guidance_block"):
                scale = init_args.get("guidance_scale", 1.0)
                settings = {"block": init_args["guidance_block"], "scale": scale}
                facts["sampling"] = {"perturbed_attention": settings}
    return facts
