"""Flags, signals and error messages that the command-line programs share."""

import ast
import contextlib
import ctypes
import difflib
import gc
import importlib
import logging as std_logging
import os
import pathlib
import re
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from typing import Any

from absl import app, flags, logging
from ml_collections import ConfigDict, config_flags

from jaxnerf.options import MAX_INT, Range, between, is_auto, is_tuple
from jaxnerf.registry import READERS, needs_folder
from jaxnerf.runtime import failed_imports, signals, stages

COUNT, PART = between(1, MAX_INT), between(0, 1)  # ranges of flags
CONFIGS = pathlib.Path(__file__).resolve().parents[1] / "configs"

flags.disclaim_key_flags()  # a flag defined here belongs to the program that calls


def run(
    main: Callable[[list[str]], Any],
    *,
    positional: bool = False,
    prepare: Callable[[list[str]], list[str]] = list,
    stopped: str | Callable[[], str] = "before anything was saved; the same command starts again",
) -> None:
    """Parses the flags, imports the plugins and calls main(argv).

    The process exits with 2 on a wrong flag and with 1 on a ValueError, OSError or MemoryError, each reported in one
    line, and with 128 plus the signal's number on SIGINT, SIGTERM or SIGHUP, see `signals`.

    Args:
        main: the program. Its module's docstring opens the help.
        positional: whether arguments that are not flags are accepted, as argv[1:].
        prepare: called with the command line once the plugins are imported, before flags are parsed: it may define
            flags, and returns the command line that is parsed.
        stopped: completes the message "stopped ..." after a signal: what was saved, and how to continue; a function
            that returns it where that depends on the flags.
    """
    signals.keep_streams()
    sys.excepthook = failed_imports.show
    os.environ["PYTHONSAFEPATH"] = "1"  # of Python's own children, none imports from the working folder
    _keep_memory()
    # Tracing a step creates hundreds of thousands of objects, few of them in cycles. Python's default of one
    # collection per 700 objects takes a good part of the tracing time.
    gc.set_threshold(50_000)
    signals.handle(signals.interrupt)
    stages.show()
    flags.DEFINE_list(
        "plugins",
        [],
        "Modules to import first: they register fields, samplers, losses, dataset readers, exporters or estimators.",
    )

    def program(argv):
        try:
            if len(argv) > 1 and not positional:
                raise ValueError(f"unexpected argument {argv[1]!r}; flags look like --name=value")
            # Imported after the flags are parsed, so that a wrong flag is reported at once.
            from jaxnerf.runtime import cores
            from jaxnerf.runtime.compilation_cache import use_compilation_cache

            cores.limit_jax()
            use_compilation_cache()
            result = main(argv)
            sys.stdout.flush()
            return result
        except UnicodeEncodeError as error:
            _leave(1, f"a name is not UTF-8: {error.object[:200]!r} ({error.reason}); rename the file or the folder")
        except (ValueError, OSError) as error:
            _leave(1, _in_words_of_file(str(error)))
        except MemoryError as error:
            _leave(1, f"out of memory ({error}); free memory, or reduce what the flags ask for")

    try:
        # Before the flags are parsed, as the options of registered parts are flags, too.
        _import_plugins(given_flag("plugins", sys.argv).split(","))
        app.run(program, argv=prepare(sys.argv), flags_parser=lambda argv: _parse(argv, main.__module__))
    except ValueError as error:
        _leave(1, error)
    except KeyboardInterrupt as interrupt:
        code = 128 + (interrupt.args or (signal.SIGINT,))[0]
        stages.show(False)
        if callable(stopped):
            stopped = stopped() if flags.FLAGS.is_parsed() else "before anything was read"
        print(f"stopped {stopped}", file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        # A regular exit would destroy what threads of XLA still use, which can end in a segmentation fault.
        os._exit(code)
    finally:  # all is done: a signal while Python shuts down prints nothing
        stages.show(False)
        signals.handle(lambda number, _: os._exit(128 + number))


def define_config(
    help: str,
    *,
    required: bool = False,
    load_saved: Callable[[str], Any] | None = None,
    describe_options: Callable[[], str] | None = None,
    option_names: Callable[[], Sequence[str]] | None = None,
) -> flags.FlagHolder:
    """Defines --config, which takes the name or the path of a config file, followed by `:argument` or not.

    Args:
        help: what the config is for.
        required: whether the flag must be given.
        load_saved: path -> the ConfigDict in a config.json that a run has saved; None: such paths are not accepted.
        describe_options: returns what --config=help:options prints.
        option_names: returns the names "section.option" of all options, from which the error of an unknown flag names
            those that may be meant.
    """
    lists = f"--config=help lists the names{', --config=help:options all options' if describe_options else ''}."
    config = config_flags.DEFINE_config_file("config", None, f"{help} {lists}")
    parser = flags.FLAGS["config"].parser
    load = parser.parse

    def parse(value):
        if load_saved and value.endswith(".json"):
            return load_saved(value).lock()
        if describe_options and value == "help:options":
            print(describe_options())
            sys.exit(0)
        return _load_file(load, _list_configs() if value == "help" else config_path(value))

    parser.parse, parser.option_names = parse, option_names
    if required:
        flags.mark_flag_as_required("config")
    return config


def with_saved_config(argv: Sequence[str], *, only_for_fields: bool = False) -> list[str]:
    """Returns a command line with --config=<workdir>/config.json if it has --workdir and no --config.

    Args:
        argv: the program and its arguments.
        only_for_fields: whether to do so only if the command line sets a field, by --config.SECTION.FIELD=VALUE.
    """
    program, *arguments = argv
    path = pathlib.Path(given_flag("workdir", argv)) / "config.json"
    sets_fields = any(re.match(r"--?(no)?config\.", argument) for argument in arguments)
    if given_flag("config", argv) or not given_flag("workdir", argv) or not path.exists():
        return [*argv]
    # Before the flags that set its fields.
    return [*argv] if only_for_fields and not sets_fields else [program, f"--config={path}", *arguments]


def given_flag(name: str, argv: Sequence[str]) -> str:
    """Returns the value of a flag in a command line or its --flagfile before it is parsed; "" where it is not given."""
    arguments, value = list(argv[1:]), ""
    with contextlib.suppress(flags.Error):  # absl reports it
        arguments = flags.FLAGS.read_flags_from_files(arguments)
    for index, argument in enumerate(arguments):
        found, equals, given = argument.lstrip("-").partition("=")
        if argument.startswith("-") and found == name:
            value = given if equals else next(iter(arguments[index + 1 :]), "")
    return value


def define_value(name: str, help: str, kind: Any, range: Range | None, *, auto: bool = True) -> flags.FlagHolder:
    """Defines a flag of an option's type, in a range, or with "auto"; None when it is not given."""
    if kind is bool:
        return flags.DEFINE_bool(name, None, help)
    return flags.DEFINE(_Value(kind, auto=auto, range=range), name, None, help)


def define_step(help: str) -> flags.FlagHolder:
    """Defines --step, that of a checkpoint; None when it is not given."""
    return flags.DEFINE_integer("step", None, help, lower_bound=0)


def use_data(config, data_dir: str | None, format: str | None = None):
    """Puts --data_dir and --format into a config and returns it; ValueError if there is no such format."""
    if format and format != "auto":
        READERS.get(format)
    if data_dir:
        config.data.dir = data_dir
        if not needs_folder(config.data.format):
            config.data.format = "auto"
    if format:
        config.data.format = format
    return config


def config_names() -> list[str]:
    """Returns the names that --config takes."""
    return sorted(path.stem for path in CONFIGS.glob("*.py") if path.stem != "__init__")


def config_path(value: str) -> str:
    """Returns the path of the config that a value of --config selects, with the value's `:argument`.

    The name of a config wins over a file without a suffix: it is code, and the working folder may be a stranger's.

    Raises:
        ValueError: if there is neither a file nor a config of this name.
    """
    name, colon, argument = value.partition(":")
    if name not in config_names():
        if os.path.isfile(name):
            return value
        near = difflib.get_close_matches(name, config_names(), n=1)
        near = [f"{name}.py"] if os.path.isfile(f"{name}.py") else near
        meant = f"; did you mean {near[0]}?" if near else ""
        raise ValueError(
            f"there is no file and no config {name!r}, expected a path or one of {', '.join(config_names())}{meant}"
        )
    return f"{CONFIGS / name}.py{colon}{argument}"


def _load_file(load, path):
    """Returns the config of a file; a fault in the file ends the program with one line that names its place."""
    file = path.partition(":")[0]
    std_logging.disable(std_logging.WARNING)  # that of ml_collections, where the file returns None
    try:
        config = load(path)
        if isinstance(config, ConfigDict):
            return config
        fault = f"get_config() returns {type(config).__name__}, expected a ConfigDict"
        fault = getattr(config, "_error", fault)  # of a file that cannot be read
    except Exception as error:
        if str(error).startswith("Error whilst parsing"):  # ml_collections raises it again, with its trace as text
            error = error.__context__
        if failed := failed_imports.reason(error):
            _leave(1, failed)
        trace = traceback.extract_tb(error.__traceback__)
        places = [each.lineno for each in trace if os.path.abspath(each.filename) == os.path.abspath(file)]
        file, fault = ", line ".join([file, *map(str, places[-1:])]), f"{type(error).__name__}: {_unquoted(error)}"
        if not places and "no attribute 'get_config'" in fault:
            fault = "defines no get_config(), which returns the config"
    finally:
        std_logging.disable(std_logging.NOTSET)
    _leave(2, f"--config: {file}: {fault}; correct the file")


def _in_words_of_file(message):
    """Returns a message about an option with the config file's name, where no flag but the file has set the option."""
    flag, file = re.match(r"--(config\.[\w.]+)", message), given_flag("config", sys.argv).partition(":")[0]
    if not flag or not os.path.isfile(file) or any(flag[1] in argument for argument in sys.argv):
        return message
    return f"{file}: {message[2:]}"


def _list_configs():
    for name in config_names():
        docstring = ast.get_docstring(ast.parse((CONFIGS / f"{name}.py").read_text()))
        print(f"{name:15} {docstring.splitlines()[0]}")
    sys.exit(0)


class _Value(flags.ArgumentParser):
    """Parses a text, a number in a range, or numbers that commas separate; or "auto"."""

    def __init__(self, kind, *, auto, range):
        self._kind, self._auto, self._range = kind, auto, range
        name = {int: "an integer", float: "a number", str: "a text"}.get(kind, "numbers that commas separate")
        self.syntactic_help = f"{'auto, or ' * auto}{name}{f' ({range.text})' if range else ''}"

    def parse(self, argument):
        if self._kind is str or (self._auto and is_auto(argument)):
            return argument
        try:
            value = tuple(map(float, argument.split(","))) if is_tuple(self._kind) else self._kind(argument)
        except ValueError:
            value = None
        if value is None or self._range and not self._range.holds(value):
            raise ValueError(f"expected {self.syntactic_help}")
        return value


def _keep_memory():
    """Keeps freed memory in the process, where the C library is glibc.

    By default glibc returns blocks of 32 MiB and more to the system at once. A training step on a CPU
    allocates such a block for its activations and would page-fault through all of it in every step, which
    can take as long as the step itself.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt:
        mallopt(-4, 0)  # M_MMAP_MAX: no block is mapped separately
        mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD
        mallopt(-2, 2**28)  # M_TOP_PAD: without it, memory that other threads free is still returned
        mallopt(-8, 1)  # M_ARENA_MAX: all threads share a heap, as others are unmapped whenever they are empty


def _parse(argv: Sequence[str], module: str) -> list[str]:
    if {"--help", "-help", "-h", "--helpshort"} & set(argv[1:]):
        print(_help(module))
        sys.exit(0)
    try:
        rest = flags.FLAGS(argv)
        for flag in (flags.FLAGS[name] for name in flags.FLAGS):
            number = isinstance(flag.value, int | float) and "." not in flag.name  # options have their own ranges
            if number and not abs(flag.value) <= MAX_INT:  # nor NaN, which is in every range of absl
                _leave(2, f"--{flag.name} is {str(flag.value):.40}, expected at most {MAX_INT:,}; correct it")
            if flag.value == "" and flag.present and "." not in flag.name:
                _leave(2, f"--{flag.name} is empty; give a value, or omit it")
        verbosity = flags.FLAGS["verbosity"]
        if not verbosity.present or verbosity.value in (0, 1):
            level = std_logging.INFO if verbosity.present else std_logging.WARNING
            logging.set_verbosity(logging.FATAL)  # orbax logs every file that it touches
            logger = std_logging.getLogger("jaxnerf")
            logger.setLevel(level)
            if logger.propagate:  # otherwise absl would put the date and a line number before each message
                logger.addHandler(std_logging.StreamHandler())
                logger.propagate = False
        return rest
    except flags.IllegalFlagValueError as error:
        required = re.fullmatch(r"flag --(\w+)=None: Flag --\w+ must have a value other than None\.", str(error))
        if not required:
            _leave(2, error)
        help = flags.FLAGS[required[1]].help
        _leave(2, f"--{required[1]} is missing: {help[0].lower()}{' '.join(help[1:].split())}")
    except flags.UnrecognizedFlagError as error:
        if error.flagname.startswith("config."):
            _leave(2, f"{error}; give --config=NAME, which has such fields")
        meant = _options_meant(error.flagname)
        _leave(2, f"--{error.flagname}: no such flag; {meant}" if meant else error)
    except Exception as error:
        if failed := failed_imports.reason(error):
            _leave(1, failed)
        if isinstance(error, (flags.Error, TypeError, ValueError, OSError, ImportError, SyntaxError)):
            _leave(2, error)
        if not isinstance(error, AttributeError | KeyError):
            raise
        given = [found for each in argv[1:] if (found := re.match(r"--?(?:no)?config\.([^=]+)", each))]
        wrong = [found[1] for found in given if found[1] not in _option_names()]
        if not wrong:
            raise
        where = "--config=help:options lists all options, those of registered parts with --plugins=MODULE, too"
        _leave(2, f"--config.{wrong[0]}: no such option; {' '.join([_options_meant(wrong[0]), where]).strip()}")


def _option_names():
    """Returns the names "section.option" of all options; none of a program without --config."""
    parser = flags.FLAGS["config"].parser if "config" in flags.FLAGS else None
    return (getattr(parser, "option_names", None) or list)()


def _options_meant(name):
    """Returns a question with the flags of the options that an unknown one may mean; "" where it resembles none."""
    known, name = _option_names(), name.replace("-", "_")
    section, _, last = name.rpartition(".")
    words = {option: option.rpartition(".")[2] for option in known}
    kinds: list[Callable[[str], object]] = [
        lambda option: name in (option, words[option]),
        lambda option: name.removeprefix("no") in (option, words[option]),  # --nomuon sets a boolean
        lambda option: option.startswith(section and f"{section}.") and words[option].startswith(f"{last}_"),
        lambda option: difflib.get_close_matches(name, [option if section else words[option]], cutoff=0.8),
        lambda option: last == words[option],
    ]
    found = next(filter(None, (list(filter(kind, known)) for kind in kinds)), [])
    return f"did you mean {' or '.join(f'--config.{option}' for option in found[:5])}?" if found else ""


def _unquoted(error):
    """Returns the text of an error of ml_collections, which often is the text of another one in quotation marks."""
    try:
        text = str(ast.literal_eval(str(error)))
    except (SyntaxError, ValueError):
        text = str(error)
    return text.replace("\n", ", ").replace("Did you", "did you").removesuffix("?")


def _help(module: str) -> str:
    """Returns a program's docstring and flags; absl's own help lists no flags of an installed program."""
    lines = [(sys.modules[module].__doc__ or "").strip(), "", "Flags:"]
    for flag in sorted(flags.FLAGS.get_key_flags_for_module(module), key=lambda flag: flag.name):
        name = f"[no]{flag.name}" if flag.boolean else flag.name
        default = f" Default: {flag.default_as_str.strip(chr(39))}." if flag.default else ""
        lines.append(flags.text_wrap(f"--{name}: {flag.help}{default}", 100, indent="      ", firstline_indent="  "))
    lines.append("  --verbosity: 1 prints every inferred value with its reason, 2 also what libraries log.")
    return "\n".join([*lines, "", "--helpfull lists the flags of the libraries, too."])


def _import_plugins(names: Sequence[str]) -> None:
    names = [name.strip() for name in names if name.strip()]
    if names:
        sys.path.append(os.getcwd())  # the path of an installed program does not contain it
    for name in names:
        try:
            importlib.import_module(name)
        except Exception as error:  # a plugin is the user's code: report any failure in one line
            advice = "correct the module, or set PYTHONPATH to its folder"
            if (path := pathlib.Path(name)).name != name or path.suffix == ".py":
                advice = f"give the name of a module, not a file: {path.stem}, with PYTHONPATH={path.absolute().parent}"
            fault = f"--plugins: cannot import {name!r} ({type(error).__name__}: {error}); {advice}"
            raise ValueError(failed_imports.reason(error) or fault) from error


def _leave(code, error):
    line = " ".join(str(error).split())
    print(f"error: {line}", file=sys.stderr)
    # Operations that are torn down can fail again, for instance on a full disk; one message is enough.
    sys.unraisablehook = lambda _: None
    warnings.simplefilter("ignore")
    sys.exit(code)
