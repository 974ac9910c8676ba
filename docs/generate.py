# SPDX-License-Identifier: Apache-2.0
"""Fill README and pages with figures and tables that come from elsewhere; ``--check`` only says which are out of date.

    python docs/generate.py [--check]

Figures: ``51<!--one_person.pa_mpjpe_mm-->`` is the value of that key in ``docs/numbers.json``, with as many decimals as
the page has. Regions: the lines between ``<!-- generated: NAME -->`` and ``<!-- end -->`` come from the code of the
package: parameters, commands, recipes, layouts and reasons for drops and notes.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import itertools
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

NUMBERS = ROOT / "docs/numbers.json"
PAGES = (ROOT / "README.md", ROOT / "benchmarks/RESULTS.md", *sorted((ROOT / "docs").rglob("*.md")))

_FIGURE = re.compile(r"(-?\d[\d,]*)(\.\d+)?(\*\*)?<!--([\w.]+)-->")
_REGION = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
_ATTRIBUTE = re.compile(r"^    (\w+): (.*(?:\n        .*)*)", re.MULTILINE)
_BARE_OPTION = re.compile(r"`[^`]*`|(--\w[\w-]*)")
_PAGE = re.compile(r"docs/(\w+/\w+\.md)")
_COMMENT = re.compile(r"^    (\w+): .*?  # (.*)$", re.MULTILINE)
_SECTION = re.compile(r"\nAttributes:\n(.*?)(?:\n\n|\Z)", re.DOTALL)


def main() -> int:
    """Rewrite the pages, or name those that would change."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="change nothing; exit code 1 if a page is out of date")
    args = parser.parse_args()
    stale = [page for page in PAGES if filled(page.read_text()) != page.read_text()]
    for page in stale:
        print(page.relative_to(ROOT))
        if not args.check:
            page.write_text(filled(page.read_text()))
    return int(args.check and bool(stale))


def filled(text: str) -> str:
    """Return a page with its regions and figures up to date."""
    text = _REGION.sub(lambda match: match[1] + REGIONS[match[2]]() + match[3], text)
    values = numbers()
    return _FIGURE.sub(lambda match: _figure(match, values), text)


def numbers() -> dict[str, float]:
    """Return all figures of ``docs/numbers.json`` by key."""
    groups = json.loads(NUMBERS.read_text()).values()
    return {key: value for group in groups for key, value in group["values"].items()}


def _figure(match: re.Match, values: dict[str, float]) -> str:
    decimals = len(match[2] or ".") - 1
    return f"{values[match[4]]:{',' if ',' in match[1] else ''}.{decimals}f}{match[3] or ''}<!--{match[4]}-->"


# --- regions


def parameters() -> str:
    """Return the table of the node's parameters."""
    from paul_ros.stream.parameters import as_markdown

    return as_markdown()


def reasons() -> str:
    """Return a table for each kind of reason by which a message or person is dropped, or a note is made."""
    from paul_ros.stream.reason import DROP, NOTE, PERSON
    from paul_ros.stream.reasons import REASONS

    titles = {
        DROP: "**Dropped messages**, `dropped_<reason>` in `/diagnostics`:",
        PERSON: "**Persons left out**, `dropped_<reason>`:",
        NOTE: "**Irregular but used**, `noted_<reason>`:",
    }
    tables = []
    for kind, title in titles.items():
        rows = [(f"`{r.slug}`", f"{r.what}.", r.fix, r.warns) for r in REASONS.values() if r.kind == kind]
        tables.append(f"{title}\n\n{table(('reason', 'what happened', 'what to do', 'WARN'), rows)}")
    return "\n".join(tables)


def options() -> str:
    """Return a table of the options of `paul replay` that stand for parameters and topics of the node."""
    from paul_ros.cli.launcher import build_parser
    from paul_ros.stream.option_advice import TOPICS, in_options
    from paul_ros.stream.parameters import DEFAULTS

    arguments = vars(build_parser(["replay"]).parse_args(["replay", "BAG"]))
    kinds = {**dict.fromkeys(TOPICS, "topic"), **dict.fromkeys(DEFAULTS, "parameter")}
    named = [(f"{kind} `{name}`", in_options(f"`{name}`", arguments)) for name, kind in kinds.items()]
    rows = [(name, f"`--{option.partition('--')[2]}`") for name, option in named if "--" in option]
    return table(("node", "`paul replay`"), rows)


def layouts() -> str:
    """Return a table of the shipped layouts."""
    from paul_ros.layout import layout_names, load_layout

    found = [load_layout(name) for name in layout_names()]
    rows = [(f"`{layout.name}`", len(layout.names), " ".join(layout.description.split())) for layout in found]
    return table(("layout", "points", "description"), rows)


