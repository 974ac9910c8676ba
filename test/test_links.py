# SPDX-License-Identifier: Apache-2.0
"""The documents point to files that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "training/README.md",
    ROOT / "bags/README.md",
    *ROOT.glob("benchmarks/*.md"),
    *ROOT.glob("docs/*.md"),
]
_LINK = re.compile(r'\]\(<?([^)\s>]+)|\b(?:src|href)="([^"]+)"')


def broken_links(document: Path) -> list[str]:
    """Of the links [..](path) and src="path" or href="path", those without a scheme that lead nowhere."""
    targets = [a or b for a, b in _LINK.findall(document.read_text())]
    relative = [t.partition("#")[0] for t in targets if not re.match(r"[a-z][a-z+.-]*:", t)]
    return [target for target in relative if target and not (document.parent / target).exists()]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file(document):
    assert not broken_links(document)


def test_a_broken_link_is_found(tmp_path):
    (tmp_path / "here.md").write_text(
        "[a](here.md) [b](here.md#top) [c](#top) [d](https://x.org/gone) [e](gone.md)\n"
        '![f](out.png "title") <img src="gone.svg"> <a href="here.md">\n'
    )
    assert broken_links(tmp_path / "here.md") == ["gone.md", "out.png", "gone.svg"]
