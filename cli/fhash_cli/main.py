"""`fhash`: finds and runs a command; turns an error into one line on stderr and an exit code.

Exit codes: 0 success; 1 failure; 2 usage or unsuitable input; 3 a quality gate missed; 4 damaged or
unsupported file; 130 interrupted.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from types import FrameType
from typing import Any, cast

import click

from fhash_cli.output import (
    describe_error,
    error_object,
    one_line,
    print_json,
    printed,
    say,
    warn,
)
from fhash_formats.errors import (
    FhashWarning,
    InterruptedEncodingError,
    MissingDependencyError,
    suggestion,
)

TASKS = {
    "Start here": {
        "info": "say what a file holds, what to type to encode it, and how good a RUN.fhz is",
        "encode": "fit a series and write it as RUN.fhz",
        "render": "draw a picture or a film of RUN.fhz",
        "view": "show RUN.fhz in a browser",
        "decode": "rebuild a region of RUN.fhz, at any time, in another format",
        "demo": "simulate, encode, decode, compare, draw",
    },
    "Measure": {
        "diff": "measure RUN.fhz against its data, or against another file",
        "cost": "measure what accuracy costs in time and bytes on your data",
        "verify": "read and check every part of RUN.fhz",
        "bench": "measure fhash and other codecs on this machine",
        "selftest": "check hard cases on this machine",
    },
    "Long and parallel runs": {
        "append": "code further steps behind those of RUN.fhz",
        "plan": "choose tiles and settings once, for `fhash encode --part --plan`",
        "merge": "join the parts that `fhash encode --part` wrote",
    },
    "Other tools": {
        "paraview": "open RUN.fhz in ParaView, or print the path of its reader",
        "serve": "serve decoded values of RUN.fhz over HTTP, as Zarr",
        "export": "write the model of RUN.fhz in plain numbers, for any Zarr library",
        "pack": "make RUN.fhz of coded Zarr arrays, without coding again",
        "unpack": "make coded Zarr arrays of RUN.fhz, without coding again",
        "hdf5-plugin-path": "print the folder of the filter for HDF5, for HDF5_PLUGIN_PATH",
        "completion": "print the shell code that completes fhash's words on Tab",
    },
}
"""Commands by what people want of them, with their help lines; the module of one in
`fhash_cli.commands` is imported only on use."""
COMMANDS = {name: text for task in TASKS.values() for name, text in task.items()}
"""Help line of each command."""
DISTRIBUTIONS = {"bench": "fhash[bench]"}
"""Commands of other distributions, entry points of the group `fhash.commands`, and what installs
them."""
FILES = {
    **dict.fromkeys(("plan", "merge", "append"), "parts"),
    **dict.fromkeys(("pack", "unpack", "export", "serve"), "zarr"),
    **dict.fromkeys(("verify", "diff"), "checks"),
    **dict.fromkeys(("view", "hdf5-plugin-path", "paraview", "completion"), "view"),
}
"""Modules of the commands that share one; any other command has one of its own name."""


class Program(click.Group):
    """The commands of COMMANDS, imported on use.

    `main` ends the process with one of the exit codes above, never with a traceback.
    """

    def list_commands(self, context: click.Context) -> list[str]:
        """Names in the order of COMMANDS."""
        return list(COMMANDS)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """The click command of a name; None for a name that is unknown."""
        if name not in COMMANDS:
            return None
        if name in DISTRIBUTIONS:
            return _of_distribution(name)
        module = importlib.import_module(f"fhash_cli.commands.{FILES.get(name, name)}")
        _keep_freed_memory()
        attribute = f"{name.replace('-', '_')}_command" if name in FILES else "command"
        return cast(click.Command, getattr(module, attribute))

    def format_commands(self, context: click.Context, formatter: click.HelpFormatter) -> None:
        """The list of commands for `--help`, without importing them."""
        for task, commands in TASKS.items():
            with formatter.section(task):
                formatter.write_dl(list(commands.items()), col_max=10)  # one name is longer

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command of a line; raises UsageError for an unknown one, with the likeliest."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            likely = suggestion(args[0], COMMANDS)
            raise click.UsageError(f"No such command '{one_line(args[0])[:60]}'; {likely}", ctx)
        return super().resolve_command(ctx, args)

    def invoke(self, context: click.Context) -> Any:
        """Run the command; each warning is one line on stderr.

        Ctrl-C becomes an error here, before click prints lines of its own about it.
        """
        with warnings.catch_warnings():
            warnings.showwarning = warn
            _show_own_warnings()
            try:
                return super().invoke(context)
            except KeyboardInterrupt:
                raise InterruptedEncodingError("interrupted") from None

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run the command line and raise SystemExit.

        With --json an error is an object on stdout too, unless the result stands there already.
        """
        printed.set(False)
        words = list(args[0] if args and args[0] is not None else extra.get("args") or sys.argv[1:])
        try:
            result = super().main(*args, **{**extra, "standalone_mode": False})
        except Exception as error:
            if isinstance(error, click.Abort):  # Ctrl-C before the command began
                error = InterruptedEncodingError("interrupted")
            if os.environ.get("FHASH_DEBUG"):
                traceback.print_exc(file=sys.stderr)
            line, code = describe_error(error)
            if _asks_for_json(words) and not printed.get() and sys.stdout is not None:
                with suppress(OSError):
                    print_json(error_object(error))
            say(f"error: {line}")
            sys.exit(code)
        # click returns the exit code of commands that end early (--help, --version), else None.
        sys.exit(result if isinstance(result, int) else 0)