def recipes() -> str:
    """Return a table of the shipped recipes: the comment at the head of each file, and what it sets.

    A list shows its first item.
    """
    folder = ROOT / "training/recipes"
    rows = []
    for path in sorted(folder.glob("*.yaml")):
        lines = path.read_text().splitlines()
        head = itertools.takewhile(lambda line: line.startswith("#"), lines)
        purpose = _PAGE.sub(_link, " ".join(line[2:] for line in head if "SPDX" not in line))
        sets = [
            f"{line} [{after.strip(' -')}, ...]" if line.endswith(":") else line.split("  #")[0]
            for line, after in zip(lines, [*lines[1:], ""])
            if line and not line.startswith(("#", " "))
        ]
        rows.append((f"`{path.stem}`", purpose, ", ".join(f"`{line}`" for line in sets)))
    return table(("recipe", "purpose", "settings"), rows)


def _link(match: re.Match) -> str:
    """Return a link from a page of the reference to the page that a source file names, by that page's title."""
    title = (ROOT / match[0]).read_text().splitlines()[0].removeprefix("# ")
    return f"[{title}](../{match[1]})"


def settings() -> str:
    """Return the table of a recipe's settings."""
    from training.recipe import Recipe

    return attributes(Recipe)


def views() -> str:
    """Return the table of the settings of motion-capture views."""
    from training.people.view_settings import ViewSettings

    return attributes(ViewSettings)


def attributes(kind: type) -> str:
    """Return a table of a dataclass: names, defaults, and what its docstring or a comment beside it says of each."""
    section = _SECTION.search(inspect.getdoc(kind) or "")
    meanings = dict(_COMMENT.findall(inspect.getsource(kind))) | dict(_ATTRIBUTE.findall(section[1] if section else ""))
    rows = [
        (f"`{field.name}`", f"`{_yaml(field.default)}`", _code(meanings.get(field.name, "")))
        for field in dataclasses.fields(kind)
    ]
    return table(("setting", "default", "meaning"), rows)


def _yaml(value: object) -> str:
    """Return a default as YAML has it."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_yaml, value))}]"
    return json.dumps(value) if value is None or isinstance(value, bool) else str(value)


def _code(text: str) -> str:
    """Return a docstring's text as a cell of Markdown: one line, and one backquote in place of two."""
    return " ".join(text.split()).replace("``", "`")


def commands() -> str:
    """Return every command of `paul` with its arguments, from the parsers themselves."""
    return "\n".join(_commands(paul_parser(), "paul", None))


def paul_parser() -> argparse.ArgumentParser:
    """Return the parser of `paul`, with the options of all commands, those of `train` too."""
    from paul_ros.cli import launcher

    return launcher.build_parser()


def _commands(parser: argparse.ArgumentParser, name: str, said: str | None) -> Iterator[str]:
    """Yield the parts of a command and of those below it; `said` is an epilog that was already shown."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if name != "paul":
        yield f"## `{name}`\n\n{_escaped(parser.description or '')}\n"
    if not groups:
        positional = [_placeholder(action) for action in parser._actions if not action.option_strings]
        yield f"```text\n{' '.join([name, *positional, '[options]'])}\n```\n"
        shown = [action for action in parser._actions if action.help != argparse.SUPPRESS and action.dest != "help"]
        yield table(("argument", "meaning"), [_row(action, parser) for action in shown])
    if name != "paul" and parser.epilog and parser.epilog != said:
        yield f"```text\n{parser.epilog.strip()}\n```\n"
    for group in groups:
        for word, child in group.choices.items():
            yield from _commands(child, f"{name} {word}", parser.epilog)


def _row(action: argparse.Action, parser: argparse.ArgumentParser) -> tuple[str, str]:
    words = action.option_strings or [_placeholder(action)]
    value = "" if action.nargs == 0 or not action.option_strings else f" {_placeholder(action)}"
    text = (action.help or "") % {"default": action.default, "prog": parser.prog}
    required = " (required)" if action.option_strings and action.required else ""
    return f"`{', '.join(words)}{value}`{required}", _escaped(text)


def _placeholder(action: argparse.Action) -> str:
    choices = f"{{{','.join(map(str, action.choices))}}}" if action.choices else action.dest.upper()
    word = " ".join(action.metavar) if isinstance(action.metavar, tuple) else str(action.metavar or choices)
    return {"+": f"{word} ...", "*": f"[{word} ...]", "?": f"[{word}]"}.get(str(action.nargs), word)


def _escaped(text: str) -> str:
    """Return text of a parser as a cell or line of Markdown; HTML would draw the dashes of a bare option as one."""
    text = re.sub(r"(\*|<)", r"\\\1", " ".join(text.split()))
    return _BARE_OPTION.sub(lambda match: f"`{match[1]}`" if match[1] else match[0], text)


def table(head: tuple[str, ...], rows: list[tuple]) -> str:
    """Return a table in Markdown."""
    lines = [head, ("---",) * len(head), *rows]
    return "".join(f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


REGIONS: dict[str, Callable[[], str]] = {
    function.__name__: function
    for function in (parameters, reasons, options, layouts, recipes, settings, views, commands)
}

if __name__ == "__main__":
    sys.exit(main())
