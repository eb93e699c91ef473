"""What a user types: mistakes answered at once, suggestions, help, completion, lines of a fit."""

import contextlib
import io
import json
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
import yaml
from fault_commands import Command, leave_wandb_of_parent, write_stdout

from r3dpa.cli import ALIASES, COMMANDS, OWN_PARSER, main
from r3dpa.cli.class_arguments import class_arguments
from r3dpa.cli.fit import check_class_arguments
from r3dpa.cli.messages import argument_names
from r3dpa.cli.parser import load, make_parser, parse
from r3dpa.cli.presets import conf_folder, expand_preset, find_configs, stage_files

MISTAKES = {
    "fit": "give a stage, or --config FILE",
    "fit jointly": "unknown stage 'jointly' (did you mean joint?)",
    "fit joint_demo": "unknown stage 'joint_demo'",
    "fit joint --preset demoo": "unknown preset 'demoo' (did you mean demo?)",
    "fit joint --ckptpath last": "unknown option --ckptpath (did you mean --ckpt_path?)",
    "fit joint --ckpt_path no.ckpt": "--ckpt_path: no checkpoint file no.ckpt",
    "fit joint --model.init_args.init_from no.ckpt": "--model.init_args.init_from: no checkpoint",
    "fit --config no.yaml": "--config: no file no.yaml",
    "fit joint --trainer.max_stepz 3": "--trainer.max_stepz (did you mean --trainer.max_steps?)",
    # The known options before it are left to the parser of the trainer.
    "fit joint --trainer.logger.init_args.name=x --trainer.callbacks+=x --trainer.max_stepz=3": (
        "--trainer.max_stepz (did you mean --trainer.max_steps?)"
    ),
    "fit joint --trainer.loger+=x": "--trainer.loger+ (did you mean --trainer.logger?)",
    "fit joint --data.init_args.bach_size 3": "data.init_args.bach_size (did you mean batch_size?)",
    "fit joint --preset images --data.soruce x": "--data.soruce (did you mean source?)",
    "fit joint --model.init_args.init_fron x": "init_args.init_fron (did you mean init_from?)",
    "data features --trainer.devises 4": "--trainer.devises (did you mean --trainer.devices?)",
    "smaple": "unknown command 'smaple' (did you mean sample?)",
    "inpant": "unknown command 'inpant' (did you mean inpaint?)",
    "sample --out x --ckpt no.ckpt": "no checkpoint file no.ckpt",
    "sample --out x --stpes 3": "unknown option --stpes (did you mean --steps?)",
    "edit vary --scan no.bin --out x": "--scan no.bin: no such file or folder",
    "edit mix --left a.bin --right b.bin --out x --ckpt s.safetensors": "trained without 3D",
    "data objects --data x --out o.safetensors --ckpt s.safetensors": "trained without 3D",
    "data check no": "bad: no: is no folder and no file",
    "data features --data . --extracter x": "--extracter (did you mean --extractor?)",
    "data view no": "no: no such file or folder",
    "data weather no --out x": "no: no such file or folder",
    "data sensor no --out s.yaml": "no: no such file or folder",
    "data features --data no/data": "--data no/data: no such folder of scans or data YAML",
    "data features --data no.yaml": "--data no.yaml: no such folder of scans or data YAML",
    "data features --config no.yaml": "--config: no file no.yaml",
    "data prepare --config no.yaml": "--config: no file no.yaml",
    "data prepare --confg x": "unknown option --confg (did you mean --config?)",
    "data prepare --config conf/data/demo.yaml --data.init_args.num_scan 3": "(did you mean num_sc",
    "data reference --data no --out x.safetensors": "--data no: no such file or folder",
    "data reference --data . --out x --spaces frud": "--spaces: unknown value 'frud'; choose from",
    "data weather . --out x --weather.visiblity_m 60": "(did you mean --weather.visibility_m?)",
    "data convert . out --to xyz": "--to: unknown value 'xyz'; choose from bin, pcd.bin, ply",
    "data features --data . --extractor scalar": "unknown feature source 'scalar' (did you mean sc",
    "data plan no.yaml --scans . --out x": "unknown sensor 'no.yaml'; choose from",
    "cite --ckpt no.ckpt": "no checkpoint file no.ckpt",
    "completion zsh": "r3dpa completion: shell: unknown value 'zsh'; choose from bash",
    "convert no.pt x.safetensors": "no checkpoint file no.pt; give an existing file",
    "convert r3dpa-s x.safetensors --decoder no.ckpt": "no checkpoint file no.ckpt; give an exist",
    "report no": "no: no such file or folder",
    "ablate nowhere": "nowhere: no table or folder of tables; choose from conf/ablation",
    "ablate tabel_3": "no table or folder of tables (did you mean conf/ablation/table_3?)",
    "ablate conf/ablation --scale dmeo": "unknown scale 'dmeo' (did you mean demo?)",
    "evaluate --samples no --reference no": "--samples no: no such file or folder",
}


