# SPDX-License-Identifier: Apache-2.0
"""README and pages: Sphinx builds them without a warning, their code runs, their commands are those of the package.

Python blocks run, in order and in one namespace a page, in a folder that has the shipped recordings. So do shell blocks
below a line ``<!-- run -->``; ``<!-- run with ... -->`` adds words to their last command, as fewer steps. A block below
a line with nothing but a file's name in backquotes is that file. All other shell lines are parsed.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import json
import os
import re
import shlex
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from conftest import needs
from test_numbers import script

from paul_ros.errors import LayoutError
from paul_ros.layout import Layout
from paul_ros.ros.diagnostics import Health
from paul_ros.stream.parameters import DEFAULTS
from paul_ros.stream.stream import open_stream

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "benchmarks/RESULTS.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = {page: str(page.relative_to(ROOT)) for page in PAGES}
_BLOCK = re.compile(
    r"^(?:<!-- run(?P<with>.*?) -->\n|`(?P<file>[^`\n]+)`\n\n)?```(?P<kind>\w+)\n(?P<text>.*?)^```\n", re.M | re.S
)
_INLINE = re.compile(r"`(paul \w[^`]*)`")
#: Topics that may be remapped, and what a node's own name is remapped by.
TOPICS = {"keypoints", "camera_info", "depth", "__node", "__ns"}
#: The node's launcher, where `make setup` puts it.
LAUNCHER = ".venv/lib/paul_ros/lifter"
#: Words in place of something that a user has.
_PLACEHOLDER = re.compile(r"COMMAND|\.\.\.")

pytestmark = pytest.mark.docs


@dataclass(frozen=True)
class Block:
    """A block of code: its language, its text, the file that it is, and whether and with which more words it runs."""

    kind: str
    text: str
    file: str | None
    runs: bool
    more: tuple[str, ...]


def blocks(page: Path) -> Iterator[Block]:
    for match in _BLOCK.finditer(page.read_text()):
        words = shlex.split((match["with"] or "").removeprefix(" with"))
        yield Block(match["kind"], match["text"], match["file"], match["with"] is not None, tuple(words))


def lines(page: Path, *kinds: str) -> list[str]:
    """Commands of a page's shell blocks; a backslash continues a line."""
    text = "".join(block.text for block in blocks(page) if block.kind in kinds)
    return [line for line in text.replace("\\\n", " ").splitlines() if line.strip()]


def commands(program: str, find: Callable[[Path], list[str]]) -> list:
    """Words after the program's name of every line with it that `find` gives of a page, as cases."""
    cases = []
    for page in PAGES:
        for line in find(page):
            words = list(itertools.takewhile(lambda word: word != "|", shlex.split(line, comments=True)))
            if program in words and not _PLACEHOLDER.search(line):
                cases.append(pytest.param(words[words.index(program) + 1 :], id=f"{NAMES[page]}: {line.strip()[:60]}"))
    return cases


def shell_lines(page: Path) -> list[str]:
    return lines(page, "sh")


def help_lines(page: Path) -> list[str]:
    """Examples of `--help`."""
    return [line for line in lines(page, "text") if line.startswith("  paul ")]


def inline(page: Path) -> list[str]:
    return _INLINE.findall(page.read_text())


def inline_scripts(page: Path) -> list[str]:
    return re.findall(r"`(python [^`]*)`", page.read_text())


@pytest.fixture(scope="module")
def paul() -> argparse.ArgumentParser:
    return script("generate").paul_parser()


@pytest.mark.parametrize("words", commands("paul", shell_lines) + commands("paul", help_lines))
def test_every_command_parses(paul: argparse.ArgumentParser, words: list[str]) -> None:
    paul.parse_args(words)


