"""Base of every command: options in groups by purpose, and none twice that takes one value."""

from __future__ import annotations

import click

GROUPS: dict[str, tuple[str, ...]] = {
    "Input": ("var", "axes", "t", "shape", "dtype", "endian", "missing", "select"),
    "Quality, one of": (
        "psnr", "psnr-bulk", "max-error", "max-error-rel", "ratio", "min-psnr", "target", "bound",
    ),
    "Feature": ("feature", "dilation"),
    "Steps and region": ("time", "roi", "box", "lod"),
    "Values": ("outside", "fill"),
    "Profile compact": ("profile", "effort", "tile"),
    "Profile paper": (
        "key-frames", "fold", "embedding-size", "hidden-layers", "width", "epochs",
        "learning-rate", "schedule", "batch", "tables", "engine", "engines",
    ),
    "Scene": (
        "scene", "steps", "paper-shape", "gallery", "set", "effect", "size", "background",
        "antialiasing", "scale",
    ),
    "Camera": (
        "view", "azimuth", "elevation", "zoom", "projection", "position", "focal-point", "view-up",
    ),
    "Colour and opacity": (
        "cmap", "opacity", "range", "density", "isosurface", "volume", "no-volume", "track",
    ),
    "Clipping": ("clip", "clip-box", "clip-plane"),
    "Animation": (
        "animate", "frames", "fps", "pictures", "evolution", "columns", "part-of", "split",
    ),
    "Accuracy and speed": (
        "march", "device", "step", "threshold", "samples-per-pass", "skipping",
    ),
    "Comparison": ("peer", "part", "seconds", "turns", "speed"),
    "Address": ("host", "port"),
    "Cases": ("all", "case", "group"),
    "Output": ("o", "plain", "force", "report", "plot", "save-scene", "depth", "normal"),
    "Run": (
        "seed", "timings", "deterministic", "processes", "explain", "json", "q", "quiet", "v",
        "verbose", "help",
    ),
}  # fmt: skip
"""Names of options by group, in the order of the help; options that none names come last."""
ELSEWHERE = {
    ("decode", "t"): "Steps and region",
    ("decode", "dtype"): "Values",
    ("decode", "isosurface"): "Output",
    ("render", "t"): "Steps and region",
    ("encode", "device"): "Run",
    ("train", "device"): "Run",
    ("rate", "device"): "Run",
    ("demo", "shape"): "Scene",
    ("diff", "max-error"): "Quality, gates",
    ("diff", "min-psnr"): "Quality, gates",
    ("diff", "min-psnr-bulk"): "Quality, gates",
    ("rate", "target"): "Comparison",
    ("rate", "bound"): "Comparison",
    ("rate", "profile"): "Comparison",
    ("train", "engines"): "Comparison",
}
"""Groups of options that mean something else in one command, by command and option."""
WHY_ONCE = {"var": "a file RUN.fhz holds one variable, so encode each with a command of its own"}
"""Advice to those who repeat an option, where it is not plain; by the name of its parameter."""
LAST = ("Output", "Run")
"""Groups that end the help, in this order."""
OTHERS = "Further options"
"""Group of the options that GROUPS does not name."""


def group_of(command: str, option: click.Option) -> str:
    """The group of an option of a command: the first that names it, else the last of all."""
    names = [name.lstrip("-") for name in option.opts]
    for name in names:
        if (command, name) in ELSEWHERE:
            return ELSEWHERE[command, name]
    return next((title for title, members in GROUPS.items() if set(names) & set(members)), OTHERS)


class BaseCommand(click.Command):
    """A command whose help lists its options by purpose, and which takes single values once."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse an option that is given twice and takes one value: click would drop the first."""
        if not ctx.resilient_parsing:
            given = self.make_parser(ctx).parse_args(args=list(args))[2]
            for option in given:
                if given.count(option) > 1 and isinstance(option, click.Option):
                    _check_repeated(option, ctx)
        return super().parse_args(ctx, args)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The options of the help, in their groups."""
        rows: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None and isinstance(parameter, click.Option):
                title = group_of(self.name or "", parameter)
                rows.setdefault(title, []).append(record)
        last = [title for title in LAST if title in rows]
        first = [title for title in dict.fromkeys((*GROUPS, *rows)) if title in rows]
        for title in [title for title in first if title not in last] + last:
            with formatter.section(title):
                formatter.write_dl(rows[title])


class BaseGroup(click.Group):
    """A group of such commands."""

    command_class = BaseCommand

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse a line without a command by the names of the commands, not by the whole help."""
        if not args and not ctx.resilient_parsing:
            names = ", ".join(self.list_commands(ctx))
            raise click.UsageError(f"Missing command; give one of {names}", ctx)
        return super().parse_args(ctx, args)


def _check_repeated(option: click.Option, ctx: click.Context) -> None:
    """Raise UsageError for an option that is given twice, unless that means something."""
    if option.multiple or option.count or (option.is_flag and not option.secondary_opts):
        return
    name = "/".join([option.opts[-1], *option.secondary_opts])
    advice = WHY_ONCE.get(option.name or "", "give it once")
    raise click.UsageError(f"{name} is given more than once; {advice}", ctx)
