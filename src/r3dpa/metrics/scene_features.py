"""Feature spaces in which sets of scenes are compared, one vector per scene.

===============  =======================================  =====  ===============
name             features                                 width  weights
===============  =======================================  =====  ===============
``frid``         decoder of RangeViT, bands of rows       1024   official file
``fld``          mean patch token of LIP-Loc              384    official file
``fsvd``         MinkowskiNet before its head, rings      768    official file
``fpvd``         SPVCNN before its head, rings            768    official file
``frd``          4096 values of RangeNet-53 (R2DM)        4096   official file
``frid_r2flow``  decoder of RangeNet-21, bands of rows    512    official file
``frid_lidm``    the same without standardised input      512    official file
``fpd``          last four layers of PointNet (R2DM)      1808   official file
``fwid``         tokens of ``waffleiron-s``, over points  128    in the package
``fwid_judge``   the same of ``waffleiron-judge``         96     in the package
``fgeo``         ``geometric``, mean over points          64     needs none
===============  =======================================  =====  ===============

Distances in the last three have no published numbers. ``fwid`` and ``fwid_judge`` take the weights
of another WaffleIron too, as ``conf/experiment/waffleiron_judge.yaml`` writes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r3dpa.feature_names import FREE_SPACES, SPACES
from r3dpa.features import GeometricFeatures, WaffleIronJudge, WaffleIronS
from r3dpa.features.geometric import CENTRES
from r3dpa.features.scalr import sha256
from r3dpa.geometry import unproject
from r3dpa.io import usable_device
from r3dpa.metrics.networks.liploc import GREY_LEVELS_PER_M, LIPLoc
from r3dpa.metrics.networks.minkowski import SPVCNN, MinkowskiNet
from r3dpa.metrics.networks.pointnet import POINTS_SCALE_M, PointNet
from r3dpa.metrics.networks.rangenet import NUM_BANDS, NUM_PICKED, RangeNet, banded, picked
from r3dpa.metrics.networks.rangevit import RangeViT, range_channels
from r3dpa.metrics.networks.sparse import NUM_BINS, pool_voxels, voxelize
from r3dpa.metrics.scene import DEFAULT, EvaluationScene, Protocol

# Not all generators make intensities: all points get the mean of real scans.
_INTENSITY = CENTRES[-1]


@dataclass(frozen=True)
class SceneFeatures:
    """A frozen network as a map from scenes to vectors."""

    name: str  #: one of :data:`r3dpa.feature_names.SPACES`
    dim: int  #: width F of the features
    card: dict[str, Any]  #: ``backbone``, ``layer``, ``weights`` (SHA-256), ``preprocessing``
    extract: Callable[[Sequence[EvaluationScene]], Tensor]  #: ``(B, F)``, of :func:`through_sensor`

    @property
    def label(self) -> str:
        """Head of the column in tables."""
        return self.name.upper()

    @torch.inference_mode()
    def __call__(self, scenes: Sequence[EvaluationScene]) -> Tensor:
        """Return features ``(B, F)`` float32 on the CPU.

        Raises:
            ValueError: If features are not finite; names the scene.
        """
        # GPUs round the factors of a convolution to 10 bits (TF32) unless disabled.
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            features = self.extract(scenes).float().cpu()
        broken = (~features.isfinite().all(dim=1)).nonzero().flatten().tolist()
        if broken:
            raise ValueError(
                f"{scenes[broken[0]].name}: its features of {self.label} hold NaN or infinite "
                "values; check the scene, and the weights"
            )
        return features


def scene_features(
    name: str, ckpt: str | Path | None = None, protocol: Protocol = DEFAULT, device: str = "cpu"
) -> SceneFeatures:
    """Return a feature space by its name.

    Raises:
        ValueError: If the name is unknown, or the weights are missing or of another network.
    """
    if name not in SPACES:
        raise ValueError(f"unknown feature space {name!r}; choose from {', '.join(SPACES)}")
    if name == "fgeo" and ckpt is not None:
        raise ValueError(f"fgeo has no weights: leave {ckpt} out")
    if name in FREE_SPACES:
        return point_extractor_space(name, None if ckpt is None else Path(ckpt), device)
    if ckpt is None:
        raise ValueError(
            f"{name} needs weights: give --ckpt.{name} FILE (`r3dpa test`: --scorer.ckpt.{name} "
            f"FILE), the model.ckpt of the release; without a file there are "
            f"{', '.join(FREE_SPACES)}"
        )
    if name == "frid":
        return range_vit_space(RangeViT.from_checkpoint(ckpt, protocol.sensor).to(device))
    if name == "fld":
        return lip_loc_space(LIPLoc.from_checkpoint(ckpt).to(device), protocol)
    if name == "fpd":
        return point_net_space(PointNet.from_checkpoint(ckpt).to(device), protocol)
    if name in ("frd", "frid_r2flow", "frid_lidm"):
        return range_net_space(name, RangeNet.from_checkpoint(ckpt).to(device), protocol)
    network = (SPVCNN if name == "fpvd" else MinkowskiNet).from_checkpoint(ckpt)
    return voxel_space(network.to(device), protocol)


def feature_spaces(
    names: Iterable[str], ckpt: Mapping[str, Any] | None, protocol: Protocol, device: str
) -> list[SceneFeatures]:
    """Return feature spaces by name.

    Raises:
        ValueError: As :func:`scene_features`, or for weights of a space that is not among them.
    """
    names, files = list(dict.fromkeys(names)), ckpt or {}
    for name in files:
        if name not in names:
            raise ValueError(
                f"--ckpt.{name}: {name} is not among the spaces ({', '.join(names)}); add it to "
                f"them, or leave its file out (`r3dpa test`: --scorer.ckpt.{name})"
            )
    device = usable_device(device)
    return [scene_features(name, files.get(name), protocol, device) for name in names]


def range_vit_space(network: RangeViT) -> SceneFeatures:
    """FRID's features; a network of 5 input channels needs scenes with intensity."""
    device = network.image_mean.device

    def extract(scenes: Sequence[EvaluationScene]) -> Tensor:
        if network.in_channels < 5:
            return network(_stack(scenes, "range_m", device), None)
        intensity = _intensities(scenes, "RangeViT", device, "; give the weights rangevit_wo_i")
        return network(_stack(scenes, "range_m", device), intensity)

    card = _card(network, "decoder, means of bands of rows", "pixel corners, -1 where empty")
    card["in_channels"] = network.in_channels
    return SceneFeatures("frid", network.dim, card, extract)


