"""Encodings of the F-Hash paper's evaluation, trained side by side, and answers to its claims."""

from __future__ import annotations
