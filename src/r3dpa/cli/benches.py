"""The commands of ``r3dpa bench``; heavy imports stay inside."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from r3dpa.cli.files import check_file, check_folder, print_text

__all__ = ["BENCHES"]


def bench_training(
    conf: Path = Path("conf"),
    stages: tuple[str, ...] = ("vae_alignment", "joint", "flow_matching"),
    batch_size: int = 1,
    steps: int = 2,
    precision: Literal["32-true", "bf16-mixed"] = "32-true",
    device: Literal["auto", "cpu", "cuda"] = "auto",
    out: Path | None = None,
    quick: bool = False,
) -> None:
    """Train each stage for a few steps at its real size; print time, memory, work and speed.

    Args:
        conf: Folder of the configurations.
        stages: Experiments below ``<conf>/experiment``, such as ``[joint]``; one process each.
        batch_size: Scans per step.
        steps: Optimiser steps; two are needed for the peak memory of a long run.
        precision: Precision as the Trainer names it.
        device: ``cpu``, ``cuda``, or ``auto`` for the GPU where there is one.
        out: JSON file for the same figures.
        quick: The demo's networks, with memory format, precision and fused optimiser compared.
    """
    from r3dpa.bench.training import StepSettings, training

    check_file(out)
    print_text(
        training(conf, stages, StepSettings(batch_size, steps, precision, device), out, quick)
    )


def bench_simulation(quick: bool = False, out: Path | None = None) -> None:
    """Simulate scans of plain streets and of bad weather; print the time of each part and effect.

    The budget is that of one core: set ``OMP_NUM_THREADS=1``, as ``make bench-simulation`` does.

    Args:
        quick: Two scans of each case instead of 9 or 36.
        out: JSON file for the same figures.
    """
    from r3dpa.bench.simulation import simulation

    check_file(out)
    print_text(simulation(quick, out))


def bench_features(
    scan: Path | None = None, out: Path | None = None, quick: bool = False, wi48: bool = False
) -> None:
    """Build feature grids, read them back and pass one scan through networks; print the cost.

    Args:
        scan: KITTI ``.bin`` file; a simulated scan where not given.
        out: JSON file for the same figures.
        quick: Small sizes, only to try it.
        wi48: Measure one pass of WI-48-768, too: minutes on a CPU.
    """
    from r3dpa.bench.features import features

    check_file(out)
    print_text(features(scan, out, quick, wi48))


def bench_metrics(scan: Path | None = None, out: Path | None = None, quick: bool = False) -> None:
    """Time the networks of the metrics, JSD, MMD and sparse convolution; print the cost.

    JSD, MMD and the convolution run beside a plain way to the same result, which must agree.

    Args:
        scan: KITTI ``.bin`` file; a simulated scan where not given.
        out: JSON file for the same figures.
        quick: Small sizes, only to try it.
    """
    from r3dpa.bench.metrics import metrics

    check_file(out)
    print_text(metrics(scan, out, quick))


def bench_data(quick: bool = False, out: Path | None = None) -> None:
    """Simulate, read, project and load scans; print the scans per second of each step.

    Args:
        quick: Eight scans as 32 x 256 images and few rounds.
        out: JSON file for the same figures.
    """
    from r3dpa.bench.data import data

    check_file(out)
    print_text(data(quick, out))


def bench_vae(
    nets: list[str] | None = None,
    ckpt: dict[str, Path] | None = None,
    scans: Path | None = None,
    conf: Path = Path("conf"),
    batch_size: int = 1,
    rounds: int = 3,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    quick: bool = False,
    out: Path | None = None,
) -> None:
    """Decode and encode with the layouts of the VAE; print time beside reconstruction.

    Args:
        nets: Names, ``h2p4d8`` for ``<conf>/net/vae_h2p4d8.yaml``, or YAML files of a VAE, thin
            ones for example; all four official layouts where not given.
        ckpt: Checkpoint by name, whose reconstruction is measured: ``--ckpt.h2p4d8 FILE``.
        scans: ``.bin`` file, or folder of them, to reconstruct; simulated ones where not given.
        conf: Folder of the configurations.
        batch_size: Range images per pass.
        rounds: Passes of each case.
        device: ``cpu``, ``cuda``, or ``auto`` for the GPU where there is one.
        quick: The demo's VAE, only to try it.
        out: JSON file for the same figures.
    """
    from r3dpa.bench.vae import VAESettings, vae

    check_file(out)
    settings = None if quick else VAESettings(batch_size, rounds, device=device)
    print_text(vae(nets, ckpt, scans, conf, settings, quick, out))


def bench_sampling(
    out: Path,
    ckpt: Path | None = None,
    data: Path | None = None,
    quick: bool = False,
    scenes: int | None = None,
    batch_size: int | None = None,
    rounds: int | None = None,
    nfe: list[int] | None = None,
    reference_steps: int | None = None,
    tuned: list[Path] | None = None,
    autoguidance: Path | None = None,
    guidance_scale: float = 2.0,
    allow_other_latents: bool = False,
    device: str = "auto",
) -> None:
    """Measure what accuracy costs in time, for an exact velocity and a trained model; draw it.

    Args:
        out: Folder for tables, pictures and ``quality.json``.
        ckpt: Checkpoint of stage joint or flow_matching; without one only a mixture of Gaussians
            whose velocity is exact.
        data: Real scans, a folder or a file of ``r3dpa reference``, to compare the scenes with.
        quick: Few scenes, steps and rounds: minutes on a CPU.
        scenes: Solved by each way to sample; 256, or 8 with ``--quick``.
        batch_size: Scenes computed together; 64 on a GPU, 4 on a CPU.
        rounds: Of the timing; 20, or 3 with ``--quick``.
        nfe: Network evaluations a scene; 2 to 256, or 4 to 32 with ``--quick``.
        reference_steps: Heun steps of the converged solution; 1000, or 200 with ``--quick``.
        tuned: Files of ``r3dpa tune-solver``, each one more way.
        autoguidance: Snapshot of a weaker model: one more way is guided away from it.
        guidance_scale: Strength of autoguidance.
        allow_other_latents: Accept a snapshot whose latents are only about the same.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from r3dpa.bench.sampling import sampling

    check_folder(out)
    make, about = None, None
    if ckpt is not None:
        from r3dpa.cli.scenes import WeakGuide, generators_of

        guide = None
        if autoguidance is not None:
            guide = WeakGuide(autoguidance, guidance_scale, (0.0, 1.0), allow_other_latents)
        make, about = generators_of(ckpt, guide, device)
    elif autoguidance is not None or tuned:
        raise ValueError("--autoguidance and --tuned belong to a model; give its --ckpt")
    print_text(
        sampling(
            out,
            make,
            data,
            quick,
            scenes=scenes,
            batch_size=batch_size,
            rounds=rounds,
            nfe=nfe,
            reference_steps=reference_steps,
            tuned=tuned or (),
            autoguided=autoguidance is not None,
            about=about,
        )
    )