def range_net_space(name: str, network: RangeNet, protocol: Protocol) -> SceneFeatures:
    """Features of RangeNet++ for ``frd``, ``frid_r2flow`` or ``frid_lidm``.

    LiDM feeds metres, -1 where a pixel is empty, on the corners of pixels; the others standardise
    the channels, 0 where empty, with constants that differ between archives.

    Raises:
        ValueError: If the network cannot halve the columns of the sensor five times, or its rings
            do not fill 16 equal bands.
    """
    beams, columns = protocol.sensor.beams, protocol.sensor.columns
    if columns % 32 or (name != "frd" and beams % NUM_BANDS):
        raise ValueError(
            f"{name} needs a multiple of 32 columns, and of {NUM_BANDS} rings for its bands, but "
            f"the images are {beams} x {columns}: leave {name} out of the spaces"
        )
    device, raw = network.image_mean.device, name == "frid_lidm"
    corner = raw or protocol.unprojection == "corner"

    def extract(scenes: Sequence[EvaluationScene]) -> Tensor:
        range_m = _stack(scenes, "range_m", device)
        if raw:
            channels = range_channels(range_m, protocol.sensor)
        else:
            xyz = unproject(range_m, protocol.projection, corner).movedim(-1, 1)
            channels = torch.cat([range_m.clamp(min=0)[:, None], xyz], dim=1)
        if network.in_channels == 5:
            intensity = _intensities(scenes, "RangeNet", device)[:, None]
            channels = torch.cat([channels, intensity], dim=1)
        features = network.feature_map(channels if raw else network.normalise(channels))
        return picked(features) if name == "frd" else banded(features)

    layer = "decoder, values at fixed places" if name == "frd" else "decoder, means of bands"
    where = f"pixel {'corners' if corner else 'centres'}"
    card = _card(network, layer, f"{where}, -1 where empty" if raw else f"{where}, standardised")
    if not raw:
        card["mean"] = network.image_mean.flatten().tolist()
        card["deviation"] = network.image_std.flatten().tolist()
    dim = NUM_PICKED if name == "frd" else network.width * NUM_BANDS
    return SceneFeatures(name, dim, card, extract)


def point_net_space(network: PointNet, protocol: Protocol) -> SceneFeatures:
    """FPD's features, of the points of all pixels; those without a return are at the origin."""
    corner, device = protocol.unprojection == "corner", network.fc3.weight.device

    def extract(scenes: Sequence[EvaluationScene]) -> Tensor:
        points = unproject(_stack(scenes, "range_m", device), protocol.projection, corner)
        return network(points.flatten(1, 2).transpose(1, 2) / POINTS_SCALE_M)

    where = f"pixel {protocol.unprojection}s, origin where empty, {POINTS_SCALE_M:g} m are 1"
    return SceneFeatures("fpd", network.dim, _card(network, "last four layers", where), extract)


