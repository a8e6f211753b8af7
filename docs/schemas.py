"""JSON Schemas of what commands print with `--json` and of settings in files, and their tables.

python docs/schemas.py           prints the tables
python docs/schemas.py NAME      prints the schema of a command, or of settings
"""

from __future__ import annotations

import dataclasses
import json
import re
import sys
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from pydoc import locate
from typing import Annotated, Any, Literal, NotRequired, is_typeddict

from fhash_codec.records import Record
from fhash_codec.simulation.effects import Effect
from fhash_codec.simulation.scene import EFFECTS

Schema = dict[str, Any]

RESULTS = {
    "encode": "fhash_codec.comparison.EncodeReport fhash_cli.commands.encode.Chosen",
    "encode --var u,v": "fhash_codec.encoding.DatasetReport",
    "plan": "fhash_cli.commands.parts.PlanReport",
    "merge": "fhash_codec.appending.parts.MergeReport",
    "append": "fhash_codec.appending.writer.AppendReport",
    "pack": "fhash_codec.views.pack.PackReport",
    "unpack": "fhash_codec.views.unpack.UnpackReport",
    "decode": "fhash_cli.commands.decode.Decoded",
    "decode --var u,v": "fhash_cli.commands.decode.DecodedSeveral",
    "render": "fhash_cli.commands.render.Rendered",
    "render --animate": "fhash_codec.rendering.film.Animated",
    "render --evolution": "fhash_cli.commands.render.Evolved",
    "view": "fhash_cli.commands.view.Shown",
    "view --static": "fhash_cli.commands.view.Written",
    "info": "fhash_codec.file_info.VolumeInfo",
    "info of several variables": "fhash_codec.file_info.DatasetInfo",
    "info DATA": "fhash_codec.file_info.DataInfo",
    "serve": "fhash_cli.commands.zarr.Served",
    "export": "fhash_codec.plain.ExportReport",
    "verify": "fhash_cli.commands.checks.Verified",
    "diff": "fhash_codec.comparison.Compared",
    "demo": "fhash_cli.commands.demo.Demonstrated fhash_codec.comparison.Compared",
    "demo -o FILE": "fhash_cli.commands.demo.SimulatedFile",
    "demo --gallery": "fhash_cli.commands.demo.Gallery",
    "cost": "fhash_codec.cost.results.CostReport fhash_cli.commands.cost.ReportFiles",
    "bench train": "fhash_bench.train.TrainBench",
    "bench rate": "fhash_bench.rate.measuring.RateBench",
    "bench table": "fhash_bench.rate.table.RateTable",
    "bench ablate": "fhash_bench.ablate.AblateBench",
    "bench kinds": "fhash_bench.rate.kinds_bench.KindsBench",
    "bench mine": "fhash_bench.rate.mine.MineBench fhash_bench.commands.mine.PageFile",
    "bench labels": "fhash_bench.labels.LabelReport",
    "bench paper": "fhash_bench.commands.paper.PaperReport",
    "bench paper --parameters": "fhash_bench.commands.paper.Parameters",
    "bench render": "fhash_bench.pictures.results.RenderBench",
    "selftest": "fhash_codec.selftest.run.SelftestReport",
    "errors": "fhash_cli.output.ErrorObject",
}
"""Records, TypedDicts or dataclasses, whose keys together are the object that a command prints."""
MISSED = ("encode", "encode --var u,v", "diff", "info DATA", "cost")
"""Commands whose object may have the keys of an error beside its own."""
SETTINGS = {
    "EncodeConfig": "fhash_codec.config.EncodeConfig",
    "render --scene": "fhash_codec.rendering.scenes.Scene",
    "render --animate FILE": "fhash_codec.rendering.timeline.Animation",
    "demo --scene": "fhash_codec.simulation.scene.SimulatedScene",
}
"""Records of settings that users write as files, or find in them."""
ALSO = """
AblateBench.rows Against.ratio Beside.ratio BreakEven.ratio BreakEven.pictures CaseResult.holds
Finding.holds KindsBench.ratios LabelSize.ratio MineBench.verdicts Playback.ratio
RateBench.best_peers RenderBench.summary Switch.ratio
"""
"""Properties and methods of dataclasses whose values stand beside their fields in JSON."""
ELSEWHERE = """
fhash_bench.paper.printed.TableReport fhash_codec.cost.prediction.TimeBudget
fhash_codec.rendering.tracking.Followed fhash_codec.simulation.simulate.Counts
"""
"""Records whose names the modules of commands know only to mypy, so that they start fast."""
TYPES = {
    **{bool: "boolean", int: "integer", float: "number"},
    **{str: "string", Path: "string", types.NoneType: "null"},
}


def schemas() -> dict[str, Schema]:
    """Schemas of draft 2020-12, by command or name of settings."""
    return {name: schema_of(name) for name in (*RESULTS, *SETTINGS)}


