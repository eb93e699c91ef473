"""The official code of a local checkout as modules, with stand-ins for packages that are absent.

Nothing of the checkout is copied here or written to. Its modules are imported from its folder,
then taken out of ``sys.modules`` again, so that their short names (``utils``, ``models``) meet
nobody else.
"""

from __future__ import annotations

import importlib
import logging
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import torch.nn.functional as F
import yaml
from torch import Tensor, nn

COMMIT = "aa08e6d"
"""Commit of valeoai/R3DPA that is compared with."""

_PACKAGES = ("generate", "samplers", "utils", "dataset_kitti", "models", "loss")


class Overlay:
    """An object of which some attributes are replaced; all others are those of the original."""

    def __init__(self, base: Any, **replaced: Any) -> None:
        self._base = base
        self.__dict__.update(replaced)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._base, name)


class OfficialCode(NamedTuple):
    """Imported modules of a checkout."""

    repo: Path
    modules: dict[str, Any]

    def __getitem__(self, name: str) -> Any:
        return self.modules[name]


def load_official(repo: Path) -> OfficialCode:
    """Imports the official code of a checkout of the commit without local changes."""
    git = ["git", "--no-optional-locks", "-C", str(repo)]
    found = subprocess.run(
        [*git, "describe", "--always", "--dirty"], capture_output=True, text=True
    )
    if found.stdout.strip() != COMMIT or not (repo / "generate.py").is_file():
        raise ValueError(
            f"{repo} is no unchanged checkout of commit {COMMIT} of valeoai/R3DPA: get it with "
            f"`git clone https://github.com/valeoai/R3DPA && git checkout {COMMIT}`"
        )
    replaced = _stand_ins()
    with _importing_from(repo, replaced), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Deprecated names of torch are theirs to change.
        importlib.import_module("generate")
        modules = {
            name: module
            for name, module in sys.modules.items()
            if name.partition(".")[0] in _PACKAGES and name not in replaced
        }
    return OfficialCode(repo, modules)


@contextmanager
def _importing_from(repo: Path, replaced: Mapping[str, ModuleType]) -> Iterator[None]:
    """Imports come from the folder first; modules, path and bytecode are as before afterwards."""
    before = dict(sys.modules)
    writes_nothing = sys.dont_write_bytecode
    for name in list(sys.modules):
        if name.partition(".")[0] in _PACKAGES:
            del sys.modules[name]
    sys.modules.update(replaced)
    sys.path.insert(0, str(repo))
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        sys.dont_write_bytecode = writes_nothing
        sys.path.remove(str(repo))
        for name in list(sys.modules):
            if name in replaced or name.partition(".")[0] in _PACKAGES:
                del sys.modules[name]
        sys.modules.update(before)


def _stand_ins() -> dict[str, ModuleType]:
    """Modules in place of packages that are absent, or need several processes or weights."""
    contents: dict[str, dict[str, Any]] = {
        # With the numerics of timm 1.0.11.
        "timm": {},
        "timm.models": {},
        "timm.models.vision_transformer": {
            cls.__name__: cls for cls in (PatchEmbed, Attention, Mlp)
        },
        "omegaconf": {"OmegaConf": _Configuration},
        "dictdot": {"dictdot": _Dot},
        "torchvision": {},
        "torchvision.utils": {"make_grid": _never},
        "accelerate": {"Accelerator": _never},
        "accelerate.logging": {"get_logger": logging.getLogger},
        "accelerate.utils": {
            "DistributedDataParallelKwargs": _never,
            "ProjectConfiguration": dict,
            "set_seed": _never,
        },
        "loss.perceptual_loss": {"PerceptualLoss": _NoPerceptualLoss},  # its weight is 0
        "models.mocov3_vit": {},
        "torch.utils.tensorboard": {"SummaryWriter": _never},
    }
    modules = {name: ModuleType(name) for name in contents}
    for name, content in contents.items():
        vars(modules[name]).update(content)
    return modules


def _never(*args: Any, **kwargs: Any) -> Any:
    raise AssertionError("a part of the official code runs that was thought not to")


class PatchEmbed(nn.Module):
    """Patches of an image as tokens, as ``timm.layers.PatchEmbed`` numbers and names them."""

    def __init__(self, size: tuple[int, int], patch: int, channels: int, width: int, bias: bool):
        super().__init__()
        self.patch_size = (patch, patch)
        self.grid_size = (size[0] // patch, size[1] // patch)
        self.num_patches = self.grid_size[0] * self.grid_size[1]
        self.proj = nn.Conv2d(channels, width, patch, patch, bias=bias)

    def forward(self, image: Tensor) -> Tensor:
        return self.proj(image).flatten(2).transpose(1, 2)


class Attention(nn.Module):
    """Multi-head attention with the weights of ``timm.layers.Attention``."""

    def __init__(self, dim: int, num_heads: int, qkv_bias: bool, qk_norm: bool) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.qkv = nn.Linear(dim, 3 * dim, bias=qkv_bias)
        self.q_norm = nn.LayerNorm(dim // num_heads) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(dim // num_heads) if qk_norm else nn.Identity()
        self.proj = nn.Linear(dim, dim)

    def forward(self, tokens: Tensor) -> Tensor:
        batch, number, width = tokens.shape
        split = self.qkv(tokens).view(batch, number, 3, self.num_heads, -1)
        query, key, value = split.permute(2, 0, 3, 1, 4)
        query, key = self.q_norm(query), self.k_norm(key)
        mixed = F.scaled_dot_product_attention(query, key, value)
        return self.proj(mixed.transpose(1, 2).reshape(batch, number, width))


class Mlp(nn.Module):
    """Two linear layers with the weights of ``timm.layers.Mlp``, without dropout."""

    def __init__(
        self, in_features: int, hidden_features: int, act_layer: type[nn.Module], drop: int
    ) -> None:
        super().__init__()
        assert not drop
        self.fc1 = nn.Linear(in_features, hidden_features)
        self.act = act_layer()
        self.fc2 = nn.Linear(hidden_features, in_features)

    def forward(self, tokens: Tensor) -> Tensor:
        return self.fc2(self.act(self.fc1(tokens)))


class _Dot(dict):
    """A dictionary whose entries are attributes too."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(name) from None


class _Yaml(yaml.SafeLoader):
    """YAML 1.2 as OmegaConf reads it: ``1e-6`` is a number."""


_Yaml.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"),
    list("0123456789+-"),
)


class _Configuration:
    @staticmethod
    def load(path: str) -> _Dot:
        # yaml.load with a safe loader
        return _dotted(yaml.load(Path(path).read_text(), _Yaml))


def _dotted(value: Any) -> Any:
    if isinstance(value, dict):
        return _Dot({key: _dotted(entry) for key, entry in value.items()})
    return [_dotted(entry) for entry in value] if isinstance(value, list) else value


class _NoPerceptualLoss(nn.Module):
    def __init__(self, name: str) -> None:
        super().__init__()

    def forward(self, image: Tensor, reconstruction: Tensor) -> Tensor:
        return image.new_zeros(())
