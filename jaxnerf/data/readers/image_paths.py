"""Finds the image files that a dataset's file names, also where the names on the disk differ a little."""

import os
import re
import unicodedata
from pathlib import Path
from typing import Any

from jaxnerf.data.images.image_files import IMAGE_SUFFIXES, is_hidden
from jaxnerf.data.readers.validation import check_inside
from jaxnerf.options import short_repr

_TRIED = 5  # paths that are compared with the files


class ImageFinder:
    """Finds files below a folder. Each folder is listed at most once, and only if a name does not fit exactly.

    Attributes:
        folder: below which files are searched.
        renamed: {path as it was asked for: file} of the files whose names differ from it in case or Unicode form.
        moved: {absolute path of an image: its path below the folder}.
    """

    def __init__(self, folder: str | os.PathLike):
        """Creates a finder; no folder is listed yet."""
        self.folder, self.renamed, self.moved = Path(folder), {}, {}
        self._listings = {}

    def inside(self, name: Any, *, key: str, source: Any) -> str:
        """Returns a path that a file states, relative to the folder, with / between folders.

        A path that leaves the folder and returns by its name stays inside. Of an absolute path, such as one of
        another computer, the longest end that exists in the folder is used, or else its name in images/.

        Args:
            name: the file's value of the key; / or \\ between folders.
            key, source: where it is stated, for the message.

        Raises:
            ValueError: if the value is no path or leads out of the folder, see `check_inside`.
        """
        parts = _parts_of_absolute(name)
        if not parts or ".." in parts:
            return self._inside_by_text(name, key, source)
        ends = ["/".join(parts[start:]) for start in range(len(parts))] + [f"images/{parts[-1]}"]
        ends = list(dict.fromkeys(ends))
        for end in ends:
            if self.find(end):
                path = check_inside(end, key=key, source=source)
                self.moved |= {name: path} if key == "file_path" else {}
                return path
        raise ValueError(
            f"{source}: {key} {short_repr(name)} leaves the folder, and {self.folder} has no "
            f"{' or '.join(ends[-2:])} either; copy the file there, or correct the path{nearly(self, ends[0])}"
        )

    def _inside_by_text(self, name, key, source):
        """Returns what `inside` does for a relative path."""
        if isinstance(name, str):
            own = os.path.basename(os.path.abspath(self.folder))
            up, _, rest = os.path.normpath(name.replace("\\", "/")).partition(f"../{own}/")
            name = rest if rest and not up else name
        try:
            return check_inside(name, key=key, source=source)
        except ValueError as error:
            raise ValueError(f"{error}{nearly(self, name) if isinstance(name, str) and name else ''}") from None

    def find(self, path: str) -> Path | None:
        """Returns the file at a path, with or without an image's extension; None if there is none.

        Names that differ from the path in upper and lower case, or in composed and decomposed Unicode, are
        followed if one alone fits.
        """
        return self._first(path, (path, *(path + suffix for suffix in IMAGE_SUFFIXES)))

    def find_exact(self, path: str) -> Path | None:
        """Returns what `find` does for a path that has its extension."""
        return self._first(path, (path,))

    def _first(self, path, candidates):
        for candidate in candidates:
            if os.path.isfile(self.folder / candidate):  # Path.is_file raises if the name is too long
                return self.folder / candidate
        for candidate in candidates:
            if (found := self._folded(candidate)) and os.path.isfile(found):
                self.renamed[path] = found
                return found
        return None

    def similar(self, path: str) -> str | None:
        """Returns the path below the folder of a file that nearly fits, which may be another image; None without one.

        It lies at the end of the path, or in images/, perhaps with another extension.
        """
        parts = [part for part in re.split(r"[/\\]", path) if part not in ("", ".", "..")]
        ends = ["/".join(parts[start:]) for start in range(len(parts))] + ["/".join(("images", *parts[-1:]))]
        for end in ends:
            for candidate in (end, os.path.splitext(end)[0]):
                if found := self._folded(candidate) or self._of_stem(candidate):
                    if os.path.isfile(found):
                        return found.relative_to(self.folder).as_posix()
        return None

    def notes(self, source: Path) -> list[str]:
        """Returns a note about the files that were found under other names than those that a file states."""
        notes = []
        for path, found in list(self.renamed.items())[:1]:
            read = f"{found.relative_to(self.folder).as_posix()!r} is read for {path!r}"
            notes.append(f"{source}: {len(self.renamed)} paths differ from the files in case or Unicode form: {read}")
        for name, path in list(self.moved.items())[:1]:
            example = f"{short_repr(name)} as {path}"
            notes.append(f"{source}: has {len(self.moved)} absolute file_paths, read from its own folder: {example}")
        return notes

    def _folded(self, path):
        """Returns the one file or folder whose path equals it apart from case and Unicode form, or None."""
        place = self.folder
        for part in path.split("/"):
            if not os.path.exists(place / part):
                names = self._names(place).get(fold(part), [])
                if len(names) != 1:
                    return None
                part = names[0]
            place /= part
        return place

    def _of_stem(self, path):
        """Returns an image with the path's name and any image's extension, or None."""
        place = self._folded(os.path.dirname(path)) if "/" in path else self.folder
        stem = fold(os.path.basename(path))
        for suffix in IMAGE_SUFFIXES if place else ():
            if names := self._names(place).get(stem + suffix):
                return place / names[0]
        return None

    def _names(self, place):
        """Returns {folded name: names} of the printable entries of a folder that are not hidden."""
        if place not in self._listings:
            names = sorted(os.listdir(place)) if os.path.isdir(place) else []
            listing = self._listings[place] = {}
            for name in names:
                if name.isprintable() and not is_hidden(name):  # messages contain it
                    listing.setdefault(fold(name), []).append(name)
        return self._listings[place]


def nearly(finder: ImageFinder, *paths: str) -> str:
    """Returns "" or the end of a message that names the file that nearly fits one of some paths without a file."""
    for path in paths[:_TRIED]:
        if found := finder.similar(path):
            return f"; {finder.folder / found} nearly fits {short_repr(path)}: rename it, or correct the path"
    return ""


def _parts_of_absolute(name):
    """Returns the folders and the name of an absolute path of any system; [] if it is relative."""
    match = re.match(r"([A-Za-z]:)?[/\\](.*)", name, re.DOTALL) if isinstance(name, str) else None
    return [part for part in re.split(r"[/\\]", match[2]) if part not in ("", ".")] if match else []


def fold(name: str) -> str:
    """Returns a name in the form in which names are compared: without case, in composed Unicode."""
    return unicodedata.normalize("NFC", name).casefold()
