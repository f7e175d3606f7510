"""Files appear complete or not at all, whatever interrupts or competes with the writer."""

import os
import threading

import pytest

from jaxnerf.runtime import atomic_files


def test_partial_file_replaces_the_file_at_the_end(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with atomic_files.partial_file(path, suffix=".tmp.png") as partial:
        partial.write_text("new")
        assert path.read_text() == "old" and partial.name.endswith(".tmp.png")
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


def test_error_leaves_the_old_file(tmp_path):
    path = tmp_path / "file.txt"
    atomic_files.write_text(path, "old")
    with pytest.raises(RuntimeError), atomic_files.partial_file(path) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_full_disk_is_an_error_that_names_the_file(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(OSError, match="No space left.*file.txt"), atomic_files.partial_file(path) as partial:
        os.symlink("/dev/full", partial)
        with partial.open("w") as file:
            file.write("new")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_swept_partial_file_is_an_error_only_if_the_file_is_missing(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("finished by another process")
    with atomic_files.partial_file(path) as partial:
        partial.write_text("same")
        atomic_files.sweep(tmp_path)
    assert path.read_text() == "finished by another process"
    with pytest.raises(FileNotFoundError), atomic_files.partial_file(tmp_path / "missing.txt"):
        pass


def test_first_writer_wins(tmp_path):
    path = tmp_path / "file.txt"
    threads = [threading.Thread(target=atomic_files.write_text_once, args=(path, f"{i}" * 1000)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    content = path.read_text()
    assert len(content) == 1000 and len(set(content)) == 1
    atomic_files.write_text_once(path, "later")
    assert path.read_text() == content and list(tmp_path.iterdir()) == [path]
