"""The official code of a local checkout as modules, with stand-ins for packages that are absent.

Nothing of the checkout is copied here or written to. Its modules are imported from its folder,
then taken out of ``sys.modules`` again, so that their short names (``utils``, ``models``) meet
nobody else.
"""

from __future__ import annotations

import hashlib
import importlib
import logging
import pickle
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
import yaml
from torch import Tensor, nn

COMMIT = "aa08e6d"
"""Commit of valeoai/R3DPA that is compared with."""

# Files that are run or read, and the first 64 bits of their SHA-256 at that commit.
_DIGESTS = {
    "generate.py": "303118dd25702e2a",
    "samplers.py": "caa3c87f2b5ec04c",
    "utils.py": "c8c603055ce8f07c",
    "dataset_kitti.py": "1a507d332e6cac2d",
    "train_repae.py": "d1916ba529e1f46b",
    "models/sit.py": "5376a0bc83265d7d",
    "models/unet.py": "91a39b3323acecb4",
    "models/basic.py": "5e37654173c3d671",
    "models/attention.py": "9ab95c718796e3b4",
    "models/autoencoder.py": "5f93cfce55f9e79a",
    "models/model_lidm.py": "37e2859e7254b2d0",
    "models/model_ldm.py": "060011798c22a962",
    "loss/losses.py": "8bf6e93d58857da2",
    "loss/discriminator.py": "a05f12c266eee99c",
    "configs/kitti.yaml": "2d7fed48238b07d7",
    "configs/l1_lpips_kl_gan.yaml": "85576d4b0bd59251",
}
_PACKAGES = ("generate", "train_repae", "samplers", "utils", "dataset_kitti", "models", "loss")


class Overlay:
    """An object of which some attributes are replaced; all others are those of the original."""

    def __init__(self, base: Any, **replaced: Any) -> None:
        self._base = base
        self.__dict__.update(replaced)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._base, name)


@dataclass(frozen=True)
class OfficialCode:
    """Imported modules of a checkout."""

    repo: Path
    modules: Mapping[str, Any]
    stand_ins: Mapping[str, str]

    def __getitem__(self, name: str) -> Any:
        return self.modules[name]


def load_official(repo: Path) -> OfficialCode:
    """Imports the official code."""
    _check_checkout(repo)
    stand_ins = _stand_ins()
    replaced: dict[str, ModuleType] = {}
    for _, modules in stand_ins.values():
        replaced |= modules
    with _importing_from(repo, replaced), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Deprecated names of torch are theirs to change.
        importlib.import_module("generate")
        importlib.import_module("train_repae")
        modules = {
            name: module
            for name, module in sys.modules.items()
            if name.partition(".")[0] in _PACKAGES and name not in replaced
        }
    return OfficialCode(repo, modules, {name: text for name, (text, _) in stand_ins.items()})


def _check_checkout(repo: Path) -> None:
    get = f"get it with `git clone https://github.com/valeoai/R3DPA && git checkout {COMMIT}`"
    if not repo.is_dir():
        raise ValueError(f"{repo} is no folder; give a checkout of valeoai/R3DPA: {get}")
    for name, digest in _DIGESTS.items():
        file = repo / name
        if not file.is_file():
            raise ValueError(f"{repo} is no checkout of valeoai/R3DPA, it has no {name}; {get}")
        found = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
        if found != digest:
            raise ValueError(
                f"{file} is not that of commit {COMMIT} of valeoai/R3DPA (SHA-256 begins with "
                f"{found}, not {digest}); run `git checkout {COMMIT}` there, without local changes"
            )


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


def _stand_ins() -> dict[str, tuple[str, dict[str, ModuleType]]]:
    """What is said and which modules there are for each package; only for absent ones."""
    timm = _module("timm.models.vision_transformer", PatchEmbed=PatchEmbed, Attention=Attention)
    timm.Mlp = Mlp  # type: ignore[attr-defined]
    optional = {
        "timm": (
            "own patch embedding, attention and MLP with the numerics of timm 1.0.11",
            {"timm": _module("timm"), "timm.models": _module("timm.models"), timm.__name__: timm},
        ),
        "omegaconf": (
            "YAML as nested dictionaries",
            {"omegaconf": _module("omegaconf", OmegaConf=_Configuration)},
        ),
        "dictdot": ("a dictionary with attributes", {"dictdot": _module("dictdot", dictdot=_Dot)}),
        "joblib": ("dump by pickle", {"joblib": _module("joblib", dump=_dump)}),
        "torchvision": (
            "a name, never called",
            {
                "torchvision": _module("torchvision"),
                "torchvision.utils": _module("torchvision.utils", make_grid=_never),
            },
        ),
    }
    # In every case: what would need several processes, files of weights, or a second logger.
    always = {
        "accelerate": (
            "one process, full precision, no overhead; it times the steps",
            {
                "accelerate": _module("accelerate", Accelerator=_never),
                "accelerate.logging": _module("accelerate.logging", get_logger=logging.getLogger),
                "accelerate.utils": _module(
                    "accelerate.utils",
                    DistributedDataParallelKwargs=_never,
                    ProjectConfiguration=dict,
                    set_seed=_never,
                ),
            },
        ),
        "loss.perceptual_loss": (
            "zero: its weight is 0, though the official step computes a VGG",
            {
                "loss.perceptual_loss": _module(
                    "loss.perceptual_loss", PerceptualLoss=_NoPerceptualLoss
                )
            },
        ),
        "models.mocov3_vit": (
            "a name, never called",
            {"models.mocov3_vit": _module("models.mocov3_vit")},
        ),
        "tensorboard": (
            "a name, never called",
            {"torch.utils.tensorboard": _module("torch.utils.tensorboard", SummaryWriter=_never)},
        ),
    }
    return {name: value for name, value in optional.items() if find_spec(name) is None} | always


