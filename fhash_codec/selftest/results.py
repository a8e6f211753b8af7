"""The results of cases, as records and JSON values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fhash_codec.selftest.case import Finding

__all__ = ["CaseResult", "Summary", "relative"]


def relative(finding: Finding) -> float:
    """The figure as a multiple of its limit: above 1 if the property does not hold.

    Infinite if the figure is NaN, or positive with a limit of 0.
    """
    if not finding.holds:
        return (
            math.inf
            if finding.limit <= 0 or math.isnan(finding.worst)
            else finding.worst / finding.limit
        )
    return max(finding.worst, 0.0) / finding.limit if finding.limit > 0 else 0.0


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """The results of one case.

    Attributes:
        name: name of the case.
        group: its group.
        about: one line that says what is hard.
        under: names of the settings that were tried.
        findings: the findings under all settings, each with the name of its settings in `under`.
        errors: one line for each error that kept the case, or a check of it, from finishing.
        left_out: names of settings that were not tried, since they need torch.
    """

    name: str
    group: str
    about: str
    under: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    errors: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether there was no error and all figures are within their limits."""
        return not self.errors and all(finding.holds for finding in self.findings)

    @property
    def worst(self) -> Finding | None:
        """The finding nearest to its limit, or farthest beyond it."""
        return max(self.findings, key=relative, default=None)

    @property
    def failures(self) -> list[str]:
        """One line for each error and for each property that does not hold."""
        broken = [finding for finding in self.findings if not finding.holds]
        return [
            *self.errors,
            *(
                f"{finding.under}: {finding.name} is {finding.worst:.6g} {finding.unit}, "
                f"at most {finding.limit:.6g}"
                for finding in broken
            ),
        ]

    def to_dict(self) -> dict[str, Any]:
        """JSON values; figures that are not finite become text."""
        return {
            "name": self.name,
            "group": self.group,
            "about": self.about,
            "under": list(self.under),
            "holds": self.holds,
            "findings": [_finding_dict(finding) for finding in self.findings],
            "errors": list(self.errors),
            "left_out": list(self.left_out),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> CaseResult:
        """The result with the values that `to_dict` returned."""
        findings = tuple(
            Finding(
                name=values_of_finding["name"],
                worst=float(values_of_finding["worst"]),
                limit=float(values_of_finding["limit"]),
                unit=values_of_finding["unit"],
                under=values_of_finding["under"],
            )
            for values_of_finding in values["findings"]
        )
        plain = {name: values[name] for name in ("name", "group", "about")}
        return cls(
            **plain,
            under=tuple(values["under"]),
            findings=findings,
            errors=tuple(values["errors"]),
            left_out=tuple(values["left_out"]),
        )


@dataclass(frozen=True, kw_only=True)
class Summary:
    """The results of many cases, in the order of the catalogue."""

    results: Sequence[CaseResult]

    @property
    def holds(self) -> bool:
        """Whether every case holds."""
        return all(result.holds for result in self.results)

    @property
    def groups(self) -> dict[str, list[CaseResult]]:
        """The results by group."""
        groups: dict[str, list[CaseResult]] = {}
        for result in self.results:
            groups.setdefault(result.group, []).append(result)
        return groups

    @property
    def failures(self) -> list[str]:
        """One line for each failure, beginning with the name of the case."""
        return [f"{result.name}: {line}" for result in self.results for line in result.failures]

    @property
    def left_out(self) -> int:
        """The number of settings that were not tried, since they need torch."""
        return sum(len(result.left_out) for result in self.results)

    def worst(self) -> dict[str, tuple[CaseResult, Finding]]:
        """The finding nearest to its limit for each property, by name, with its case."""
        worst: dict[str, tuple[CaseResult, Finding]] = {}
        for result in self.results:
            for finding in result.findings:
                previous = worst.get(finding.name)
                if previous is None or relative(finding) > relative(previous[1]):
                    worst[finding.name] = result, finding
        return worst

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
