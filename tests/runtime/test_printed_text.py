"""Text of strangers is shown, and never obeyed, by terminals."""

import io
import unicodedata

from jaxnerf.runtime import signals
from jaxnerf.runtime.printed_text import printable
from runs import run_forked

# Moves the cursor, sets the title of the window, clears the line, and shows what follows from right to left.
HOSTILE = "a\x1b[2J\x1b]0;title\x07\r\x9b1A\x7f\u202egnp\u2066.\u200f\u2028b\udcff"


def test_all_controls_of_terminals_and_of_bidirectional_text_are_escaped():
    marks = {"LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI"}
    characters = list(map(chr, range(0x110000)))
    unsafe = [each for each in characters if unicodedata.category(each) in ("Cc", "Cs", "Zl", "Zp")]
    unsafe += [each for each in characters if unicodedata.bidirectional(each) in marks] + ["\u061c", "\u200e", "\u200f"]
    assert printable("".join(characters), keep="".join(unsafe)) == "".join(characters)
    assert printable("".join(unsafe)) == "".join(ascii(each)[1:-1] for each in unsafe)
    safe = "".join(sorted({*characters} - {*unsafe}))
    assert printable(safe) == safe


def test_programs_print_nothing_that_a_terminal_obeys():
    stream = io.StringIO()
    output = signals._Output(stream)
    print(HOSTILE, "é\tb", file=output)
    output.writelines([HOSTILE, "\n"])
    assert stream.getvalue().splitlines() == [f"{printable(HOSTILE)} é\tb", printable(HOSTILE)]
    output.write_as_is("\r\033[K")
    assert stream.getvalue().endswith("\n\r\033[K")


def test_every_way_out_of_a_program_is_cleaned(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(
        "import logging, sys, warnings\nfrom jaxnerf.runtime import cli, stages\n\n\ndef main(argv):\n"
        f"    text = {HOSTILE!r}\n    print(text)\n    print(text, file=sys.stderr)\n"
        "    logging.getLogger('jaxnerf').warning(text)\n    warnings.warn(text)\n"
        "    with stages.Progress(text, 1) as progress:\n        progress.show(1, text)\n"
        "    raise ValueError(text)\n\n\ncli.run(main)\n"
    )
    code, out, err = run_forked(program, folder=tmp_path)
    assert code == 1 and out == f"{printable(HOSTILE)}\n"
    assert err.count("\\u202e") == 5 and err.splitlines()[-1].startswith("error: a\\x1b")
    assert printable(out + err, keep="\n\t") == out + err


def test_an_encoding_without_a_character_ends_no_program(tmp_path, monkeypatch):
    program = tmp_path / "program.py"
    program.write_text(
        "import io, sys\nsys.stdout = io.TextIOWrapper(sys.stdout.buffer, encoding='ascii')\n"
        "from jaxnerf.runtime import cli\ncli.run(lambda argv: print('90 °'))\n"
    )
    assert run_forked(program, folder=tmp_path)[:2] == (0, "90 \\xb0\n")
