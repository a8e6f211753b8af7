"""The encodings that are tried: their order, names and options."""

from __future__ import annotations

from fhash_codec.config import EncodeConfig
from fhash_codec.cost.plan import PEERS, Wish, paper_config, wishes


def test_the_default_and_the_peers_come_early_and_every_name_once() -> None:
    every = list(wishes())
    assert EncodeConfig() in [wish.config for wish in every[:6]]
    assert [wish.codec for wish in every[1:4]] == list(PEERS)
    names = [wish.name for wish in every]
    assert len(names) == len(set(names))
    assert {wish.codec for wish in every} == {"compact", "paper", *PEERS}


def test_options_give_the_encoding_again() -> None:
    config = EncodeConfig(effort=3, psnr=45.0)
    wish = Wish(codec="compact", group="compact, effort 3", config=config)
    assert wish.options == "--psnr 45 --effort 3"
    assert wish.name == "compact, effort 3, 45 dB"
    assert Wish(codec="compact", group="g", config=EncodeConfig()).options == ""
    paper = Wish(codec="paper", group="paper", config=paper_config(1))
    assert (paper.name, paper.options) == ("paper, 1 epoch", "--profile paper --epochs 1")