def unknown(parser: argparse.ArgumentParser, words: list[str]) -> list[str]:
    """Commands and options among the words that `paul` does not have; a command in a sentence may lack the rest."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if groups and words:
        child = groups[0].choices.get(words[0])
        return unknown(child, words[1:]) if child else words[:1]
    return [
        word for word in words if word.startswith("-") and word != "-" and word not in parser._option_string_actions
    ]


@pytest.mark.parametrize("words", commands("paul", inline))
def test_commands_in_sentences_exist(paul: argparse.ArgumentParser, words: list[str]) -> None:
    assert unknown(paul, words) == []


def test_a_command_that_does_not_exist_is_found(paul: argparse.ArgumentParser) -> None:
    with pytest.raises(SystemExit):
        paul.parse_args(["replay", "x.mcap", "--no-such-option"])
    assert unknown(paul, ["replay", "--no-such-option"]) == ["--no-such-option"]
    assert unknown(paul, ["repaly", "x.mcap"]) == ["repaly"]


def refused_ros(words: list[str]) -> list[str]:
    """Names after `ros2 run` or `ros2 launch` that this package does not have."""
    if words[:2] == ["run", "paul_ros"]:
        return _refused_run(words[2:])
    if words[:2] == ["launch", "paul_ros"]:
        return _refused_launch(*words[2:])
    return []


def _refused_run(words: list[str]) -> list[str]:
    wrong = [] if (ROOT / "lib/paul_ros" / words[0]).exists() else [words[0]]
    for flag, value in zip(words, words[1:]):
        name = value.partition(":=")[0]
        known = {"-p": {*DEFAULTS, "use_sim_time"}, "-r": TOPICS}.get(flag)
        if known and name not in known and not (flag == "-p" and name.startswith("qos_overrides./")):
            wrong.append(value)
    return wrong


def _refused_launch(name: str, *arguments: str) -> list[str]:
    file = ROOT / "launch" / name
    if not file.exists():
        return [name]
    known = {argument.get("name") for argument in ElementTree.parse(file).getroot().findall("arg")}
    return [argument for argument in arguments if argument.partition(":=")[0] not in known]


@pytest.mark.parametrize("page", PAGES, ids=NAMES.get)
def test_make_has_the_targets_that_pages_name(page: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    named = {line.split()[1] for line in lines(page, "sh") if line.startswith("make ")}
    assert named | set(re.findall(r"`make ([\w-]+)`", page.read_text())) <= targets


@pytest.mark.parametrize("words", commands("python", shell_lines) + commands("python", inline_scripts))
def test_scripts_and_modules_exist(words: list[str]) -> None:
    module = ROOT / words[1].replace(".", "/") if words[0] == "-m" else ROOT / words[0]
    assert module.is_file() or module.with_suffix(".py").is_file() or (module / "__main__.py").is_file()


@pytest.mark.parametrize("words", commands("ros2", shell_lines))
def test_every_ros_command_names_what_exists(words: list[str]) -> None:
    assert refused_ros(words) == []


@pytest.mark.parametrize("words", commands(LAUNCHER, shell_lines))
def test_every_start_of_the_launcher_names_what_exists(words: list[str]) -> None:
    assert refused_ros(["run", "paul_ros", Path(LAUNCHER).name, *words]) == []


def test_a_ros_command_with_a_wrong_name_is_found() -> None:
    words = ["run", "paul_ros", "lifter", "--ros-args", "-p", "smothing:=1.0", "-r", "keypoint:=/x"]
    assert refused_ros(words) == ["smothing:=1.0", "keypoint:=/x"]
    assert refused_ros(["launch", "paul_ros", "lifter.launch.xml", "topic:=/x"]) == ["topic:=/x"]


def having(holds: Callable[[Block], bool]) -> list:
    """Pages with such a block, as cases."""
    return [pytest.param(page, id=NAMES[page]) for page in PAGES if any(map(holds, blocks(page)))]


@needs("mcap", "rosbags", "torch", "matplotlib", "rich", "tqdm")
@pytest.mark.parametrize("page", having(lambda block: block.runs or block.kind == "python"))
def test_the_code_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("bags", "paul_ros", "training"):
        Path(name).symlink_to(ROOT / name)
    names: dict = {}
    for block in blocks(page):
        if block.file:
            if block.kind == "python":
                compile(block.text, block.file, "exec")
            Path(block.file).parent.mkdir(exist_ok=True)
            Path(block.file).write_text(block.text)
        elif block.kind == "python":
            exec(compile(block.text, NAMES[page], "exec"), names)
        elif block.kind == "sh" and block.runs:
            run_shell(block, tmp_path)


def run_shell(block: Block, folder: Path) -> None:
    found = [shlex.split(line, comments=True) for line in block.text.replace("\\\n", " ").splitlines()]
    for words in filter(None, found):
        assert words[0] == "paul", "only `paul` runs in a test"
        more = block.more if words is found[-1] else ()
        run([sys.executable, "-m", "paul_ros.cli", *words[1:], *more], folder)


def run(command: list[str], folder: Path) -> None:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert done.returncode == 0, done.stderr


def first_column(page: str, heading: str) -> set[str]:
    """Names in backquotes in the first column of the tables below a heading."""
    section = (ROOT / page).read_text().split(f"{heading}\n", 1)[1].split("\n#", 1)[0]
    cells = re.findall(r"^\| (`[^|]*) \|", section, re.M)
    return {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}


@needs("mcap", "rosbags")
def test_the_keys_of_a_replay_are_those_documented(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    run(
        [sys.executable, "-m", "paul_ros.cli", "replay", str(ROOT / "bags/one_person.mcap"), "--json", str(report)],
        ROOT,
    )
    assert json.loads(report.read_text()).keys() == first_column("docs/reference/json.md", "## `paul replay`")


def test_bare_options_of_a_help_text_become_code() -> None:
    text = "with --truth, of `paul train --shapes`; * is any"
    assert script("generate")._escaped(text) == r"with `--truth`, of `paul train --shapes`; \* is any"


def test_the_keys_of_a_layout_file_are_those_documented() -> None:
    with pytest.raises(LayoutError, match="unknown key 'colour'") as refused:
        Layout.from_dict({"colour": "red"})
    known = str(refused.value).split("keys are ")[1]
    assert set(known.split(", ")) == first_column("docs/reference/layouts.md", "## Keys")


def test_the_values_of_the_diagnostics_are_those_documented() -> None:
    stream = open_stream()
    reported = Health(0.0, stream).report(1.0, stream).values
    assert reported.keys() == first_column("docs/reference/node.md", "## Diagnostics")


@needs("mcap", "rosbags")
@pytest.mark.parametrize(
    "thing, further",
    [
        ("human", ("docs/reference/json.md", "## The model file")),
        ("coco17", ("docs/reference/layouts.md", "## Keys")),
        ("bags/one_person.mcap", None),
    ],
)
def test_the_keys_of_an_inspection_are_those_documented(thing: str, further: tuple | None, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    run([sys.executable, "-m", "paul_ros.cli", "inspect", thing, "--json", str(report)], ROOT)
    found = json.loads(report.read_text())
    section = (ROOT / "docs/reference/json.md").read_text().split("## `paul inspect`\n")[1].split("\n## ")[0]
    (row,) = re.findall(rf"^\| `{found.pop('kind')}` \|.*", section, re.M)
    assert found.keys() <= set(re.findall(r"`(\w+)`", row)) | (first_column(*further) if further else set())


def test_the_keys_of_the_layout_topic_are_those_documented() -> None:
    described = open_stream().describe()
    assert described.keys() == first_column("docs/reference/node.md", "### The JSON of `~/layout`")


@pytest.mark.parametrize("page", having(lambda block: block.kind == "yaml"))
def test_layouts_in_yaml_are_layouts(page: Path) -> None:
    for block in blocks(page):
        if block.kind == "yaml":
            data = yaml.safe_load(block.text)
            if "names" in data:
                assert Layout.from_dict(data).names


def test_sphinx_builds_all_pages_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("myst_parser")
    pytest.importorskip("furo")
    options = ["-W", "--keep-going", "-q", "-b", "html", "-d", str(tmp_path / "doctrees")]
    run([sys.executable, "-m", "sphinx", *options, str(ROOT / "docs"), str(tmp_path / "html")], ROOT)
    assert (tmp_path / "html/tutorials/your_own_object.html").exists()
    (mathjax,) = re.findall(r'src="([^"]*mathjax[^"]*)"', (tmp_path / "html/explanation/method.html").read_text())
    offline = importlib.util.find_spec("sphinx-mathjax-offline") is not None
    assert (tmp_path / "html/explanation" / mathjax.partition("?")[0]).exists() == offline
