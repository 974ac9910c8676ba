# SPDX-License-Identifier: Apache-2.0
"""Output paths are refused before the work begins, if they would cost an input or cannot be written."""

from __future__ import annotations

import pytest

from paul_ros.errors import BagError, OutputError
from paul_ros.files import atomic_file, write_atomically
from paul_ros.output_files import check_output, check_outputs


@pytest.fixture
def bag(tmp_path):
    """A bag folder of one file."""
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "a.mcap").write_bytes(b"recorded")
    return folder


@pytest.mark.parametrize("name", ["a.mcap", "new.mcap", "metadata.yaml"])
def test_files_of_a_bag_folder_are_protected(bag, name):
    with pytest.raises(OutputError, match="part of an input; name another output"):
        check_outputs([bag / name], [bag])
    assert [file.name for file in bag.iterdir()] == ["a.mcap"]


def test_a_report_may_lie_in_the_folder_of_an_input(bag):
    check_outputs([bag / "report.json", None], [bag, None, "human"])


def test_an_input_is_protected_under_any_of_its_names(bag, tmp_path):
    (tmp_path / "link.mcap").symlink_to(bag / "a.mcap")
    with pytest.raises(OutputError, match="overwrite an input"):
        check_outputs([tmp_path / "link.mcap"], [bag / "a.mcap"])


def test_two_outputs_of_one_name(tmp_path):
    with pytest.raises(OutputError, match="two outputs"):
        check_outputs([tmp_path / "a.json", tmp_path / "b" / ".." / "a.json"], [])


def test_the_folder_of_an_output_is_made(tmp_path):
    check_output(tmp_path / "deep" / "down" / "a.json")
    assert (tmp_path / "deep" / "down").is_dir() and not list((tmp_path / "deep" / "down").iterdir())


def test_an_output_error_is_no_bag_error():
    assert not issubclass(OutputError, BagError)


def test_an_error_of_writing_names_the_file_and_not_the_temporary_one(tmp_path):
    out, absent = tmp_path / "folder", tmp_path / "absent"
    out.mkdir()
    with pytest.raises(IsADirectoryError) as refusal:
        write_atomically(out, b"data")
    assert refusal.value.filename == str(out) and list(tmp_path.iterdir()) == [out]
    with pytest.raises(FileNotFoundError) as refusal, atomic_file(tmp_path / "file"):
        absent.read_bytes()
    assert refusal.value.filename == str(absent) and list(tmp_path.iterdir()) == [out]
