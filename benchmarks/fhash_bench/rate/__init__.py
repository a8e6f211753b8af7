"""Bytes, speed and access beside other codecs. May import fhash_codec.cost.peer_codecs."""

from __future__ import annotations
