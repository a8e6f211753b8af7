"""The results of the hard cases as Markdown; the same figures give the same text."""

from __future__ import annotations

from collections.abc import Sequence

from fhash_codec.selftest.case import Finding
from fhash_codec.selftest.results import CaseResult, Summary

__all__ = ["markdown"]

HEAD = """\
# Numerical stability

Made by `fhash selftest{options} --report`: {cases} hard cases. Each case is encoded with several
settings, decoded and drawn. A property holds if its figure is at most its limit. For each case, the
tables show the property whose figure came nearest to its limit.{where}

**{verdict}**
"""


def markdown(summary: Summary, *, options: str = "", where: str = "") -> str:
    """The verdict, the worst figure of every property, and a table of cases for every group.

    Args:
        summary: the results.
        options: options of the command that made them, for the text.
        where: a sentence on machine and time.
    """
    failures = summary.failures
    verdict = (
        "Everything holds."
        if summary.holds
        else "1 does not hold."
        if len(failures) == 1
        else f"{len(failures)} do not hold."
    )
    sections = [
        HEAD.format(
            options=options,
            cases=len(summary.results),
            verdict=verdict,
            where=where and f"\n\n{where}",
        )
    ]
    if failures:
        sections.append(
            "## What does not hold\n\n" + "\n".join(f"- {_plain(line)}" for line in failures) + "\n"
        )
    worst = summary.worst()
    sections.append("## The worst of every property\n")
    rows = [
        (name, _figure(finding), _limit(finding), result.name, finding.under)
        for name, (result, finding) in sorted(worst.items())
    ]
    sections.append(_table(("property", "worst", "limit", "case", "settings"), rows))
    for group, results in summary.groups.items():
        sections.append(f"## {group.capitalize()}\n")
        sections.append(
            _table(
                ("case", "what is hard", "settings", "nearest to its limit", "figure", "limit"),
                [_row(result) for result in results],
            )
        )
    return "\n".join(sections)


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
