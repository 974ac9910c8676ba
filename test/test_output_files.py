# SPDX-License-Identifier: Apache-2.0
"""Output paths are refused before the work begins, if they would cost an input or cannot be written."""

from __future__ import annotations

import errno
import os
import stat
import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from paul_ros.errors import BagError, OutputError
from paul_ros.files import atomic_file, is_stream, read_npz, write_atomically, write_json, write_npz
from paul_ros.output_files import check_output, check_outputs

NOBODY = 65534


@pytest.fixture
def bag(tmp_path):
    """A bag folder of one file."""
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "a.mcap").write_bytes(b"recorded")
    return folder


@pytest.mark.parametrize("name", ["a.mcap", "new.mcap", "new.mcap.zstd", "new.db3", "metadata.yaml"])
def test_files_of_a_bag_folder_are_protected(bag, name):
    with pytest.raises(OutputError, match="part of an input; name another output"):
        check_outputs([bag / name], [bag])
    assert [file.name for file in bag.iterdir()] == ["a.mcap"]


def test_a_report_may_lie_in_the_folder_of_an_input(bag):
    check_outputs([bag / "report.json", None], [bag, None, "human"])


@pytest.mark.parametrize("link", [Path.symlink_to, Path.hardlink_to])
def test_an_input_is_protected_under_any_of_its_names(bag, tmp_path, link):
    link(tmp_path / "link.mcap", bag / "a.mcap")
    with pytest.raises(OutputError, match="overwrite an input"):
        check_outputs([tmp_path / "link.mcap"], [bag / "a.mcap"])


def test_a_bag_folder_is_protected_under_any_of_its_names(bag, tmp_path):
    (tmp_path / "link").symlink_to(bag)
    for output, source in ((tmp_path / "link" / "new.mcap", bag), (bag / "new.mcap", tmp_path / "link")):
        with pytest.raises(OutputError, match="part of an input"):
            check_outputs([output], [source])


def test_two_outputs_of_one_name(tmp_path):
    with pytest.raises(OutputError, match="two outputs"):
        check_outputs([tmp_path / "a.json", tmp_path / "b" / ".." / "a.json"], [])
    (tmp_path / "b.json").symlink_to("a.json")
    with pytest.raises(OutputError, match="two outputs"):
        check_outputs([tmp_path / "a.json", tmp_path / "b.json"], [])


@pytest.mark.parametrize("order", [1, -1])
def test_an_output_cannot_be_the_folder_of_another(tmp_path, order):
    outputs = [tmp_path / "m.npz", tmp_path / "m.npz" / "report.json"][::order]
    with pytest.raises(OutputError, match="one output is the folder of another"):
        check_outputs(outputs, [])


def test_a_check_makes_nothing(tmp_path):
    check_output(tmp_path / "deep" / "down" / "a.json")
    check_output(tmp_path / "a.json")
    assert not list(tmp_path.iterdir())
    write_atomically(tmp_path / "deep" / "down" / "a.json", b"data")
    assert names(tmp_path / "deep" / "down") == ["a.json"]


def test_folders_that_were_made_go_with_the_failed_output(tmp_path):
    (tmp_path / "old").mkdir()
    for folder in (tmp_path / "new" / "deep", tmp_path / "old"):
        with pytest.raises(KeyboardInterrupt), atomic_file(folder / "a.json"):
            raise KeyboardInterrupt
    assert names(tmp_path) == ["old"] and names(tmp_path / "old") == []


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


# --- what is written to is never replaced by something of another kind


def names(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


@contextmanager
def umask(value: int):
    before = os.umask(value)
    try:
        yield
    finally:
        os.umask(before)


def test_writers_of_one_name_do_not_meet(tmp_path):
    """The last one to end wins, with a whole file."""
    out = tmp_path / "a"
    with atomic_file(out) as first, atomic_file(out) as second:
        first.write(b"1" * 9)
        second.write(b"2" * 5)
        first.write(b"1")
        assert len(names(tmp_path)) == 2 and all(name.endswith(".part") for name in names(tmp_path))
    assert out.read_bytes() == b"1" * 10 and names(tmp_path) == ["a"]


@pytest.mark.parametrize("target", ["real", "absent", "absent/deep"])
def test_the_target_of_a_link_is_written_and_the_link_stays(tmp_path, target):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "real").write_bytes(b"old")
    (tmp_path / "one").symlink_to(Path("elsewhere", target))
    (tmp_path / "two").symlink_to("one")
    check_output(tmp_path / "two")
    write_atomically(tmp_path / "two", b"new")
    assert (tmp_path / "elsewhere" / target).read_bytes() == b"new"
    assert os.readlink(tmp_path / "two") == "one" and (tmp_path / "one").is_symlink()
    assert names(tmp_path) == ["elsewhere", "one", "two"]


def test_links_that_lead_to_no_file(tmp_path):
    (tmp_path / "loop").symlink_to("pool")
    (tmp_path / "pool").symlink_to("loop")
    (tmp_path / "folder").symlink_to(tmp_path)
    for name, clue in (("loop", "Too many levels of symbolic links"), ("folder", "it is a folder")):
        with pytest.raises(OutputError, match=f"cannot write .*{name}: {clue}"):
            check_output(tmp_path / name)
        with pytest.raises(OSError, match=name):
            write_atomically(tmp_path / name, b"data")
    assert names(tmp_path) == ["folder", "loop", "pool"] and all(file.is_symlink() for file in tmp_path.iterdir())


def test_a_device_is_written_straight(tmp_path):
    link = tmp_path / "null.json"
    link.symlink_to(os.devnull)
    assert is_stream(link)  # a fault must not cost root its device
    check_outputs([link, link], [])
    write_json(link, {"frames": 1})
    assert os.readlink(link) == os.devnull and stat.S_ISCHR(os.stat(os.devnull).st_mode)
    assert names(tmp_path) == ["null.json"]


