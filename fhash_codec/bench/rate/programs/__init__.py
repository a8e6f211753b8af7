"""Peers that are programs of their own, which the user names: one file for each kind."""
