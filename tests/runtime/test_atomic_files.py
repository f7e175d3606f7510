"""Files appear complete or not at all, whatever interrupts or competes with the writer."""

import os
import resource
import threading

import pytest

from jaxnerf.runtime import atomic_files
from jaxnerf.tools.exporters.partial_folder import partial_folder


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
        partial.unlink()
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
    with pytest.raises(FileNotFoundError), atomic_files.partial_file(tmp_path / "missing.txt") as partial:
        partial.unlink()


@pytest.mark.parametrize("write", [atomic_files.write_text, atomic_files.write_text_once])
def test_nothing_is_written_through_a_link(tmp_path, monkeypatch, write):
    """Names of partial files cannot be guessed; here they can."""
    (tmp_path / "precious").write_text("content")
    (tmp_path / "run").mkdir()
    monkeypatch.setattr(atomic_files.secrets, "token_hex", lambda size: "0")
    os.symlink(tmp_path / "precious", tmp_path / "run" / "file.txt.0.tmp")
    with pytest.raises(FileExistsError, match="file.txt.0.tmp"):
        write(tmp_path / "run" / "file.txt", "new")
    os.symlink(tmp_path / "precious", tmp_path / "run" / "file.txt")
    with pytest.raises(OSError, match="symbolic links.*file.txt"):
        atomic_files.open_regular(tmp_path / "run" / "file.txt", "a")
    write(tmp_path / "run" / "file.txt", "new")
    os.link(tmp_path / "precious", tmp_path / "run" / "other name")
    with pytest.raises(OSError, match="Not a regular file.*other name"):
        atomic_files.open_regular(tmp_path / "run" / "other name", "a")
    assert (tmp_path / "precious").read_text() == "content"


def test_only_regular_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    os.symlink("pipe", tmp_path / "link")
    for path in (tmp_path / "pipe", tmp_path / "link", tmp_path, "/dev/zero"):
        with pytest.raises(OSError, match="Not a regular file"):
            atomic_files.read_bytes(path)
    (tmp_path / "file").write_text("content")
    os.symlink("file", tmp_path / "link to a file")
    assert atomic_files.read_bytes(tmp_path / "link to a file") == b"content"


def test_a_tree_has_no_links_pipes_or_devices(tmp_path):
    folder = tmp_path / "folder"
    atomic_files.check_tree(folder)  # there is none
    (folder / "below").mkdir(parents=True)
    (folder / "below" / "file").write_text("content")
    atomic_files.check_tree(folder)
    os.symlink("file", folder / "below" / "link")
    with pytest.raises(ValueError, match="below/link: is a symbolic link, expected"):
        atomic_files.check_tree(folder)
    atomic_files.check_tree(folder, links=True)
    os.symlink(folder, tmp_path / "other")
    with pytest.raises(ValueError, match="other: is a symbolic link"):
        atomic_files.check_tree(tmp_path / "other")
    atomic_files.check_tree(tmp_path / "other", links=True)
    os.mkfifo(folder / "pipe")
    with pytest.raises(ValueError, match="folder/pipe: is a pipe or a device"):
        atomic_files.check_tree(folder, links=True)


def test_a_file_larger_than_memory_is_an_error_that_names_it(tmp_path):
    """A sparse file takes no space, neither on the disk nor in an archive."""
    (tmp_path / "file").touch()
    os.truncate(tmp_path / "file", 2**43)
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (2**42, limits[1]))
    try:
        with pytest.raises(OSError, match="Cannot allocate memory.*file"):
            atomic_files.read_bytes(tmp_path / "file")
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def test_whole_numbers_have_at_most_64_bits():
    assert atomic_files.parse_json(f"[{2**64 - 1}, {-(2**63)}, 1e999]") == [2**64 - 1, -(2**63), float("inf")]
    for digits in (str(2**64), str(-(2**63) - 1), "1" * 400, "-" + "1" * 10_000):
        with pytest.raises(ValueError, match=f"a whole number of {len(digits)} digits"):
            atomic_files.parse_json(f'{{"a": [{digits}]}}')


@pytest.mark.parametrize("content", ["[" * 100_000, '{"a":' * 100_000, '{"a": 1', "\xff"])
def test_malformed_json_is_an_error_that_names_the_file(tmp_path, content):
    (tmp_path / "file.json").write_text(content, encoding="latin-1")
    with pytest.raises(ValueError, match=r"file.json: malformed JSON \(.*\); restore it"):
        atomic_files.read_json(tmp_path / "file.json", "restore it")


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


def test_a_folder_appears_complete_or_not_at_all(tmp_path):
    target = tmp_path / "mesh-10"
    with pytest.raises(OSError, match="full.*mesh-10"), partial_folder(target):
        raise OSError(28, "full")
    assert not list(tmp_path.iterdir())
    for content in ("old", "new"):
        with partial_folder(target) as partial:
            (partial / "mesh.ply").write_text(content)
            assert not (target / "mesh.ply").exists() or (target / "mesh.ply").read_text() == "old"
    assert (target / "mesh.ply").read_text() == "new" and list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("link", [False, True])
def test_a_folder_replaces_a_file_or_a_link_and_leaves_nothing_behind(tmp_path, link):
    precious = tmp_path / "precious" / "mesh.ply"
    precious.parent.mkdir()
    precious.write_text("kept")
    target = tmp_path / "mesh-10"
    target.symlink_to(precious.parent) if link else target.write_text("a file")
    with partial_folder(target) as partial:
        (partial / "mesh.ply").write_text("new")
    assert (target / "mesh.ply").read_text() == "new" and precious.read_text() == "kept"
    assert sorted(tmp_path.iterdir()) == [target, precious.parent] and not target.is_symlink()


def test_partial_folders_of_killed_processes_are_removed_and_those_of_running_ones_stay(tmp_path):
    killed = tmp_path / "mesh-10.0123456789abcdef.tmp"
    killed.mkdir()
    (killed / "mesh.ply").write_text("half")
    mine = tmp_path / "my.tmp"
    mine.mkdir()
    with partial_folder(tmp_path / "splats-10") as running:
        assert not killed.exists() and mine.exists()
        with partial_folder(tmp_path / "mesh-10"):
            assert running.exists()