def test_a_full_device_is_named(tmp_path):
    link = tmp_path / "full.json"
    link.symlink_to("/dev/full")
    assert is_stream(link)
    with pytest.raises(OSError, match="No space left") as refusal:
        write_json(link, {"frames": 1})
    assert refusal.value.filename == str(link) and stat.S_ISCHR(os.stat("/dev/full").st_mode)


def test_a_pipe_is_written_straight(tmp_path):
    """Formats that look back, as zip does, are written from front to end."""
    pipe, got = tmp_path / "pipe.npz", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_bytes()))
    reader.start()
    check_output(pipe)
    write_npz(pipe, {"a": np.arange(1000)})
    reader.join(10)
    (tmp_path / "got.npz").write_bytes(got[0])
    assert read_npz(tmp_path / "got.npz", ["a"])["a"].tolist() == list(range(1000))
    assert pipe.is_fifo() and names(tmp_path) == ["got.npz", "pipe.npz"]


def test_an_open_descriptor_is_continued(tmp_path):
    """As /dev/stdout is, if a shell has redirected it to a file: what others write there stays."""
    with open(tmp_path / "log", "wb", buffering=0) as log:
        log.write(b"before ")
        for path in (Path(f"/dev/fd/{log.fileno()}"), Path(f"/proc/self/fd/{log.fileno()}")):
            assert is_stream(path)
            check_output(path)
            write_atomically(path, b"within ")
        log.write(b"after")
    assert (tmp_path / "log").read_bytes() == b"before within within after" and names(tmp_path) == ["log"]
    with pytest.raises(OSError, match="Bad file descriptor|No such file"):
        write_atomically("/dev/fd/987", b"data")


@pytest.mark.parametrize("mode", [0o600, 0o664])
def test_an_existing_file_keeps_its_permissions(tmp_path, mode):
    out = tmp_path / "a"
    out.touch()
    out.chmod(mode)
    with umask(0o077):
        write_atomically(out, b"new")
    assert stat.S_IMODE(out.stat().st_mode) == mode and out.read_bytes() == b"new"


def test_a_new_file_has_the_permissions_of_the_umask(tmp_path):
    for mask in (0o022, 0o077, 0o002):
        with umask(mask):
            write_atomically(tmp_path / f"{mask}", b"new")
        assert stat.S_IMODE((tmp_path / f"{mask}").stat().st_mode) == 0o666 & ~mask


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files to others")
def test_owner_and_write_permission(tmp_path):
    tmp_path.chmod(0o777)
    for name, mode in (("own", 0o644), ("kept", 0o444)):
        (tmp_path / name).write_bytes(b"old")
        (tmp_path / name).chmod(mode)
        os.chown(tmp_path / name, NOBODY, NOBODY)
    write_atomically(tmp_path / "own", b"new")
    assert (tmp_path / "own").stat().st_uid == NOBODY
    os.seteuid(NOBODY)
    try:
        for write in (check_output, lambda path: write_atomically(path, b"new")):
            with pytest.raises((OSError, OutputError), match="Permission denied"):
                write(tmp_path / "kept")
    finally:
        os.seteuid(0)
    assert (tmp_path / "kept").read_bytes() == b"old" and names(tmp_path) == ["kept", "own"]


@pytest.mark.parametrize("length, fits", [(255, True), (256, False)])
def test_long_names(tmp_path, length, fits):
    path = tmp_path / ("ä" * (length // 2) + "a" * (length % 2))
    if fits:
        write_atomically(path, b"data")
        assert names(tmp_path) == [path.name]
        return
    with pytest.raises(OutputError, match="File name too long"):
        check_output(path)


def test_names_of_files_that_are_no_text_are_reported_as_json(tmp_path):
    write_json(tmp_path / "a.json", {"bag": os.fsdecode(b"\xff.mcap"), "unit": "µs"})
    assert (tmp_path / "a.json").read_bytes() == b'{\n  "bag": "\\udcff.mcap",\n  "unit": "\xc2\xb5s"\n}\n'


def test_a_folder_that_is_removed_meanwhile_is_named(tmp_path):
    out = tmp_path / "folder" / "a"
    with pytest.raises(FileNotFoundError) as refusal, atomic_file(out):
        [part] = out.parent.iterdir()
        part.unlink()
        out.parent.rmdir()
    assert refusal.value.filename == str(out) and names(tmp_path) == []


def test_a_file_that_is_a_mount_of_its_own_is_overwritten(tmp_path, monkeypatch):
    """As a file that a container shares with its host: the system refuses to replace it."""
    out = tmp_path / "a"
    out.write_bytes(b"old")

    def busy(part, target):
        raise OSError(errno.EBUSY, "Device or resource busy", part)

    monkeypatch.setattr(os, "replace", busy)
    number = out.stat().st_ino
    write_atomically(out, b"new")
    assert out.read_bytes() == b"new" and out.stat().st_ino == number and names(tmp_path) == ["a"]


@pytest.mark.parametrize("mode", ["wb", "ab"])
def test_an_archive_goes_behind_what_a_descriptor_holds(tmp_path, mode):
    """Also where every write goes to the end, as with `>>`."""
    with open(tmp_path / "log", mode, buffering=0) as log:
        log.write(b"before ")
        write_npz(f"/dev/fd/{log.fileno()}", {"a": np.arange(9)})
    (tmp_path / "a.npz").write_bytes((tmp_path / "log").read_bytes().removeprefix(b"before "))
    assert read_npz(tmp_path / "a.npz", ["a"])["a"].tolist() == list(range(9))