def logger(kind, **init_args):
    return {"class_path": f"lightning.pytorch.loggers.{kind}", "init_args": init_args}


WANDB = logger("WandbLogger", save_dir="", offline=True)
CSV = logger("CSVLogger", save_dir="", name="")


@pytest.fixture(scope="module")
def fitted(smoke_args, make_once):
    """Run folder of a short fit of vae_alignment as a user starts it, and both its outputs."""

    def fit(folder):
        words = smoke_args("vae_alignment", folder / "run", "--trainer.enable_progress_bar=true")
        words += [f"--trainer.logger={json.dumps([WANDB, CSV])}", "--trainer.callbacks=[]"]
        folder.mkdir()
        stdout = partial(write_stdout, folder / "stdout")
        command = Command(folder / "stderr", words, stdout, leave_wandb_of_parent)
        status, seen = command.end()
        assert status == 0, seen

    folder = make_once("fitted", fit)
    stdout, stderr = ((folder / name).read_text() for name in ("stdout", "stderr"))
    return folder / "run", stdout, stderr


def test_a_fit_says_what_it_lacks_and_what_follows(fitted):
    run_dir, _, stderr = fitted
    ckpt = run_dir / "checkpoints" / "last.ckpt"
    assert "without --model.init_args.rgb_weights the frozen SiT is random" in stderr
    assert "global batch: 2 = 2 per process x 1 processes x 1 accumulated" in stderr
    next_command = f"next: r3dpa fit joint --model.init_args.init_from {ckpt}"
    assert stderr.splitlines()[-1] == f"checkpoint: {ckpt}; {next_command}"


def test_the_bar_of_a_fit_shows_losses_and_no_notices_remain(fitted):
    _, stdout, stderr = fitted
    assert "loss=" in stdout
    assert "reconstruction=" in stdout
    assert "v_num" not in stdout
    notices = ("GPU available", "TPU", "Tip", "anonymous", "Seed set", "wandb sync", "sync_dist")
    assert not [notice for notice in notices if notice in stdout + stderr]


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """Answers to the mistakes in one process, and slow packages imported up to each of them."""
    program = f"""
import sys, json, io, contextlib, pathlib
from r3dpa.cli import main
for name in ("a.bin", "b.bin", "s.safetensors"):
    pathlib.Path(name).touch()
pathlib.Path("s.yaml").write_text("feature_source: null")
answers = []
for line in {list(MISTAKES)}:
    text = io.StringIO()
    with contextlib.redirect_stderr(text), contextlib.redirect_stdout(text):
        try: main(line.split())
        except SystemExit: pass
        except (ValueError, OSError) as error: text.write(str(error))
    answers.append([text.getvalue(), sorted({{"torch", "scipy.signal"}} & set(sys.modules))])
print(json.dumps(answers))
"""
    folder = tmp_path_factory.mktemp("mistakes")
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=True, timeout=100
    )
    return dict(zip(MISTAKES, json.loads(done.stdout), strict=True))


@pytest.mark.parametrize("line", list(MISTAKES))
def test_a_simple_mistake_is_answered_before_torch_is_imported(line, answers):
    answer, slow_imports = answers[line]
    assert MISTAKES[line] in answer
    assert not slow_imports


def test_a_file_that_needs_no_option_is_named_without_one(answers):
    assert answers["data sensor no --out s.yaml"][0] == "no: no such file or folder"