def schema_of(name: str) -> Schema:
    """The schema of what a command prints, or of settings."""
    if name in SETTINGS:
        found = _settings(*_records(SETTINGS[name]))
    else:
        found = _object(*_records(RESULTS[name]))
    if name in MISSED:
        found["properties"] |= schema_of("errors")["properties"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **found}


def keys(schema: Schema, place: str = "") -> Iterator[tuple[str, Schema]]:
    """Every key below a schema, with its own: `a.b`, `a[].b` in a list, `a.*` for any key.

    Those of a record within that has a table of its own are left out.
    """
    results = {records.split()[0].rpartition(".")[2] for records in RESULTS.values()}
    results.add("FileInfo")  # `fhash info` tells all of it, and more
    for option in schema.get("anyOf", ()):
        yield from keys(option, place)
    if "items" in schema:
        yield from keys(schema["items"], f"{place}[]")
    if isinstance(rest := schema.get("additionalProperties"), dict):
        yield from keys(rest, f"{place}.*")
    if not place or schema.get("title") not in results:
        for name, inner in schema.get("properties", {}).items():
            key = f"{place}.{name}" if place else name
            yield key, inner
            yield from keys(inner, key)


def markdown(schema: Schema) -> str:
    """The description of a schema, and a table of its keys."""
    head = [schema["description"], ""]
    rows = [(f"`{key}`", _words(inner), _meaning(inner)) for key, inner in keys(schema)]
    effects = schema["properties"].get("effects", {}).get("items", {}).get("oneOf", ())
    names = [each["properties"]["effect"]["const"] for each in effects]
    more = [
        f"\n### `{name}`\n\n{markdown(each)}" for name, each in zip(names, effects, strict=True)
    ]
    return "\n".join([*head, table(rows, "key", "type", "meaning"), *more])


def table(rows: Sequence[tuple[str, ...]], *titles: str) -> str:
    """A table in Markdown."""
    lines = [titles, tuple("---" for _ in titles), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _words(schema: Schema, many: str = "") -> str:
    """The type of a schema in words, such as `list of integers or null`."""
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(_words(each, many) for each in schema["anyOf"]))
    if schema.get("enum") == [None, False]:
        return "null"
    if "enum" in schema or "const" in schema:
        values = schema.get("enum", [schema.get("const")])
        texts = [each if isinstance(each, str) else json.dumps(each) for each in values]
        return " or ".join(f"`{text}`" for text in texts)
    kinds = schema.get("type", "object" if "oneOf" in schema else "any value")
    words = []
    for kind in kinds if isinstance(kinds, list) else [kinds]:
        rest = schema.get("additionalProperties")
        if kind == "array":
            inner = _words(schema["items"], "s")
            words.append(f"list{many} of {f'({inner})' if ' or ' in inner else inner}")
        elif kind == "object" and rest:
            words.append(f"object{many} of {_words(rest, 's')}")
        elif kind == "object":
            words.append(f"{'free ' * (rest == {})}object{many}")
        else:
            words.append({"string": "text", "null": "null"}.get(kind, kind + many))
    return " or ".join(words)


def _meaning(schema: Schema) -> str:
    """The description of a schema, its range and its default, in a cell of a table."""
    bounds = {}
    for each in (schema, schema.get("items", {}), *schema.get("anyOf", ())):
        bounds |= {name: each[name] for name in ("minimum", "maximum") if name in each}
    told = [schema.get("description", "").rstrip(".")]
    if bounds:
        told.append(f"{bounds['minimum']:g} to {bounds['maximum']:g}")
    if schema.get("default") not in (None, []):
        told.append(f"default `{json.dumps(schema['default'])}`")
    text = "; ".join(filter(None, told)).replace("\n", " ").replace("|", "\\|")
    return re.sub(r"(?<![\w`-])(--[a-z][a-z-]*)", r"`\1`", text)  # else a dash on the site


def _records(paths: str) -> list[Any]:
    found = [locate(path) for path in paths.split()]
    assert None not in found, paths
    return found


def _object(*records: Any) -> Schema:
    """The schema of an object that has the keys of some TypedDicts and dataclasses."""
    properties: dict[str, Schema] = {}
    required = []
    names = {each.__name__: each for each in _records(ELSEWHERE)}
    for record in records:
        told = _attributes(record)
        hints = typing.get_type_hints(record, localns=names, include_extras=True)
        beside = (each.split(".") for each in ALSO.split())
        for name in (name for owner, name in beside if owner == record.__name__):
            also = getattr(record, name)
            hints[name] = typing.get_type_hints(getattr(also, "fget", also))["return"]
            text = also.__doc__.partition("\n")[0].rstrip(".").replace("None", "null")
            told[name] = text[0].lower() + text[1:]
        for name, hint in hints.items():
            optional = typing.get_origin(hint) is NotRequired
            found = _schema(typing.get_args(hint)[0] if optional else hint)
            properties.setdefault(name, found | _description(told.get(name), found))
            if not optional and getattr(record, "__total__", True):
                required.append(name)
    return _closed(records[0], properties, required)


