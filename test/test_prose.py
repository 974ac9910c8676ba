# SPDX-License-Identifier: Apache-2.0
"""Sentences are short and begin with their subject: in Markdown, docstrings and comments."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest
from import_graph import PACKAGES, ROOT

MAX_WORDS = 30
MAX_LONG_SHARE = 0.02
#: Beginnings of headless clauses, such as "What is measured must be ...". Questions may begin so.
HEADLESS = re.compile(r"(Of|What|Who|Whose|Whoever|That|Which|Whether|Than|Nor)\b.*[^?]$", re.DOTALL)
NOT_PROSE = re.compile(r"```.*?```|\$\$.*?\$\$|^\s*[|#>!<].*?$|^ {4,}\S.*?$", re.DOTALL | re.MULTILINE)
#: A list item or an argument, as in "name: text", is a sentence of its own.
ITEM = re.compile(r"\n\s*(?=[-*] |\d+\. |[\w, *]{1,40}: )")


def sentences(text: str) -> list[str]:
    """Return the sentences of a text; code and formulas count as one word."""
    text = re.sub(r"``?[^`]+``?|\$[^$]+\$|\]\([^)]*\)", " code ", text)
    parts = [part for block in re.split(r"\n\s*\n", text) for part in ITEM.split(block)]
    found = [" ".join(each.split()) for part in parts for each in re.split(r"(?<=[.!?:])\s+(?=[A-Z*(\"'])", part)]
    return [each for each in (sentence.lstrip("-*[( ") for sentence in found) if each]


def of_python(source: str) -> Iterator[str]:
    """Yield the docstrings and the comments; consecutive lines that hold only a comment are one text."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            yield ast.get_docstring(node) or ""
    block, last = "", 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            after_code = bool(token.line[:column].strip())
            if row != last + 1 or after_code:
                yield block
                block = ""
            block, last = f"{block}\n{token.string.lstrip('#: ')}", 0 if after_code else row
    yield block


def of_markdown(source: str) -> Iterator[str]:
    """Yield the prose without code blocks, tables, headings and quotations."""
    yield NOT_PROSE.sub("\n", source)


def texts(file: Path) -> Iterator[str]:
    source = file.read_text(encoding="utf-8")
    yield from of_python(source) if file.suffix == ".py" else of_markdown(source)


def faults(sentence: str) -> str:
    """Return 'headless', 'long' or ''."""
    if HEADLESS.match(sentence):
        return "headless"
    return "long" if len(sentence.split()) > MAX_WORDS else ""


@pytest.fixture(scope="module")
def places() -> list[tuple[Path, str, str]]:
    """(file, sentence, fault) of everything that a user or a maintainer reads."""
    files = [ROOT / "README.md", ROOT / "benchmarks/RESULTS.md", *(ROOT / "docs").rglob("*.md")]
    files += [file for package in PACKAGES for suffix in ("*.py", "*.md") for file in (ROOT / package).rglob(suffix)]
    return [
        (file.relative_to(ROOT), sentence, faults(sentence))
        for file in sorted(files)
        for text in texts(file)
        for sentence in sentences(text)
    ]


def listed(places: list[tuple[Path, str, str]], fault: str) -> list[str]:
    return [f"{file}: {sentence}" for file, sentence, found in places if found == fault]


def test_no_sentence_is_headless(places) -> None:
    assert "\n".join(listed(places, "headless")) == ""


def test_few_sentences_are_long(places) -> None:
    long = listed(places, "long")
    assert len(long) < MAX_LONG_SHARE * len(places), "\n".join(long)


@pytest.mark.parametrize(
    "text, found",
    [
        ("What is no person has its root anywhere.", ["headless"]),
        ("What is it? Of a person nothing is known.", ["", "headless"]),
        (f"The {'very ' * 30}long sentence ends. This one is `{'code ' * 40}` only.", ["long", ""]),
        ("Args:\n    names: whether it is so.\n    other: " + "word " * 31, ["", "", "long"]),
    ],
)
def test_what_counts_as_a_fault(text: str, found: list[str]) -> None:
    assert [faults(sentence) for sentence in sentences(text)] == found


def test_all_prose_of_a_file_is_read() -> None:
    python = (
        '"""Module."""\nx = "# no comment"  # Why.\ny = 1  # Alone.\n# Two\n# lines.\ndef f():\n    """Function."""\n'
    )
    assert [" ".join(text.split()) for text in of_python(python) if text] == [
        "Module.",
        "Function.",
        "Why.",
        "Alone.",
        "Two lines.",
    ]
    markdown = "# Of no use\n\nRead.\n\n```\nOf code.\n```\n| of | a table |\n\n- One.\n- Two.\n"
    assert [each for text in of_markdown(markdown) for each in sentences(text)] == ["Read.", "One.", "Two."]
