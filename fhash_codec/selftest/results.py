"""What was found of the cases, as records and JSON values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fhash_codec.selftest.case import Finding

__all__ = ["CaseResult", "Summary", "relative"]


def relative(finding: Finding) -> float:
    """The figure in parts of its limit: above 1 where it does not hold, infinite where the limit is 0 and it is more."""
    if not finding.holds:
        return (
            math.inf
            if finding.limit <= 0 or math.isnan(finding.worst)
            else finding.worst / finding.limit
        )
    return max(finding.worst, 0.0) / finding.limit if finding.limit > 0 else 0.0


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """What was found of one case.

    under: names of its settings that were tried. findings: of all of them, each with its settings in `under`. errors: one line for each
    setting under which the case did not come to an end.
    """

    name: str
    group: str
    about: str
    under: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    errors: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether everything was measured and keeps its limit."""
        return not self.errors and all(finding.holds for finding in self.findings)

    @property
    def worst(self) -> Finding | None:
        """The finding nearest to its limit, or farthest beyond it."""
        return max(self.findings, key=relative, default=None)

    @property
    def failures(self) -> list[str]:
        """A line for each thing that is wrong."""
        broken = [one for one in self.findings if not one.holds]
        return [
            *self.errors,
            *(
                f"{one.under}: {one.name} is {one.worst:.6g} {one.unit}, at most {one.limit:.6g}"
                for one in broken
            ),
        ]

    def to_dict(self) -> dict[str, Any]:
        """JSON values; a figure that is not finite is text."""
        return {
            "name": self.name,
            "group": self.group,
            "about": self.about,
            "under": list(self.under),
            "holds": self.holds,
            "findings": [_finding_dict(finding) for finding in self.findings],
            "errors": list(self.errors),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> CaseResult:
        """From `to_dict`'s values."""
        findings = tuple(
            Finding(
                name=one["name"],
                worst=float(one["worst"]),
                limit=float(one["limit"]),
                unit=one["unit"],
                under=one["under"],
            )
            for one in values["findings"]
        )
        plain = {name: values[name] for name in ("name", "group", "about")}
        return cls(
            **plain, under=tuple(values["under"]), findings=findings, errors=tuple(values["errors"])
        )


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The results of many cases, in the order of the catalogue."""

    results: Sequence[CaseResult]

    @property
    def holds(self) -> bool:
        """Whether every case does."""
        return all(result.holds for result in self.results)

    @property
    def groups(self) -> dict[str, list[CaseResult]]:
        """The results by group."""
        found: dict[str, list[CaseResult]] = {}
        for result in self.results:
            found.setdefault(result.group, []).append(result)
        return found

    @property
    def failures(self) -> list[str]:
        """A line for each thing that is wrong, beginning with the case."""
        return [f"{result.name}: {line}" for result in self.results for line in result.failures]

    def worst(self) -> dict[str, tuple[CaseResult, Finding]]:
        """Of each property, by name, the finding nearest to its limit and its case."""
        found: dict[str, tuple[CaseResult, Finding]] = {}
        for result in self.results:
            for finding in result.findings:
                if finding.name not in found or relative(finding) > relative(
                    found[finding.name][1]
                ):
                    found[finding.name] = result, finding
        return found

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return {
            "holds": self.holds,
            "cases": [result.to_dict() for result in self.results],
            "failures": self.failures,
        }


def _finding_dict(finding: Finding) -> dict[str, Any]:
    figures = {
        name: value if math.isfinite(value) else str(value)
        for name, value in (("worst", finding.worst), ("limit", finding.limit))
    }
    return {
        "name": finding.name,
        **figures,
        "unit": finding.unit,
        "under": finding.under,
        "holds": finding.holds,
    }
