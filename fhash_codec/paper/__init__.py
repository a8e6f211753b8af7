"""The paper profile: the published F-Hash."""
