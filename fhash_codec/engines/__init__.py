"""Engines: how the network is trained and evaluated; same results, different speed."""
