"""The encodings that `fhash cost` tries, the most telling first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fhash_codec.config import EncodeConfig

__all__ = ["EPOCHS", "PEERS", "Wish", "paper_config", "wishes"]

PEERS = ("SZ3", "SPERR", "ZFP")
"""Peers that are measured where their package is there."""
EPOCHS = (2, 3, 5, 10, 20, 50)
"""Epochs of the profile paper, of which the largest number that fits is trained after a first."""


@dataclass(frozen=True, kw_only=True)
class Wish:
    """An encoding to be measured.

    Attributes:
        codec: "compact", "paper" or a peer.
        group: the curve that it belongs to.
        config: settings; None for a peer, and for "paper", whose epochs follow from the time.
        target: PSNR in dB that a peer is set to.
    """

    codec: str
    group: str
    config: EncodeConfig | None = None
    target: float = 0.0

    @property
    def options(self) -> str:
        """Options of `fhash encode` that give the encoding; empty for a peer and the defaults."""
        if self.config is None:
            return ""
        default = EncodeConfig()
        return " ".join(
            f"--{name.replace('_', '-')} {value:g}"
            if isinstance(value, float)
            else f"--{name.replace('_', '-')} {value}"
            for name, value in vars(self.config).items()
            if value != getattr(default, name)
        )

    @property
    def name(self) -> str:
        """The encoding in words."""
        if self.config is None:
            return f"{self.codec}, {self.target:g} dB" if self.target else self.codec
        if self.codec == "paper":
            count = self.config.epochs
            return f"paper, {count} epoch" + ("s" if count > 1 else "")
        promise = next(
            (
                text
                for value, text in (
                    (self.config.psnr, f"{self.config.psnr or 0:g} dB"),
                    (
                        self.config.max_error_rel,
                        f"error within {100 * (self.config.max_error_rel or 0):g} %",
                    ),
                )
                if value is not None
            ),
            "the default promise",
        )
        return f"{self.group}, {promise}"


def wishes() -> Iterator[Wish]:
    """Every encoding, in the order in which they are measured."""
    yield _psnr(1, 50)
    yield from _peers(50)
    yield _psnr(3, 50)
    yield Wish(codec="compact", group="compact, effort 5", config=EncodeConfig())
    yield Wish(codec="paper", group="paper")
    # Peers take several times the time that is shown for them, since each is led to its target.
    for effort in (1, 3):
        for target in (40, 60):
            yield _psnr(effort, target)
    for target in (40, 60):
        yield from _peers(target)
    for target in (45, 70):
        yield _psnr(1, target)
        yield from _peers(target)
        yield _psnr(3, target)
    for target in (40, 60):
        yield _psnr(5, target)
    for share in (0.01, 0.001):
        yield Wish(
            codec="compact",
            group="compact, effort 3",
            config=EncodeConfig(effort=3, max_error_rel=share),
        )
    yield _psnr(2, 50)
    yield _psnr(5, 45)
    yield _psnr(7, 50)
    yield _psnr(9, 50)


def paper_config(epochs: int) -> EncodeConfig:
    """Settings of the published model, trained for some epochs."""
    return EncodeConfig(profile="paper", epochs=epochs)


def _psnr(effort: int, target: float) -> Wish:
    return Wish(
        codec="compact",
        group=f"compact, effort {effort}",
        config=EncodeConfig(effort=effort, psnr=float(target)),
    )


def _peers(target: float) -> Iterator[Wish]:
    for name in PEERS:
        yield Wish(codec=name, group=name, target=float(target))
