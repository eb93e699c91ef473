"""What a VAE costs and keeps: time, work and memory of its two halves, and its reconstruction."""

from __future__ import annotations

import copy
import ctypes
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode
from tqdm import tqdm

from r3dpa.bench.timing import Comparison, compare, seconds
from r3dpa.checkpoints import NetworkState, read_checkpoint
from r3dpa.checkpoints.networks import format_table
from r3dpa.data import find_scans, read_scan
from r3dpa.data.scans import evenly
from r3dpa.geometry import (
    LidarSensor,
    RangeCodec,
    ScanGeometry,
    SphericalProjection,
    range_image,
)
from r3dpa.io import atomic_path, command, machine, one_line, usable_device, versions
from r3dpa.nn import VAE
from r3dpa.simulation import Street, Weather, hdl64e, simulate_scan

__all__ = [
    "NETS",
    "Reconstruction",
    "VAECost",
    "VAESettings",
    "peak_bytes",
    "reconstruction",
    "vae",
    "vae_flop",
]

NETS = ("h2p4d8", "h1p4d4", "h16d4", "h16p2d16")
"""Variants with official weights, measured where none are named."""

_QUICK_NETS = ("demo",)
_CASES = {
    "fp32": (torch.float32, torch.contiguous_format),
    "fp32 channels-last": (torch.float32, torch.channels_last),
    "bf16": (torch.bfloat16, torch.contiguous_format),
    "bf16 channels-last": (torch.bfloat16, torch.channels_last),
}
_GIGA, _MIB = 1e9, 2**20


