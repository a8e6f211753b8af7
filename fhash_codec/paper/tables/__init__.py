"""The paper profile's tables through the coder of the compact profile: `--tables transform`."""