def _module(name: str, **content: Any) -> ModuleType:
    module = ModuleType(name)
    module.__dict__.update(content)
    return module


def _never(*args: Any, **kwargs: Any) -> Any:
    raise AssertionError("a part of the official code runs that was thought not to")


class PatchEmbed(nn.Module):
    """Patches of an image as tokens, as ``timm.layers.PatchEmbed`` numbers and names them."""

    def __init__(
        self,
        img_size: tuple[int, int],
        patch_size: int,
        in_chans: int,
        embed_dim: int,
        bias: bool = True,
    ) -> None:
        super().__init__()
        self.patch_size = (patch_size, patch_size)
        self.grid_size = (img_size[0] // patch_size, img_size[1] // patch_size)
        self.num_patches = self.grid_size[0] * self.grid_size[1]
        self.proj = nn.Conv2d(in_chans, embed_dim, patch_size, patch_size, bias=bias)

    def forward(self, image: Tensor) -> Tensor:
        return self.proj(image).flatten(2).transpose(1, 2)


class Attention(nn.Module):
    """Multi-head attention with the weights of ``timm.layers.Attention``."""

    def __init__(
        self, dim: int, num_heads: int = 8, qkv_bias: bool = False, qk_norm: bool = False
    ) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.fused_attn = True
        self.qkv = nn.Linear(dim, 3 * dim, bias=qkv_bias)
        self.q_norm = nn.LayerNorm(dim // num_heads) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(dim // num_heads) if qk_norm else nn.Identity()
        self.proj = nn.Linear(dim, dim)

    def forward(self, tokens: Tensor) -> Tensor:
        batch, number, width = tokens.shape
        split = self.qkv(tokens).view(batch, number, 3, self.num_heads, -1)
        query, key, value = split.permute(2, 0, 3, 1, 4)
        query, key = self.q_norm(query), self.k_norm(key)
        if self.fused_attn:
            mixed = F.scaled_dot_product_attention(query, key, value)
        else:
            scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-2, -1)
            mixed = scores.softmax(dim=-1) @ value
        return self.proj(mixed.transpose(1, 2).reshape(batch, number, width))


class Mlp(nn.Module):
    """Two linear layers with the weights of ``timm.layers.Mlp``, without dropout."""

    def __init__(
        self,
        in_features: int,
        hidden_features: int,
        act_layer: Callable[[], nn.Module],
        drop: float = 0.0,
    ) -> None:
        super().__init__()
        if drop:
            raise ValueError(f"the stand-in for timm knows no dropout, got {drop}")
        self.fc1 = nn.Linear(in_features, hidden_features)
        self.act = act_layer()
        self.fc2 = nn.Linear(hidden_features, in_features)

    def forward(self, tokens: Tensor) -> Tensor:
        return self.fc2(self.act(self.fc1(tokens)))


class OneProcess:
    """What a training script asks of ``accelerate.Accelerator``, for one process on the CPU."""

    is_main_process = is_local_main_process = use_distributed = False
    sync_gradients = True
    process_index, num_processes = 0, 1
    device = torch.device("cpu")
    clip_grad_norm_ = staticmethod(nn.utils.clip_grad_norm_)

    def __init__(self, clock: Callable[[], float]) -> None:
        self.clock = clock
        self.seconds: list[float] = []

    @contextmanager
    def accumulate(self, models: list[nn.Module]) -> Iterator[None]:
        start = self.clock()
        yield
        self.seconds.append(self.clock() - start)

    def autocast(self) -> nullcontext[None]:
        return nullcontext()

    def backward(self, loss: Tensor) -> None:
        loss.backward()

    def prepare(self, *things: Any) -> tuple[Any, ...]:
        return things

    def unwrap_model(self, model: nn.Module) -> nn.Module:
        return model

    def gather(self, values: Tensor) -> Tensor:
        return values

    def wait_for_everyone(self) -> None:
        """Returns at once."""

    def end_training(self) -> None:
        """Returns at once."""


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


def _dump(value: Any, path: str) -> None:
    with Path(path).open("wb") as file:
        pickle.dump(value, file, protocol=pickle.HIGHEST_PROTOCOL)


class _NoPerceptualLoss(nn.Module):
    def __init__(self, name: str) -> None:
        super().__init__()

    def forward(self, image: Tensor, reconstruction: Tensor) -> Tensor:
        return image.new_zeros(())
