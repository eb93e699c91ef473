"""The ``r3dpa`` command: LightningCLI for the stages, plain functions for everything else.

Heavy imports stay inside the commands, so that ``r3dpa --help`` answers at once.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from r3dpa.cli.edits import EDITS, joined_numbers
from r3dpa.cli.files import check_file, check_folder, print_text

if TYPE_CHECKING:
    from r3dpa.simulation import Weather

__all__ = ["main"]

_STAGE_COMMANDS = {
    "fit": "train a stage",
    "validate": "evaluate a checkpoint on the validation split",
    "test": "evaluate a checkpoint on the test split",
    "predict": "reconstruct scans with a checkpoint",
}


def simulate(
    out: Path,
    scans: int = 100,
    seed: int = 0,
    workers: int = 1,
    drives: list[str] | None = None,
    sensor: str = "hdl64e",
    return_mode: Literal["strongest", "dual"] = "strongest",
    effects: dict[str, str | bool] | None = None,
    weather: Weather | None = None,
) -> None:
    """Write simulated scans in the KITTI-360 layout.

    The same command completes what was interrupted. Prints what each effect did and cost, which
    stays in ``report.json``; ``sim/*.json`` tells it for each scan.

    Args:
        out: Root of the data set to write.
        scans: Number of scans over all drives.
        seed: Seed of streets and instrument.
        workers: Processes; the bytes written do not depend on it.
        drives: Four-digit drives to fill, such as '["0003"]'; all official ones where not given.
        sensor: ``hdl64e``, ``hdl32e``, ``vls128``, or a calibration YAML as ``velodyne_pointcloud``
            reads, for an HDL-64E.
        return_mode: Strongest return of each shot, or the two strongest.
        effects: ``auto``, ``on`` or ``off`` by effect, such as ``--effects.fog off``; those not
            named run where the scene calls for them.
        weather: Weather of all scans, such as ``--weather.rain_mm_h 10``; drawn where not given.
    """
    from r3dpa.simulation import load_sensor
    from r3dpa.simulation import simulate as write

    lidar = load_sensor(sensor, return_mode=return_mode)
    try:
        report = write(out, scans, seed, workers, drives, lidar, effects, weather)
    except KeyboardInterrupt:
        sys.stderr.write(f"r3dpa simulate: stopped; the same command goes on in {out}\n")
        sys.exit(130)  # as a shell reports an interrupt
    print_text(report)


def ablate_tables(
    tables: Path,
    scale: str = "demo",
    seeds: str = "0",
    out: Path | None = None,
    jobs: int = 1,
    devices: int = 1,
    rgb_weights: Path | None = None,
    wandb: Literal["offline", "online", "off"] = "offline",
    budget_only: bool = False,
) -> None:
    """Train, test and compare the rows of the paper's ablations.

    Prints what it will cost, then trains each stage once, however many rows and tables share it,
    and writes ``<table>.md``, ``.tex``, ``.csv`` and ``.json``. The same command goes on after an
    interrupt. A row that fails leaves the others alone; the exit status is then 1.

    Args:
        tables: Folder of a table, such as ``conf/ablation/table_3``, or of several:
            ``conf/ablation``.
        scale: ``demo`` for CPU cores, ``small`` for half an hour of one GPU, ``paper``; or a YAML
            file of that kind.
        seeds: Numbers separated by commas; every row is trained and tested for each.
        out: Folder for everything; ``runs/ablation/<scale>`` where not given.
        jobs: Trainings and tests at a time; cores are shared out, all of them use the first GPU.
        devices: GPUs of each training, which share its batch.
        rgb_weights: RGB-pretrained SiT, official ``.pt`` or ours, instead of pretraining one.
        wandb: A run for each row and seed, ``offline`` in ``<out>/wandb`` for ``wandb sync``, or
            ``online``, where the stages can be watched, too.
        budget_only: Print what it would cost, and start nothing.
    """
    from r3dpa.cli.ablate_tables import ablate_tables as run

    if not all(word.isdecimal() for word in _words(seeds)):
        raise ValueError(f"--seeds {seeds}: give whole numbers separated by commas, such as 0,1,2")
    numbers = [int(word) for word in _words(seeds)]
    try:
        complete = run(tables, scale, numbers, out, jobs, devices, rgb_weights, wandb, budget_only)
    except KeyboardInterrupt:
        sys.stderr.write("r3dpa ablate: stopped; the same command goes on\n")
        sys.exit(130)  # as a shell reports an interrupt
    if not complete:
        sys.exit(1)


def check(path: Path) -> None:
    """List every bad scan and missing folder of a data set; exits with 1 if there is any.

    Args:
        path: Root in the KITTI-360 layout, or any folder of ``.bin`` scans.
    """
    from r3dpa.data.checks import check as check_scans

    report = check_scans(path)
    print_text(report)
    if not report.ok:
        sys.exit(1)


def view(
    source: Path, out: Path | None = None, num: int = 8, reference: Path | None = None
) -> None:
    """Draw scans as range images, from above, and as a page with point clouds to turn.

    Args:
        source: A ``.bin``, ``.ply`` or ``.npz`` file, or a folder of ``.bin`` scans in any layout.
        out: Folder for the pictures and the page; ``view/<name of the source>`` where not given.
        num: Scans to show at most, evenly spread over the folder.
        reference: Scan to show beside the others, such as a real one beside simulated ones.
    """
    from r3dpa.cli.view import view as draw

    if out is not None:
        check_folder(out)
    print_text(draw(source, out, num, reference))


def realism(scans: Path, reference: Path, out: Path | None = None) -> None:
    """Compare scans with real ones, each measure beside the distance between real drives.

    Args:
        scans: Folder of ``.bin`` scans (A); one drive per folder.
        reference: Folder of real scans (B), of two or more drives; a single one is halved.
        out: JSON file for the table and the curves behind it.
    """
    from r3dpa.cli.realism import realism as compare

    check_file(out)
    print_text(compare(scans, reference, out))


def sample(
    ckpt: Path,
    out: Path,
    num: int = 16,
    seed: int = 0,
    quality: Literal["draft", "good", "best"] | None = None,
    solver: Literal[
        "euler",
        "heun",
        "midpoint",
        "ab2",
        "ab3",
        "dpmpp_2m",
        "unipc",
        "dopri5",
        "euler_maruyama",
    ]
    | None = None,
    steps: int | None = None,
    shift: float | None = None,
    eta: float | None = None,
    sde_last: Literal["denoise", "mean"] | None = None,
    sde_last_time: float | None = None,
    autoguidance: Path | None = None,
    guidance_scale: float | None = None,
    guidance_interval: tuple[float, float] | None = None,
    allow_other_latents: bool = False,
    batch_size: int = 8,
    decode_batch_size: int | None = None,
    precision: Literal["fp32", "bf16"] = "fp32",
    compile: bool = False,
    device: str = "auto",
    weights: Literal["ema", "last"] = "ema",
    formats: str = "bin",
    pictures: int = 64,
    overwrite: bool = False,
) -> None:
    """Generate scenes from a checkpoint.

    The same command completes what was interrupted. An option that the chosen solver does not read
    is an error. ``metadata.json`` keeps paths as they are given here.

    Args:
        ckpt: Checkpoint of stage joint or flow_matching, ``.ckpt`` or exported ``.safetensors``.
        out: Folder for scenes, pictures and metadata; must not hold other scenes.
        num: Number of scenes.
        seed: Scene i depends on (seed, i) alone, not on the batch size.
        quality: Choose solver, steps and shift from what was measured: ``draft``, ``good`` or
            ``best``.
        solver: ODE solver; or ``euler_maruyama`` for the SDE, where none is given.
        steps: Solver steps; 256 where not given.
        shift: Finer steps near noise (above 1) or data (below 1) of the ODE; 1 where not given.
        eta: Strength of the noise of the SDE; 1, as published, where not given.
        sde_last: Last SDE step: ``denoise``, where not given, or ``mean`` as in the official
            sampler.
        sde_last_time: Time from which the last SDE step starts; 0.04 where not given.
        autoguidance: Snapshot of a weaker model to be guided away from; doubles the evaluations.
        guidance_scale: Strength of autoguidance, 1 for none; 2 where not given.
        guidance_interval: Guided times, such as '[0.2, 0.8]'; 0 is data, 1 noise. All where not
            given.
        allow_other_latents: Accept a snapshot whose latents are only about the same.
        batch_size: Scenes sampled together.
        decode_batch_size: Scenes decoded together; ``batch_size`` where not given.
        precision: Weights of the networks; ``bf16`` needs a processor or GPU that computes in it.
        compile: Compile the networks: a minute or more at first, then faster.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        weights: Averaged (``ema``) or last weights of the SiT.
        formats: Files of points, separated by commas: ``bin``, ``ply``, ``npz``; the range images
            are in ``range_m.npy``.
        pictures: Draw this many scenes.
        overwrite: Write into a folder that holds scenes already, and start anew.
    """
    from r3dpa.cli.scenes import WeakGuide
    from r3dpa.cli.scenes import sample as generate
    from r3dpa.generation import SamplerConfig

    chosen = {
        "solver": solver,
        "steps": steps,
        "shift": shift,
        "eta": eta,
        "sde_last": sde_last,
        "sde_last_time": sde_last_time,
    }
    given: dict[str, Any] = {name: value for name, value in chosen.items() if value is not None}
    if quality is not None and given:
        raise ValueError(f"--quality {quality} chooses what --{next(iter(given))} gives; drop one")
    if quality is not None:
        sampler = SamplerConfig.of_quality(quality)
        print_text(SamplerConfig.quality_line(quality))
    else:
        sampler = SamplerConfig(**given)
    needs = {
        "guidance_scale": (guidance_scale is not None, "autoguidance", autoguidance),
        "guidance_interval": (guidance_interval is not None, "autoguidance", autoguidance),
        "allow_other_latents": (allow_other_latents, "autoguidance", autoguidance),
    }
    for name, (is_given, other, value) in needs.items():
        if is_given and value is None:
            raise ValueError(f"--{name} says nothing without --{other}; give both or none")
    guide = None
    if autoguidance is not None:
        scale = 2.0 if guidance_scale is None else guidance_scale
        guide = WeakGuide(autoguidance, scale, guidance_interval or (0.0, 1.0), allow_other_latents)
    try:
        metadata = generate(
            ckpt,
            out,
            num,
            seed,
            sampler,
            batch_size=batch_size,
            decode_batch_size=decode_batch_size,
            compile=compile,
            precision=precision,
            device=device,
            weights=weights,
            guide=guide,
            formats=_words(formats),
            pictures=pictures,
            overwrite=overwrite,
        )
    except KeyboardInterrupt:
        again = "the same command, without --overwrite," if overwrite else "the same command"
        sys.stderr.write(f"r3dpa sample: stopped; {again} goes on in {out}\n")
        sys.exit(130)  # as a shell reports an interrupt
    if metadata["drawn_by_last_run"]:
        print_text(
            f"{num} scenes in {out}: {metadata['nfe']:.5g} network evaluations each, "
            f"{metadata['device_seconds_per_scene']:.3g} s a scene on the device, "
            f"{metadata['seconds_per_scene']:.3g} s end to end; "
            f"{metadata['threads']['torch']} CPU threads"
        )


def reference(
    data: Path,
    out: Path,
    spaces: str = "fwid,fgeo",
    ckpt: dict[str, Path] | None = None,
    split: Literal["train", "val", "all"] = "all",
    limit: int | None = None,
    protocol: Literal["default", "published"] = "default",
    device: str = "auto",
) -> None:
    """Write the statistics of real scans that r3dpa evaluate compares samples with.

    The same command completes what was interrupted.

    Args:
        data: Folder of scans, in the KITTI-360 layout or any other, or a data YAML.
        out: File to write, ``.safetensors``.
        spaces: Feature spaces, separated by commas: ``fwid`` and ``fgeo`` need no file; ``frid``,
            ``fld``, ``fsvd`` and ``fpvd`` the weights of the official networks.
        ckpt: Weights by space, such as ``--ckpt.frid model.ckpt``.
        split: Which scans of the data.
        limit: Use this many scans at most, spread evenly.
        protocol: ``published`` prepares scans as the published numbers do: points on the corners
            of pixels, and pictures of LIP-Loc that wrap around.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
    """
    from r3dpa.cli.evaluate import reference as write

    check_file(out)
    try:
        line = write(data, out, _words(spaces), ckpt, split, limit, protocol, device)
    except KeyboardInterrupt:
        sys.stderr.write(f"r3dpa reference: stopped; the same command goes on with {out}\n")
        sys.exit(130)  # as a shell reports an interrupt
    print_text(line)


def evaluate(
    samples: Path,
    reference: Path,
    spaces: str | None = None,
    ckpt: dict[str, Path] | None = None,
    protocol: Literal["default", "published"] | None = None,
    skip_bad: bool = False,
    allow_few: bool = False,
    label: str | None = None,
    device: str = "auto",
    out: Path | None = None,
    split: Literal["val", "all"] | None = None,
) -> None:
    """Tell how near the samples of any generator are to real scans.

    Prints every metric with its confidence interval and its floor, the distance of real scans from
    real scans, and a table beside the published numbers.

    Args:
        samples: File or folder: ``r3dpa sample``, R3DPA, LiDAR-Diffusion, R2DM, R2Flow, RangeLDM,
            or any clouds as ``.bin``, ``.ply``, ``.txt`` or ``.npz``.
        reference: File of ``r3dpa reference``, or R3DPA's own ``data_statistics.npy``.
        spaces: Feature spaces, separated by commas; where not given, those of the reference that
            need no file or have one in ``ckpt``.
        ckpt: Weights by space, such as ``--ckpt.frid model.ckpt``.
        protocol: Refuse a reference of another protocol than this.
        skip_bad: Leave out samples that cannot be used, and say which.
        allow_few: Accept fewer samples than features: only to try it.
        label: Name of the generator in tables; that of ``samples`` where not given.
        device: ``cpu``, ``cuda``, ``cuda:1`` or ``auto``.
        out: Folder for the numbers (JSON, CSV), tables (Markdown, LaTeX) and figures.
        split: Of ``data_statistics.npy`` alone; ``val`` where it holds both and none is given.
    """
    from r3dpa.cli.evaluate import evaluate as compare

    if out is not None:
        check_folder(out)
    names = None if spaces is None else _words(spaces)
    options = (skip_bad, allow_few, label, device, out, split)
    print_text(compare(samples, reference, names, ckpt, protocol, *options))


def convert(
    source: Path,
    out: Path,
    to: Literal["r3dpa", "official"] = "r3dpa",
    overwrite: bool = False,
    sit_args: dict[str, Any] | None = None,
    encoding: Literal["linear", "log2"] | None = None,
    into: Path | None = None,
) -> None:
    """Convert official checkpoints into ours, or ours into official ones.

    Args:
        source: Official ``.pt``, Lightning ``.ckpt`` or exported ``.safetensors``.
        out: File to write, ``.safetensors`` for ours and ``.pt`` for the official layout.
        to: Layout of the result.
        overwrite: Replace ``out`` where it exists.
        sit_args: Official files only: SiT arguments that the file does not tell, such as
            ``{alignment_depth: 4}``.
        encoding: Official files only: range encoding, where the file does not tell.
        into: Put RGB weights into the SiT of this YAML, such as ``conf/net/sit_b2.yaml``, and tell
            what was kept, resized and dropped; ``--model.init_args.rgb_weights`` takes ``out``.
    """
    from r3dpa.checkpoints import convert as convert_checkpoint

    result = convert_checkpoint(
        source, out, to, overwrite=overwrite, sit_args=sit_args, encoding=encoding, into=into
    )
    print_text(result.table())


def replay(file: Path, ckpt: Path, device: str = "cpu") -> None:
    """Run a step that was skipped again, and tell where it stopped to be finite.

    Args:
        file: Of ``<run_dir>/bad_batches``.
        ckpt: Weights, best those of the last step before it.
        device: ``cpu``, ``cuda`` or ``cuda:1``.
    """
    from r3dpa.cli.replay import replay as run_again

    print_text(run_again(file, ckpt, device))


def report(run: Path) -> None:
    """Draw the loss curves of a run and print where each loss started and ended.

    Args:
        run: Folder given to ``r3dpa fit`` as ``--run_dir``.
    """
    from r3dpa.cli.scenes import report as draw

    print_text(draw(run))


_COMMANDS: dict[str, Callable[..., None]] = {
    command.__name__.replace("_", "-"): command
    for command in (
        *(simulate, check, view, realism),
        *(sample, reference, evaluate, convert, replay, report),
    )
} | {"ablate": ablate_tables}


def _words(text: str) -> list[str]:
    """Words separated by commas."""
    return [word.strip() for word in text.split(",")]


def _help() -> str:
    summaries = _STAGE_COMMANDS | {
        name: (command.__doc__ or "").splitlines()[0]
        for name, command in (_COMMANDS | EDITS).items()
    }
    summaries["features"] = "write the feature grids of a data set, on any number of devices"
    summaries["bench"] = "measure what a part costs: r3dpa bench --help lists them"
    lines = [f"  {name:<12} {summary}" for name, summary in summaries.items()]
    head = ["usage: r3dpa COMMAND [options]", "", "Generate LiDAR scenes (R3DPA).", ""]
    return "\n".join([*head, *lines, "", "r3dpa COMMAND --help lists the options of a command."])


def _run_function(
    function: Callable[..., None] | dict[str, Any],
    words: list[str],
    prog: str,
    as_positional: bool = False,
) -> None:
    """Run a function, or one of several by name, with its arguments from the command line."""
    from jsonargparse import auto_cli

    from r3dpa.cli.parser import FlagParser

    try:
        auto_cli(function, words, as_positional=as_positional, parser_class=FlagParser, prog=prog)
    except ValueError as error:
        # Where None would do, too, the parser lists every type that it tried; its cause is what
        # the value's own class found wrong.
        if "Union subtypes" in str(error) and isinstance(error.__cause__, ValueError):
            raise error.__cause__ from None
        raise


def _refuse_imports() -> None:
    """Keeps YAML files from naming functions that run commands or code, such as os.system."""
    from jsonargparse import set_parsing_settings

    set_parsing_settings(import_path_denylist=["torch.hub", "torch.load", "torch.package"])


def _run(args: list[str]) -> None:
    if args and not args[0].startswith("-"):
        _refuse_imports()
    if not args or args[0] in ("-h", "--help"):
        print_text(_help())
    elif args[0] == "--version":
        from r3dpa import __version__

        print_text(__version__)
    elif args[0] in _STAGE_COMMANDS:
        from r3dpa.cli.stages import run

        run(args)
    elif args[0] == "features":
        from r3dpa.cli.features import features

        features(args[1:])
    elif args[0] == "bench":
        from r3dpa.cli.benches import BENCHES

        _run_function(BENCHES, args[1:], "r3dpa bench")
    elif args[0] in EDITS:
        _run_function(EDITS[args[0]], joined_numbers(args[1:]), f"r3dpa {args[0]}")
    elif args[0] in _COMMANDS:
        positional = args[0] in ("check", "view", "convert", "replay", "report", "ablate")
        _run_function(_COMMANDS[args[0]], args[1:], f"r3dpa {args[0]}", positional)
    else:
        print_text(f"r3dpa: unknown command {args[0]!r}\n\n{_help()}")
        sys.exit(2)


def main(args: list[str] | None = None) -> None:
    """Runs the command line.

    Args:
        args: Words after ``r3dpa``. Where None, those of the process: an error about files or
            values is then one line on the terminal, not a traceback.
    """
    if args is not None:
        _run(args)
        return
    args = sys.argv[1:]
    # As Ctrl-C does; SIGTERM alone would leave no word, and Lightning would not obey it everywhere.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        _run(args)
    except (ValueError, OSError) as error:
        if args[0] == "fit":
            raise  # where training broke is part of the message
        sys.exit(f"r3dpa {args[0]}: {error}")
