"""The paper profile's tables through the coder of the profile compact: `--tables transform`."""
