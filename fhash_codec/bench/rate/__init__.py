"""Bytes and speed beside other codecs."""