def test_known_arguments_of_classes_are_left_to_the_parser():
    """The source names at least the arguments that the parser finds in the imported class."""
    configs = [*stage_files().values(), *(conf_folder() / "data").glob("*.yaml")]
    sections = [yaml.safe_load(path.read_text()) for path in configs]
    classes = {
        section[group]["class_path"]
        for section in sections
        for group in ("model", "data")
        if "class_path" in section.get(group, {})
    }
    assert {"r3dpa.data.SimulatedDataModule", "r3dpa.modules.JointAlignment"} <= classes
    for class_path in classes:
        accepted = {name.partition(".")[0] for name in argument_names(class_path)} - {"help"}
        assert accepted <= set(class_arguments(class_path))
    assert not class_arguments("torch.nn.Linear")


def test_an_option_belongs_to_the_class_that_was_named_before_it(tmp_path):
    images = tmp_path / "images.yaml"
    images.write_text("data: {class_path: r3dpa.data.ImageDataModule}")
    of_images, of_scans = (
        ["--data.init_args." + name, "3"] for name in ("image_size", "grid_size")
    )
    words = ["--config", str(images), *of_images]
    check_class_arguments("fit", [*words, "-c", "conf/data/folder.yaml", *of_scans])
    check_class_arguments("fit", [*words, "--data", "LidarDataModule", *of_scans])
    check_class_arguments("fit", [*words, "--data", "my_package.LidarDataModule", *of_scans])
    with pytest.raises(SystemExit):
        check_class_arguments("fit", [*words, *of_scans])
    images.write_text("data: {")  # reported by the parser, which names the file and the line
    check_class_arguments("fit", [*words, *of_scans])


def test_fit_alone_names_stages_and_presets(answers):
    answer, _ = answers["fit"]
    assert all(f"  {stage} " in answer for stage in ("joint", "vae_alignment", "r2dm"))
    assert "kitti360, " in answer
    assert "_demo " not in answer


def test_overlays_are_no_stages():
    assert {"joint", "flow_matching", "r2flow"} <= set(stage_files())
    assert not {"joint_demo", "r2flow_reflow", "r2flow_distilled"} & set(stage_files())
    for preset in (["--preset", "demo"], ["--preset=demo"]):
        words, name = expand_preset(["joint", *preset, "--trainer.max_steps", "3"])
        assert name == "demo"
        assert words[-4:] == ["--run_dir", "runs/demo/joint", "--trainer.max_steps", "3"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"trainer: [1,2\n", "line 2: expected ',' or ']'"),
        (b"", "is empty; a configuration has lines"),
        (b"\xff\xfe\x00", "is no text"),
    ],
)
@pytest.mark.parametrize("option", ["--config {}", "--config={}"])
def test_a_configuration_that_cannot_be_read_is_named(option, content, message, tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_bytes(content)
    words = ["--config", str(conf_folder() / "trainer.yaml"), *option.format(file).split()]
    with pytest.raises(ValueError, match=rf"mine\.yaml.*{re.escape(message)}"):
        find_configs(words)


@pytest.mark.parametrize("option", ["--config", "-c"])
def test_configurations_of_the_package_are_found_from_any_folder(option, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = str(conf_folder() / "trainer.yaml")
    assert find_configs([option, "conf/trainer.yaml"]) == [option, file]
    assert find_configs([f"{option}=conf/trainer.yaml"]) == [f"{option}={file}"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--model.init_args.init_fron x", "--model.init_args.init_fron (did you mean init_from?)"),
        (
            "--model.init_args.sit.init_args.depth many",
            "--model.init_args.sit.init_args.depth: expected int, got 'many'",
        ),
        ("--data torch.utils.data.DataLoader", "DataLoader is not allowed: a configuration may"),
    ],
)
def test_a_message_names_the_option_as_it_is_typed(words, message, capsys):
    with pytest.raises(SystemExit):
        main(["fit", "joint", *words.split()])
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_absent_weights_of_an_extractor_are_named_in_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    narrow = ["--model.init_args.vae.init_args.channels=32"]
    narrow += [
        f"--model.init_args.sit.init_args.{size}" for size in ("hidden_size=48", "num_heads=2")
    ]
    with pytest.raises(ValueError, match=r"^data/weights/scalr\.pth: no such file; give ckpt_last"):
        main(["fit", "joint", "--preset", "kitti360_paper", "--dry_run", *narrow])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--quality bset", "--quality: unknown value 'bset'; choose from instant, draft, good, be"),
        ("--guidance_interval 0.2", "--guidance_interval: expected a tuple with 2 elements"),
        ("--formats bin plx", "--formats: unknown value 'plx'; choose from bin, ply, npz"),
        ("--eta x", "--eta: expected float, got 'x'"),
        ("--num 1e9", "--num: expected a whole number in digits, got '1e9'"),
        ("--seed 1.5", "--seed: expected a whole number in digits, got '1.5'"),
    ],
)
def test_a_message_says_what_is_accepted(words, message, capsys):
    with pytest.raises(SystemExit):
        main(["sample", "--out", "x", *words.split()])
    assert message in capsys.readouterr().err