def _show_own_warnings() -> None:
    """Let no filter for other libraries, as PYTHONWARNINGS=ignore, hide the lines of a command."""
    actions = [
        action
        for action, message, kind, module, _ in warnings.filters
        if issubclass(FhashWarning, kind) and message is None and module is None
    ]
    if actions[:1] == ["ignore"]:
        warnings.simplefilter("default", FhashWarning)


def _of_distribution(name: str) -> click.Command:
    """The command that another distribution gives.

    Where none is installed, a command that takes any words and raises MissingDependencyError.
    """
    from importlib.metadata import entry_points

    for point in entry_points(group="fhash.commands", name=name):
        return cast(click.Command, point.load())

    def missing() -> None:
        raise MissingDependencyError(
            f"{name} is a package of its own; pip install '{DISTRIBUTIONS[name]}',"
            " in the sources ./benchmarks"
        )

    words = {"ignore_unknown_options": True, "allow_extra_args": True}
    return click.Command(name, callback=missing, context_settings=words, add_help_option=False)


def _asks_for_json(words: Sequence[str]) -> bool:
    """Whether a command line has the option --json, also one that cannot be parsed."""
    return "--json" in words[: words.index("--") if "--" in words else None]


@click.group(
    cls=Program,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)
@click.version_option(package_name="fhash", message="%(prog)s %(version)s")
@click.pass_context
def program(context: click.Context) -> None:
    """A codec for time-varying volumes: keeps the features you name, reads any region at any time.

    Results go to stdout, messages and progress to stderr. With --json the result, or the error, is
    one JSON object, whose keys the documentation lists.

    \b
    Exit codes:
      0    success
      1    failure: a full disk, no memory, a check of selftest that does not hold
      2    usage, or an unsuitable input
      3    a promise of quality or a gate missed; such a file is RUN.missed.fhz, never RUN.fhz
      4    a damaged or unsupported file
      130  interrupted by Ctrl-C

    \b
    Completion by the Tab key, in the start-up file of the shell:
      bash   eval "$(fhash completion bash)"       in ~/.bashrc
      zsh    eval "$(fhash completion zsh)"        in ~/.zshrc
      fish   fhash completion fish | source        in ~/.config/fish/config.fish
    """
    if context.invoked_subcommand is None:
        click.echo(context.get_help(), err=True)
        context.exit(2)


def main() -> None:
    """Entry point of the console script."""
    _occupy_streams()
    _heed_signals()
    try:
        program(prog_name="fhash")
    except KeyboardInterrupt:
        say("error: interrupted")
        sys.exit(InterruptedEncodingError.exit_code)
    finally:
        _settle_stdout()


def _occupy_streams() -> None:
    """Open the null device in place of closed standard streams.

    Otherwise an output file would get the number of a closed stream, and with it whatever is
    printed there.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _heed_signals() -> None:
    """Treat SIGTERM and SIGHUP like Ctrl-C, so that no partial output remains.

    A signal that is ignored (nohup) stays ignored.
    """
    sys.unraisablehook = _repeat_lost
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(number)


LOST_SECONDS = 0.01
"""Time after which a lost signal comes again; by then its callback has usually ended."""


def _repeat_lost(lost: sys.UnraisableHookArgs) -> None:
    """Send a signal again whose KeyboardInterrupt Python ignored, in a weak reference's callback
    or a destructor: the command would run on to its end."""
    if not isinstance(lost.exc_value, KeyboardInterrupt):
        sys.__unraisablehook__(lost)
        return
    number, *_ = *lost.exc_value.args, signal.SIGINT  # Python's own handler gives no number
    # Sent to the process it ends a sleep of the main thread; on Windows that would kill.
    send = partial(os.kill, os.getpid()) if os.name == "posix" else signal.raise_signal
    threading.Timer(LOST_SECONDS, send, [number]).start()


MALLOC = {-8: 1, -3: 32 << 20, -1: 256 << 20}
"""Values of glibc's `mallopt` parameters M_ARENA_MAX, M_MMAP_THRESHOLD and M_TRIM_THRESHOLD."""


def _keep_freed_memory() -> None:
    """Let the C library use freed memory again for the next array, of any thread, where it can.

    It would give it back to the system, which clears it page by page: a twentieth of the seconds
    of an encoding, and more where threads wait for each other there.
    """
    with suppress(MissingDependencyError, OSError, AttributeError):
        from fhash_formats.native import ffi

        library = ffi.dlopen(None)
        for parameter, value in MALLOC.items():
            library.mallopt(parameter, value)


def _settle_stdout() -> None:
    """Flush stdout, and drop the rest where it is full or closed.

    Otherwise the interpreter prints a traceback of its own at exit.
    """
    if sys.stdout is None:
        return
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


if __name__ == "__main__":
    main()
