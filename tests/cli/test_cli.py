"""The ``r3dpa`` command: help, usage errors, and errors as one line on the terminal."""

import subprocess
import sys

import pytest

from r3dpa.cli import COMMANDS, OWN_PARSER, main


def python(*words):
    command = [sys.executable, *words]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


class TestHelp:
    def test_lists_every_command_and_loads_nothing_heavy(self):
        heavy = ["torch", "lightning", "matplotlib", "numpy", "wandb", "jsonargparse"]
        out = python(
            "-c",
            "import sys; from r3dpa.cli import main; main(['--help']); "
            f"print('loaded', [name for name in {heavy} if name in sys.modules])",
        )
        listed = {line[2:19].strip() for line in out.splitlines() if line.startswith("  ")}
        assert listed == set(COMMANDS)
        assert out.splitlines()[-1] == "loaded []"
        assert all(len(x.split()) > 3 for x in out.splitlines() if x.startswith("  "))

    def test_options_of_commands_are_listed_without_torch(self):
        out = python(
            "-c",
            "import sys; from r3dpa.cli import COMMANDS, OWN_PARSER, main\n"
            "for name in COMMANDS:\n"
            "    if COMMANDS[name].target not in OWN_PARSER:\n"
            "        try: main([*name.split(), '--help'])\n"
            "        except SystemExit as stop: assert stop.code == 0\n"
            "print('loaded', [name for name in ('torch', 'lightning') if name in sys.modules])",
        )
        assert out.splitlines()[-1] == "loaded []"
        read = [name for name in COMMANDS if COMMANDS[name].target not in OWN_PARSER]
        assert all(f"{name} [" in out for name in read)

    def test_help_of_extraction(self, capsys):
        with pytest.raises(SystemExit) as stop:
            main(["data", "features", "--help"])
        assert stop.value.code == 0
        assert "data features [" in capsys.readouterr().out

    def test_the_help_of_models_shows_how_to_read_a_card(self, capsys):
        main([])
        (line,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith("  models"))
        main(["models", *line.partition("; ")[2].split()[:2]])
        assert capsys.readouterr().out.startswith("#")

    @pytest.mark.parametrize("words", [[], ["-h"], ["edit"], ["edit", "--help"]])
    def test_help_of_no_command_and_of_a_group(self, words, capsys):
        main(words)
        out = capsys.readouterr().out
        assert out.startswith(f"usage: r3dpa {'edit ' if 'edit' in words else ''}COMMAND [options]")
        assert ("  sample" in out) == ("edit" not in words)
        assert "  edit inpaint " in out

    def test_module_form_and_version(self):
        assert python("-m", "r3dpa", "--version").strip() == "0.1.0"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["edit", "vari"], "unknown command 'edit vari' (did you mean edit vary?)"),
        (["sample", "--ckpt", "a"], "--out must be given"),
        (
            ["sample", "--ckpt", "a", "--out", "b", "--num", "0"],
            "--num: expected a number above 0, got 0",
        ),
        (["sample", "--ckpt", "a", "--out", "b", "--seed", "-1"], "--seed: "),
        (
            ["reference", "--data", "a", "--out", "b", "--limit", "0"],
            "--limit: expected a number above 0, got 0",
        ),
        (["features", "--dat", "x"], "dat"),
    ],
)
def test_usage_errors_name_the_word(words, message, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["convert", "no.pt", "x.pt"], "r3dpa convert: no checkpoint file no.pt; give"),
        (["edit", "vary", "--scan", "f", "--out", "f"], "r3dpa edit vary: f is a f"),
        (
            ["fit", "jointly"],
            "r3dpa fit: unknown stage 'jointly' (did you mean joint?); choose from few_step",
        ),
    ],
)
def test_an_error_of_the_process_is_one_line(words, message, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "f").touch()
    monkeypatch.setattr(sys, "argv", ["r3dpa", *words])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code.startswith(message)
    assert "\n" not in stop.value.code


def test_an_error_of_a_fit_that_has_not_started_is_one_line(monkeypatch, smoke_args, tmp_path):
    monkeypatch.setattr(sys, "argv", ["r3dpa", *smoke_args("flow_matching", tmp_path)])
    with pytest.raises(
        SystemExit, match=r"^r3dpa fit: .*give --model\.init_args\.init_from a checkpoint"
    ):
        main()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["view", "scans", "--out", "file"], "file is a file; give another --out"),
        (["realism", "--scans", "scans", "--reference", "scans", "--out", "scans"], "is a folder"),
        (["bench", "training", "--out", "scans"], "scans is a folder; give --out the name"),
        (["bench", "training", "--out", "file/costs.json"], "file is a file; give another --out"),
    ],
)
def test_an_out_that_cannot_be_written_is_refused_before_the_work(
    words, message, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "scans").mkdir()  # empty: whatever read it first would say so
    with pytest.raises(ValueError, match=message):
        main(words)
