"""Every command line in Markdown, notebooks, Makefile and the comments of ``conf`` is accepted.

An installed wheel holds the configurations, and its commands find them.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from r3dpa.cli import ALIASES, COMMANDS, GROUPS, OWN_PARSER, main
from r3dpa.cli.features import features_parser, with_data_class
from r3dpa.cli.parser import load, make_parser, parse
from r3dpa.cli.stages import StageParser

TOP = Path(__file__).resolve().parents[2]
CONF = TOP / "conf"
PYPROJECT = TOP / "pyproject.toml"
EXTRAS = tomllib.loads(PYPROJECT.read_text())["project"]["optional-dependencies"]
MAKEFILE = (TOP / "Makefile").read_text()
# Given to `test` and `predict` in place of the configuration of a run that is not there.
JOINT = [CONF / f"{name}.yaml" for name in ("trainer", "data/simulated", "experiment/joint")]


def commands_in(text):
    """Words after ``r3dpa`` of the lines that start with it, continued lines joined."""
    for line in text.replace("\\\n", " ").splitlines():
        found = re.match(r"[\s$!]*r3dpa (?!COMMAND)(.+)", line)
        if found:
            words = shlex.split(found[1].partition(" > ")[0], comments=True)
            if "..." not in words and not any("|" in word for word in words):
                yield words


def split_command(words):
    """Full name of a command, which must exist, and the words after it."""
    length = 2 if words[0] in GROUPS else 1
    name = " ".join(words[:length])
    name = ALIASES.get(name, name)
    assert name in COMMANDS
    return name, words[length:]


def documents():
    """Texts for readers by name; of notebooks the sources of all cells."""
    names = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "notebooks/LOG.md")
    cards = ("src/r3dpa/weights/r3dpa-s.md", "src/r3dpa/features/README.md")
    texts = {name: (TOP / name).read_text() for name in (*names, *cards)}
    for path in sorted((TOP / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text())["cells"]
        texts[path.name] = "\n".join("".join(cell["source"]) for cell in cells)
    return texts


def spans_of(text, command):
    """Code spans of Markdown that start with a command."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    return re.findall(rf"`({command} [^`]+)`", prose.replace("\n", " "))


# Targets whose recipes call `r3dpa`, in each of their variants.
MAKE = (
    *("demo", "demo DATA=scans", "demo SCRATCH=1", "demo SCRATCH=1 DATA=scans"),
    *(
        "my-sensor DATA=scans",
        "gallery",
        "r3dpa-s",
        "r3dpa-s-more",
        "r3dpa-s-control",
        "r3dpa-s-rgb",
        "r3dpa-s-first",
        "r3dpa-s-scores",
        "bench-training",
        "bench-sampling",
        "bench-gpu CKPT=a.ckpt",
    ),
    "ablations",
)


def recipe_of(words, makefile="Makefile"):
    """What ``make`` would run after its set-up; a variable that nothing defines is an error."""
    make = ["make", "--dry-run", "--warn-undefined-variables", "-o", ".venv/.installed"]
    result = subprocess.run(
        [*make, "-f", makefile, *words.split()], cwd=TOP, capture_output=True, text=True
    )
    assert not result.stderr, f"make {words}: {result.stderr}"
    assert result.returncode == 0
    lines = result.stdout.replace("\\\n", " ").splitlines()
    return "\n".join(re.sub(r"^.*?\.venv/bin/r3dpa ", "r3dpa ", line) for line in lines)


def test_a_sensor_that_is_given_is_not_estimated():
    """And one in the folder that is made anew is not deleted."""
    assert "data sensor" in recipe_of("my-sensor DATA=scans")
    recipe = recipe_of("my-sensor DATA=scans SENSOR=vlp16")
    assert "data sensor" not in recipe
    assert "data plan 'vlp16'" in recipe
    with pytest.raises(AssertionError, match=r"copy runs/my_sensor/sensor\.yaml out of it"):
        recipe_of("my-sensor DATA=scans SENSOR=runs/my_sensor/sensor.yaml")


def documented():
    found = {}
    for name, text in documents().items():
        # A span without options only names a command.
        complete = [s for s in spans_of(text, "r3dpa") if " --" in s and "--help" not in s]
        found[name] = "\n".join([text, *complete])
    for words in MAKE:
        found[f"make {words}"] = recipe_of(words)
    for path in sorted(CONF.rglob("*.yaml")):
        lines = [line for line in path.open() if re.match(r"#\s{2,}(r3dpa|--)", line)]
        found[str(path.relative_to(TOP))] = "".join(line.lstrip("# ") for line in lines)
    seen = []
    for name, text in found.items():
        for number, words in enumerate(commands_in(text)):
            if name.startswith("make my-sensor") and words[0] == "fit":
                continue  # takes files of `data plan`: tests/data/test_sensor_plan.py
            if words not in seen:
                seen.append(words)
                yield pytest.param(words, id=f"{name}-{number}-{words[0]}")


@pytest.mark.parametrize("words", list(documented()))
def test_command_is_accepted(words, monkeypatch, capsys):
    monkeypatch.chdir(TOP)
    monkeypatch.setattr(StageParser, "dump", lambda *_, **__: "")  # a quarter of the time
    name, rest = split_command(words)
    if name == "data features":
        features_parser(name).parse_args(with_data_class(rest))
    elif COMMANDS[name].target in OWN_PARSER:
        for place, word in enumerate(words):
            if word == "--config" and not Path(words[place + 1]).is_file():
                configs = [w for path in JOINT for w in ("--config", str(path))]
                words = [*words[:place], *configs, *words[place + 2 :]]
                break
        with pytest.raises(SystemExit) as ended:
            main([*words, "--print_config"])
        assert ended.value.code == 0, capsys.readouterr().err
    else:
        if "--config" in rest and not Path(rest[rest.index("--config") + 1]).is_file():
            place = rest.index("--config")
            rest = rest[:place] + rest[place + 2 :]
        parse(load(COMMANDS[name].target), rest, name)


def other_commands():
    """Lines of shell blocks that do not start with ``r3dpa``, and ``make`` in code spans."""
    for name, text in documents().items():
        blocks = "\n".join(re.findall(r"```bash\n(.*?)```", text, re.DOTALL))
        lines = blocks.replace("\\\n", " ").splitlines()
        lines += re.findall(r"^[!%](.*)", text, re.MULTILINE) if name.endswith(".ipynb") else []
        for line in [*lines, *spans_of(text, "make"), *spans_of(text, r"\.venv/bin/pytest")]:
            words = shlex.split(line, comments=True)
            if words and words[0] != "r3dpa":
                yield pytest.param(words, id=f"{name}-{'-'.join(words[:2])}")


@pytest.mark.parametrize("words", list(other_commands()))
def test_other_command_exists(words):
    if words[0] == "make":
        subprocess.run(["make", "--dry-run", *words[1:]], cwd=TOP, check=True, capture_output=True)
    elif words[0] == ".venv/bin/pytest":
        assert words[1] == "-m"
        assert f'"{words[2]}:' in PYPROJECT.read_text()
    elif words[:2] == ["pip", "install"]:
        extras = re.fullmatch(r"(?:\.|r3dpa)(?:\[([\w,]+)\])?", words[2])
        assert words[2] == "torch" or extras
        assert not extras or not extras[1] or set(extras[1].split(",")) <= set(EXTRAS)
    else:
        assert words in ([".", ".venv/bin/activate"], ["matplotlib", "inline"])


def test_a_span_without_options_names_a_command():
    groups = {name.split()[0] for name in COMMANDS}
    for text in documents().values():
        for span in spans_of(text, "r3dpa"):
            words = span.split()[1:]
            if words[0] not in {"COMMAND", "--help"} and words not in [[group] for group in groups]:
                split_command(words)


def test_abridged_spans_have_options_of_their_commands():
    """``...`` stands for further options and ``a|b`` for a choice; such a span is not run."""
    spans = [span for text in documents().values() for span in spans_of(text, "r3dpa")]
    abridged = [span for span in spans if " --" in span and re.search(r"\.\.\.|\|", span)]
    assert abridged
    for span in abridged:
        name, words = split_command(shlex.split(span)[1:])
        actions = make_parser(load(COMMANDS[name].target))._actions
        options = {option for action in actions for option in action.option_strings}
        assert {word for word in words if word.startswith("--")} <= options, span


def test_recipes_are_read_whole():
    """As many commands as lines of a recipe that call ``r3dpa``, in all targets that do."""
    for words in MAKE:
        recipe = recipe_of(words)
        assert len(list(commands_in(recipe))) == recipe.count("r3dpa ") > 0, words
    called, target = set(), ""
    for line in MAKEFILE.splitlines():
        target = line.partition(":")[0] if re.match(r"[\w-]+:", line) else target
        if line.startswith("\t") and re.search(r"/r3dpa |FIT(_\w+)?\)", line):
            called.add(target)
    assert called == {words.split()[0] for words in MAKE}


def test_a_missing_variable_of_the_makefile_fails(tmp_path):
    renamed = tmp_path / "Makefile"
    renamed.write_text(MAKEFILE.replace("FIT_SECOND :=", "SECOND_FIT :="))
    with pytest.raises(AssertionError, match="undefined variable 'FIT_SECOND'"):
        recipe_of("r3dpa-s", renamed)


def test_readme_shows_every_group():
    shown = {split_command(words)[0] for words in commands_in((TOP / "README.md").read_text())}
    assert {"fit", "sample", "test", "evaluate", "ablate", "convert"} <= shown
    assert {name.split()[0] for name in shown} >= {"data", "edit", "bench"}


@pytest.mark.slow
def test_commands_of_an_installed_wheel(tmp_path):
    source, site = tmp_path / "source", tmp_path / "site"
    skipped = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for name in ("src", "conf"):
        shutil.copytree(TOP / name, source / name, symlinks=True, ignore=skipped)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(TOP / name, source / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--no-build-isolation", "--no-deps"]
    subprocess.run([*pip, "-q", "-w", tmp_path, source], check=True, timeout=300)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(site)
    shipped = {f"r3dpa/{p.relative_to(TOP)}" for p in (TOP / "conf").rglob("*.yaml")}
    assert shipped <= names
    environment = {**os.environ, "PYTHONPATH": str(site)}

    def r3dpa(*words):
        return subprocess.run(
            [sys.executable, "-m", "r3dpa", *words],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=200,
        ).stdout

    assert "class_path: r3dpa.modules.JointAlignment" in r3dpa(
        *("fit", "joint", "--preset", "demo", "--print_config")
    )
    assert r3dpa("ablate", "conf/ablation", "--scale", "demo", "--budget_only").startswith("budget")
