"""Kernels on disk: only in folders that nobody else can write, whole or not at all, and never trusted blindly."""

import os
import signal
import stat
import sys

import pytest

from certbound.simulation.compiled import cache
from certbound.simulation.compiled.cache import cache_directory, is_private, load_kernel, write_atomically

SOURCE = """
from numba import njit

@njit("int64(int64)", cache=@CACHE@)
def run(n):
    return n + {number}
"""

posix = pytest.mark.skipif(sys.platform == "win32", reason="POSIX permissions")


@pytest.fixture
def private(tmp_path, monkeypatch):
    """A cache of this test's own, and no kernel loaded yet."""
    tmp_path.chmod(0o700)
    monkeypatch.setenv("CERTBOUND_CACHE", str(tmp_path))
    monkeypatch.setattr(cache, "_LOADED", {})
    return tmp_path / "kernels"


def files(folder, pattern):
    return sorted(folder.rglob(pattern))


@posix
def test_the_folder_is_made_private(private):
    assert cache_directory() == private
    assert stat.S_IMODE(private.stat().st_mode) == 0o700


@posix
@pytest.mark.parametrize("mode", [0o755, 0o770, 0o777, 0o701])
def test_a_folder_open_to_others_is_not_used(private, mode, caplog):
    private.mkdir()
    private.chmod(mode)
    assert cache_directory() is None
    assert "others could write" in caplog.text
    assert load_kernel(SOURCE.format(number=1))(1) == 2
    assert files(private, "*") == []


@posix
def test_a_link_to_a_folder_is_not_used(private, tmp_path):
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    private.symlink_to(tmp_path / "elsewhere")
    assert cache_directory() is None


@posix
def test_a_folder_below_one_that_others_can_write_is_not_private(tmp_path):
    shared = tmp_path / "shared"
    inner = shared / "kernels"
    inner.mkdir(parents=True, mode=0o700)
    assert is_private(inner)
    shared.chmod(0o777)
    assert not is_private(inner)
    shared.chmod(0o1777)  # sticky, as /tmp is: others cannot exchange what is mine
    assert is_private(inner)


def test_the_cache_can_be_switched_off(private, monkeypatch):
    monkeypatch.setenv("CERTBOUND_CACHE", "off")
    assert cache_directory() is None
    assert load_kernel(SOURCE.format(number=2))(1) == 3
    assert not private.exists()


def test_a_kernel_is_compiled_once_and_its_source_can_be_read(private, monkeypatch):
    assert load_kernel(SOURCE.format(number=3))(1) == 4
    (source,) = files(private, "kernel_*.py")
    assert "return n + 3" in source.read_text()
    before = {file: file.stat().st_mtime_ns for file in files(private, "*") if file.is_file()}
    monkeypatch.setattr(cache, "_LOADED", {})
    assert load_kernel(SOURCE.format(number=3))(1) == 4
    assert {file: file.stat().st_mtime_ns for file in files(private, "*") if file.is_file()} == before


def test_a_source_that_was_changed_on_disk_is_not_run(private, monkeypatch):
    load_kernel(SOURCE.format(number=4))
    (source,) = files(private, "kernel_*.py")
    source.write_text(source.read_text().replace("n + 4", "n + 666"))
    monkeypatch.setattr(cache, "_LOADED", {})
    assert load_kernel(SOURCE.format(number=4))(1) == 5
    assert "666" not in source.read_text()


@pytest.mark.parametrize("pattern", ["*.nbi", "*.nbc", "kernel_*.json"])
@pytest.mark.parametrize("content", [b"", b"\x80garbage", None])
def test_damaged_files_are_made_anew(private, monkeypatch, pattern, content):
    load_kernel(SOURCE.format(number=5))
    for file in files(private, pattern):
        file.write_bytes(file.read_bytes()[:100] if content is None else content)
    monkeypatch.setattr(cache, "_LOADED", {})
    assert load_kernel(SOURCE.format(number=5))(1) == 6
    assert all(file.stat().st_size > 100 for file in files(private, "*.nb?"))


def test_the_oldest_kernels_are_dropped(private, monkeypatch):
    monkeypatch.setattr(cache, "_KEPT", 2)
    for number in range(4):
        load_kernel(SOURCE.format(number=10 + number))
        for age, file in enumerate(reversed(files(private, "kernel_*.py"))):
            os.utime(file, ns=(file.stat().st_atime_ns, file.stat().st_mtime_ns - age))
    assert len(files(private, "kernel_*.py")) == 2
    assert len(files(private, "kernel_*.json")) == 2
    assert len(files(private, "*.nbc")) == 2


@posix
def test_a_kernel_that_another_process_drops_while_the_oldest_are_sought_is_passed_over(private, monkeypatch):
    monkeypatch.setattr(cache, "_KEPT", 1)
    cache_directory()
    (private / "kernel_gone.py").symlink_to(private / "nothing")  # listed, and not there when it is looked at
    assert load_kernel(SOURCE.format(number=20))(1) == 21
    assert [file.name for file in files(private, "kernel_*.py")] != ["kernel_gone.py"]
    assert len(files(private, "kernel_*.py")) == 1


@pytest.mark.parametrize("step", ["_drop_damaged", "_seal"])
def test_a_kernel_that_another_process_drops_while_it_is_compiled_runs_all_the_same(private, monkeypatch, step):
    there = getattr(cache, step)

    def drop(path):
        path.unlink()
        there(path)

    monkeypatch.setattr(cache, step, drop)
    assert load_kernel(SOURCE.format(number=22))(1) == 23


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    target = tmp_path / "file"
    write_atomically(target, b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomically(target, b"new")
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


@posix
def test_a_timer_waits_until_a_kernel_is_loaded(private, monkeypatch):
    rung: list[bool] = []
    loaded = []

    def load(digest, source, folder):
        signal.raise_signal(signal.SIGALRM)
        loaded.append(list(rung))
        return lambda: 5

    monkeypatch.setattr(cache, "_run", load)
    before = signal.signal(signal.SIGALRM, lambda *_: rung.append(True))
    try:
        assert load_kernel("a kernel that nobody wrote")() == 5
    finally:
        signal.signal(signal.SIGALRM, before)
    assert loaded == [[]]
    assert rung == [True]
