"""Text of unknown origin, made safe to print: names in files may move a terminal's cursor or reverse what follows."""

import re

# Control characters, the marks, embeddings, overrides and isolates of bidirectional text, separators of lines, and
# halves of surrogate pairs, by which Python stands for bytes of a file name that are not UTF-8.
_UNSAFE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: object, keep: str = "") -> str:
    """Returns str(text) with an escape, such as \\n, in place of each unsafe character that is not in `keep`."""
    return _UNSAFE.sub(lambda found: found[0] if found[0] in keep else ascii(found[0])[1:-1], str(text))
