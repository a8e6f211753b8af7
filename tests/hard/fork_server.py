"""A process that imports fhash once and runs each command line in a fork; started by
`faulty.Server`.

It reads one JSON object per line. {"words": [...], "log": path, "inject": [[name, ...], ...]}
starts a command line; the answer is its process id. {"wait": pid} waits for that process; the
answer is its exit code, or minus the number of the signal that ended it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from typing import Any

import injections

import fhash_cli.commands.decode
import fhash_cli.commands.encode
import fhash_cli.commands.render  # noqa: F401 - imported for the forks
from fhash_cli.main import main

OWN = (
    "fhash_codec",
    "fhash_codec.appending.parts",
    "fhash_codec.appending.writer",
    "fhash_codec.encoding",
    "fhash_codec.encoding",
    "fhash_codec.compact.encode",
    "fhash_codec.isosurface",
    "fhash_codec.paper.engines.native",
    "fhash_codec.paper.train",
    "fhash_codec.paper.train",
    "fhash_codec.rendering.renderer",
    "fhash_formats.container",
)
"""Modules of fhash that are imported before the first fork."""
LIBRARIES = (
    "h5py",
    "zarr",
    "xarray",
    "h5netcdf",
    "PIL.PngImagePlugin",
    "PIL.GifImagePlugin",
)
"""Libraries that are imported before the first fork, if they are installed."""


def run(words: list[str], log: str, inject: list[list[Any]]) -> None:
    """Run a command line in the child as the console script does; never return.

    Its streams go to the file `log`.
    """
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for name, *arguments in inject:
            getattr(injections, name)(*arguments)
        if words[0] == "writer":
            injections.write_steps(*words[1:])
        sys.argv = ["fhash", *words]
        main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException as error:
        print(f"ESCAPED {type(error).__name__}: {error}", file=sys.stderr)
        code = 99
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def serve() -> None:
    """Answer requests until the input ends."""
    import importlib
    import importlib.util

    for name in OWN:
        importlib.import_module(name)
    for name in LIBRARIES:
        if importlib.util.find_spec(name) is not None:
            importlib.import_module(name)
    print("ready", flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        if "wait" in request:
            _, status = os.waitpid(request["wait"], 0)
            print(os.waitstatus_to_exitcode(status), flush=True)
            continue
        child = os.fork()
        if child == 0:
            run(**request)
        print(child, flush=True)


if __name__ == "__main__":
    serve()