def _closed(record: Any, properties: dict[str, Schema], required: Sequence[str]) -> Schema:
    text = record.__doc__.partition("Attributes:")[0]
    return {
        "title": record.__name__,
        "description": re.sub(r"\s*\n\s*", " ", text.strip()),
        "type": "object",
        "properties": properties,
        "required": list(dict.fromkeys(required)),
        "additionalProperties": False,
    }


def _description(text: str | None, schema: Schema) -> Schema:
    """The description of a key: a text, its own, or the first sentence of what is within."""
    inner = [schema, schema.get("items"), schema.get("additionalProperties")]
    for each in (*inner, *schema.get("anyOf", ())):
        text = text or (each.get("description", "").partition(". ")[0] if each else None)
    return {"description": text} if text else {}


def _attributes(record: Any) -> dict[str, str]:
    """Texts on the attributes in the docstring of a class, `name, other: text`, by name."""
    text = " ".join(record.__doc__.partition("Attributes:")[2].split()).replace("None", "null")
    names = "|".join(record.__annotations__)
    _, *parts = re.split(rf"(?:^|(?<=\. ))((?:(?:{names}), )*(?:{names})): ", text)
    told = zip(parts[::2], parts[1::2], strict=True)
    return {name: each.strip(" .") for several, each in told for name in several.split(", ")}


def _schema(hint: Any) -> Schema:
    """The schema of an annotation.

    In `Annotated` a text is the description, and anything else the type of the value in JSON.
    """
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        others = [each for each in inner[1:] if not isinstance(each, str)]
        told = {"description": inner[-1]} if isinstance(inner[-1], str) else {}
        return _schema((others or inner)[0]) | told
    if origin is Literal:
        return {"enum": list(inner)} if len(inner) > 1 else {"const": inner[0]}
    if origin in (types.UnionType, typing.Union):
        return _any_of([_schema(each) for each in inner])
    if origin is tuple and ... not in inner:
        item = _any_of([_schema(each) for each in dict.fromkeys(inner)])
        return {"type": "array", "items": item, "minItems": len(inner), "maxItems": len(inner)}
    if origin in (list, tuple, Sequence):
        return {"type": "array", "items": _schema(inner[0])}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema(inner[1])}
    if is_typeddict(hint):
        return _object(hint)
    if dataclasses.is_dataclass(hint):
        return _nested(hint) if issubclass(hint, Record) else _object(hint)
    return {} if hint is Any else {"type": TYPES[hint]}


def _any_of(options: list[Schema]) -> Schema:
    """The schema of one of several; simple types, and null beside another, in one list."""
    options = [each for option in options for each in option.get("anyOf", [option])]
    first, *others = options
    if all(each.keys() == {"type"} for each in others) and isinstance(first.get("type"), str):
        kinds = [each["type"] for each in options]
        return {**first, "type": kinds if others else kinds[0]}
    return {"anyOf": options}


def _settings(record: Any) -> Schema:
    """The schema of a record of settings, with defaults, ranges, choices and help."""
    hints, properties, required = typing.get_type_hints(record), {}, []
    for field in dataclasses.fields(record):
        found = _bounded(_schema(hints[field.name]), field.metadata)
        found |= _description(field.metadata.get("help"), found)
        if field.default is dataclasses.MISSING:
            required.append(field.name)
        elif not isinstance(field.default, Record):
            found["default"] = json.loads(json.dumps(field.default))
        properties[field.name] = found
    return _closed(record, properties, required)


def _nested(record: Any) -> Schema:
    """The schema of a record in another: a table, or `true` where all has defaults; an effect."""
    if record is Effect:
        kinds = [_settings(each) for each in EFFECTS.values()]
        for kind, schema in zip(EFFECTS, kinds, strict=True):
            schema["properties"]["effect"] = {"const": kind, "description": "which effect it is"}
            schema["required"].append("effect")
        return {"oneOf": kinds}
    schema = _settings(record)
    if schema["required"]:
        return schema
    return {"anyOf": [schema, {"const": True}], "description": schema["description"]}


def _bounded(schema: Schema, told: Mapping[str, Any]) -> Schema:
    """A schema with the range of its numbers and the choices of its texts, also within a list."""
    found = dict(schema)
    if "items" in schema:
        found["items"] = _bounded(schema["items"], told)
    if "anyOf" in schema:
        found["anyOf"] = [_bounded(each, told) for each in schema["anyOf"]]
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if None not in (told.get("low"), told.get("high")) and {"number", "integer"} & {*kinds}:
        found |= {"minimum": told["low"], "maximum": told["high"]}
    if told.get("choices") and "string" in kinds:
        found["enum"] = list(told["choices"])
    if "null" in kinds:
        # TOML has no null: false stands for it.
        others = [{**found, "type": kind} for kind in kinds if kind != "null"]
        return {"anyOf": [*others, {"enum": [None, False]}]}
    return found


if __name__ == "__main__":
    if sys.argv[1:]:
        print(json.dumps(schema_of(" ".join(sys.argv[1:])), indent=2))
    else:
        print("\n\n".join(f"## `{name}`\n\n{markdown(it)}" for name, it in schemas().items()))
