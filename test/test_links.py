# SPDX-License-Identifier: Apache-2.0
"""Links of README and pages lead to files and headings that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "training/README.md", "bags/README.md")),
    *ROOT.glob("benchmarks/*.md"),
    *sorted((ROOT / "docs").rglob("*.md")),
]
_LINK = re.compile(r'\]\(<?([^)\s>]+)|\b(?:src|href)="([^"]+)"')
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
_LABEL = re.compile(r"^\(([\w-]+)\)=$", re.MULTILINE)


def anchors(text: str) -> set[str]:
    """Names of a page's headings, as GitHub and MyST make them, and of its labels."""
    text = _FENCE.sub("", text)
    words = (re.sub(r"[^\w\- ]", "", heading.lower()).strip() for heading in _HEADING.findall(text))
    return {word.replace(" ", "-") for word in words} | set(_LABEL.findall(text))


def broken_links(document: Path) -> list[str]:
    """Links without a scheme, [..](path#heading) and src or href="path", to no file or to no heading of its page."""
    targets = [a or b for a, b in _LINK.findall(document.read_text())]
    return [
        target
        for target in targets
        if not re.match(r"[a-z][a-z+.-]*:", target) and not _leads(document, *_split(target))
    ]


def _split(target: str) -> tuple[str, str]:
    path, _, anchor = target.partition("#")
    return path, anchor


def _leads(document: Path, path: str, anchor: str) -> bool:
    file = document.parent / path if path else document
    return file.exists() and (not anchor or file.suffix != ".md" or anchor in anchors(file.read_text()))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file_and_heading(document: Path) -> None:
    assert not broken_links(document)


def named_pages(file: Path) -> set[str]:
    """Pages of docs/ that a source file names by their path."""
    return set(re.findall(r"\bdocs/[\w/]+\.\w+", file.read_text(encoding="utf-8")))


@pytest.mark.parametrize("folder", ("paul_ros", "msg_adapters", "training", "benchmarks", "bags", "docs", "launch"))
def test_sources_name_pages_that_exist(folder: str) -> None:
    files = [path for path in (ROOT / folder).rglob("*.*") if path.suffix in (".py", ".yaml", ".xml", ".md")]
    assert {name: file for file in files for name in named_pages(file) if not (ROOT / name).exists()} == {}


@pytest.mark.parametrize("name, most", [("README.md", 110), ("benchmarks/RESULTS.md", 150)])
def test_pages_for_everybody_are_short(name: str, most: int) -> None:
    assert len((ROOT / name).read_text().splitlines()) <= most


def test_every_page_is_in_the_index() -> None:
    index = (ROOT / "docs/index.md").read_text()
    pages = [path.relative_to(ROOT / "docs").with_suffix("") for path in (ROOT / "docs").rglob("*.md")]
    assert [str(page) for page in pages if str(page) != "index" and f"\n{page}\n" not in index] == []


def test_a_broken_link_is_found(tmp_path: Path) -> None:
    (tmp_path / "here.md").write_text(
        "# On top\n[a](here.md) [b](here.md#on-top) [c](#on-top) [d](https://x.org/gone) [e](gone.md) [f](#below)\n"
        '![g](out.png "title") <img src="gone.svg"> <a href="here.md"> [h](here.md#below)\n'
    )
    assert broken_links(tmp_path / "here.md") == ["gone.md", "#below", "out.png", "gone.svg", "here.md#below"]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_source_files_that_a_page_names_exist(document: Path) -> None:
    folders = "paul_ros|msg_adapters|training|test|docs|benchmarks|bags"
    named = re.findall(rf"`((?:{folders})/[\w./]*)`", document.read_text())
    assert [name for name in named if not (ROOT / name).exists()] == []