def help_of(command, capsys):
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    return capsys.readouterr().out


def test_help_does_not_end_in_null_and_lists_the_weather(capsys):
    for command in ("sample", "edit complete", "data reference"):
        text = help_of(command, capsys)
        assert "null" not in text
        assert "<class" not in text
    text = help_of("data simulate", capsys)
    assert text.count("  --weather.visibility_m ") == 1


def test_fit_help_starts_with_stages_and_presets(capsys):
    text = help_of("fit", capsys)
    assert text.startswith("usage: r3dpa fit STAGE [--preset NAME]")
    assert text.index("\n  joint ") < text.index("--trainer.max_steps")
    assert "<class" not in text


def test_common_names_of_options():
    """How many of something are made or read is ``--num``, processes are ``--workers``."""
    counts = {"--limit", "--frames", "--scenes", "--jobs"}
    for command in COMMANDS.values():
        if command.target not in OWN_PARSER:
            names = [action.option_strings for action in make_parser(load(command.target))._actions]
            assert not [strings for strings in names if strings and strings[0] in counts]
    simulate = make_parser(load("lidarsim:simulate"))
    arguments = [simulate.parse_args(["--out", "x", name, "7"]) for name in ("--num", "--scans")]
    assert [config.scans for config in arguments] == [7, 7]


@pytest.fixture(scope="module")
def completion():
    """Script that completes commands in bash."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        main(["completion", "bash"])
    return printed.getvalue()


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        (["sam"], ["sample"]),
        (["edit", ""], ["inpaint", "mix", "complete", "vary", "interpolate"]),
        (["fit", "joi"], ["joint", "joint_unet"]),
        (["fit", "joint", "--pres"], ["--preset"]),
        (["sample", "--qua"], ["--quality"]),
        (["view", "--nu"], ["--num"]),
        (["data", "view", "--nu"], ["--num"]),
    ],
)
def test_completion(typed, completed, completion):
    words = " ".join(repr(word) for word in ["r3dpa", *typed])
    call = f"COMP_WORDS=({words}); COMP_CWORD={len(typed)}; _r3dpa; echo ${{COMPREPLY[@]}}"
    script = f"{completion}\n{call}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == completed


@pytest.mark.parametrize(
    ("command", "words", "value"),
    [
        ("convert", "--half a b", True),
        ("convert", "--half No a b", False),
        ("convert", "a --half=true b --overwrite", True),
        ("data convert", "--drop_nan a b --columns x y z", True),
    ],
)
def test_a_boolean_option_takes_no_other_word(command, words, value):
    _, config = parse(load(COMMANDS[command].target), words.split(), command)
    assert config["drop_nan" if command == "data convert" else "half"] is value
    assert config["out"] == Path("b")


def test_short_names_of_commands_are_unique():
    assert set(ALIASES.values()) <= set(COMMANDS)
    assert not set(ALIASES) & set(COMMANDS)


def test_a_fit_that_is_refused_leaves_no_configuration_and_no_wandb_run(smoke_args, tmp_path):
    words = smoke_args("vae_alignment", tmp_path, "--data.init_args.grid_size=[4, 16]")
    words += [f"--trainer.logger={json.dumps([WANDB])}", "--trainer.callbacks=[]"]
    with pytest.raises(ValueError, match=r"set --data\.init_args\.grid_size to the latter"):
        main(words)
    assert not (tmp_path / "config.yaml").exists()
    assert not (tmp_path / "wandb").exists()


def test_a_fit_logs_its_configuration_to_wandb(fitted):
    run_dir, _, _ = fitted
    (run,) = run_dir.glob("wandb/offline-run-*/run-*.wandb")
    content = run.read_bytes()
    assert b"train/reconstruction" in content
    assert b"r3dpa.modules.VAEAlignment" in content
