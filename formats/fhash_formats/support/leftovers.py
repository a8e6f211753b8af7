"""What a killed writer left behind: temporaries that name their writer, and the next writer of the same output clears them away.

A temporary is `.OUTPUT.<machine>-<process>-<random>.partial`, an older output on its way out ends in `.old`. Nothing is taken from a
writer that lives, or that may: one on another machine or in another container is never asked, so its leftovers stay.
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

PARTIAL, OLD = ".partial", ".old"
LONGEST = 40
"""Characters of an output's name in that of its temporary, which so stays below the 255 bytes of most file systems."""
_NAME = re.compile(
    r"\.(?P<output>.+)\.(?P<machine>[0-9a-f]{8})-(?P<process>[0-9]{1,10})-[0-9a-f]{8}(?P<kind>\.partial|\.old)",
    re.DOTALL,
)


def new_stem(name: str) -> str:
    """The start of the names of an output's temporaries, unlike that of any other writer's."""
    return f".{_short(name)}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"


def clear(targets: Iterable[Path]) -> None:
    """Clear away what killed writers of these outputs left; an output that one had moved aside and not yet replaced comes back."""
    folders: dict[Path, dict[str, Path]] = {}
    for target in targets:
        folders.setdefault(target.parent, {})[_short(target.name)] = target
    for folder, outputs in folders.items():
        with suppress(
            OSError
        ):  # no such folder, or not ours to read: the checks of the output say it better
            for name in sorted(os.listdir(folder)):
                found = _NAME.fullmatch(name) if name.endswith((PARTIAL, OLD)) else None
                if (
                    found
                    and found["output"] in outputs
                    and not _may_live(found["machine"], int(found["process"]))
                ):
                    _clear(
                        folder / name, outputs[found["output"]], moved_aside=found["kind"] == OLD
                    )


def remove(path: Path) -> None:
    """Delete a file or a folder, if that can be done."""
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
    """A name, or of a long one the beginning and a digest of all of it, so that no two outputs share their leftovers."""
    if len(name) <= LONGEST:
        return name
    return f"{name[: LONGEST - 9]}-{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}"


@cache
def _machine() -> str:
    """A digest of what process numbers are good for: this machine, and on Linux this container of it."""
    parts = [platform.node()]
    with suppress(OSError):
        parts.append(Path("/etc/machine-id").read_text(encoding="utf-8", errors="replace"))
    with suppress(OSError):
        parts.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.sha256("\n".join(parts).encode(errors="replace")).hexdigest()[:8]


def _may_live(machine: str, process: int) -> bool:
    """False only where the process is known to be gone."""
    # A process number of our own is another thread's. On Windows the question itself, signal 0, would end a process.
    if machine != _machine() or process == os.getpid() or os.name == "nt":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's
        return True
    with suppress(OSError):  # killed, and its parent has not asked for it yet
        return Path(f"/proc/{process}/stat").read_text(errors="replace").rpartition(")")[2].split()[
            :1
        ] != ["Z"]
    return True