def bench_control(
    ckpt: Path,
    data: Path,
    library: Path,
    out: Path,
    quick: bool = False,
    parts: tuple[
        Literal["strength", "guided", "mix", "inpaint", "complete", "round_trip", "cost"], ...
    ] = ("strength", "guided", "mix", "inpaint", "complete", "round_trip", "cost"),
    scenes: int = 64,
    cases: int = 32,
    round_trips: int = 16,
    solver: Literal["midpoint", "heun", "euler", "ab2", "ab3", "dpmpp_2m", "unipc"] = "midpoint",
    steps: int = 32,
    strength: float = 0.5,
    window: tuple[float, float] = (0.0, 1.0),
    features_ckpt: Path | None = None,
    device: str = "auto",
) -> None:
    """Measure guidance, mixing, inpainting, completion and inversion of a model; write tables.

    Guided and unguided scenes get the same noise, and features are extracted again from the points
    that were made. Everything is of the validation drives, but ``strength``, which compares
    strengths and windows on the training drives.

    Args:
        ckpt: Checkpoint of stage joint or flow_matching, aligned with features.
        data: Root of a data set of ``r3dpa simulate``, whose scans have labels.
        library: File of ``r3dpa objects`` with class car, made with the features of the checkpoint.
        out: Folder for ``control.md``, ``control.json`` and a sheet for each application; parts are
            added to those that are in it.
        quick: Two scenes of each and two steps, only to try it.
        parts: What to measure.
        scenes: Scenes of guided and mix.
        cases: Scans of inpaint and complete.
        round_trips: Scans of round_trip, and scenes of each row of strength.
        solver: ODE solver of scenes and edits.
        steps: Its steps.
        strength: Guidance in velocities, 0 to 1.
        window: First and last guided time; 0 data, 1 noise.
        features_ckpt: Weights of the feature source, where it has none of its own.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from r3dpa.bench.control import ControlSettings, control
    from r3dpa.checkpoints import read_checkpoint
    from r3dpa.cli.scenes import generator_from
    from r3dpa.editing import EditSettings
    from r3dpa.generation import SamplerConfig
    from r3dpa.io import usable_device

    check_folder(out)
    device = usable_device(device)
    edit = EditSettings(solver, steps, strength=strength, window=window)
    settings = ControlSettings(parts, scenes, cases, round_trips, edit=edit)
    checkpoint = read_checkpoint(ckpt)
    generator = generator_from(checkpoint, SamplerConfig(), device=device)
    about = {"file": ckpt.name, "stage": checkpoint.stage, "step": checkpoint.step}
    print_text(
        control(
            generator,
            checkpoint.feature_source,
            data,
            library,
            out,
            settings.quick() if quick else settings,
            features_ckpt,
            about,
        )
    )


def bench_speed(
    device: str = "auto",
    rounds: int = 5,
    batch_size: int = 64,
    quick: bool = False,
    out: Path | None = None,
) -> None:
    """Sample with full-size networks of random weights; print seconds a scene beside the limit.

    Args:
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        rounds: Of the timing.
        batch_size: Scenes of a large batch, on a GPU.
        quick: Small networks, only to try it.
        out: JSON file for the same figures.
    """
    from r3dpa.bench.speed import random_generators, speed
    from r3dpa.io import usable_device

    check_file(out)
    device = usable_device(device)
    print_text(speed(random_generators(device, quick), rounds, out, batch_size, quick))


def bench_official(
    repo: Path,
    parts: tuple[Literal["sampler", "decode", "scenes", "joint"], ...] = (
        "sampler",
        "decode",
        "scenes",
        "joint",
    ),
    size: Literal["small", "full"] = "small",
    steps: int = 50,
    scenes: int = 10,
    rounds: int = 5,
    clock: Literal["wall", "processor"] = "wall",
    ckpt: Path | None = None,
    quick: bool = False,
    out: Path | None = None,
) -> None:
    """Run a local checkout of the official code beside ours, with the same weights; print ratios.

    Both must give the same result first. Nothing of the checkout is changed.

    Args:
        repo: Checkout of valeoai/R3DPA at commit aa08e6d.
        parts: What to run: latents of a batch, one decoded image, scenes from weights to files, a
            training step of stage joint.
        size: Networks of ``joint``; ``full`` takes minutes a step on a CPU.
        steps: Network evaluations of the official sampler.
        scenes: Scenes written, an even number.
        rounds: Measurements of each case that count.
        clock: ``wall``, or ``processor`` for the time of the processor alone.
        ckpt: Trained networks for ``sampler`` and ``scenes``; random ones where not given, for
            which equal error means little.
        quick: Two rounds, 10 steps, 2 scenes: a trial.
        out: JSON file for the same figures.
    """
    from r3dpa.bench.official import OfficialSettings, official
    from r3dpa.cli.scenes import sample

    def write(
        ckpt: Path, folder: Path, num: int, seed: int, batch: int, sampler: Any, precision: Any
    ) -> None:
        sample(
            ckpt,
            folder,
            num,
            seed,
            sampler,
            batch_size=batch,
            precision=precision,
            device="cpu",
            pictures=0,
        )

    check_file(out)
    settings = OfficialSettings(parts, size, steps, scenes, rounds, clock, quick)
    print_text(official(repo, write, settings, ckpt, out))


BENCHES: dict[str, Callable[..., None]] = {
    "training": bench_training,
    "sampling": bench_sampling,
    "control": bench_control,
    "speed": bench_speed,
    "vae": bench_vae,
    "data": bench_data,
    "simulation": bench_simulation,
    "features": bench_features,
    "metrics": bench_metrics,
    "official": bench_official,
}