def lip_loc_space(network: LIPLoc, protocol: Protocol) -> SceneFeatures:
    """FLD's features, with the cast of the protocol."""
    farthest_m = 255 / GREY_LEVELS_PER_M

    def extract(scenes: Sequence[EvaluationScene]) -> Tensor:
        range_m = _stack(scenes, "range_m", network.embedding.weight.device)
        if protocol.liploc_cast == "clip":
            range_m = range_m.clamp(0, farthest_m)
        return network(range_m)

    preprocessing = f"{GREY_LEVELS_PER_M} grey levels a metre, {protocol.liploc_cast} to 8 bits"
    card = _card(network, "mean patch token, normalised", preprocessing)
    return SceneFeatures("fld", network.dim, card, extract)


def voxel_space(network: MinkowskiNet, protocol: Protocol) -> SceneFeatures:
    """Features of FPVD for an SPVCNN, of FSVD for a plain MinkowskiNet."""
    name = "fpvd" if isinstance(network, SPVCNN) else "fsvd"
    if isinstance(network, SPVCNN):
        network.voxel_m = protocol.voxel_m
    network.requires_grad_(False).eval()
    sensor, voxel_m = protocol.sensor, protocol.voxel_m

    def extract(scenes: Sequence[EvaluationScene]) -> Tensor:
        device = network.head.weight.device
        limits = {"range_min_m": sensor.range_min_m, "range_max_m": sensor.range_max_m}
        clouds = []
        for index, scene in enumerate(scenes):
            voxels, inputs = voxelize(_points(scene), voxel_m, **limits)
            clouds.append((F.pad(voxels, (0, 1), value=index), inputs))
        coordinates, inputs = (torch.cat(parts).to(device) for parts in zip(*clouds, strict=True))
        return pool_voxels(network(coordinates, inputs), coordinates, len(scenes), voxel_m)

    preprocessing = f"voxels of {voxel_m:g} m, first point, no intensity"
    card = _card(network, f"before the head, means of {NUM_BINS} rings", preprocessing)
    return SceneFeatures(name, NUM_BINS * network.widths[-1], card, extract)


def point_extractor_space(name: str, ckpt: Path | None, device: str) -> SceneFeatures:
    """Features of FWID, FWID_JUDGE and FGEO: means over points, not lifted to more dimensions."""
    extractor: Any
    if name == "fgeo":
        extractor = GeometricFeatures()
        dim, layer = extractor.basis.shape[1], "kernel features, mean over points"
    else:
        extractor = (WaffleIronJudge if name == "fwid_judge" else WaffleIronS)(ckpt)
        dim, layer = extractor.network.width, "normalised tokens, mean over points"
    extractor.to(device)

    def extract(scenes: Sequence[EvaluationScene]) -> Tensor:
        clouds = [F.pad(_points(scene), (0, 1), value=_INTENSITY) for scene in scenes]
        features = extractor.point_features([extractor.prepare(cloud) for cloud in clouds])
        return torch.stack([values.mean(dim=0) for values in features])

    card = {
        "backbone": extractor.name,
        "layer": layer,
        "weights": extractor.settings.get("weights"),
        "preprocessing": f"intensity {_INTENSITY:g} for all points",
        "version": extractor.settings["version"],
    }
    return SceneFeatures(name, dim, card, extract)


def _card(network: nn.Module, layer: str, preprocessing: str) -> dict[str, Any]:
    card = {"backbone": type(network).__name__, "layer": layer, "weights": sha256(network)}
    return {**card, "preprocessing": preprocessing}


def _stack(scenes: Sequence[EvaluationScene], field: str, device: torch.device) -> Tensor:
    return torch.stack([getattr(scene, field) for scene in scenes]).to(device)


def _intensities(
    scenes: Sequence[EvaluationScene], network: str, device: torch.device, advice: str = ""
) -> Tensor:
    for scene in scenes:
        if scene.intensity is None:
            raise ValueError(
                f"{scene.name}: has no intensity, which these weights of {network} read{advice}"
            )
    return _stack(scenes, "intensity", device)


def _points(scene: EvaluationScene) -> Tensor:
    assert scene.points is not None, "scenes of through_sensor have points"
    return scene.points
