"""Leftovers of a killed writer: the next writer of the same output clears them away.

The name of a temporary names its writer: `.OUTPUT.<machine>-<process>-<random>.partial`. An older
output that is being replaced has such a name with the ending `.old`. Files of a writer that may
still live are never touched. So leftovers of writers on other machines or in other containers
stay, since this process cannot tell whether those writers live.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path

PARTIAL = ".partial"
"""Ending of the name of a temporary."""
OLD = ".old"
"""Ending of the name of an older output that is being replaced."""
MAX_NAME = 40
"""Characters of an output's name in the name of its temporary.

The name of the temporary so stays below the 255 bytes of most file systems.
"""
_NAME = re.compile(
    r"\.(?P<output>.+)\.(?P<machine>[0-9a-f]{8})-(?P<process>[0-9]{1,10})-[0-9a-f]{8}(?P<kind>\.partial|\.old)",
    re.DOTALL,
)


def new_stem(name: str) -> str:
    """The name of an output's temporary without its ending; no other writer has the same."""
    return f".{_short(name)}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"


def clear(targets: Iterable[Path]) -> None:
    """Clear away the leftovers of killed writers of these outputs.

    An output that a killed writer had moved aside but not replaced gets its name back.
    """
    folders: dict[Path, dict[str, Path]] = {}
    for target in targets:
        folders.setdefault(target.parent, {})[_short(target.name)] = target
    for folder, outputs in folders.items():
        # The checks of the output give a better message for a folder that cannot be listed.
        with suppress(OSError):
            for name in sorted(os.listdir(folder)):
                match = _NAME.fullmatch(name) if name.endswith((PARTIAL, OLD)) else None
                if (
                    match
                    and match["output"] in outputs
                    and not _may_live(match["machine"], int(match["process"]))
                ):
                    target = outputs[match["output"]]
                    _clear(folder / name, target, moved_aside=match["kind"] == OLD)


def remove(path: Path) -> None:
    """Delete a file or a folder; a failure is ignored."""
    with suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def _clear(leftover: Path, target: Path, *, moved_aside: bool) -> None:
    if moved_aside and not os.path.lexists(target):
        with suppress(OSError):
            os.rename(leftover, target)
        return
    remove(leftover)


def _short(name: str) -> str:
    """The output's name in that of its temporary: at most MAX_NAME characters.

    A longer name is cut and gets a digest of all of it, so that no two outputs share leftovers.
    """
    if len(name) <= MAX_NAME:
        return name
    return f"{name[: MAX_NAME - 9]}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}"


@cache
def _machine() -> str:
    """A digest of the place in which process numbers are unique.

    That is this machine, and on Linux this container on it.
    """
    names = [platform.node()]
    with suppress(OSError):
        names.append(Path("/etc/machine-id").read_text(encoding="utf-8", errors="replace"))
    with suppress(OSError):
        names.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.sha256("\n".join(names).encode(errors="replace")).hexdigest()[:8]


def _may_live(machine: str, process: int) -> bool:
    """Whether a writer may still run; False only for a process that is known to be gone."""
    # A temporary with this process's number belongs to one of its threads. On Windows, asking by
    # signal 0 would end the process.
    if machine != _machine() or process == os.getpid() or os.name == "nt":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # the process is another user's
        return True
    # A zombie was killed, and its parent has not waited for it yet.
    with suppress(OSError):
        fields = Path(f"/proc/{process}/stat").read_text(errors="replace").rpartition(")")[2]
        return fields.split()[:1] != ["Z"]
    return True