@dataclass(frozen=True)
class VAESettings:
    """How VAEs are measured.

    Args:
        batch_size: Range images per pass.
        rounds: Passes of each case, after one that does not count.
        image_size: Rows and columns, where no checkpoint tells.
        num_scans: Scans that are reconstructed.
        device: ``cpu``, ``cuda``, or ``auto`` for the GPU where there is one.

    Raises:
        ValueError: If a count is below 1.
    """

    batch_size: int = 1
    rounds: int = 3
    image_size: tuple[int, int] = (64, 1024)
    num_scans: int = 8
    device: Literal["auto", "cpu", "cuda"] = "auto"

    def __post_init__(self) -> None:
        """Check the counts."""
        for name in ("batch_size", "rounds", "num_scans"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")

    @property
    def place(self) -> torch.device:
        """Where it is measured."""
        return torch.device(usable_device(self.device))


@dataclass(frozen=True)
class Reconstruction:
    """What is left of scans, through the mean of the posterior and back.

    Args:
        scans: How many.
        error_m: Mean absolute range error in metres, of pixels with a return in both; None where
            there is no such pixel.
        agreement: Share of the pixels that have a return in both or in neither.
        bf16_error_m: Likewise in metres, between decoding in bf16 and in fp32.
    """

    scans: int
    error_m: float | None
    agreement: float
    bf16_error_m: float | None


@dataclass(frozen=True)
class VAECost:
    """What a VAE costs. The cases are fp32 and bf16 weights, each with both memory layouts.

    Args:
        name: Of the variant.
        weights: Name of the checkpoint, or ``untrained``.
        image_size: Rows and columns of the range image.
        latent_size: Channels, rows and columns of the latents.
        parameters: Of encoder and decoder with their 1x1 convolutions.
        flop: Of encoding and of decoding one range image: twice the multiplications.
        encode: Times of one batch.
        decode: Times of one batch.
        decode_peak_bytes: Memory of decoding one batch by case, beyond weights and latents; of the
            process on a CPU, of tensors on a GPU; None where the system does not tell.
        reconstruction: None without trained weights or range encoding.
    """

    name: str
    weights: str
    image_size: tuple[int, int]
    latent_size: tuple[int, int, int]
    parameters: dict[str, int]
    flop: dict[str, int]
    encode: Comparison
    decode: Comparison
    decode_peak_bytes: dict[str, int | None]
    reconstruction: Reconstruction | None

    def facts(self) -> list[str]:
        """Cells of the first table."""
        found = self.reconstruction
        quality = (
            [f"{self.weights}: no reconstruction figure", "-", "-"]
            if found is None
            else [
                "-" if value is None else f"{value:.4f}"
                for value in (found.error_m, found.agreement, found.bf16_error_m)
            ]
        )
        return [
            self.name,
            "x".join(map(str, self.image_size)),
            "x".join(map(str, self.latent_size)),
            *(f"{count / 1e6:.2f}" for count in self.parameters.values()),
            *(f"{flop / _GIGA:.1f}" for flop in self.flop.values()),
            *quality,
        ]

    def times(self, batch_size: int) -> list[list[str]]:
        """Rows of the second table, one a case: milliseconds per range image."""
        rows = []
        for case in _CASES:
            cells = [self.name, case]
            for half, comparison in (("decode", self.decode), ("encode", self.encode)):
                ms, ratio = comparison.ms[case], comparison.over_first.get(case)
                per_image = [value / batch_size for value in (ms.median, ms.min, ms.max)]
                cells += [
                    "{:.4g} ({:.4g}..{:.4g})".format(*per_image),
                    "1"
                    if ratio is None
                    else f"{ratio.value:.3f} ({ratio.low:.3f}..{ratio.high:.3f})",
                    f"{self.flop[half] / _GIGA / (per_image[0] / 1000):.4g}",
                ]
            peak = self.decode_peak_bytes[case]
            rows.append([*cells, "-" if peak is None else f"{peak / _MIB:.0f}"])
        return rows

    def verdicts(self) -> list[str]:
        """How far the first case is from itself, and whether ratios mean anything."""
        return [
            f"{self.name} {half}: {next(iter(_CASES))} against itself "
            f"{c.repeat.value:.3f} ({c.repeat.low:.3f}..{c.repeat.high:.3f})"
            + ("" if c.sound else ": the machine was not quiet, no ratio counts")
            for half, c in (("decode", self.decode), ("encode", self.encode))
        ]


def vae(
    nets: Sequence[str] | None = None,
    ckpt: Mapping[str, Path] | None = None,
    scans: Path | None = None,
    conf: Path = Path("conf"),
    settings: VAESettings | None = None,
    quick: bool = False,
    out: Path | None = None,
) -> str:
    """Measures VAEs one after the other, the cases of each in turn.

    Decoding and encoding are timed apart. A checkpoint replaces the random weights of the net of
    its name, or adds a net; its scan geometry sets the image size, and its reconstruction is
    measured.

    Args:
        nets: Names, ``h2p4d8`` for ``<conf>/net/vae_h2p4d8.yaml``, or YAML files of a VAE, thin
            ones for example; where None, :data:`NETS`, or the demo's with ``quick``.
        ckpt: Checkpoint with a VAE, of any layout, by name.
        scans: ``.bin`` file, or folder of them, to reconstruct; simulated streets where None.
        conf: Folder of the configurations.
        settings: Sizes, effort and device.
        quick: Demo VAE, 32 x 256 pixels, two scans: only to try it.
        out: JSON file for the same figures, without rounding.

    Returns:
        A table of sizes, work and reconstruction, one of times, and a line each about the
        repetition of every first case, settings, machine and versions.

    Raises:
        ValueError: If a YAML file is absent or describes no VAE, a checkpoint holds none, or there
            is no scan.
        ScanError: If a scan cannot be used.
    """
    if settings is None:
        quick_settings = VAESettings(rounds=3, image_size=(32, 256), num_scans=2)
        settings = quick_settings if quick else VAESettings()
    files, chosen = dict(ckpt or {}), nets or (_QUICK_NETS if quick else NETS)
    subjects = {
        _name(net): _subject(net, files.get(_name(net)), conf, settings.image_size)
        for net in (*chosen, *files)
    }
    points = _points(scans, settings.num_scans)
    costs = [
        _measure(subject, points, settings)
        for subject in tqdm(subjects.values(), "bench", unit="VAE", disable=None)
    ]
    device = settings.place
    gpu = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    about: dict[str, str | dict[str, Any]] = {
        "command": command(),
        "settings": asdict(settings)
        | {"scans": "simulated" if scans is None else scans.name, "device": device.type},
        "machine": machine()
        | {"threads": torch.get_num_threads(), "gpu": gpu}
        | {"fp32_convolutions_in_tf32": gpu is not None and torch.backends.cudnn.allow_tf32},
        "versions": versions(torch),
    }
    if out is not None:
        content = {**about, "vaes": [asdict(cost) for cost in costs]}
        with atomic_path(out) as temporary:
            temporary.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n")
    header = ["VAE", "image", "latents", "encoder M", "decoder M", "encode GFLOP", "decode GFLOP"]
    header += ["range error m", "mask agreement", "bf16 error m"]
    per_half = ("ms per scene", "over fp32", "GFLOP/s")
    timed = [
        "VAE",
        "case",
        *(f"{half} {what}" for half in ("decode", "encode") for what in per_half),
    ]
    lines = [format_table(header, (cost.facts() for cost in costs)), ""]
    rows = [row for cost in costs for row in cost.times(settings.batch_size)]
    lines += [format_table([*timed, "decode peak MiB"], rows), ""]
    lines += [line for cost in costs for line in cost.verdicts()]
    return "\n".join([*lines, *(f"{name}: {one_line(values)}" for name, values in about.items())])


@dataclass(frozen=True)
class _Subject:
    """A VAE to measure: its weights' file name, if any, and what it was trained on, if known."""

    name: str
    network: VAE
    weights: str
    geometry: ScanGeometry
    trained: bool


def _name(net: str) -> str:
    return Path(net).stem.removeprefix("vae_")


def _subject(net: str, ckpt: Path | None, conf: Path, image_size: tuple[int, int]) -> _Subject:
    rows, columns = image_size
    sensor = LidarSensor(beams=rows, columns=columns)
    geometry = ScanGeometry(SphericalProjection(sensor), RangeCodec(), image_size)
    name = _name(net)
    if ckpt is not None:
        checkpoint = read_checkpoint(ckpt)
        network, trained = checkpoint.network("vae").build(), checkpoint.geometry is not None
        if checkpoint.geometry is not None:
            geometry = ScanGeometry.from_dict(dict(checkpoint.geometry))
        weights = ckpt.name if trained else f"{ckpt.name} (range encoding unknown)"
    else:
        path = Path(net) if net.endswith(".yaml") else conf / "net" / f"vae_{net}.yaml"
        if not path.is_file():
            raise ValueError(
                f"there is no configuration {path} of a VAE; name one of {', '.join(NETS)} in the "
                "repository of r3dpa, or give conf its folder conf, or a YAML file"
            )
        config = yaml.safe_load(path.read_text())
        if not isinstance(config, dict) or "class_path" not in config:
            raise ValueError(f"{path} names no class_path; give the YAML file of a VAE")
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            state = NetworkState(config["class_path"], config.get("init_args") or {}, {})
            network, weights, trained = state.new(), "untrained", False
    if not isinstance(network, VAE):
        raise ValueError(f"{ckpt or net} describes a {type(network).__name__}, not a VAE")
    return _Subject(name, network.eval().requires_grad_(False), weights, geometry, trained)


def _points(scans: Path | None, num_scans: int) -> list[Tensor]:
    """``(P, 4)`` points of each scan."""
    if scans is not None:
        found = evenly(find_scans(scans), num_scans)
        return [torch.from_numpy(read_scan(scan.path, LidarSensor())) for scan in found]
    streets = [Street(seed, 0, Weather()).scene(0) for seed in range(num_scans)]
    sensor = hdl64e()
    return [
        torch.from_numpy(simulate_scan(scene, sensor, (seed, "effects", 0, 0)).points)
        for seed, scene in enumerate(streets)
    ]


@torch.inference_mode()
def _measure(subject: _Subject, points: Sequence[Tensor], settings: VAESettings) -> VAECost:
    device, geometry = settings.place, subject.geometry
    sensor = geometry.projection.sensor
    images = torch.stack(
        [geometry.codec.encode(range_image(p[:, :3], geometry.projection)[0]) for p in points]
    )[:, None].to(device)
    network = subject.network.to(device)
    batch = images[torch.arange(settings.batch_size, device=device) % len(images)]
    latents = network.encode(batch).mean
    halves: dict[str, dict[str, Callable[[], Tensor]]] = {"decode": {}, "encode": {}}
    peaks: dict[str, int | None] = {}
    for case, (dtype, layout) in _CASES.items():
        own = copy.deepcopy(network)
        if dtype == torch.bfloat16:
            own = _halved(own)
        own = own.to(memory_format=layout)  # type: ignore[call-overload]
        halves["decode"][case] = _pass(own.decode, latents.to(memory_format=layout), device)
        halves["encode"][case] = _pass(
            partial(_mean_latents, own), batch.to(dtype, memory_format=layout), device
        )
        peaks[case] = peak_bytes(halves["decode"][case], device)
    times = {
        half: compare({case: seconds(run) for case, run in cases.items()}, settings.rounds)
        for half, cases in halves.items()
    }
    counted, flop = {"encode": 0, "decode": 0}, vae_flop(network, (sensor.beams, sensor.columns))
    for key, parameter in network.named_parameters():
        half = "encode" if key.startswith(("encoder.", "quant_conv.")) else "decode"
        counted[half] += parameter.numel()
    return VAECost(
        name=subject.name,
        weights=subject.weights,
        image_size=(sensor.beams, sensor.columns),
        latent_size=(latents.shape[1], latents.shape[2], latents.shape[3]),
        parameters=counted,
        flop=flop,
        encode=times["encode"],
        decode=times["decode"],
        decode_peak_bytes=peaks,
        reconstruction=reconstruction(network, images, geometry) if subject.trained else None,
    )


def _halved(network: VAE) -> VAE:
    """The network in bfloat16, its decoder as scenes are sampled with."""
    network.encoder.bfloat16()
    network.quant_conv.bfloat16()
    return network.halve_decoder_()


def _mean_latents(network: VAE, image: Tensor) -> Tensor:
    return network.encode(image).mean


def _pass(
    function: Callable[[Tensor], Tensor], values: Tensor, device: torch.device
) -> Callable[[], Tensor]:
    """The function on these values, until the device has done it."""

    def run() -> Tensor:
        result = function(values)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return result

    return run


def vae_flop(network: VAE, image_size: tuple[int, int]) -> dict[str, int]:
    """FLOP of encoding and of decoding one image, counted without computing anything.

    Args:
        network: On any device.
        image_size: Rows and columns of the range image.

    Returns:
        ``encode`` and ``decode``: twice the multiplications of convolutions and attention.
    """
    network = copy.deepcopy(network).to("meta")
    image = torch.empty(1, network.in_channels, *image_size, device="meta")
    with FlopCounterMode(display=False) as encoding:
        latents = network.encode(image).mean
    with FlopCounterMode(display=False) as decoding:
        network.decode(latents)
    return {"encode": encoding.get_total_flops(), "decode": decoding.get_total_flops()}


@torch.inference_mode()
def reconstruction(network: VAE, images: Tensor, geometry: ScanGeometry) -> Reconstruction:
    """Reconstructs encoded range images, one after the other.

    Args:
        network: In evaluation mode, fp32.
        images: ``(B, 1, H, W)`` in [-1, 1].
        geometry: Range encoding and sensor.
    """
    sensor, codec = geometry.projection.sensor, geometry.codec
    low = copy.deepcopy(network).halve_decoder_()
    errors, low_errors, same = _Mean(), _Mean(), _Mean()
    for image in images.split(1):
        latents = network.encode(image).mean
        decoded = (image, network.decode(latents), low.decode(latents))
        true_m, found_m, low_m = (codec.decode(one, sensor) for one in decoded)
        errors.add((true_m - found_m).abs()[(true_m > 0) & (found_m > 0)])
        low_errors.add((found_m - low_m).abs()[(found_m > 0) & (low_m > 0)])
        same.add((true_m > 0) == (found_m > 0))
    agreement = same.value
    assert agreement is not None
    return Reconstruction(len(images), errors.value, agreement, low_errors.value)


class _Mean:
    """Mean of the values of several tensors; None without any."""

    def __init__(self) -> None:
        self._sum = 0.0
        self._count = 0

    def add(self, values: Tensor) -> None:
        self._sum += values.double().sum().item()
        self._count += values.numel()

    @property
    def value(self) -> float | None:
        return self._sum / self._count if self._count else None


def peak_bytes(function: Callable[[], object], device: torch.device) -> int | None:
    """Largest memory while a function runs, beyond that before it.

    Args:
        function: Waits for the device before it returns.
        device: Whose memory: resident memory of this process on a CPU, tensors on a GPU.

    Returns:
        None where the system does not tell.
    """
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        function()
        return torch.cuda.max_memory_allocated(device) - before
    try:
        ctypes.CDLL(None).malloc_trim(0)  # or memory that earlier cases left would serve this one
        Path("/proc/self/clear_refs").write_text("5")  # the peak of Linux starts anew
    except (OSError, AttributeError, TypeError):  # another system, or not permitted
        return None
    before = _resident_bytes("VmRSS")
    function()
    return _resident_bytes("VmHWM") - before


def _resident_bytes(name: str) -> int:
    """``VmRSS``, resident memory of this process, or ``VmHWM``, its peak."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith(name))
    return int(line.split()[1]) * 1024
