"""The shell beside other renderers."""

from __future__ import annotations

import pytest

from fhash_codec.bench.pictures import beside_shell as module
from fhash_codec.bench.pictures import orbit
from fhash_codec.bench.pictures.beside_shell import beside_shell
from fhash_formats.errors import MissingDependencyError


def test_vtk_draws_the_shell_unlit_and_lit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orbit, "SIDE", 24)
    found = beside_shell(1, 24)
    assert [(pair.scene, pair.shaded) for pair in found] == [
        ("shell of 24^3", False),
        ("shell of 24^3", True),
    ]
    for pair in found:
        assert pair.peer.startswith("VTK 9")
        assert pair.ours_ms > 0
        assert pair.peer_ms >= 0
        assert pair.ratio == pair.peer_ms / pair.ours_ms
        assert pair.psnr is None or pair.psnr > 20


def test_without_any_peer_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise MissingDependencyError("comparing with VTK needs it: pip install 'fhash[bench]'")

    monkeypatch.setattr(module, "require_vtk", missing)
    with pytest.raises(MissingDependencyError, match="pip install"):
        beside_shell(1, 16)
