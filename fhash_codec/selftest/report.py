"""The results of the hard cases as Markdown: the same text for the same figures."""

from __future__ import annotations

from collections.abc import Sequence

from fhash_codec.selftest.case import Finding
from fhash_codec.selftest.results import CaseResult, Summary

__all__ = ["markdown"]

HEAD = """\
# Numerical stability

Made by `fhash selftest{options} --report`: {cases} hard cases, each encoded under several settings, decoded and drawn. A figure holds where
it is at most its limit. Of each case the property is shown that came nearest to its limit.{where}

**{verdict}**
"""


def markdown(summary: Summary, *, options: str = "", where: str = "") -> str:
    """The verdict, the worst figure of every property, then of every case, group by group.

    options: of the command that made it. where: a sentence on machine and time.
    """
    failures = summary.failures
    verdict = (
        "Everything holds."
        if summary.holds
        else "1 does not hold."
        if len(failures) == 1
        else f"{len(failures)} do not hold."
    )
    parts = [
        HEAD.format(
            options=options,
            cases=len(summary.results),
            verdict=verdict,
            where=where and f"\n\n{where}",
        )
    ]
    if failures:
        parts.append(
            "## What does not hold\n\n" + "\n".join(f"- {_plain(line)}" for line in failures) + "\n"
        )
    worst = summary.worst()
    parts.append("## The worst of every property\n")
    rows = [
        (name, _figure(one), _limit(one), result.name, one.under)
        for name, (result, one) in sorted(worst.items())
    ]
    parts.append(_table(("property", "worst", "limit", "case", "settings"), rows))
    for group, results in summary.groups.items():
        parts.append(f"## {group.capitalize()}\n")
        parts.append(
            _table(
                ("case", "what is hard", "settings", "nearest to its limit", "figure", "limit"),
                [_row(one) for one in results],
            )
        )
    return "\n".join(parts)


def _row(result: CaseResult) -> tuple[str, ...]:
    worst = result.worst
    shown = (
        ("-", "-", "-")
        if worst is None
        else (f"{worst.name} ({worst.under})", _figure(worst), _limit(worst))
    )
    if result.errors:
        shown = (result.errors[0], "-", "-")
    return (result.name, result.about, ", ".join(result.under), *shown)


def _figure(finding: Finding) -> str:
    return f"{finding.worst:.4g} {finding.unit}".rstrip()


def _limit(finding: Finding) -> str:
    return f"{finding.limit:.4g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return (
        "\n".join("| " + " | ".join(_plain(cell) for cell in line) + " |" for line in lines) + "\n"
    )


def _plain(text: str) -> str:
    return text.replace("|", "\\|")
