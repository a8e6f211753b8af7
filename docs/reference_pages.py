"""Pages of the reference that are made from the program: commands, options, JSON and settings.

They are written below docs/reference/made before Sphinx reads its sources; git ignores them.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path

import click
import schemas
from schemas import table

from fhash_cli.main import COMMANDS, program
from fhash_cli.options import BaseCommand


def commands() -> Iterator[tuple[str, BaseCommand]]:
    """Every command that does work, by the words that call it."""
    for name in COMMANDS:
        command = program.get_command(click.Context(program), name)
        assert command is not None, name
        if isinstance(command, click.Group):
            for part in command.list_commands(click.Context(command)):
                inner = command.get_command(click.Context(command), part)
                assert inner is not None, part
                yield f"{name} {part}", inner
        else:
            yield name, command


def _cell(text: str) -> str:
    """A text as a cell of a table in Markdown."""
    escaped = re.sub(r"([\\|<>*_\[\]{}$])", r"\\\1", " ".join(text.split()))
    return re.sub(r"(?<!\w)(\\-\\-|--)([a-z][a-z-]*)", r"`--\2`", escaped)


def _code(text: str) -> str:
    """A text as code in a cell of a table."""
    return "`" + text.replace("|", "\\|") + "`"


def _prose(command: click.Command) -> str:
    """The help of a command as Markdown; paragraphs that keep their lines become blocks."""
    text = inspect.cleandoc(command.help or "").split("\f")[0]
    made = []
    for paragraph in text.split("\n\n"):
        if paragraph.startswith("\b\n"):
            lines = paragraph.removeprefix("\b\n")
            made.append(f"```text\n{lines}\n```")
        else:
            made.append(_cell(paragraph))
    if command.epilog:
        made.append(f"```console\n{command.epilog}\n```")
    return "\n\n".join(made)


def command_page() -> str:
    """Every command: its usage, its help, and its options by purpose."""
    parts = [
        "# Commands\n\nMade from the program; `fhash COMMAND --help` prints the same. Options of"
        " all commands in one table: [](options.md). Output as JSON: [](../../json.md).",
    ]
    for name, command in commands():
        context = click.Context(command, info_name=f"fhash {name}")
        usage = " ".join(command.collect_usage_pieces(context))
        parts += [f"## fhash {name}", f"```text\nfhash {name} {usage}\n```", _prose(command)]
        for group, records in command.grouped(context).items():
            cells = [(_code(form), _cell(text)) for form, text in records]
            parts.append(table(cells, group, ""))
    return "\n\n".join(parts) + "\n"


def option_page() -> str:
    """All options of all commands, by name, with the commands that have them."""
    found: dict[tuple[str, str], list[str]] = {}
    for name, command in commands():
        for records in command.grouped(click.Context(command, info_name=name)).values():
            for record in records:
                found.setdefault(record, []).append(name)
    everywhere = len(list(commands()))
    rows = [
        (
            _code(form),
            "all" if len(names) == everywhere else ", ".join(f"`{name}`" for name in names),
            _cell(text),
        )
        for (form, text), names in sorted(
            found.items(), key=lambda row: re.sub("^-., ", "", row[0][0]).strip("-")
        )
    ]
    return (
        "# All options\n\nMade from the program. An option that means something else in another"
        f" command stands there twice.\n\n{table(rows, 'option', 'commands', 'meaning')}\n"
    )


def schema_pages() -> Iterator[tuple[str, str]]:
    """Files by name: keys of JSON, settings in files, and the schema of each."""
    pages = {"json.md": ["# Keys of JSON"], "settings.md": ["# Settings in files"]}
    for name, schema in schemas.schemas().items():
        file = re.sub(r"\W+", "-", name).strip("-") + ".json"
        words = "" if name[0].isupper() or name == "errors" else "fhash "
        page = pages["settings.md" if name in schemas.SETTINGS else "json.md"]
        page += [f"## `{words}{name}`", f"{{download}}`JSON Schema <{file}>`"]
        page.append(schemas.markdown(schema))
        yield file, json.dumps(schema, indent=1)
    yield from ((name, "\n\n".join(parts) + "\n") for name, parts in pages.items())


def write(folder: Path) -> None:
    """Write the pages that changed."""
    folder.mkdir(exist_ok=True)
    made = {"commands.md": command_page(), "options.md": option_page(), **dict(schema_pages())}
    for name, text in made.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
